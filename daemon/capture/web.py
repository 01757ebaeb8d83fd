"""Files of a camera or companion over HTTP, from the local net only."""

from __future__ import annotations

import http.client
import ipaddress
import re
import socket
from collections.abc import Iterator
from urllib.parse import SplitResult, urlsplit

from daemon.remote import MOST_BYTES, CutError, RefusedError

SCHEMES = ("http", "https")
_WAIT_S = 10.0
_BLOCK_BYTES = 128 * 1024
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+)")


def read_web(url: str, start_byte: int) -> Iterator[bytes | None]:
    """The file from ``start_byte`` on, in blocks; None first where it comes from its beginning instead.

    Raises:
        RefusedError: no such file, too large, or not on the local net. CutError: nobody answers.
    """
    parts = urlsplit(url)
    connection = _connection(parts)
    try:
        path = parts.path or "/"
        connection.request(
            "GET",
            f"{path}?{parts.query}" if parts.query else path,
            headers={"Host": parts.netloc.rpartition("@")[2], "Range": f"bytes={start_byte}-"},
        )
        answer = connection.getresponse()
        if start_byte and answer.status == 416:
            # Nothing after it: all is here, or the file is another one.
            if answer.getheader("Content-Range") == f"bytes */{start_byte}":
                return
            yield None
            raise CutError("the file has changed")
        if start_byte and answer.status == 200:
            yield None
            start_byte = 0
        elif answer.status not in (200, 206):
            raise RefusedError(f"it answers {answer.status} {answer.reason}".rstrip())
        yield from _content(answer, start_byte)
    except (OSError, http.client.HTTPException, ValueError) as error:
        if isinstance(error, ValueError):
            raise RefusedError(f"the address cannot be used ({error})") from error
        raise CutError(f"{parts.hostname} does not answer ({_reason(error)})") from error
    finally:
        connection.close()


def _content(answer: http.client.HTTPResponse, start_byte: int) -> Iterator[bytes]:
    told = answer.getheader("Content-Length")
    size = start_byte + int(told) if told is not None and told.isdigit() else None
    place = start_byte
    if answer.status == 206:
        found = _RANGE.fullmatch(answer.getheader("Content-Range", ""))
        if found is None or int(found[1]) != start_byte:
            raise RefusedError("it sends another part than was asked for")
        size = int(found[2])
    if size is not None and size > MOST_BYTES:
        raise RefusedError(f"it has {size / 2**20:.0f} MB")
    while block := answer.read1(_BLOCK_BYTES):
        place += len(block)
        if place > MOST_BYTES:
            raise RefusedError(f"it has more than {MOST_BYTES // 2**20} MB")
        yield block
    if size is not None and place < size:
        raise CutError("the connection was cut")


def _connection(parts: SplitResult) -> http.client.HTTPConnection:
    """To an address that is checked first and then used: a name may mean another place the next time."""
    try:
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise RefusedError(f"the address cannot be used ({error})") from error
    if not host:
        raise RefusedError("the address names no host")
    secure = parts.scheme.lower() == "https"
    number = port or (443 if secure else 80)
    try:
        found = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise CutError(f"no host is named {host}") from error
    place = str(found[0][4][0])
    at = ipaddress.ip_address(place.partition("%")[0])
    if not (at.is_private or at.is_loopback or at.is_link_local):
        raise RefusedError(f"{host} is not on the local net")
    if secure:
        return http.client.HTTPSConnection(host, number, timeout=_WAIT_S)
    return http.client.HTTPConnection(place, number, timeout=_WAIT_S)


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error) or type(error).__name__).lower()
