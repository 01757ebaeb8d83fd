"""The one door to the web: a page for one browser on this machine, behind a token in its address.

Only the loopback address is listened on. A request is answered only if its path begins with the token and it
was sent to this very address by name (a foreign page that has its own name point here is refused), and what
changes something only if it comes from the page itself. Everything else gets 403 and no word more.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import re
import secrets
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any

from calib.errors import FieldcalError, InputError

#: No request of a page of ours is larger.
_LARGEST_BODY = 65_536
_DIGITS = re.compile(r"[0-9]{1,9}")
_TIMEOUT_S = 60.0
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True)
class Reply:
    """What a request gets. ``lasting``: the browser may keep it as long as this token lives.

    ``afterwards`` is called once it has been sent.
    """

    body: bytes
    kind: str
    status: int = 200
    lasting: bool = False
    afterwards: Callable[[], None] | None = None

    @classmethod
    def of_json(cls, data: object, status: int = 200) -> Reply:
        text = json.dumps(data, ensure_ascii=False, allow_nan=False)
        return cls(text.encode("utf-8"), "application/json; charset=utf-8", status)


#: From the parts of the path behind the token, and the body of a POST (None: a GET). None: no such thing.
Answer = Callable[[tuple[str, ...], bytes | None], Reply | None]


@contextlib.contextmanager
def served(answer: Answer, port: int = 0) -> Iterator[str]:
    """Answer requests in threads of their own; yields the address to open, token and all.

    ``answer`` is called from several threads at once. A ``FieldcalError`` of it is told to the page.

    Raises:
        InputError: the port is taken.
    """
    token = secrets.token_urlsafe(24)
    try:
        server = _Server(port, token, answer)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(
            f"Port {port} cannot be used ({reason}): leave --port away or name another."
        ) from error
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        yield f"http://{server.host}/{token}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    #: A browser that still holds connections open does not keep the program from ending.
    block_on_close = False

    def __init__(self, port: int, token: str, answer: Answer) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.host = f"127.0.0.1:{self.server_port}"
        self.names = {self.host, f"localhost:{self.server_port}"}
        self.token = token
        self.answer = answer

    def server_bind(self) -> None:
        # The library's own asks the network for this machine's name, which takes its time in the field.
        TCPServer.server_bind(self)
        self.server_name, self.server_port = "127.0.0.1", int(self.socket.getsockname()[1])

    def handle_error(self, request: Any, client_address: Any) -> None:
        # A browser that goes away, or no longer wants a picture, is no fault.
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = _TIMEOUT_S
    server: _Server

    def do_GET(self) -> None:
        if "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self._refuse()
        else:
            self._reply(None)

    def do_POST(self) -> None:
        size = self.headers.get("Content-Length", "")
        if not self._allowed() or not self._from_page() or _DIGITS.fullmatch(size) is None:
            self._refuse()
        elif int(size) > _LARGEST_BODY:
            self._send(Reply(b"Too large.", "text/plain", 413), close=True)
        else:
            self._reply(self.rfile.read(int(size)))

    def version_string(self) -> str:
        return "fieldcal"

    def log_message(self, format: str, *args: Any) -> None:
        """The terminal is for the user."""

    def _allowed(self) -> bool:
        named = self.headers.get_all("Host", [])
        token = self.path.split("/")[1] if self.path.startswith("/") else ""
        known = hmac.compare_digest(token.encode("utf-8", "replace"), self.server.token.encode())
        return known and len(named) == 1 and named[0] in self.server.names

    def _from_page(self) -> bool:
        origin = self.headers.get("Origin")
        return origin is None or origin.removeprefix("http://") in self.server.names

    def _reply(self, body: bytes | None) -> None:
        if not self._allowed():
            self._refuse()
            return
        parts = tuple(self.path.partition("?")[0].split("/")[2:])
        try:
            made = self.server.answer(parts, body)
        except FieldcalError as error:
            made = Reply.of_json({"error": str(error)}, 422)
        self._send(made or Reply(b"Not found.", "text/plain", 404))

    def _refuse(self) -> None:
        self._send(Reply(b"Forbidden.", "text/plain", 403), close=True)

    def _send(self, reply: Reply, close: bool = False) -> None:
        self.send_response(reply.status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", reply.kind)
        self.send_header("Content-Length", str(len(reply.body)))
        self.send_header("Cache-Control", "private, max-age=86400" if reply.lasting else "no-store")
        if close:  # What is still unread of the request must not pass for the next one.
            self.send_header("Connection", "close")
            self.close_connection = True
        self.end_headers()
        self.wfile.write(reply.body)
        if reply.afterwards is not None:
            reply.afterwards()
