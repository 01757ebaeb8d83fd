"""How fast photos of 12 megapixels are rendered: CPU seconds on one core, over ground and at structures.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.render_speed [--width 4000]

CPU seconds are those of all threads together. Making the world and the lens's rays is not counted:
both are made once per survey.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import dataclass

import cv2
import numpy as np

from calib.field import Lens
from sim.flights import phantom3, rotation_looking
from sim.render import RenderOptions, lens_rays, render
from sim.world import World
from sim.worlds import build_world

ROLLING_SHUTTER = RenderOptions(readout_s=0.03)
SMEARED = RenderOptions(readout_s=0.03, exposure_s=1 / 400)


@dataclass(frozen=True)
class Case:
    """A photo: world, place (m), compass direction and angle off nadir (degrees)."""

    name: str
    kind: str
    centre_m: tuple[float, float, float]
    yaw_deg: float
    off_nadir_deg: float
    options: RenderOptions
    texel_m: float = 0.04


CASES = (
    Case("rolling, nadir, 60 m", "rolling", (0, 0, 60), 0, 0, RenderOptions()),
    Case("rolling, 40 degrees off nadir", "rolling", (0, -50, 60), 0, 40, ROLLING_SHUTTER),
    Case("rolling, the same with motion blur", "rolling", (0, -50, 60), 0, 40, SMEARED),
    Case("levee, 40 degrees off nadir", "levee", (0, -50, 60), 0, 40, ROLLING_SHUTTER),
    Case("lodge, orbit at 25 m", "building", (0, -22, 14), 0, 65, ROLLING_SHUTTER, 0.01),
    Case("wall, from 10 m", "wall", (0, -10, 4), 0, 90, ROLLING_SHUTTER, 0.005),
)


def main() -> None:
    """Print megapixels per CPU second of every case, the best of two photos each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--width", type=int, default=4000, help="width of the photos in px (default: 4000)")
    width = parser.parse_args().width // 4 * 4
    size = (width, width * 3 // 4)
    cv2.setNumThreads(1)
    rays = lens_rays(Lens(phantom3(*size)))
    print(f"{size[0]} x {size[1]} px, one thread")
    world: World | None = None
    kind = ""
    for case in CASES:
        if case.kind != kind:
            world = None  # two worlds at a time would be counted as memory
            half_m = 130.0 if case.texel_m > 0.02 else 60.0
            world = build_world(case.kind, 1, half_m=half_m, texel_m=case.texel_m)
            kind = case.kind
        assert world is not None
        rotation = rotation_looking(np.array([case.yaw_deg]), np.array([case.off_nadir_deg]))[0]
        seconds = []
        for seed in (1, 2):
            started = time.process_time()
            render(
                world,
                rays,
                rotation,
                np.array(case.centre_m, float),
                velocity_m_s=np.array([8.0, 0.0, 0.0]),
                options=case.options,
                seed=seed,
            )
            seconds.append(time.process_time() - started)
        rate = size[0] * size[1] / 1e6 / min(seconds)
        print(f"{case.name:36} {min(seconds):6.2f} CPU s   {rate:5.2f} megapixels/s")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
