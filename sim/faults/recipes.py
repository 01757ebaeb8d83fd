"""Random faults by a seed, for campaigns."""

from __future__ import annotations

import random
from dataclasses import dataclass

from sim.faults.line import LineFaults, Moment, MomentKind
from sim.vehicle.faults import Faults


@dataclass(frozen=True)
class Recipe:
    """``line``: between vehicle and ground. ``vehicle``: what the vehicle itself does."""

    seed: int
    line: LineFaults
    vehicle: Faults

    @property
    def words(self) -> str:
        """Its faults in short."""
        line = self.line
        found = [f"{moment.kind} at {moment.step} for {moment.seconds:.1f} s" for moment in line.moments]
        if self.vehicle.reject_item is not None:
            found.append(f"refuses {self.vehicle.reject_item}")
        shares = (("loss", line.drop_share), ("doubled", line.repeat_share))
        found += [f"{name} {share:.0%}" for name, share in shares if share]
        if line.delay_s:
            found.append(f"{line.delay_s * 1e3:.0f}±{line.jitter_s * 1e3:.0f} ms")
        return ", ".join(found) or "none"


def random_recipe(seed: int, items: int, old: int, longest_s: float = 12.0) -> Recipe:
    """Faults for an upload; one in six is only a bad line.

    Args:
        items: of the mission. old: of the mission that the vehicle holds, which is read before.
        longest_s: of a cut.
    """
    rng = random.Random(seed)
    kinds = [*MomentKind, "refuse", "line"]
    kind = kinds[seed % len(kinds)]
    moments = []
    if isinstance(kind, MomentKind):
        # Reading list, items and end of the mission, list and end of the fence; then count and items.
        written = old + 2 + 2 + 1 + items
        # Another station comes in between writing and reading back: before, the vehicle denies it.
        first, last = (written + 1, written + 2) if kind is MomentKind.OVERWRITE else (1, written + items)
        moments.append(Moment(rng.randint(first, last), kind, rng.uniform(0.5, longest_s)))
        if rng.random() < 0.3:  # and the bringing back is disturbed as well
            again = MomentKind(rng.choice(list(MomentKind)[:3]))
            at = written + items + rng.randint(3, items)
            moments.append(Moment(at, again, rng.uniform(0.5, longest_s)))
    delay_s = rng.choice((0.0, 0.0, 0.01, 0.05))
    line = LineFaults(
        rng.choice((0.0, 0.0, 0.02)),
        rng.choice((0.0, 0.05, 0.2)),
        delay_s,
        delay_s * rng.random(),
        tuple(moments),
    )
    refuse = rng.randrange(1, items) if kind == "refuse" else None
    return Recipe(seed, line, Faults(reject_item=refuse))
