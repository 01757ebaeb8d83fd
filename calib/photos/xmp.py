"""XMP packets -> flat dictionary.

Makers' packets are often not valid XML (undeclared prefixes, bare ampersands, cut off), so the
packet is read as a stream without namespace processing, and what was read before an error counts.
Expat through defusedxml: no entities, no external references.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from xml.sax import SAXException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl

from defusedxml.common import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.sax import parseString  # type: ignore[import-untyped]

_SCAFFOLD = ("rdf:", "x:", "xmlns", "xml:")
_ATTRIBUTE = re.compile(r"""([A-Za-z][\w-]*:[\w.-]+)\s*=\s*(?:"([^"<]*)"|'([^'<]*)')""")
_ELEMENT = re.compile(r"<([A-Za-z][\w-]*:[\w.-]+)\s*>([^<]*)</\1\s*>")


class _Collector(ContentHandler):
    """Attributes and element texts as ``prefix:name``, nested ones as ``prefix:outer/inner``."""

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, str] = {}
        self._names: list[str] = []
        self._texts: list[str] = []

    def _key(self, name: str) -> str:
        outer = next((n for n in reversed(self._names) if not n.startswith(_SCAFFOLD)), None)
        return name if outer is None else f"{outer}/{name.rpartition(':')[2]}"

    def _put(self, key: str, value: str) -> None:
        value = value.strip()
        if not value:
            return
        self.values.setdefault(key, value)

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        name = name.lower()
        self._names.append(name if name.startswith(_SCAFFOLD) else self._key(name))
        self._texts.append("")
        for attribute, value in attrs.items():
            if not attribute.lower().startswith(_SCAFFOLD):
                self._put(self._key(attribute.lower()), value)

    def characters(self, content: str) -> None:
        if self._texts:
            self._texts[-1] += content

    def endElement(self, name: str) -> None:  # noqa: ARG002
        key, text = self._names.pop(), self._texts.pop()
        if key == "rdf:li":
            # A sequence's members belong to the property that holds them.
            outer = next((i for i in reversed(range(len(self._names))) if self._names[i][:4] != "rdf:"), None)
            if outer is not None:
                self._texts[outer] = ",".join(t for t in (self._texts[outer].strip(), text.strip()) if t)
        elif not key.startswith(_SCAFFOLD):
            self._put(key, text)


def parse_packet(packet: bytes) -> dict[str, str]:
    """XMP packet -> {"drone-dji:gimbalpitchdegree": "-90.00", ...}; keys in lower case.

    Attributes and elements come out alike; members of structures as ``prefix:outer/inner``,
    sequences joined by commas. Broken packets give what can be read of them, never an error.
    """
    collector = _Collector()
    body = packet.strip(b"\x00 \r\n\t")
    try:
        parseString(body, collector)
    except (SAXException, DefusedXmlException, UnicodeError, ValueError, LookupError):
        text = body.decode("utf-8", "replace")
        for match in _ATTRIBUTE.finditer(text):
            _add(collector.values, match[1], match[2] or match[3] or "")
        for match in _ELEMENT.finditer(text):
            _add(collector.values, match[1], match[2])
    return collector.values


def _add(values: dict[str, str], name: str, value: str) -> None:
    name = name.lower()
    if value.strip() and not name.startswith(_SCAFFOLD):
        values.setdefault(name, value.strip())


def number(values: Mapping[str, str], *keys: str) -> float | None:
    """First of ``keys`` that holds a finite number ("+12.3", "123/10", "12.3 m"); None otherwise."""
    for key in keys:
        value = as_number(values.get(key))
        if value is not None:
            return value
    return None


_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?:\s*/\s*([+-]?\d+\.?\d*))?")


def as_number(text: str | None) -> float | None:
    """Leading number or fraction of a text; None where there is none or its denominator is 0."""
    match = _NUMBER.match(text or "")
    if match is None:
        return None
    value, below = float(match[1]), float(match[2] or 1)
    if below == 0 or abs(value) > 1e300:
        return None
    return value / below


def numbers(text: str | None) -> list[float]:
    """All numbers of a comma or semicolon separated text; empty where any member is none."""
    members = [as_number(part) for part in re.split(r"[,;\s]+", (text or "").strip()) if part]
    return [] if None in members else [m for m in members if m is not None]
