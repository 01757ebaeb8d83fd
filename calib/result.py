"""Everything a check found out, in one value: what report, exports and JSON are made from."""

from __future__ import annotations

from dataclasses import dataclass, field

from calib.extra_pass import ExtraPass
from calib.findings import Finding, Verdict
from calib.flown import FlownNetwork
from calib.photos.photo import CameraIdentity, LeftOut
from calib.reference import EquifinalLine, Reference
from calib.solution import Dome, Estimate, Network, Solution


@dataclass(frozen=True)
class Timing:
    wall_s: float
    cpu_s: float
    photos_per_s: float


@dataclass(frozen=True)
class CheckResult:
    """The outcome of ``fieldcal check``.

    ``reference_note`` says why a candidate reference was not used, or how it was converted.
    ``line`` is the equifinal line that the survey was held against (None: no reference).
    ``what_to_fly`` is one paragraph for the pilot (None for TRUST). ``flown``: what more photos are
    planned from. ``extra_pass``: the one that was found among the photos.
    """

    verdict: Verdict
    headline: str
    findings: tuple[Finding, ...]
    camera: CameraIdentity
    solution: Solution
    estimate: Estimate
    network: Network
    dome: Dome
    reference: Reference | None
    reference_note: str
    line: EquifinalLine | None
    what_to_fly: str | None
    left_out: tuple[LeftOut, ...]
    timing: Timing
    exports: dict[str, str] = field(default_factory=dict)
    flown: FlownNetwork | None = None
    extra_pass: ExtraPass | None = None
