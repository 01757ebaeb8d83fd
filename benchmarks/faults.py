"""Uploads with faults, by the hundred: is the old mission intact after every one that failed?

`python -m benchmarks.faults --flights 200` writes benchmarks/faults.md. Real sockets and real time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

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

HERE = Path(__file__).parent
HOME = LocalFrame(47.0, 8.5, 430.0)


@dataclass(frozen=True)
class Flown:
    """``holds``: old, new, other or mixed. ``outcome``: of the upload, or "not begun"."""

    recipe: Recipe
    flavour: Flavour
    outcome: str
    holds: str
    seconds: float

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


def fly(seed: int) -> Flown:
    """One upload; patience as in the field."""
    flavour = FLAVOURS[seed // 6 % 2]
    old, new = items(flavour, 6, 40.0), items(flavour, 15, 60.0)
    recipe = random_recipe(seed, len(new), len(old))
    started = time.monotonic()
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
    return Flown(recipe, flavour, outcome, holds, time.monotonic() - started)


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
        f"**{len(flown) - len(wrong)} of {len(flown)} intact.**",
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
        *(f"* seed {f.recipe.seed}: {f.outcome}, holds {f.holds} ({f.recipe.words})" for f in wrong),
    ]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=8)
    got = parser.parse_args()
    flown = []
    with ProcessPoolExecutor(got.workers) as pool:
        for one in pool.map(fly, range(got.first, got.first + got.flights)):
            flown.append(one)
            words = (one.flavour, one.kind, one.outcome, one.holds, f"{one.seconds:.0f} s")
            print(one.recipe.seed, *words, flush=True)
    (HERE / "faults.md").write_text(report(flown), encoding="utf-8")
    sys.exit(0 if all(f.right for f in flown) else 1)


if __name__ == "__main__":
    main()
