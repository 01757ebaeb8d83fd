"""Rendered surveys: a folder of photos as a drone would bring them, and ``truth.json``."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.field import Lens
from calib.frames import LocalFrame, rotation_tilt_deg
from calib.photos.photo import GimbalAngles
from sim.flights import Flight, flight_plan, jittered, phantom3
from sim.pattern import Pattern, random_pattern
from sim.photo_writer import PhotoTags, level_gimbal, write_photo
from sim.render import RenderOptions, lens_rays, render
from sim.world import World, make_world

TRUTH_FILE = "truth.json"


@dataclass(frozen=True)
class SurveyOptions:
    """How a rendered survey is flown and photographed.

    ``camera``: true lens (default: the papers' Phantom 3 scaled to the size). ``pattern_px``: largest
    length of a non-Brown pattern at 4000 px image width; ``aspect``: b1 / f. Errors of what is
    written: ``gps_sigma_m`` horizontally, ``height_sigma_m`` vertically, ``gimbal_sigma_deg`` of
    pitch and yaw. ``apart``: nadir and convergent photos go to folders of their own.
    ``lens_corrected``: what the files say about it (see :func:`lens_corrected` for such a lens).
    """

    camera: BrownCamera | None = None
    pattern_px: float = 0.0
    aspect: float = 0.0
    site_m: float = 120.0
    relief_m: float = 2.0
    gps_sigma_m: float = 2.5
    height_sigma_m: float = 0.5
    gimbal_sigma_deg: float = 1.0
    position_jitter_m: float = 1.0
    height_jitter_m: float = 0.5
    attitude_jitter_deg: float = 1.0
    speed_m_s: float = 8.0
    render: RenderOptions = field(default_factory=RenderOptions)
    apart: bool = False
    texel_m: float | None = None
    lens_corrected: bool = False
    model: str = "FC300X"
    serial: str | None = "FIELDCALSIM0001"
    start: datetime = datetime(2026, 5, 12, 10, 30, 0, 250_000)  # local, as cameras write it
    latitude_deg: float = 50.8310
    longitude_deg: float = -0.1420
    ground_altitude_m: float = 75.0


@dataclass(frozen=True)
class SurveyTruth:
    """What a rendered survey was made from.

    photos: k paths relative to the survey's folder; rotations_cam_from_world (k, 3, 3),
    centres_m (k, 3), in the frame at ``origin_wgs84`` (ground level, x east, y north, z up).
    """

    recipe: str
    seed: int
    camera: BrownCamera
    pattern: Pattern | None
    photos: tuple[str, ...]
    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    origin_wgs84: tuple[float, float, float]

    def total_px(self, rays: FloatArray) -> FloatArray:
        """Rays (..., 2) -> pixels (..., 2): the true total mapping."""
        brown_px = self.camera.project(rays)
        return brown_px if self.pattern is None else brown_px + self.pattern(brown_px)


def lens_corrected(camera: BrownCamera, k1_left: float = -0.01) -> BrownCamera:
    """The camera of JPEGs that were corrected inside it, with the little K1 that this leaves.

    Give such a survey a ``pattern_px`` as well: what corrections leave is not Brown's.
    """
    ideal = BrownCamera.ideal(camera.width, camera.height, camera.f_px)
    return replace(ideal, k1=k1_left)


def write_survey(
    recipe: str,
    out_dir: Path,
    seed: int,
    *,
    size: tuple[int, int] = (1000, 750),
    options: SurveyOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    workers: int = 2,
) -> SurveyTruth:
    """Render a flight (:func:`sim.flights.flight_plan`) into ``out_dir`` and write its truth.

    ``progress`` is called with photos done and photos in all, from this thread.

    Raises:
        KeyError: no recipe of that name.
        OSError: a file cannot be written.
    """
    options = options or SurveyOptions()
    width, height = size
    camera = options.camera or phantom3(width, height)
    camera = replace(camera, b1_px=camera.b1_px + options.aspect * camera.f_px)
    pattern = None
    if options.pattern_px > 0:
        pattern = random_pattern(seed, camera, options.pattern_px * camera.width / 4000)
    flight = jittered(
        flight_plan(recipe, options.site_m),
        seed,
        options.position_jitter_m,
        options.height_jitter_m,
        options.attitude_jitter_deg,
    )
    tags = _tags(flight, seed, options)
    names = _names(flight, options.apart)
    for folder in {(out_dir / name).parent for name in names}:
        folder.mkdir(parents=True, exist_ok=True)
    truth = SurveyTruth(
        recipe,
        seed,
        camera,
        pattern,
        names,
        flight.rotations_cam_from_world,
        flight.centres_m,
        (options.latitude_deg, options.longitude_deg, options.ground_altitude_m),
    )
    # As fine as the pixels of the lowest photos.
    gsd_m = float(flight.centres_m[:, 2].min()) / camera.f_px
    texel_m = options.texel_m or max(gsd_m, 0.02)
    world = _world(seed, 1.25 * options.site_m, texel_m, options.relief_m)
    rays = lens_rays(Lens(camera), pattern)

    def make(i: int) -> None:
        image = render(
            world,
            rays,
            flight.rotations_cam_from_world[i],
            flight.centres_m[i],
            velocity_m_s=options.speed_m_s * flight.track[i],
            options=options.render,
            seed=seed * 1000 + i,
        )
        write_photo(out_dir / names[i], image, tags[i])

    # Threads, not processes: the work is done inside numpy and OpenCV, and the world is large.
    with ThreadPoolExecutor(min(workers, 2)) as pool:
        for done, _ in enumerate(pool.map(make, range(len(flight))), start=1):
            if progress is not None:
                progress(done, len(flight))
    _write_truth(out_dir / TRUTH_FILE, truth)
    return truth


@lru_cache(maxsize=1)
def _world(seed: int, half_m: float, texel_m: float, relief_m: float) -> World:
    return make_world(seed, half_m=half_m, texel_m=texel_m, relief_m=relief_m)


def _names(flight: Flight, apart: bool) -> tuple[str, ...]:
    def folder(rotation: FloatArray) -> str:
        return ("convergent/" if rotation_tilt_deg(rotation) > 20 else "nadir/") if apart else ""

    return tuple(
        f"{folder(r)}DJI_{i:04d}.JPG" for i, r in enumerate(flight.rotations_cam_from_world, start=1)
    )


def _tags(flight: Flight, seed: int, options: SurveyOptions) -> list[PhotoTags]:
    """What the vehicle writes: positions and angles with their errors, times from the way flown."""
    rng = np.random.default_rng([seed, 7])
    k = len(flight)
    sigma = [options.gps_sigma_m, options.gps_sigma_m, options.height_sigma_m]
    error = rng.normal(size=(k, 3)) * sigma
    frame = LocalFrame(options.latitude_deg, options.longitude_deg, options.ground_altitude_m)
    geodetic = frame.geodetic(flight.centres_m + error)
    way_m = np.linalg.norm(np.diff(flight.centres_m, axis=0, prepend=flight.centres_m[:1]), axis=1)
    seconds = np.cumsum(np.maximum(way_m / max(options.speed_m_s, 1.0), 2.0))
    gimbals = [level_gimbal(rotation) for rotation in flight.rotations_cam_from_world]
    turned = options.gimbal_sigma_deg * rng.normal(size=(k, 2))
    return [
        PhotoTags(
            time=options.start + timedelta(seconds=round(float(s), 3)),
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            altitude_m=float(altitude),
            height_above_launch_m=float(centre[2] + wrong[2]),
            gimbal=GimbalAngles(gimbal.yaw_deg + turn[0], max(gimbal.pitch_deg + turn[1], -90.0), 0.0),
            flight=GimbalAngles(gimbal.yaw_deg + turn[0], -6.0, 0.5),
            model=options.model,
            serial=options.serial,
            lens_corrected=options.lens_corrected,
        )
        for s, (latitude, longitude, altitude), centre, wrong, gimbal, turn in zip(
            seconds, geodetic, flight.centres_m, error, gimbals, turned, strict=True
        )
    ]


def _write_truth(path: Path, truth: SurveyTruth) -> None:
    pattern = truth.pattern
    content = {
        "schema": "fieldcal.sim/1",
        "recipe": truth.recipe,
        "seed": truth.seed,
        "camera": asdict(truth.camera),
        "pattern_coefficients_px": None if pattern is None else pattern.coefficients.tolist(),
        "origin_wgs84": truth.origin_wgs84,
        "photos": [
            {"name": name, "centre_m": centre, "rotation_cam_from_world": rotation}
            for name, centre, rotation in zip(
                truth.photos,
                truth.centres_m.tolist(),
                truth.rotations_cam_from_world.tolist(),
                strict=True,
            )
        ],
    }
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")


def read_truth(folder: Path) -> SurveyTruth:
    """The truth of a survey that :func:`write_survey` wrote into ``folder``.

    Raises:
        FileNotFoundError: there is none, or it was not finished.
    """
    content = json.loads((folder / TRUTH_FILE).read_text(encoding="utf-8"))
    camera = BrownCamera(**content["camera"])
    coefficients = content["pattern_coefficients_px"]
    pattern = None if coefficients is None else Pattern(camera.width, camera.height, np.array(coefficients))
    latitude, longitude, altitude = content["origin_wgs84"]
    return SurveyTruth(
        content["recipe"],
        content["seed"],
        camera,
        pattern,
        tuple(photo["name"] for photo in content["photos"]),
        np.array([photo["rotation_cam_from_world"] for photo in content["photos"]]),
        np.array([photo["centre_m"] for photo in content["photos"]]),
        (latitude, longitude, altitude),
    )
