"""One flight through the field check, and whether its verdict was right.

What a verdict asserts, and hence when it is false:

* TRUST: the calibration may be used. Its f lies within 0.1 % of the true f, it bends the model by no
  more than 0.1 % of the flying height, and where a reference took part in the decision, the camera
  truly agrees with it (f within 0.1 %, radial profile within the check's tolerance). False when one of
  these is violated by more than the standard deviation that the check itself states.
* REFLY: something is wrong that more photos would cure or settle. False when the calibration is
  within 0.1 % in f and dome, the camera truly agrees with the reference, *and* these photos can fix
  f: an adjustment that knows all that disturbs the flight would know f as well as the check demands
  (``focal-sigma``). A lucky value from photos that cannot fix f does not make REFLY false.
* CANNOT_TELL is no error, but too much of it is no use: it is counted where a reference is there and an
  ideal adjustment, one that knows what disturbs the flight, would settle the 0.1 % rule against this
  reference in nine of ten such flights. Where the camera is 0.08 % off, or the best possible sigma is
  0.045 %, nobody settles it at 95 %; beside it stands the count over all flights whose sigma could be
  0.051 % or less, with what an ideal adjustment would leave open of them.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np

from benchmarks.verdict_cases import Case
from benchmarks.verdict_truth import ideal_sigma_f_percent, true_dome_percent
from benchmarks.verdict_world import options_of, reference_of, survey_of
from calib.check import conclude
from calib.errors import AlignmentError
from calib.findings import State
from calib.limits import (
    DOME_LIMIT_PERCENT,
    FOCAL_LIMIT_PERCENT,
    FOCAL_SIGMA_ALONE_PERCENT,
    FOCAL_SIGMA_PERCENT,
)
from calib.result import Timing
from sim.solution import identity_of, outcome_of

#: Verdict of a flight that could not be calibrated: the check ends with a message.
NO_RESULT = "no result"
NAN = float("nan")


@dataclass(frozen=True)
class Score:
    """What came out of a case, against its truth.

    ``df_percent``: found f against the true one. ``ideal_sigma_percent``: sigma of f of an
    adjustment that knows what disturbs the flight. ``z_*``: errors in stated sigmas. Domes in % of the
    flying height: the true one of the reconstructed points, and the one that the check predicts from
    the reference (NaN without one). ``ref_*``: the reference against the camera that flew; ``decides``:
    whether the reference took part in the decision. ``flagged``, ``open``: rules by their answer.
    """

    case: Case
    verdict: str
    headline: str
    flagged: tuple[str, ...]
    open: tuple[str, ...]
    photos: int = 0
    observations: int = 0
    decides: bool = False
    df_percent: float = NAN
    sigma_percent: float = NAN
    formal_percent: float = NAN
    ideal_sigma_percent: float = NAN
    z_f: float = NAN
    z_k1: float = NAN
    z_k2: float = NAN
    z_k3: float = NAN
    true_dome_percent: float = NAN
    predicted_dome_percent: float = NAN
    sigma_dome_percent: float = NAN
    ref_df_percent: float = NAN
    ref_deviation_px: float = NAN
    tolerance_px: float = NAN
    factor: float = NAN
    split_sigmas: float = NAN
    cpu_s: float = NAN

    @property
    def observable(self) -> bool:
        """Whether these photos can fix f as well as the check demands."""
        limit = FOCAL_SIGMA_PERCENT if self.decides else FOCAL_SIGMA_ALONE_PERCENT
        return self.ideal_sigma_percent <= limit

    def calibration_bad(self, margin: float = 0.0) -> bool:
        """f or dome off by more than 0.1 % and ``margin`` stated sigmas."""
        return (
            abs(self.df_percent) > FOCAL_LIMIT_PERCENT + margin * self.sigma_percent
            or abs(self.true_dome_percent) > DOME_LIMIT_PERCENT + margin * self.sigma_dome_percent
        )

    @property
    def reference_bad(self) -> bool:
        """Whether the reference took part and is not the camera that flew."""
        return self.decides and (
            abs(self.ref_df_percent) > FOCAL_LIMIT_PERCENT or self.ref_deviation_px > self.tolerance_px
        )

    @property
    def trust_wrong(self) -> bool:
        """Whether TRUST would be false here."""
        return self.calibration_bad(1.0) or self.reference_bad

    @property
    def refly_wrong(self) -> bool:
        """Whether REFLY would be false here."""
        return self.observable and not self.calibration_bad() and not self.reference_bad

    @property
    def false_trust(self) -> bool:
        return self.verdict == "TRUST" and self.trust_wrong

    @property
    def false_refly(self) -> bool:
        return self.verdict == "REFLY" and self.refly_wrong

    @property
    def should_tell(self) -> bool:
        """Whether a verdict other than CANNOT_TELL may be asked for."""
        return self.case.reference != "none" and self.observable


def score(case: Case) -> Score:
    """Simulate, check and compare with the truth."""
    started = time.process_time()
    block = survey_of(case)
    held = reference_of(case, block)
    truth = block.lens.brown
    nominal = truth.f_px * (1 + 0.04 * float(np.random.default_rng([case.number, 25]).uniform(-1, 1)))
    try:
        outcome, calibrated = outcome_of(block, nominal, case.number, held.reference, identity_of(block))
    except AlignmentError as error:
        return Score(case, NO_RESULT, str(error), (), (), len(block.centres_m), len(block.observations))
    result = conclude(outcome, (), held.reference, held.note, Timing(0.0, 0.0, 0.0))
    found, dome, options = outcome.estimate, outcome.dome, options_of(case, truth)
    off, sigma = found.brown.vector - truth.vector, np.sqrt(np.diag(found.covariance))
    z = off / np.where(sigma > 0, sigma, np.nan)
    by_rule = {f.rule: f for f in result.findings}
    return Score(
        case=case,
        verdict=result.verdict.value,
        headline=result.headline,
        flagged=tuple(f.rule for f in result.findings if f.state is State.FLAG),
        open=tuple(f.rule for f in result.findings if f.state is State.UNKNOWN),
        photos=len(block.centres_m),
        observations=len(calibrated.observations),
        decides=by_rule["focal-sigma"].threshold == FOCAL_SIGMA_PERCENT,
        df_percent=100 * float(off[0]) / truth.f_px,
        sigma_percent=100 * found.sigma_f_px / truth.f_px,
        formal_percent=100 * found.sigma_f_formal_px / truth.f_px,
        ideal_sigma_percent=ideal_sigma_f_percent(
            block, calibrated, options.noise_px, options.correlated_px, nominal
        ),
        z_f=float(z[0]),
        z_k1=float(z[3]),
        z_k2=float(z[4]),
        z_k3=float(z[5]),
        true_dome_percent=true_dome_percent(
            calibrated.adjusted.state.points_m, block.points_m[calibrated.point_index], dome.flying_height_m
        ),
        predicted_dome_percent=NAN if dome.amplitude_percent is None else dome.amplitude_percent,
        sigma_dome_percent=100 * dome.sigma_m / dome.flying_height_m,
        ref_df_percent=held.df_percent,
        ref_deviation_px=held.deviation_px,
        tolerance_px=by_rule["equifinal-deviation"].threshold or NAN,
        factor=found.correlation_factor,
        split_sigmas=by_rule["cross-validation"].value or NAN,
        cpu_s=time.process_time() - started,
    )


def to_row(one: Score) -> dict[str, object]:
    """As JSON has it."""
    return asdict(one)


def from_row(row: dict[str, object]) -> Score:
    """Inverse of :func:`to_row`."""
    content = dict(row)
    parts = content.pop("case")
    assert isinstance(parts, dict)
    for name in ("flagged", "open"):
        listed = content[name]
        assert isinstance(listed, list)
        content[name] = tuple(listed)
    return Score(case=Case(**parts), **content)  # type: ignore[arg-type]
