"""Small figures as SVG text: stacked bars, points with a diagonal, a histogram with a curve."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

_STYLE = (
    "text{font:12px sans-serif;fill:#222}"
    ".axis{stroke:#444;stroke-width:1;fill:none}"
    ".light{stroke:#ccc;fill:none}"
)


def _svg(width: int, height: int, body: Sequence[str]) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">'
    return "\n".join(
        [
            head,
            f"<style>{_STYLE}</style>",
            '<rect width="100%" height="100%" fill="#fff"/>',
            *body,
            "</svg>",
            "",
        ]
    )


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def stacked_bars(
    title: str, rows: Sequence[tuple[str, Sequence[float]]], series: Sequence[tuple[str, str]]
) -> str:
    """Horizontal bars of shares that add up to 100 %.

    Args:
        rows: label and one value a series; scaled to their sum.
        series: name and colour.
    """
    left, wide, high = 190, 480, 22
    height = 64 + high * len(rows) + 10
    body = [_text(10, 20, title)]
    x = float(left)
    for name, colour in series:
        body += [
            f'<rect x="{x:.1f}" y="34" width="12" height="12" fill="{colour}"/>',
            _text(x + 17, 45, name),
        ]
        x += 30 + 7.5 * len(name)
    for index, (label, values) in enumerate(rows):
        y, x, total = 58 + high * index, float(left), max(sum(values), 1e-12)
        body.append(_text(left - 8, y + 14, label, "end"))
        for value, (_, colour) in zip(values, series, strict=True):
            share = value / total
            body.append(
                f'<rect x="{x:.1f}" y="{y}" width="{wide * share:.1f}" height="{high - 4}" fill="{colour}"/>'
            )
            if share > 0.08:
                body.append(_text(x + wide * share / 2, y + 14, f"{100 * share:.0f} %", "middle"))
            x += wide * share
    return _svg(left + wide + 20, height, body)


def _axes(
    title: str,
    labels: tuple[str, str],
    ticks_x: Sequence[tuple[float, str]],
    ticks_y: Sequence[tuple[float, str]],
) -> list[str]:
    """Frame of a 400 x 320 plot at (70, 40); ticks at 0..1 of an axis."""
    body = [_text(10, 20, title), '<rect class="axis" x="70" y="40" width="400" height="320"/>']
    for at, text in ticks_x:
        body += [
            f'<path class="light" d="M{70 + 400 * at:.1f} 40v320"/>',
            _text(70 + 400 * at, 376, text, "middle"),
        ]
    for at, text in ticks_y:
        body += [
            f'<path class="light" d="M70 {360 - 320 * at:.1f}h400"/>',
            _text(64, 364 - 320 * at, text, "end"),
        ]
    turned = (
        f'<text transform="translate(16 200) rotate(-90)" text-anchor="middle">{escape(labels[1])}</text>'
    )
    return [*body, _text(270, 396, labels[0], "middle"), turned]


def scatter(
    title: str, labels: tuple[str, str], points: Sequence[tuple[float, float]], reach: float, colour: str
) -> str:
    """Points within +-``reach`` (those beyond lie on the border), and the line of equality."""
    ticks = [((i + 2) / 4, f"{i / 2 * reach:g}") for i in range(-2, 3)]
    body = _axes(title, labels, ticks, ticks)
    body.append('<path class="axis" d="M70 360L470 40"/>')
    for x, y in points:
        u, v = ((min(max(value, -reach), reach) + reach) / (2 * reach) for value in (x, y))
        body.append(
            f'<circle cx="{70 + 400 * u:.1f}" cy="{360 - 320 * v:.1f}" r="2.5" fill="{colour}" '
            'opacity="0.6"/>'
        )
    return _svg(500, 410, body)


def histogram(
    title: str,
    label: str,
    values: Sequence[float],
    reach: float,
    curve: Callable[[float], float],
    colour: str,
) -> str:
    """Density of ``values`` over +-``reach`` (those beyond count at the border) against a density."""
    bins = 30
    width = 2 * reach / bins
    counts = [0] * bins
    for value in values:
        counts[min(max(int((value + reach) / width), 0), bins - 1)] += 1
    density = [count / max(len(values), 1) / width for count in counts]
    steps = [-reach + i * reach / 60 for i in range(121)]
    top = 1.1 * max(*density, *(curve(t) for t in steps))
    ticks = [((i + 2) / 4, f"{i / 2 * reach:g}") for i in range(-2, 3)]
    body = _axes(title, (label, "density"), ticks, [(0.0, "0")])
    for i, value in enumerate(density):
        h = 320 * value / top
        body.append(
            f'<rect x="{70 + 400 * i / bins:.1f}" y="{360 - h:.1f}" width="{400 / bins - 1:.1f}" '
            f'height="{h:.1f}" fill="{colour}"/>'
        )
    path = " ".join(
        f"{70 + 400 * (t + reach) / (2 * reach):.1f},{360 - 320 * curve(t) / top:.1f}" for t in steps
    )
    body.append(f'<polyline class="axis" points="{path}"/>')
    return _svg(500, 410, body)
