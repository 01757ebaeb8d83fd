"""A site: everything a mission is planned from, in metres around the launch point."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from shapely import Polygon

from calib.camera import BrownCamera
from calib.frames import LocalFrame
from mission.fence import Fence
from mission.footprint import Footprint, footprint
from mission.plan import Vehicle
from mission.space import Space
from mission.terrain import Terrain

#: Off nadir: the middle of the 20-45 degrees of [C&D], and what their convergent photos had.
ORBIT_TILT_DEG = 35.0
FAN_TILT_DEG = 40.0
GENTLE_TILT_DEG = 15.0
FORWARD_OVERLAP, SIDE_OVERLAP = 0.8, 0.7
CLEARANCE_M = 10.0


@dataclass(frozen=True)
class Wind:
    """Steady wind, from the direction ``from_deg`` clockwise from north."""

    speed_m_s: float = 0.0
    from_deg: float = 0.0


@dataclass(frozen=True)
class Wall:
    """A wall as seen from above, (east, north) in m; its foot is the ground, its top ``height_m`` higher."""

    start_m: tuple[float, float]
    end_m: tuple[float, float]
    height_m: float


@dataclass(frozen=True)
class PatternOptions:
    """What single patterns can be told; None: the pattern chooses.

    ``heading_deg``: of the grid's lines. ``second_height_m``: above ground. ``poi_m``: (east, north) of
    the point of interest. ``arc_deg``: from and to, azimuths of the stations clockwise from north as
    seen from the point of interest. ``clockwise`` None: whichever is shorter.
    """

    heading_deg: float | None = None
    second_height_m: float | None = None
    oblique_tilt_deg: float = GENTLE_TILT_DEG
    poi_m: tuple[float, float] | None = None
    tilt_deg: float | None = None
    radius_m: float | None = None
    photos: int | None = None
    arc_deg: tuple[float, float] | None = None
    clockwise: bool | None = None
    rings: int = 3
    wall: Wall | None = None
    wall_distance_m: float = 10.0


@dataclass(frozen=True)
class Site:
    """Everything a mission is planned from. ``height_m`` is above ground; overlaps are shares [0, 1).

    ``clearance_m``: least height of the path above ground, between take-off and landing.
    """

    name: str
    frame: LocalFrame
    area: Polygon
    camera: BrownCamera
    camera_name: str
    height_m: float
    terrain: Terrain
    space: Space
    vehicle: Vehicle = field(default_factory=Vehicle)
    wind: Wind = field(default_factory=Wind)
    fence: Fence = field(default_factory=Fence)
    forward_overlap: float = FORWARD_OVERLAP
    side_overlap: float = SIDE_OVERLAP
    clearance_m: float = CLEARANCE_M
    options: PatternOptions = field(default_factory=PatternOptions)

    def footprint(self, off_nadir_deg: float = 0.0) -> Footprint:
        return footprint(self.camera, off_nadir_deg)

    def ground_m(self, east_m: float, north_m: float) -> float:
        """Height of the ground at one place above the launch point's."""
        return float(self.terrain.height_m(east_m, north_m))  # type: ignore[arg-type]

    def wall_site(self) -> Site:
        """The same with a stand-off that lets passes along a wall be flown at their own distance."""
        near = min(self.space.standoff_m, 0.9 * self.options.wall_distance_m)
        return replace(self, space=replace(self.space, standoff_m=near))

    @property
    def middle_m(self) -> tuple[float, float]:
        """The point of interest, or the middle of the area, (east, north)."""
        if self.options.poi_m is not None:
            return self.options.poi_m
        return float(self.area.centroid.x), float(self.area.centroid.y)
