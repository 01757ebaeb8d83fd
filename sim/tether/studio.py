"""The ground around the vehicle's home, the photos of it, and their truth."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calib.camera import FloatArray
from calib.field import Lens
from calib.frames import LocalFrame
from daemon.link.events import HomePosition
from sim.cameras import PHANTOM_3, CameraModel
from sim.flights import Flight
from sim.options import SurveyOptions
from sim.photo_writer import PhotoTags, write_photo
from sim.render import lens_rays, render
from sim.sites import check_points, height_grid, site_world
from sim.survey import identity_of
from sim.tags import tags_of
from sim.tether.poses import Pose
from sim.tether.shutter import Exposure
from sim.truth import TRUTH_FILE, SurveyTruth, write_truth

#: Ground photographed from this high has texels as fine as pixels; nearer, its detail is made up.
_TEXEL_HEIGHT_M = 40.0
RECIPE = "camera"


@dataclass(frozen=True)
class CameraClock:
    """``offset_s``: ahead of the vehicle's date at the first photo, by ``drift_ppm`` more with time."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    whole_seconds: bool = False

    def reads(self, utc_s: float, first_utc_s: float) -> datetime:
        """What the camera writes, as if its zone were UTC."""
        own_s = utc_s + self.offset_s + 1e-6 * self.drift_ppm * (utc_s - first_utc_s)
        return datetime.fromtimestamp(own_s, UTC).replace(tzinfo=None)


@dataclass(frozen=True)
class StudioOptions:
    """``world``: a kind of :data:`sim.worlds.KINDS`, of ``site_m`` each way, mirrored beyond.
    ``gps``: whether the photos have a position, with errors of ``gps_sigma_m``."""

    size: tuple[int, int]
    model: CameraModel = PHANTOM_3
    world: str = "rolling"
    seed: int = 1
    site_m: float = 300.0
    relief_m: float = 2.0
    clock: CameraClock = CameraClock()
    dji_tags: bool = False
    gps: bool = True
    gps_sigma_m: float = 2.5


@dataclass(frozen=True)
class _Taken:
    name: str
    centre_m: FloatArray
    rotation: FloatArray
    velocity_m_s: FloatArray


@dataclass
class Studio:
    """The world at a home. :meth:`take` may be called from several threads."""

    options: StudioOptions
    out: Path
    home: HomePosition
    _taken: dict[int, _Taken] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        asked = self.options
        self.camera = asked.model.at(*asked.size)
        texel_m = _TEXEL_HEIGHT_M / self.camera.f_px
        self.world = site_world(
            *(asked.world, asked.seed),
            half_m=asked.site_m / 2,
            texel_m=texel_m,
            relief_m=asked.relief_m,
            roughness=0.02,
        )
        ground_m = float(self.world.height_m(np.zeros(1), np.zeros(1))[0])
        # The vehicle stands on the ground, wherever the ground is.
        self.frame = LocalFrame(
            self.home.latitude_deg, self.home.longitude_deg, self.home.altitude_msl_m - ground_m
        )
        self._survey = SurveyOptions(
            gps_sigma_m=asked.gps_sigma_m,
            height_sigma_m=0.2 * asked.gps_sigma_m,
            gimbal_sigma_deg=1.0,
            latitude_deg=self.frame.latitude_deg,
            longitude_deg=self.frame.longitude_deg,
            ground_altitude_m=self.frame.altitude_m,
        )
        self._identity = identity_of(asked.model, self.camera, asked.dji_tags, self._survey)
        self._rays = lens_rays(Lens(self.camera))
        self._launch_m = ground_m

    def take(self, number: int, exposure: Exposure, first_utc_s: float) -> str:
        """Render and write photo ``number`` (from 1): its name. It appears in the folder whole.

        Raises:
            OSError: it cannot be written.
        """
        pose, asked = exposure.pose, self.options
        centre_m = self.centre_m(pose)
        image = render(
            self.world,
            self._rays,
            pose.rotation_cam_from_world,
            centre_m,
            velocity_m_s=pose.velocity_m_s,
            options=asked.model.rendering,
            seed=asked.seed * 100_000 + number,
        )
        name = f"{'DJI_' if asked.dji_tags else 'IMG_'}{number:04d}.JPG"
        unfinished = self.out / f".{name}.part"
        write_photo(unfinished, image, self._tags(number, exposure, centre_m, first_utc_s))
        unfinished.replace(self.out / name)
        with self._lock:
            self._taken[number] = _Taken(name, centre_m, pose.rotation_cam_from_world, pose.velocity_m_s)
        return name

    def centre_m(self, pose: Pose) -> FloatArray:
        """East, north, up (3,) in the world."""
        place = (np.array([v]) for v in (pose.latitude_deg, pose.longitude_deg, pose.altitude_m))
        centre: FloatArray = self.frame.enu(*place)[0]
        return centre

    def _tags(self, number: int, exposure: Exposure, centre_m: FloatArray, first_utc_s: float) -> PhotoTags:
        asked, model = self.options, self.options.model
        one = Flight(exposure.pose.rotation_cam_from_world[None], centre_m[None], np.zeros((1, 3)))
        tags = tags_of(
            *(one, np.zeros(1), self._launch_m, self._identity, (model.focal_mm, model.focal_35mm)),
            *(asked.dji_tags, asked.seed * 100_000 + number, self._survey),
        )[0]
        return replace(
            tags,
            time=asked.clock.reads(exposure.utc_s, first_utc_s),
            subseconds=not asked.clock.whole_seconds,
            gps=asked.gps,
        )

    def truth(self) -> SurveyTruth | None:
        """Of the photos taken so far, in their order; None where there is none."""
        with self._lock:
            taken = [photo for _, photo in sorted(self._taken.items())]
        if not taken:
            return None
        centres = np.array([photo.centre_m for photo in taken])
        reach_m = max(5.0, 0.5 * float(np.median(centres[:, 2])))
        (west, south), (east, north) = centres[:, :2].min(axis=0), centres[:, :2].max(axis=0)
        corners = np.array([[west, south], [east, south], [east, north], [west, north]])
        outline_m = corners + reach_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return SurveyTruth(
            recipe=RECIPE,
            seed=self.options.seed,
            camera=self.camera,
            pattern=None,
            photos=tuple(photo.name for photo in taken),
            rotations_cam_from_world=np.array([photo.rotation for photo in taken]),
            centres_m=centres,
            origin_wgs84=(self.frame.latitude_deg, self.frame.longitude_deg, self.frame.altitude_m),
            velocity_m_s=np.array([photo.velocity_m_s for photo in taken]),
            heights=height_grid(self.world, outline_m),
            check_points_m=check_points(self.world, outline_m, self.options.seed),
            identity=self._identity,
        )

    def write_truth(self) -> SurveyTruth | None:
        """``truth.json`` beside the photos taken so far.

        Raises:
            OutputError: it cannot be written.
        """
        truth = self.truth()
        if truth is not None:
            clock = self.options.clock
            extra = {
                "summary": "photos of a vehicle, by a simulated camera",
                "options": {
                    "world": self.options.world,
                    "clock_offset_s": clock.offset_s,
                    "clock_drift_ppm": clock.drift_ppm,
                    "whole_seconds": clock.whole_seconds,
                },
            }
            write_truth(self.out / TRUTH_FILE, truth, extra)
        return truth
