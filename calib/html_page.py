"""The frame of every HTML file: one file that needs nothing but a browser.

Everything is inside: styles, plotly's browser library and the figures' data. The content
security policy in its head forbids every request to anywhere and every script but the two
written here, so that nothing in a photo's metadata can run or call out.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable
from importlib import resources

from plotly.offline import get_plotlyjs

from calib.wording import html_text, with_bound_units

#: Drawn signs, because fonts differ in what they have.
TICK = '<path d="M6 12.5l4 4 8-9"/>'
CROSS = '<path d="M7.5 7.5l9 9M16.5 7.5l-9 9"/>'


def html_page(title: str, body: str, extra_css: str = "") -> str:
    """The whole file. ``title`` is plain text, ``body`` is HTML."""
    library = get_plotlyjs().replace("</script", "<\\/script")
    start = _bundled("report.js")
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; "
        f"script-src {_script_hash(library)} {_script_hash(start)}; base-uri 'none'; form-action 'none'"
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html_text(title)} - fieldcal</title>
<style>{_bundled("report.css")}{extra_css}</style>
</head>
<body>
{body}
<script>{library}</script>
<script>{start}</script>
</body>
</html>
"""


def drawn_sign(drawing: str) -> str:
    """An SVG drawing inside a circle."""
    return (
        '<svg viewBox="0 0 24 24" aria-hidden="true" focusable="false" fill="none" stroke="currentColor" '
        'stroke-width="2.6" stroke-linecap="round" stroke-linejoin="round">'
        f'<circle cx="12" cy="12" r="10.4"/>{drawing}</svg>'
    )


def sentence(text: str) -> str:
    """Plain text as HTML, numbers bound to their units."""
    return with_bound_units(html_text(text))


def facts_section(
    name: str, heading: str, rows: Iterable[tuple[str, str]], as_html: Callable[[str], str] = html_text
) -> str:
    """A section of facts by name. ``name``: of the section in the file; ``as_html``: how a fact is put."""
    items = "".join(f"<dt>{html_text(key)}</dt><dd>{as_html(value)}</dd>" for key, value in rows)
    return f'<section aria-labelledby="{name}"><h2 id="{name}">{heading}</h2><dl>{items}</dl></section>'


def table_section(title: str, caption: str, heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A section that is a table; the first cell of every row is its head."""
    head = "".join(f'<th scope="col">{html_text(text)}</th>' for text in heads)
    body = "".join(
        f'<tr><th scope="row">{html_text(row[0])}</th>'
        + "".join(f"<td>{html_text(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    return (
        f"<section><h2>{html_text(title)}</h2><table><caption>{sentence(caption)}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></section>"
    )


def _bundled(name: str) -> str:
    return resources.files("calib").joinpath("data", name).read_text(encoding="utf-8")


def _script_hash(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
