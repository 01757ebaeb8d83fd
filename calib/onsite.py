"""Calibrating on site: convergent photos of a flat wall, or any convergent flight, in; a reference out."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from datetime import date
from enum import StrEnum

from calib.align.child import Job, Outcome, run_job
from calib.align.engine import Progress, Settings
from calib.align.flatness import Flatness
from calib.check import cpu_s
from calib.equifinal import STRICT_TOLERANCE_PX, Radial, equifinal_region, image_radius_px
from calib.errors import AlignmentError, InputError
from calib.evidence import Evidence, gather_evidence
from calib.findings import Finding, State, Verdict
from calib.onsite_rules import CalibrationEvidence, orbit_findings, wall_findings
from calib.photos import LeftOut, Photo, Sorted, require_block
from calib.photos.photo import CameraIdentity
from calib.reference import EquifinalLine, Reference
from calib.references import reference_from_estimate
from calib.result import Timing
from calib.solution import Dome, Estimate, Network, Solution


class Kind(StrEnum):
    """What was photographed."""

    WALL = "wall"
    ORBIT = "orbit"


class Acceptance(StrEnum):
    """Whether a calibration may serve as a reference."""

    ACCEPTED = "ACCEPTED"
    RETAKE = "RETAKE"
    CANNOT_TELL = "CANNOT_TELL"

    @property
    def verdict(self) -> Verdict:
        """The verdict of a check that has the same colour, sign and exit code."""
        return {
            "ACCEPTED": Verdict.TRUST,
            "RETAKE": Verdict.REFLY,
            "CANNOT_TELL": Verdict.CANNOT_TELL,
        }[self.value]

    @property
    def words(self) -> str:
        return self.value.replace("_", " ")


#: Rules whose flags never cast out a calibration: what they ask for shows in the sigmas.
ADVICE = frozenset({"photo-count", "wall-overlap", "texture", "opposite-signs", "directions"})


@dataclass(frozen=True)
class Calibration:
    """The outcome of ``fieldcal calibrate wall`` or ``orbit``.

    ``line``: equifinal line, band and domain for models with this camera's K3, and ``line_no_k3`` for
    models without; None where K1 and K2 have the same sign. ``what_to_do``: the next photos to take
    (empty when accepted). ``flatness`` is None for an orbit.
    """

    kind: Kind
    acceptance: Acceptance
    headline: str
    findings: tuple[Finding, ...]
    what_to_do: tuple[str, ...]
    camera: CameraIdentity
    solution: Solution
    estimate: Estimate
    network: Network
    dome: Dome
    flatness: Flatness | None
    line: EquifinalLine | None
    line_no_k3: EquifinalLine | None
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]
    timing: Timing
    temperature_c: float | None = None


def calibrate_photos(
    photos: Sorted,
    kind: Kind,
    progress: Progress,
    settings: Settings | None = None,
    temperature_c: float | None = None,
) -> Calibration:
    """Align, self-calibrate and hold against the rules.

    Raises:
        FieldcalError: the photos cannot be used; one sentence.
    """
    require_block(photos)
    started, cpu = time.monotonic(), cpu_s()
    used = photos.used
    if kind is Kind.WALL:
        # Beside a wall receivers err by more than the wall is long, and nothing of it is needed.
        used = tuple(replace(photo, position=None, gimbal=None) for photo in used)
    job = Job(used, None, settings or Settings(), wall=kind is Kind.WALL)
    try:
        outcome = run_job(job, progress)
    except AlignmentError as error:
        if kind is Kind.ORBIT:
            raise
        raise AlignmentError(
            f"{error} A wall for calibration shows rough stones, bricks or old plaster all over, "
            "and neighbouring photos show four fifths of the same."
        ) from error
    wall_s = time.monotonic() - started
    timing = Timing(wall_s, cpu_s() - cpu, len(used) / max(wall_s, 1e-9))
    return concluded(outcome, kind, photos, timing, temperature_c)


def concluded(
    outcome: Outcome, kind: Kind, photos: Sorted, timing: Timing, temperature_c: float | None = None
) -> Calibration:
    """Hold what the alignment found against the rules of the kind.

    Raises:
        InputError: a wall was asked for and the alignment measured none.
    """
    solution, estimate = outcome.solution, outcome.estimate
    evidence = gather_evidence(solution, estimate, outcome.network, outcome.dome, None)
    given = CalibrationEvidence(evidence, solution, outcome.network, outcome.flatness)
    if kind is Kind.WALL:
        if outcome.flatness is None:
            raise InputError("The wall in these photos could not be measured.")
        findings = wall_findings(given)
    else:
        findings = orbit_findings(given)
    acceptance, headline = accepted(findings, evidence)
    lines = equifinal_lines(estimate)
    return Calibration(
        kind=kind,
        acceptance=acceptance,
        headline=headline,
        findings=findings,
        what_to_do=() if acceptance is Acceptance.ACCEPTED else next_photos(findings, kind),
        camera=solution.photos[0].camera,
        solution=solution,
        estimate=estimate,
        network=outcome.network,
        dome=outcome.dome,
        flatness=outcome.flatness,
        line=lines[0],
        line_no_k3=lines[1],
        left_out=photos.left_out,
        notes=photos.notes,
        timing=timing,
        temperature_c=temperature_c,
    )


def accepted(findings: tuple[Finding, ...], evidence: Evidence) -> tuple[Acceptance, str]:
    """Accepted where every rule but those of ``ADVICE`` passes; to be retaken where one is flagged."""
    decisive = [f for f in findings if f.rule not in ADVICE]
    flagged = [f for f in decisive if f.state is State.FLAG]
    if flagged:
        return Acceptance.RETAKE, flagged[0].message
    unknown = [f for f in decisive if f.state is State.UNKNOWN]
    if unknown:
        return Acceptance.CANNOT_TELL, unknown[0].message
    sigma = 100 * evidence.sigma_f_px / evidence.f_px
    bends = [f for f in findings if f.rule.startswith(("wall-bend", "wall-twist")) and f.value is not None]
    ending = ""
    if bends:
        worst = max(abs(f.value or 0.0) for f in bends)
        ending = f", and the wall came out flat to {worst:.3f} % of the distance"
    return (
        Acceptance.ACCEPTED,
        f"The camera is calibrated: the focal length is {evidence.f_px:.2f} px, known to {sigma:.3f} % "
        f"(1 sigma){ending}.",
    )


#: What cures a rule that did not pass; the others say it in their own message.
_ROLLED = "some of them with the camera turned upright (by 90 degrees)"
_WALL_CURES = {
    "alignment": "Take the photos again from one end of the wall to the other without gaps, sharp and in "
    "even light.",
    "coverage": "Let the wall fill the whole picture, corners included: go nearer, or choose a larger wall.",
    "focal-sigma": f"Add photos head-on and from both sides at about 45 degrees, {_ROLLED}.",
    "model-sensitivity": f"Add photos head-on and from both sides at about 45 degrees, {_ROLLED}.",
    "cross-validation": "Take the photos again; zoom and focus must not change between them.",
    "wall-bend-along": "Try another wall. If that one bends as much, it is the calibration: add photos, "
    f"{_ROLLED}.",
    "wall-twist": "Try another wall, or add photos from other heights.",
    "wall-bend-up": "Try another wall, or add photos from other heights.",
}
_CIRCLE = (
    "Fly two full circles around the middle, 12 photos each: one 40 degrees off straight down, one a third "
    "higher and 25 degrees off; and take some photos straight down."
)
_ORBIT_CURES = {
    "alignment": "Fly again over textured ground with more overlap.",
    "coverage": "Let textured ground fill the whole picture: no sky, no water.",
    "focal-sigma": _CIRCLE,
    "model-sensitivity": _CIRCLE,
    "convergent-share": _CIRCLE,
    "predicted-dome": _CIRCLE,
    "cross-validation": "Take the photos again; zoom and focus must not change between them.",
}


def next_photos(findings: tuple[Finding, ...], kind: Kind) -> tuple[str, ...]:
    """What to do next, the most important first, each once."""
    cures = _WALL_CURES if kind is Kind.WALL else _ORBIT_CURES
    told: list[str] = []
    for state in (State.FLAG, State.UNKNOWN):
        for finding in findings:
            cure = cures.get(finding.rule, finding.message)
            if finding.state is state and finding.rule != "opposite-signs" and cure not in told:
                told.append(cure)
    return tuple(told)


def equifinal_lines(
    estimate: Estimate, tolerance_px: float = STRICT_TOLERANCE_PX
) -> tuple[EquifinalLine | None, EquifinalLine | None]:
    """Line, band and domain for models with the camera's own K3, and for models without K3.

    None, None where K1 and K2 have the same sign; None for models without K3 where none comes near.
    """
    radial, radius = Radial.of(estimate.brown), image_radius_px(estimate.brown)
    if not radial.opposite_signs:
        return None, None
    own = equifinal_region(radial, radius, tolerance_px, radial.k3_px).line
    try:
        return own, equifinal_region(radial, radius, tolerance_px, 0.0).line
    except InputError:
        return own, None


def default_name(camera: CameraIdentity) -> str:
    """A name for the store out of the camera's model, body and image size."""
    parts = [camera.model or camera.make or "camera", camera.serial or "", camera.band]
    words = "-".join(part for part in parts if part).lower()
    return re.sub(r"[^a-z0-9._-]+", "-", words).strip("-._")[:80] or "camera"


def calibration_date(photos: tuple[Photo, ...]) -> str:
    """Day of the first photo; today where the photos do not say."""
    times = [photo.time for photo in photos if photo.time is not None]
    return (min(times).date() if times else date.today()).isoformat()


def calibration_reference(calibration: Calibration, name: str) -> Reference:
    """The calibration as a reference for later checks, with covariance, line and provenance."""
    solution, estimate = calibration.solution, calibration.estimate
    sigma = 100 * estimate.sigma_f_px / estimate.brown.f_px
    how = (
        f"{len(solution.photos)} photos, {len(solution.observations)} observations of "
        f"{len(solution.points_m)} points, {solution.rms_px:.2f} px rms, sigma f {sigma:.3f} %"
    )
    flatness = calibration.flatness
    if flatness is not None:
        terms = zip(flatness.terms_percent, flatness.sigmas_percent, strict=True)
        bends = ", ".join(f"{value:+.3f} ± {spread:.3f}" for value, spread in terms)
        how += f"; bend along, twist, bend up of the wall: {bends} % of the distance"
    what = "a flat wall" if calibration.kind is Kind.WALL else "a convergent flight"
    made = reference_from_estimate(
        name,
        estimate,
        calibration.camera,
        calibration_date(solution.photos),
        source=f"fieldcal calibrate {calibration.kind.value}: self-calibration on {what}",
        provenance=how,
    )
    return replace(made, line=calibration.line, temperature_c=calibration.temperature_c)
