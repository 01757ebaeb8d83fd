"""Cameras for the tests of conversions and formats."""

from __future__ import annotations

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from calib.camera import BrownCamera, FloatArray
from calib.convert import radial_in_focal_units

#: [C&D] flat wall: DJI Phantom 3 Professional, K in px units.
P3P_RADIAL_PX = (-2.53e-8, 3.96e-15, -1.15e-22)
P3P = BrownCamera(4000, 3000, 2320.06, 2010.0, 1490.0, *radial_in_focal_units(P3P_RADIAL_PX, 2320.06))

#: (width, height, f / width from, to, largest |K1|): consumer drones, wide action cameras, thermal.
KINDS = (
    (4000, 3000, 0.55, 0.75, 0.2),
    (5472, 3648, 0.62, 0.75, 0.05),
    (4000, 2250, 0.55, 0.75, 0.05),
    (4000, 3000, 0.40, 0.50, 0.3),
    (640, 512, 1.1, 2.2, 0.4),
)


def image_rays(camera: BrownCamera, columns: int = 41, rows: int = 31) -> FloatArray:
    """Rays (n, 2) that fill the image evenly, its border included."""
    u, v = np.linspace(0, camera.width, columns), np.linspace(0, camera.height, rows)
    return camera.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))


def difference_px(a: BrownCamera, b: BrownCamera) -> float:
    """Largest distance of two cameras' projections over ``a``'s image; both must have its size."""
    assert (a.width, a.height) == (b.width, b.height)
    rays = image_rays(a)
    assert np.isfinite(rays).all()
    return float(np.hypot(*(a.project(rays) - b.project(rays)).T).max())


@st.composite
def cameras(
    draw: st.DrawFn,
    *,
    k4: float = 0.0,
    affine: bool = False,
    shear: bool = False,
    weak: bool = False,
) -> BrownCamera:
    """Realistic cameras: every pixel has a ray, and the distortion is monotonic.

    ``k4``: largest part of K4 in the radial factor at the corner. ``weak``: distortion that a
    camera's own correction leaves.
    """
    width, height, low, high, k1_limit = draw(st.sampled_from(KINDS))

    def within(limit: float) -> float:
        return draw(st.floats(-limit, limit, allow_subnormal=False))

    f = width * draw(st.floats(low, high))
    corner = float(np.hypot(width, height) / 2 / f)
    if weak:
        k1_limit = 0.005 / corner**2
    k1 = within(k1_limit)
    # Lenses have K1 and K2 of opposite signs ([C&D] Table 5).
    k2 = -k1 * draw(st.floats(0, 0.6))
    k3 = k1 * draw(st.floats(-0.1, 0.1))
    decentring = 2e-5 if weak else 5e-4
    camera = BrownCamera(
        width,
        height,
        f,
        width / 2 + within(0.02 * width),
        height / 2 + within(0.02 * height),
        k1,
        k2,
        k3,
        within(k4 / corner**8) if k4 else 0.0,
        within(decentring),
        within(decentring),
        within(3.0) if affine else 0.0,
        within(3.0) if shear else 0.0,
    )
    assume(np.isfinite(image_rays(camera)).all())
    return camera
