"""One flight of the refly campaign: check, pass, flown, checked again; beside it the usual remedies."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.refly_cases import LoopCase, generator, loop_case
from benchmarks.refly_world import World, flown, world_of
from benchmarks.verdict_score import NAN, NO_RESULT
from benchmarks.verdict_truth import true_dome_percent
from benchmarks.verdict_world import TrueReference, reference_of
from calib.check import conclude
from calib.errors import AlignmentError
from calib.findings import State
from calib.flown_file import NETWORK_FILE, FlownCheck, flown_check, network_bytes, read_network
from calib.judge import GEOMETRY
from calib.result import CheckResult, Timing
from calib.solution import BoolArray
from mission.plan import Station
from mission.refly import Refly, pass_plan, refly, return_height_of
from mission.refly_passes import circle, paper_fan
from mission.refly_search import PassSearch
from mission.refly_site import FlownSite, flown_site
from mission.site_file import SiteFile
from mission.timing import timing
from sim.network import SimBlock
from sim.solution import identity_of, outcome_of

#: Numbers of the passes of a flight; those that people fly come after it.
OFFERED = 1
#: The usual remedies are flown in one flight of so many each, a pass that promises no cure in one of so many.
USUAL_EVERY, NO_CURE_EVERY = 6, 4
NOT_FLOWN = "not flown"
#: What people fly: an orbit as high as the survey, of so many photos, so far off nadir.
ORBIT_PHOTOS, ORBIT_TILT_DEG = (8, 10, 12), 35.0


@dataclass(frozen=True)
class Checked:
    """A check against the truth, in percent; ``open``, ``flagged``: rules by their answer."""

    verdict: str
    headline: str
    flagged: tuple[str, ...] = ()
    open: tuple[str, ...] = ()
    sigma_percent: float = NAN
    formal_percent: float = NAN
    df_percent: float = NAN
    sigma_dome_percent: float = NAN
    true_dome_percent: float = NAN


@dataclass(frozen=True)
class Flown:
    """A pass: its photos as planned and as flown, seconds, what it promised, and what came of it.

    ``sigma_percent``, ``dome_percent``: predicted, model error included. ``promised``: it was to cure.
    """

    planned: int
    photos: int
    seconds: float
    sigma_percent: float
    dome_percent: float
    promised: bool
    check: Checked

    @property
    def was_flown(self) -> bool:
        """False: only planned."""
        return self.photos > 0

    @property
    def cured(self) -> bool:
        return self.check.verdict == "TRUST"


@dataclass(frozen=True)
class LoopScore:
    """What came out of a flight.

    ``offered``: the recommended pass, ``paper``: [C&D]'s eight photos, ``orbit``: a plain one; None where
    the flight needed no geometry or nothing was to be flown (``reason`` says why). Of six flights one has
    the paper's beside it and one the orbit. A recommended pass that promises no cure is flown in one of four.
    """

    case: LoopCase
    photos: int
    height_m: float
    tie_points: float
    before: Checked
    reason: str
    offered: Flown | None
    paper: Flown | None
    orbit: Flown | None
    refly_s: float
    cpu_s: float

    @property
    def asked(self) -> bool:
        """Whether the flight got REFLY for its geometry."""
        return self.before.verdict == "REFLY" and bool(GEOMETRY & set(self.before.flagged))


#: The three passes of a flight, in the order of :class:`LoopScore`.
Passes = tuple[Flown | None, Flown | None, Flown | None]


def score(case: LoopCase) -> LoopScore:
    """Fly, check, and where the geometry is at fault fly the pass and check again."""
    started = time.process_time()
    world = world_of(case)
    block = world.seen()
    held = reference_of(world.verdict_case, block)
    before, result = checked(block, case, held)
    photos, height = len(block.centres_m), float(np.median(block.centres_m[:, 2]))

    def scored(reason: str, found: Passes = (None, None, None), refly_s: float = 0.0) -> LoopScore:
        tie_points = len(block.observations) / photos
        cpu_s = time.process_time() - started
        offered, paper, orbit = found
        return LoopScore(
            *(case, photos, height, tie_points, before, reason, offered, paper, orbit), refly_s, cpu_s
        )

    known = None if result is None else flown_check(result)
    if known is None or known.origin_wgs84 is None:
        return scored("There is no network.")
    first = scored("")
    if not first.asked:
        return scored("No pass was asked for.")
    now = time.process_time()
    site = flown_site(_as_exported(known), SiteFile(launch=world.launch_lat_lon))
    answer = refly(site)
    refly_s = time.process_time() - now
    if answer.found is None:
        return scored(answer.reason, refly_s=refly_s)
    flies = answer.cures or case.number % NO_CURE_EVERY == 0
    offered = _offered(world, site, answer, held if flies else None)
    return scored(answer.reason, (offered, *_usual(world, site, held)), refly_s)


def checked(
    block: SimBlock, case: LoopCase, held: TrueReference, standing: BoolArray | None = None
) -> tuple[Checked, CheckResult | None]:
    """The field check on what was seen; ``standing`` (k,): photos that it knows were taken standing."""
    truth = block.lens.brown
    nominal = truth.f_px * (1 + 0.04 * float(np.random.default_rng([case.number, 25]).uniform(-1, 1)))
    try:
        outcome, calibrated = outcome_of(
            block, nominal, case.number, held.reference, identity_of(block, model=case.model), standing
        )
    except AlignmentError as error:
        return Checked(NO_RESULT, str(error)), None
    result = conclude(outcome, (), held.reference, held.note, Timing(0.0, 0.0, 0.0))
    found, dome = outcome.estimate, outcome.dome
    true_dome = true_dome_percent(
        calibrated.adjusted.state.points_m, block.points_m[calibrated.point_index], dome.flying_height_m
    )
    score = Checked(
        result.verdict.value,
        result.headline,
        tuple(f.rule for f in result.findings if f.state is State.FLAG),
        tuple(f.rule for f in result.findings if f.state is State.UNKNOWN),
        100 * found.sigma_f_px / truth.f_px,
        100 * found.sigma_f_formal_px / truth.f_px,
        100 * (found.brown.f_px / truth.f_px - 1),
        100 * dome.sigma_m / dome.flying_height_m,
        true_dome,
    )
    return score, result


def _as_exported(check: FlownCheck) -> FlownCheck:
    """Through the file that a check leaves."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / NETWORK_FILE
        path.write_bytes(network_bytes(check))
        return read_network(path)


def _offered(world: World, site: FlownSite, answer: Refly, held: TrueReference | None) -> Flown:
    """The recommended pass; only planned without a reference to hold it against."""
    found = answer.found
    assert found is not None
    if held is None:
        worth = found.worth
        return Flown(
            len(found.stations), 0, answer.duration_s, worth.sigma_f_percent, worth.dome_percent,
            answer.cures, Checked(NOT_FLOWN, ""),
        )  # fmt: skip
    return _flown(
        world, site, found.stations, OFFERED, held, answer.duration_s,
        (found.worth.sigma_f_percent, found.worth.dome_percent), answer.cures,
    )  # fmt: skip


def _usual(world: World, site: FlownSite, held: TrueReference) -> tuple[Flown | None, Flown | None]:
    """What people fly, over the same place: the papers' photos, or an orbit."""
    turn = world.case.number % USUAL_EVERY
    if turn not in (0, 3):
        return None, None
    return_m = return_height_of(site)
    search = PassSearch(site.planned, site.site, return_m)
    middle, ground, height = search.middle_m, search.ground_m, site.planned.height_agl_m
    count = ORBIT_PHOTOS[int(generator(world.case, 4).integers(len(ORBIT_PHOTOS)))]
    shape = (
        paper_fan(middle, ground, height)
        if turn == 0
        else circle(middle, ground, height, ORBIT_TILT_DEG, count, search.over.towards_launch_deg)
    )
    found = search.found(tuple(i for i in search.candidates.add(shape.stations) if i is not None))
    seconds = timing(pass_plan(found, site.site, return_m), site.site.wind).duration_s
    worth = found.worth.sigma_f_percent, found.worth.dome_percent
    made = _flown(world, site, found.stations, OFFERED + 1 + turn, held, seconds, worth, found.good)
    return (made, None) if turn == 0 else (None, made)


def _flown(
    world: World,
    site: FlownSite,
    stations: Sequence[Station],
    number: int,
    held: TrueReference,
    seconds: float,
    worth: tuple[float, float],
    promised: bool,
) -> Flown:
    flight = flown(world, stations, site.site.frame, number)
    # The photos of the recommended pass are known again, and how they were taken.
    later = np.arange(len(world.survey) + len(flight)) >= len(world.survey)
    check, _ = checked(world.seen((number, flight)), world.case, held, later if number == OFFERED else None)
    return Flown(len(stations), len(flight), seconds, *worth, promised, check)


def to_row(one: LoopScore) -> dict[str, object]:
    """As JSON has it."""
    return asdict(one) | {"case": {"number": one.case.number, "levels": dict(one.case.levels)}}


def from_row(row: dict[str, Any]) -> LoopScore:
    """Inverse of :func:`to_row`.

    Raises:
        KeyError, TypeError: it is another campaign's.
    """
    content = dict(row)
    case = LoopCase(content["case"]["number"], tuple(content.pop("case")["levels"].items()))
    if case != loop_case(case.number):
        raise KeyError(case.number)
    before = _checked_of(content.pop("before"))
    offered, paper, orbit = (_flown_of(content.pop(name)) for name in ("offered", "paper", "orbit"))
    return LoopScore(case=case, before=before, offered=offered, paper=paper, orbit=orbit, **content)


def _checked_of(row: dict[str, Any]) -> Checked:
    return Checked(**row | {name: tuple(row[name]) for name in ("flagged", "open")})


def _flown_of(row: dict[str, Any] | None) -> Flown | None:
    return None if row is None else Flown(**row | {"check": _checked_of(row["check"])})
