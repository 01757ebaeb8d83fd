"""A finished plan with all that is known about it: what the command prints, writes and draws."""

from __future__ import annotations

from dataclasses import dataclass

from mission.plan import Plan, Station
from mission.predict import Prediction
from mission.rule import Finding
from mission.site import Site
from mission.timing import Timing, timing


@dataclass(frozen=True)
class Planned:
    """A plan, its prediction and the findings about it; ``added``: photos that were added to cure it."""

    site: Site
    plan: Plan
    prediction: Prediction
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    added: tuple[Station, ...] = ()

    @property
    def timing(self) -> Timing:
        return timing(self.plan, self.site.wind)

    @property
    def gsd_m(self) -> float:
        """Ground size of a pixel straight down from the planned height."""
        return self.site.height_m / self.plan.camera.f_px
