"""Words and numbers for people: shared by the HTML report, the figures and the terminal."""

from __future__ import annotations

import html
import math
import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from calib.camera import BrownCamera
from calib.findings import Finding, State, Verdict
from calib.photos.photo import CameraIdentity, LeftOut
from calib.solution import Solution


class WithLeftOut(Protocol):
    """A result that says which photos it was made from and which not."""

    @property
    def solution(self) -> Solution: ...
    @property
    def left_out(self) -> tuple[LeftOut, ...]: ...


#: Plain titles of the rules; a rule that is not listed is shown by its id.
RULE_TITLES = {
    "focal-drift": "Focal length against the reference",
    "equifinal-deviation": "Lens distortion against the reference",
    "equifinal-line": "K1 and K2 on the equifinal line",
    "opposite-signs": "K1 and K2 have opposite signs",
    "convergent-share": "Share of convergent photos",
    "predicted-dome": "Predicted dome or dish",
    "focal-sigma": "How well the focal length is known",
    "cross-validation": "Two halves of the tie points agree",
    "model-sensitivity": "Different lens models agree",
    "coverage": "Tie points cover the sensor",
    "alignment": "Alignment of the photos",
}
#: Of further rules where the lens is held.
HELD_TITLES = {
    "reference-fit": "The photos agree with the reference",
    "radial-residuals": "Residuals that point inwards or outwards",
    "position-dome": "Dome or dish against the measured positions",
}
#: The same for the rules of calibrating on site.
CALIBRATION_TITLES = {
    "wall-bend-along": "Bend of the wall along its length",
    "wall-twist": "Twist of the wall",
    "wall-bend-up": "Bend of the wall over its height",
    "wall-share": "Share of the picture that is wall",
    "wall-angles": "Views from both sides",
    "wall-overlap": "Overlap along the wall",
    "directions": "Views from all around",
    "photo-count": "Number of photos",
    "texture": "Texture",
}
VERDICT_WORDS = {Verdict.TRUST: "TRUST", Verdict.REFLY: "REFLY", Verdict.CANNOT_TELL: "CANNOT TELL"}
#: The order in which findings are told: what went wrong first.
STATE_ORDER = (State.FLAG, State.UNKNOWN, State.PASS)
#: Name, symbol and unit of every calibration parameter of the report, by its key in report.json.
PARAMETERS = {
    "f_px": ("Focal length f", "px"),
    "cx_px": ("Principal point cx", "px"),
    "cy_px": ("Principal point cy", "px"),
    "k1": ("Radial K1", ""),
    "k2": ("Radial K2", ""),
    "k3": ("Radial K3", ""),
    "k4": ("Radial K4", ""),
    "p1": ("Decentring P1", ""),
    "p2": ("Decentring P2", ""),
    "b1_px": ("Aspect b1", "px"),
    "b2_px": ("Skew b2", "px"),
    "k1_px": ("Radial K1, pixel units", "px⁻²"),
    "k2_px": ("Radial K2, pixel units", "px⁻⁴"),
    "k3_px": ("Radial K3, pixel units", "px⁻⁶"),
}
#: Anything smaller is zero to a reader; it keeps powers of ten within the floats.
_SMALLEST = 1e-290
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_BEFORE_UNIT = re.compile(r"(?<=\d) (?=(?:%|px|cm|mm|km|m|s|degrees|sigma|photos)(?!\w))")
NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"


def rule_title(rule: str) -> str:
    return (RULE_TITLES | HELD_TITLES | CALIBRATION_TITLES).get(rule, rule)


def printable(text: str) -> str:
    """``text`` without control characters and undecodable bytes, which files may smuggle in."""
    spaced = (" " if c.isspace() else c for c in text)
    return "".join("\ufffd" if unicodedata.category(c) in ("Cc", "Cs", "Cf") else c for c in spaced)


def html_text(text: str) -> str:
    """``text`` from anywhere, safe in HTML content, in quoted attributes and in plotly's labels."""
    return html.escape(printable(text))


def with_bound_units(text: str) -> str:
    """``text`` with a space that does not break between every number and its unit."""
    return _BEFORE_UNIT.sub(NO_BREAK_SPACE, text)


def unit_text(unit: str) -> str:
    """A finding's unit for people: px⁻² for px^-2, and the height's name for % H."""
    if unit == "% H":
        return "% of the height"
    return re.sub(r"\^(-?\d+)", lambda power: power[1].translate(_SUPERSCRIPTS), unit)


def path_text(path: Path) -> str:
    """A path that can be written as UTF-8, whatever bytes the file system holds."""
    return printable(os.fsencode(path).decode("utf-8", "replace"))


def camera_name(camera: CameraIdentity) -> str:
    return printable(camera.name) or "Unknown camera"


def power_of_ten(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def quantity(value: float | None, sigma: float | None = None, unit: str = "", digits: int = 4) -> str:
    """``value ± sigma unit``, with the digits that the sigma supports (two of its own).

    Without a usable sigma ``digits`` significant digits are shown; without a value "not measured".
    """
    if value is None or not math.isfinite(value):
        return "not measured"
    known = sigma is not None and math.isfinite(sigma) and sigma > _SMALLEST
    spread = sigma if sigma is not None and known else 0.0
    scale = max(abs(value), spread)
    exponent = math.floor(math.log10(scale)) if scale > _SMALLEST else 0
    shift = exponent if not -3 <= exponent < 6 else 0
    value, spread = value * 10.0**-shift, spread * 10.0**-shift
    smallest = spread if known else abs(value)
    decimals = (2 if known else digits) - 1 - math.floor(math.log10(smallest)) if smallest > _SMALLEST else 0
    decimals = min(max(decimals, 0), 9)
    text = _minus(f"{value:.{decimals}f}")
    if known:
        text += f" ± {spread:.{decimals}f}"
    elif "." in text:
        text = text.rstrip("0").rstrip(".")
    if shift:
        text = f"({text}) × {power_of_ten(shift)}" if known else f"{text} × {power_of_ten(shift)}"
    if unit.startswith("%"):
        return f"({text}) {unit}" if known and not shift else f"{text} {unit}"
    return f"{text} {unit}".strip()


def _minus(text: str) -> str:
    return text.replace("-", "−")


def finding_value(finding: Finding) -> str:
    return quantity(finding.value, finding.sigma, unit_text(finding.unit), 3)


def ordered_findings(findings: Iterable[Finding], state: State) -> list[Finding]:
    """Findings of one state, in the order in which the judge gave them."""
    return [finding for finding in findings if finding.state is state]


def all_left_out(result: WithLeftOut) -> list[LeftOut]:
    """Photos left out at the sorting and by the alignment, each once."""
    unique: dict[Path, LeftOut] = {}
    for item in (*result.left_out, *result.solution.left_out):
        unique.setdefault(item.path, item)
    return list(unique.values())


def left_out_by_reason(result: WithLeftOut) -> dict[str, list[Path]]:
    groups: dict[str, list[Path]] = {}
    for item in all_left_out(result):
        groups.setdefault(item.reason, []).append(item.path)
    return groups


def photos_given(result: WithLeftOut) -> int:
    """All photos that the user gave: aligned or left out, whatever the reason."""
    return max(len(result.solution.photos) + len(all_left_out(result)), result.solution.photos_used)


def parameter_values(brown: BrownCamera) -> dict[str, float]:
    """Values by the keys of ``PARAMETERS``."""
    return {key: float(getattr(brown, key)) for key in PARAMETERS}
