"""Photo flights with faults, by the hundred: every trigger there once, every position as good as stated?

`python -m benchmarks.flight_faults --flights 200` writes benchmarks/flight_faults.md. Real sockets, real
files, real recording; the vehicle's time runs five times as fast, and nothing is aligned. Rows go to
benchmarks/flight_faults.jsonl, flight by flight; begun again it goes on.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import random
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from benchmarks.resumed import read_rows, run_rows
from calib.align.stream import Finished, Happening, Request, Solve, Solver
from calib.camera import BrownCamera
from calib.errors import AlignmentError
from calib.photos.photo import Photo
from daemon.flight import Flight, Options
from daemon.flight_link import FlightLink
from daemon.link.address import parse
from daemon.link.live import Link
from daemon.live.schemas import Message
from daemon.session.rows import ClockName, Stamp, Trigger
from daemon.session.store import Session
from mission.encode import FLAVOURS, Flavour
from mission.plan import Plan, Shot, Waypoint
from mission.plan import Vehicle as Aircraft
from sim.faults import LineFaults
from sim.photo_flight import Card, PhotoFlight, photo_flight
from sim.vehicle import Faults, Gnss, PhotoTaken, Wind
from sim.vehicle.options import HOME

HERE = Path(__file__).parent
#: Of the vehicle's time against the wall's; the daemon's clocks go along.
SPEED_UP = 5.0
#: Beyond so many of its sigmas a position is wrong: 1 in 3,000 by chance on the ground.
SIGMAS = 4.0
LONGEST_S = 900.0
#: A trigger whose time is so near that of a photo is that photo's.
SAME_S = 0.5
#: Times that differ by less are alike.
ALIKE_S = 0.05


@dataclass(frozen=True)
class Recipe:
    """What goes wrong on one flight. ``cuts``: (after so many photos, for so many seconds of flight)."""

    seed: int
    flavour: Flavour
    photos: int
    line: LineFaults
    cuts: tuple[tuple[int, float], ...]
    miss_photo_share: float
    skip: frozenset[int]
    by_hand: int
    clock_s: float
    drift_ppm: float
    whole_seconds: bool
    confirmed: bool
    wind: Wind
    gnss: Gnss
    power_cycles_s: tuple[float, ...]


@dataclass(frozen=True)
class Flown:
    """``photos``: that the vehicle took. ``told``: recorded triggers. ``twice``: recorded more than once.
    ``invented``: recorded, never taken. ``unsaid``: neither recorded nor named as lost, between the first
    and the last told. ``sure``, ``wrong_pairs``: sure pairs, and those that do not belong together.
    ``placed``, ``wrong_places``: photos with a position, and those further off than stated. ``across``,
    ``up``: true errors of the positions in their stated sigmas. ``away``: of which those told by a place
    that had jumped. ``boots``: how often the vehicle was switched on; ``errs``: its receiver has errors.
    ``words``: the triggers of photos that are there twice."""

    seed: int
    flavour: str
    photos: int
    told: int
    twice: int
    invented: int
    unsaid: int
    files: int
    sure: int
    wrong_pairs: int
    placed: int
    wrong_places: int
    ended: bool
    seconds: float
    boots: int
    jumps: int
    errs: bool
    across: tuple[float, ...]
    up: tuple[float, ...]
    away: tuple[bool, ...]
    words: tuple[str, ...] = ()

    @property
    def right(self) -> bool:
        faults = (self.twice, self.invented, self.unsaid, self.wrong_pairs, self.wrong_places)
        return self.ended and not any(faults)


class NoSolver(Solver):
    """In the place of the alignment: finishes everything at once, solutions with an error."""

    def __init__(self) -> None:
        super().__init__()
        self.now: Request | None = None
        self.last: Solve | None = None

    @property
    def busy(self) -> bool:
        return self.now is not None

    def submit(self, request: Request) -> None:
        self.now = request
        if isinstance(request, Solve):
            self.last = request

    def call_off(self) -> None:
        """Nothing to be called off."""

    def poll(self, timeout_s: float = 0.0) -> Happening | None:
        del timeout_s
        request, self.now = self.now, None
        if request is None:
            return None
        error = AlignmentError("Nothing is aligned here.") if isinstance(request, Solve) else None
        return Finished(request, error=error)


def recipe_of(seed: int) -> Recipe:
    """Random faults; one flight in eight has none but the camera's clock."""
    rng = random.Random(seed)
    photos = rng.randint(15, 45)
    calm = seed % 8 == 7
    delay_s = 0.0 if calm else rng.choice((0.0, 0.1, 0.5)) / SPEED_UP
    line = LineFaults(
        0.0 if calm else rng.choice((0.0, 0.02, 0.05, 0.1)),
        0.0 if calm else rng.choice((0.0, 0.1, 0.3)),
        delay_s,
        delay_s * rng.random(),
    )
    cuts = (
        ()
        if calm
        else tuple((rng.randint(2, photos - 3), rng.uniform(1, 40)) for _ in range(rng.choice((0, 0, 1, 2))))
    )
    return Recipe(
        seed,
        FLAVOURS[seed % 2],
        photos,
        line,
        tuple(sorted(cuts)),
        0.0 if calm else rng.choice((0.0, 0.05, 0.15)),
        frozenset() if calm else frozenset(n for n in range(photos) if rng.random() < rng.choice((0, 0.05))),
        rng.choice((0, 0, 1, 3)),
        rng.uniform(-3600, 3600),
        rng.uniform(-200, 200),
        rng.random() < 0.3,
        rng.random() < 0.5,
        *(_air(rng) if not calm else (Wind(), Gnss(), ())),
    )


def _air(rng: random.Random) -> tuple[Wind, Gnss, tuple[float, ...]]:
    """Wind, what the receiver gets wrong, and when the power fails."""
    wind = Wind(rng.choice((0.0, 4.0, 8.0)), rng.uniform(0, 360), rng.choice((0.5, 1.5, 3.0)))
    jumps_s = rng.choice((None, None, 120.0, 50.0))
    gnss = Gnss(*(rng.uniform(0, 0.3), rng.uniform(0.6, 1.8), jumps_s), accuracies=rng.random() < 0.75)
    return wind, gnss, (rng.uniform(15, 90),) if rng.random() < 0.3 else ()


def plan_of(recipe: Recipe) -> Plan:
    """A line with a turn and some stops, as long as the recipe has photos."""
    rng = random.Random(recipe.seed)
    stops = rng.randint(3, 6)
    steps = recipe.photos - stops
    spacing_m, height_m, out = rng.uniform(6, 14), rng.uniform(20, 60), steps // 2
    ways = [
        Waypoint(0, 0, height_m, 90.0, -90.0, Shot.LINE, spacing_m, "nadir"),
        Waypoint(out * spacing_m, 0, height_m, 90.0, -90.0),
        Waypoint(out * spacing_m, 25.0, height_m, 270.0, -90.0, Shot.LINE, spacing_m, "nadir"),
        Waypoint((out - (steps - out - 1)) * spacing_m, 25.0, height_m, 270.0, -90.0),
    ]
    for n in range(stops):
        azimuth = 2 * math.pi * n / stops
        place = 20 * math.sin(azimuth), 20 * math.cos(azimuth)
        yaw = (math.degrees(azimuth) + 180) % 360
        ways.append(Waypoint(*place, height_m, yaw, -55.0, Shot.STOP, pattern="orbit"))
    camera = BrownCamera(4000, 3000, 3000.0, 2000.0, 1500.0)
    return Plan("faults", HOME, camera, "M3E", Aircraft(speed_m_s=rng.uniform(4, 9)), tuple(ways), 70.0)


def fly(seed: int) -> Flown:
    """One flight, followed from before the take-off to its end."""
    recipe = recipe_of(seed)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home) / "card"
        with (
            photo_flight(
                recipe.flavour,
                folder,
                plan_of(recipe),
                recipe.line,
                Faults(miss_photo_share=recipe.miss_photo_share, power_cycles_s=recipe.power_cycles_s),
                lambda server: Card(
                    folder,
                    server,
                    recipe.clock_s,
                    recipe.drift_ppm,
                    recipe.whole_seconds,
                    recipe.skip,
                    recipe.by_hand,
                ),
                seed,
                camera_component=recipe.confirmed and recipe.flavour == "ardupilot",
                wind=recipe.wind,
                gnss=recipe.gnss,
            ) as flown,
            Session.create(Path(home) / "record") as session,
        ):
            return _followed(recipe, flown, folder, session, started)


def _followed(recipe: Recipe, flown: PhotoFlight, folder: Path, session: Session, started: float) -> Flown:
    solver = NoSolver()
    told: list[Message] = []

    def clock() -> float:
        return SPEED_UP * time.monotonic()

    until = time.monotonic() + LONGEST_S
    since_s = time.time() - clock()
    source = Link(parse(flown.proxy.url), clock=lambda: since_s + clock())
    flown.server.speed_up = SPEED_UP
    with FlightLink(source, session, clock) as link:
        flight = Flight(session, Options("v", folder, idle_s=120.0), solver, told.append, clock, link)

        def step(wait_s: float = 0.0) -> None:
            end = time.monotonic() + wait_s
            flight.step()
            while time.monotonic() < end:
                flight.step()

        step(1.5)
        flown.take_off(SPEED_UP)
        cuts = list(recipe.cuts)
        while not flight.over and time.monotonic() < until:
            if cuts and len(flown.server.vehicle.photos) >= cuts[0][0]:
                flown.proxy.open = False
                step(cuts.pop(0)[1] / SPEED_UP)
                flown.proxy.open = True
            step()
        ended = flight.over and flown.server.vehicle.done
        with contextlib.suppress(AlignmentError):
            flight.conclude()
        lost = len(link.book.lost)
    photos = () if solver.last is None else solver.last.photos
    return _judged(recipe, flown, session, photos, lost, ended, time.monotonic() - started)


def _judged(
    recipe: Recipe,
    flown: PhotoFlight,
    session: Session,
    photos: Iterable[Photo],
    lost: int,
    ended: bool,
    seconds: float,
) -> Flown:
    truth = flown.server.vehicle.photos
    triggers = {row.seq: row.value for row in session.triggers()}
    whose = _whose(triggers, truth)
    known = [number for number in whose.values() if number is not None]
    boots = list(
        accumulate((n == 0 or truth[n].index <= truth[n - 1].index for n in range(len(truth))), int.__add__)
    )
    between = 0
    for boot in set(boots):
        told = [number for number in known if boots[number] == boot]
        between += max(told) - min(told) + 1 if told else 0
    card = flown.card
    files = {row.seq: row.value for row in session.photos()}
    pairing = session.pairing()
    sure = [] if pairing is None else [pair for pair in pairing.value.pairs if pair.sure]
    wrong = sum(whose[pair.trigger] != card.number(files[pair.photo].path) for pair in sure)
    across, up, away = [], [], []
    for photo in photos:
        if photo.position is None:
            continue
        number = card.number(photo.path)
        if not 0 <= number < len(truth):  # by hand: it has no place
            across.append(math.inf)
            up.append(math.inf)
            away.append(False)
            continue
        horizontal, vertical = flown.place_error(number, photo.position)
        across.append(horizontal / (photo.position.sigma_horizontal_m or math.inf))
        up.append(vertical / (photo.position.sigma_vertical_m or math.inf))
        away.append(truth[number].jumped)
    return Flown(
        recipe.seed,
        recipe.flavour,
        len(truth),
        len(triggers),
        len(known) - len(set(known)),
        len(triggers) - len(known),
        max(0, between - len(set(known)) - lost),
        len(files),
        len(sure),
        wrong,
        len(across),
        sum(max(pair) > SIGMAS for pair in zip(across, up, strict=True)),
        ended,
        seconds,
        1 + len(recipe.power_cycles_s),
        flown.server.vehicle.receiver.jumps,
        recipe.gnss != Gnss(),
        tuple(across),
        tuple(up),
        tuple(away),
        tuple(
            f"{whose[seq]}: {row.image_index} at {row.at.time_s:.3f} {row.at.clock}"
            for seq, row in triggers.items()
            if known.count(whose[seq] or 0) > 1 and whose[seq] is not None
        ),
    )


def _whose(triggers: Mapping[int, Trigger], truth: Sequence[PhotoTaken]) -> dict[int, int | None]:
    """Seq of a trigger -> which photo was taken then, counted from 0: the nearest in time.

    Two starts of the vehicle can have one time since boot: then the number that the vehicle gave decides, or
    which comes next.
    """
    found: dict[int, int | None] = {}
    last = 0
    for seq, trigger in triggers.items():
        away_s = [_away_s(trigger.at, photo) for photo in truth]
        nearest_s = min(away_s, default=math.inf)
        fits = [n for n, one in enumerate(away_s) if one <= min(nearest_s + ALIKE_S, SAME_S)]
        numbered = [n for n in fits if truth[n].index == trigger.image_index]
        found[seq] = min(numbered or fits, key=lambda n: (n < last, away_s[n]), default=None)
        last = max(last, found[seq] or 0)
    return found


def _away_s(at: Stamp, photo: PhotoTaken) -> float:
    return abs(at.time_s - (photo.boot_s if at.clock is ClockName.BOOT else photo.utc_s))


def report(flown: list[Flown]) -> str:
    wrong = [one for one in flown if not one.right]
    blind = [one for one in flown if not one.sure]
    most = max((100 * one.told / max(one.photos, 1) for one in blind), default=0.0)
    cycles, jumps = sum(one.boots - 1 for one in flown), sum(one.jumps for one in flown)
    lines = [
        "# Photo flights with faults",
        "",
        f"{len(flown)} flights of 15-45 photos over real sockets, ArduPilot and PX4, at {SPEED_UP:g} "
        "times real time; by seed, all in the time of the flight: loss to 10 %, doubling to 30 %, delay to "
        "0.5 s and reordering, up to two cuts of 1-40 s, shutters that fail (to 15 %), files that never "
        "come, test shots, a camera clock off by up to an hour and drifting by up to 200 ppm, a third with "
        "whole seconds; wind to 8 m/s with gusts to 3 m/s; a receiver with noise to 0.3 m and a drift of "
        "0.6-1.8 m on each axis (1.6 times that in height), a quarter of which state dilutions only; "
        f"{jumps} jumps of 3-8 m for 4-25 s that nobody announces; {cycles} power cycles in the air. One "
        "flight in eight has none of these but the clock. Made by `python -m benchmarks.flight_faults`.",
        "",
        f"**{len(flown) - len(wrong)} of {len(flown)} flights without a fault of ours.**",
        "",
        "| flavour | flights | photos | triggers recorded | twice | invented | neither recorded nor named "
        "| files | sure pairs | wrong | positions | beyond 4 sigma | longest s |",
        "|---|" + "---|" * 12,
    ]
    for flavour in FLAVOURS:
        some = [one for one in flown if one.flavour == flavour]
        if not some:
            continue
        names = ("photos", "told", "twice", "invented", "unsaid", "files", "sure", "wrong_pairs", "placed")
        sums = [sum(getattr(one, name) for one in some) for name in (*names, "wrong_places")]
        lines.append(
            f"| {flavour} | {len(some)} | {' | '.join(map(str, sums))} | {max(o.seconds for o in some):.0f} |"
        )
    lines += [
        "",
        "A trigger whose every message was lost is named as lost; it is not counted as recorded. Flights in "
        f"which nothing is called sure, so that nothing is placed: {len(blind)}; of their triggers at most "
        f"{most:.0f} % were told.",
        "",
        *_places(flown),
        *(
            f"* seed {one.seed}: {json.dumps(asdict(one) | {'across': None, 'up': None, 'away': None})}"
            for one in wrong
        ),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _places(flown: Sequence[Flown]) -> list[str]:
    """True errors against stated sigmas, where the receiver errs at all."""
    errs = [one for one in flown if one.errs]
    lines = [
        "True errors of the positions against their stated sigmas, of flights whose receiver errs:",
        "",
        "| positions | number | within 1 sigma, % | 2 | 3 | 4 |",
        "|---|---|---|---|---|---|",
    ]
    for name, field, jumped, normal in (
        ("on the ground", "across", False, (39.3, 86.5, 98.9, 99.97)),
        ("in height", "up", False, (68.3, 95.4, 99.7, 99.99)),
        ("on the ground, while jumped", "across", True, None),
    ):
        values = [
            value
            for one in errs
            for value, away in zip(getattr(one, field), one.away, strict=True)
            if away or not jumped
        ]
        if not values:
            continue
        shares = [100 * sum(v <= limit for v in values) / len(values) for limit in (1, 2, 3, 4)]
        lines.append(f"| {name} | {len(values)} | {' | '.join(f'{share:.2f}' for share in shares)} |")
        if normal is not None:
            lines.append(f"| (normal errors of just that sigma) | | {' | '.join(map(str, normal))} |")
    return [*lines, ""]


def _row(one: Flown) -> dict[str, Any]:
    rounded = {name: [round(value, 3) for value in getattr(one, name)] for name in ("across", "up")}
    return {**asdict(one), "seconds": round(one.seconds, 1), **rounded}


def _made(row: dict[str, Any]) -> Flown:
    return Flown(**{**row, **{name: tuple(row[name]) for name in ("across", "up", "away")}})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2, help="more, and late computing is taken for faults")
    parser.add_argument("--out", type=Path, default=HERE)
    got = parser.parse_args()
    raw = got.out / "flight_faults.jsonl"
    known = {one.seed: one for one in read_rows(raw, _made)}
    flown = run_rows(got.flights, raw, got.workers, fly, _row, known)
    (got.out / "flight_faults.md").write_text(report(flown), encoding="utf-8")
    print(report(flown))
    sys.exit(0 if all(one.right for one in flown) else 1)


if __name__ == "__main__":
    main()
