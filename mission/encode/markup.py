"""XML in and out: a tree of tuples written as text, and a reader that trusts nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias, cast
from xml.sax.saxutils import escape

from defusedxml.common import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import ParseError, fromstring  # type: ignore[import-untyped]

from calib.errors import FormatError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

#: Tag with attributes, if any, and its text, its number or its children.
Node: TypeAlias = "tuple[str, str | int | float | Sequence[Node]]"


def document(root: Node) -> str:
    """The XML text, indented by two."""
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + "\n".join(_lines(root, "")) + "\n"


def _lines(node: Node, indent: str) -> list[str]:
    tag, content = node
    name = tag.split(" ", 1)[0]
    if isinstance(content, str | int | float):
        text = content if isinstance(content, str) else decimal(content)
        return [f"{indent}<{tag}>{escape(_printable(text))}</{name}>"]
    inner = [line for child in content for line in _lines(child, indent + "  ")]
    return [f"{indent}<{tag}>", *inner, f"{indent}</{name}>"]


def decimal(value: float, digits: int = 4) -> str:
    """Without exponent, without trailing zeros, never -0."""
    text = f"{value:.{digits}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if text == "-0" else text


def _printable(text: str) -> str:
    """Without the control characters that XML 1.0 has no way to write."""
    return "".join(c for c in text if c in "\t\n\r" or (c >= " " and not "\ud800" <= c <= "\udfff"))


def parse(data: bytes, what: str) -> Element:
    """The root element; document types, entities and external references are refused.

    Raises:
        FormatError: not well-formed, or not to be trusted.
    """
    try:
        return cast("Element", fromstring(data, forbid_dtd=True))
    except DefusedXmlException as error:
        raise FormatError(
            f"{what} holds a document type or entity definitions, which no mission needs and which can harm "
            "the reader: it is not read."
        ) from error
    except (ParseError, ValueError, LookupError, RecursionError) as error:
        raise FormatError(f"{what} is not well-formed XML ({error}): export it again.") from error


def local(element: Element) -> str:
    """Tag without its namespace."""
    return element.tag.rsplit("}", 1)[-1] if isinstance(element.tag, str) else ""


def child(element: Element, *path: str) -> Element | None:
    """First element along a path of local names."""
    found: Element | None = element
    for name in path:
        found = next((c for c in found if local(c) == name), None) if found is not None else None
    return found


def children(element: Element, name: str) -> list[Element]:
    return [c for c in element if local(c) == name]


def text_of(element: Element, *path: str) -> str | None:
    """Text at a path of local names without blanks around it; None where there is none."""
    found = child(element, *path)
    return None if found is None or found.text is None else found.text.strip()
