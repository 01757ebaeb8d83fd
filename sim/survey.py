"""Rendered surveys: a folder of photos as a drone would bring them, and ``truth.json``."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.errors import InputError
from calib.field import Lens
from calib.frames import rotation_tilt_deg
from calib.photos.photo import CameraIdentity, Processing
from sim.cameras import CameraModel, find_camera
from sim.flights import Flight, jittered
from sim.gps import GpsKind
from sim.network import smooth_noise
from sim.options import SurveyOptions
from sim.pattern import random_pattern
from sim.photo_writer import write_photo
from sim.recipes import Recipe, find_recipe
from sim.render import lens_rays, render
from sim.shapes import looking_at
from sim.sites import check_points, height_grid, site_world
from sim.tags import seconds_of, tags_of
from sim.truth import TRUTH_FILE, HeightGrid, SurveyTruth, read_truth, true_reference, write_truth
from sim.world import World

__all__ = [
    "TRUTH_FILE",
    "HeightGrid",
    "SurveyOptions",
    "SurveyTruth",
    "identity_of",
    "lens_corrected",
    "read_truth",
    "true_reference",
    "write_survey",
]

#: [C&D]'s site, for which the flights are written down.
_SITE_M = 120.0
#: Texture finer than this is nowhere needed; larger rasters than this take gigabytes.
_LEAST_TEXEL_M, _LARGEST_SIDE = 0.02, 12_000
#: Another flight over the ground of one seed has errors of its own.
_ANOTHER_FLIGHT = 500_000
#: A camera on its landing gear, above the ground.
_GEAR_M = 0.3

#: The last ground made: surveys of one place and seed share it.
_world = lru_cache(maxsize=1)(site_world)


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
    instead: Flight | None = None,
) -> SurveyTruth:
    """Render a survey by name (:mod:`sim.recipes`) into ``out_dir`` and write its truth, last of all.

    ``progress`` is called with photos done and photos in all, from this thread. ``instead``: other photos
    than the recipe's, over the same ground if ``options.texel_m`` is given and the same.

    Raises:
        InputError: no such recipe, or options that it cannot take; one sentence.
        OSError: a photo cannot be written. OutputError: the truth cannot be written.
    """
    options = options or SurveyOptions()
    plan = find_recipe(recipe)
    if options.camera_model is not None:
        plan = replace(plan, camera=find_camera(options.camera_model))
    scale = 1.0 if plan.fixed_scale else options.site_m / _SITE_M
    camera = options.camera or plan.camera.at(*size)
    camera = replace(camera, b1_px=camera.b1_px + options.aspect * camera.f_px)
    pattern = None
    if options.pattern_px > 0:
        pattern = random_pattern(seed, camera, options.pattern_px * camera.width / 4000)
    flight = jittered(
        plan.flight(scale, options.photos) if instead is None else instead,
        seed if instead is None else seed + _ANOTHER_FLIGHT,
        options.position_jitter_m,
        options.height_jitter_m,
        options.attitude_jitter_deg,
    )
    rendering = options.render or plan.camera.rendering
    world = _world_of(plan, flight, camera, seed, scale, options)
    if world.origin_wgs84 is not None:
        latitude_deg, longitude_deg, altitude_m = world.origin_wgs84
        options = replace(
            options, latitude_deg=latitude_deg, longitude_deg=longitude_deg, ground_altitude_m=altitude_m
        )
    if options.take_off_photo:
        flight = _on_the_ground(plan.outline_m[0] * scale, world) + flight
    dji = plan.camera.dji_tags if options.dji_tags is None else options.dji_tags
    speed_m_s = plan.speed_m_s if options.speed_m_s is None else options.speed_m_s
    identity = identity_of(plan.camera, camera, dji, options)
    tags = tags_of(
        flight,
        seconds_of(flight, speed_m_s, plan.interval_s),
        float(flight.centres_m[0, 2]) if options.take_off_photo else 0.0,
        identity,
        (plan.camera.focal_mm, plan.camera.focal_35mm),
        dji,
        seed if instead is None else seed + _ANOTHER_FLIGHT,
        options,
    )
    names = _names(flight, options.apart, "DJI_" if dji else "IMG_")
    for folder in {(out_dir / name).parent for name in names}:
        folder.mkdir(parents=True, exist_ok=True)
    # The truth of an earlier survey here must not outlive its photos.
    (out_dir / TRUTH_FILE).unlink(missing_ok=True)
    truth = SurveyTruth(
        recipe,
        seed,
        camera,
        pattern,
        names,
        flight.rotations_cam_from_world,
        flight.centres_m,
        (options.latitude_deg, options.longitude_deg, options.ground_altitude_m),
        velocity_m_s=speed_m_s * flight.track,
        readout_s=rendering.readout_s,
        heights=height_grid(world, plan.outline_m * scale),
        check_points_m=check_points(world, plan.outline_m * scale, seed),
        take_off=names[:1] if options.take_off_photo else (),
        identity=identity,
    )
    rays = lens_rays(Lens(camera), pattern)

    def make(i: int) -> None:
        image = render(
            world,
            _shimmering(rays, camera, options.haze_px, seed * 1000 + i),
            flight.rotations_cam_from_world[i],
            flight.centres_m[i],
            velocity_m_s=speed_m_s * flight.track[i],
            options=rendering,
            seed=seed * 1000 + i,
        )
        write_photo(out_dir / names[i], image, tags[i])

    # Threads, not processes: the work is done inside numpy and OpenCV, and the world is large.
    pool = ThreadPoolExecutor(min(workers, 2))
    try:
        for done, _ in enumerate(pool.map(make, range(len(flight))), start=1):
            if progress is not None:
                progress(done, len(flight))
    finally:
        pool.shutdown(cancel_futures=True)  # After Ctrl-C only those that are begun are finished.
    write_truth(out_dir / TRUTH_FILE, truth, _for_people(plan, options))
    return truth


def _shimmering(rays: FloatArray, camera: BrownCamera, rms_px: float, seed: int) -> FloatArray:
    """Rays (height, width, 2) bent by air: correlated over the photo, independent between photos."""
    if rms_px == 0:
        return rays
    rng = np.random.default_rng([seed, 9])
    nodes = np.stack(np.meshgrid(np.linspace(0, 1, 81), np.linspace(0, camera.height / camera.width, 61)), -1)
    shift = smooth_noise(rng, 1, np.zeros(nodes.size // 2, int), nodes.reshape(-1, 2)).reshape(nodes.shape)
    full = cv2.resize(shift, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    bent: FloatArray = rays + full * (rms_px * camera.width / 4000 / camera.f_px)
    return bent


def _world_of(
    plan: Recipe, flight: Flight, camera: BrownCamera, seed: int, scale: float, options: SurveyOptions
) -> World:
    if options.ortho is not None and options.dem is None:
        raise InputError("An orthophoto needs the DEM that it lies on: give both.")
    if options.dem is not None and plan.fixed_scale:
        raise InputError(f"{plan.name} photographs a structure of its own: it cannot be flown over a DEM.")
    half_m = plan.reach_m * scale
    # As fine as the pixels of the nearest photos.
    nearest_m = plan.nearest_m if plan.fixed_scale else float(flight.centres_m[:, 2].min())
    least_m = 0.25 * _LEAST_TEXEL_M if plan.fixed_scale else _LEAST_TEXEL_M
    texel_m = options.texel_m or max(nearest_m / camera.f_px, least_m, 2 * half_m / _LARGEST_SIDE)
    kind = plan.world if options.dem is None else "dem"
    return _world(
        kind,
        seed,
        half_m=half_m,
        texel_m=texel_m,
        relief_m=options.relief_m,
        roughness=plan.roughness,
        scale=scale,
        dem=options.dem,
        ortho=options.ortho,
    )


def _on_the_ground(launch_m: FloatArray, world: World) -> Flight:
    """One photo from the launch point (east, north), towards the site's middle."""
    ground = world.height_m(launch_m[:1], launch_m[1:])
    centre = np.array([[launch_m[0], launch_m[1], float(ground[0]) + _GEAR_M]])
    aim = np.array([0.0, 0.0, centre[0, 2] - 0.1 * float(np.hypot(*launch_m))])
    return Flight(looking_at(centre, aim), centre, np.zeros((1, 3)))


def identity_of(model: CameraModel, camera: BrownCamera, dji: bool, options: SurveyOptions) -> CameraIdentity:
    """What the files will say; over MAVLink nobody says what was done to the pixels."""
    if options.lens_corrected is None and options.camera is None:
        processing = model.processing
    else:
        processing = Processing.LENS_CORRECTED if options.lens_corrected else Processing.RAW
    # DJI's name on a file without DJI's tags would be read as one of its early, lens-corrected JPEGs.
    own_name = dji or not model.dji_tags
    return CameraIdentity(
        make=model.make if own_name else "Fieldcal",
        model=options.model or (model.model if own_name else f"SIM-{model.model}"),
        serial=options.serial,
        width=camera.width,
        height=camera.height,
        processing=processing if dji else Processing.UNKNOWN,
        focal_mm=model.focal_mm,
    )


def _names(flight: Flight, apart: bool, prefix: str) -> tuple[str, ...]:
    def folder(rotation: FloatArray) -> str:
        return ("convergent/" if rotation_tilt_deg(rotation) > 20 else "nadir/") if apart else ""

    return tuple(
        f"{folder(r)}{prefix}{i:04d}.JPG" for i, r in enumerate(flight.rotations_cam_from_world, start=1)
    )


def _for_people(plan: Recipe, options: SurveyOptions) -> dict[str, Any]:
    """What the survey was asked for, for those who read the file."""
    asked = {
        key: value if isinstance(value, (int, float, str, dict, type(None))) else str(value)
        for key, value in asdict(replace(options, camera=None)).items()
    }
    if options.gps is not GpsKind.RTK:
        del asked["rtk_sigma_m"]
    return {"summary": plan.summary, "notes": plan.notes, "options": asked}
