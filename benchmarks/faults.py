"""Uploads with faults, by the hundred: is the old mission intact after every one that failed?

`python -m benchmarks.faults --flights 200` writes benchmarks/faults.md. Real sockets and real time: a flight
waits far more than it computes. Rows go to benchmarks/faults.jsonl as they come; begun again it goes on.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.resumed import asked, read_rows, run_rows
from calib.errors import FieldcalError
from calib.frames import LocalFrame
from daemon.link.address import parse
from daemon.link.live import Link
from daemon.link.transfer import Patience
from daemon.link.upload import Mission, Outcome, Terms, upload
from daemon.link.vehicle_mission import mission_differences
from mission.encode import FLAVOURS, Flavour, Item
from mission.encode import constants as mav
from sim.faults import Proxy, Recipe, random_recipe
from sim.vehicle import VehicleOptions, VehicleServer
from sim.vehicle.storage import kept

HOME = LocalFrame(47.0, 8.5, 430.0)


@dataclass(frozen=True)
class Flown:
    """``holds``: old, new, other or mixed. ``outcome``: of the upload, or "not begun"."""

    seed: int
    outcome: str
    holds: str
    seconds: float
    cpu_s: float

    @property
    def recipe(self) -> Recipe:
        return recipe_of(self.seed)

    @property
    def kind(self) -> str:
        if self.recipe.vehicle.reject_item is not None:
            return "refused item"
        moments = self.recipe.line.moments
        return moments[0].kind.value if moments else "bad line only"

    @property
    def right(self) -> bool:
        return self.holds == ("new" if self.outcome == Outcome.UPLOADED else "old")


def items(flavour: Flavour, waypoints: int, height_m: float) -> tuple[Item, ...]:
    """A mission of take-off, waypoints with a photo each, and the way home."""
    x, y = round(HOME.latitude_deg * 1e7), round(HOME.longitude_deg * 1e7)
    home = [Item(mav.NAV_WAYPOINT, mav.GLOBAL, x=x, y=y, z=HOME.altitude_m)]
    found = [Item(mav.NAV_TAKEOFF, mav.GLOBAL_RELATIVE_ALT, x=x, y=y, z=height_m)]
    for n in range(waypoints):
        place = Item(mav.NAV_WAYPOINT, mav.GLOBAL_RELATIVE_ALT, x=x + 1000 * n, y=y, z=height_m)
        found += [place, Item(mav.IMAGE_START_CAPTURE, mav.MISSION, param3=1.0)]
    found.append(Item(mav.NAV_RETURN_TO_LAUNCH, mav.MISSION))
    return (*(home if flavour == "ardupilot" else []), *found)


@contextmanager
def vehicle(
    flavour: Flavour, recipe: Recipe, holds: tuple[Item, ...]
) -> Iterator[tuple[Link, VehicleServer]]:
    """A vehicle with a mission on board behind the faults of ``recipe``, and our link to it."""
    other = items(flavour, 8, 33.0)
    with (
        Proxy(recipe.line, recipe.seed, other=other) as proxy,
        VehicleServer(
            VehicleOptions(flavour), proxy.vehicle_address, faults=recipe.vehicle, seed=recipe.seed
        ) as server,
    ):
        home = server.vehicle.telemetry.home_item()
        server.vehicle.transfer.stored[0] = [kept(flavour, n, i, home) for n, i in enumerate(holds)]
        with Link(parse(proxy.url)) as link:
            link.wait_for_vehicle(60)
            yield link, server


def flavour_of(seed: int) -> Flavour:
    return FLAVOURS[seed // 6 % 2]


def missions(flavour: Flavour) -> tuple[tuple[Item, ...], tuple[Item, ...]]:
    """The one on board, and the one to be uploaded."""
    return items(flavour, 6, 40.0), items(flavour, 15, 60.0)


def recipe_of(seed: int) -> Recipe:
    old, new = missions(flavour_of(seed))
    return random_recipe(seed, len(new), len(old))


def fly(seed: int) -> Flown:
    """One upload; patience as in the field."""
    flavour = flavour_of(seed)
    old, new = missions(flavour)
    recipe = recipe_of(seed)
    started, spent_s = time.monotonic(), time.process_time()
    with vehicle(flavour, recipe, old) as (link, server), tempfile.TemporaryDirectory() as folder:
        try:
            result = upload(
                link, Mission("new", flavour, new), lambda: True, Path(folder), Terms(patience=Patience())
            )
            outcome = result.outcome.value
        except FieldcalError:
            outcome = "not begun"
        held = server.vehicle.transfer.mission
        known = {"old": old, "new": new, "other": items(flavour, 8, 33.0)}
        holds = next((n for n, i in known.items() if not mission_differences(i, held, flavour)), "mixed")
    return Flown(seed, outcome, holds, time.monotonic() - started, time.process_time() - spent_s)


def report(flown: list[Flown]) -> str:
    outcomes = [*(outcome.value for outcome in Outcome if outcome is not Outcome.REFUSED), "not begun"]
    wrong = [f for f in flown if not f.right]
    lines = [
        "# Uploads with faults",
        "",
        f"{len(flown)} uploads over real sockets, ArduPilot and PX4, faults by seed (cuts, silence and "
        "deafness of 0.5-12 s, refused items, another ground station that writes in between, loss to 2 %, "
        "doubling to 20 %, delay to 0.1 s). Intact: after an upload that succeeded the vehicle holds the new "
        "mission, after any other the old one. Made by `python -m benchmarks.faults`.",
        "",
        f"**{len(flown) - len(wrong)} of {len(flown)} intact.** "
        f"{sum(f.cpu_s for f in flown) / max(len(flown), 1):.1f} CPU-s a flight.",
        "",
        f"| fault | flights | {' | '.join(outcomes)} | as promised | longest s |",
        "|---|" + "---|" * (len(outcomes) + 3),
    ]
    for kind in sorted({f.kind for f in flown}):
        some = [f for f in flown if f.kind == kind]
        counts = Counter(f.outcome for f in some)
        cells = [kind, len(some), *(counts[outcome] for outcome in outcomes)]
        cells += [sum(f.right for f in some), f"{max(f.seconds for f in some):.0f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += [
        "",
        *(f"* seed {f.seed}: {f.outcome}, holds {f.holds} ({f.recipe.words})" for f in wrong),
    ]
    return "\n".join(lines).rstrip() + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    got = asked(__doc__, 200, arguments, workers=8)
    if got.case is not None:
        print(fly(got.case))
        return
    raw = got.out / "faults.jsonl"
    known = {one.seed: one for one in read_rows(raw, lambda row: Flown(**row))}
    flown = run_rows(got.flights, raw, got.workers, fly, asdict, known)
    (got.out / "faults.md").write_text(report(flown), encoding="utf-8")
    sys.exit(0 if all(f.right for f in flown) else 1)


if __name__ == "__main__":
    main()
