"""The numbers that a judgement rests on, and how they are taken from a solved block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import BROWN_NAMES, FloatArray
from calib.equifinal import (
    MINIMAX_ALPHA,
    MINIMAX_BETA,
    STRICT_TOLERANCE_PX,
    Deviation,
    Radial,
    best_pair,
    equifinal_region,
    image_radius_px,
    profile_deviation,
)
from calib.equifinal_published import radial_of
from calib.errors import InputError
from calib.propagation import radial_px_covariance
from calib.reference import EquifinalLine, Reference
from calib.solution import Dome, Estimate, HeldFit, Network, Solution

#: Tilt off nadir from which a photo counts as convergent, and up to which [C&D] recommend.
CONVERGENT_DEG, STEEP_DEG = 20.0, 45.0
#: The sensor is divided into GRID x GRID cells; a cell with this many observations is covered.
GRID, ENOUGH = 8, 3


@dataclass(frozen=True)
class Offset:
    """Where the survey's (K1, K2) lies relative to a line, pixel units.

    ``k2_px`` is K2 minus the line, ``inside_k1_px`` the distance of K1 to the nearer end of the
    domain (negative outside), each with its standard deviation (survey and reference together).
    """

    k2_px: float
    sigma_k2_px: float
    inside_k1_px: float
    sigma_k1_px: float


@dataclass(frozen=True)
class Coverage:
    """Share (0..1) of the sensor's cells with enough observations: middle, edges, corners."""

    centre: float
    edges: float
    corners: float


@dataclass(frozen=True)
class Evidence:
    """What the rules look at. Lengths of the lens in px; None where nothing is known.

    ``sigma_f_px`` is inflated by model spread and correlated residuals, ``sigma_f_formal_px``
    is not. ``radial`` and ``radial_covariance`` (3, 3) are K1-K3 in pixel units.
    """

    f_px: float
    sigma_f_px: float
    sigma_f_formal_px: float
    radial: Radial
    radial_covariance: FloatArray
    tolerance_px: float = STRICT_TOLERANCE_PX

    #: Reference; ``reference_note`` says why there is none, or how it was converted.
    reference_name: str | None = None
    reference_note: str = ""
    f_ref_px: float | None = None
    sigma_f_ref_px: float = 0.0
    deviation: Deviation | None = None
    line: EquifinalLine | None = None
    offset: Offset | None = None

    #: Photos with a known tilt, by their angle off nadir: below 20, 20 to 45, beyond 45 degrees.
    nadir: int | None = None
    convergent: int | None = None
    steep: int | None = None
    largest_tilt_deg: float | None = None
    heights_agl_m: tuple[float, ...] = ()

    #: Signed, percent of the flying height; the amplitude needs a reference, and its sigma holds that of the
    #: reference. What the photos alone leave open (1 sigma) needs none.
    dome_percent: float | None = None
    sigma_dome_percent: float | None = None
    dome_left_open_percent: float | None = None
    #: None as well where the block has no scale in metres.
    dome_m: float | None = None

    #: f of the odd minus f of the even photos, and the largest projection difference in sigmas.
    split_f_px: float | None = None
    split_sigma_f_px: float | None = None
    split_profile_ratio: float | None = None

    spread_f_px: float | None = None
    models: tuple[str, ...] = ()
    coverage: Coverage | None = None

    aligned: int = 0
    used: int = 0
    components: tuple[int, ...] = ()
    rms_px: float | None = None
    converged: bool = True
    #: One sentence when the positions in the photos contradict the block.
    geotag_fault: str | None = None
    #: How a lens held at the reference fits (None: it was free).
    held: HeldFit | None = None

    @property
    def convergent_share(self) -> float | None:
        if self.nadir is None or self.convergent is None or self.steep is None:
            return None
        photos = self.nadir + self.convergent + self.steep
        return (self.convergent + self.steep) / photos if photos else None


def gather_evidence(
    solution: Solution,
    estimate: Estimate,
    network: Network,
    dome: Dome | None,
    reference: Reference | None,
    reference_note: str = "",
    tolerance_px: float = STRICT_TOLERANCE_PX,
    held: HeldFit | None = None,
) -> Evidence:
    """Evidence from a solved block. ``reference`` must already be converted to its image size."""
    brown = estimate.brown
    radial = Radial.of(brown)
    covariance = radial_px_covariance(brown, estimate.covariance)[:3, :3]
    deviation = line = offset = f_ref = None
    if reference is not None:
        f_ref = reference.f_px
        try:
            against = radial_of(reference)[0]
        except InputError:
            against = None
        if against is not None:
            together = covariance + reference_radial_covariance(reference)
            radius = image_radius_px(brown)
            deviation = profile_deviation(radial, against, radius, together)
            line, offset = line_and_offset(radial, against, together, radius, tolerance_px)
    tilt = network.tilt_deg[np.isfinite(network.tilt_deg)]
    known = len(tilt) > 0
    height = dome.flying_height_m if dome is not None else float("nan")
    return Evidence(
        f_px=brown.f_px,
        sigma_f_px=estimate.sigma_f_px,
        sigma_f_formal_px=estimate.sigma_f_formal_px,
        radial=radial,
        radial_covariance=covariance,
        tolerance_px=tolerance_px,
        reference_name=None if reference is None else reference.name,
        reference_note=reference_note,
        f_ref_px=f_ref,
        sigma_f_ref_px=0.0 if reference is None else reference_sigma_f_px(reference),
        deviation=deviation,
        line=line,
        offset=offset,
        nadir=int(np.sum(tilt < CONVERGENT_DEG)) if known else None,
        convergent=int(np.sum((tilt >= CONVERGENT_DEG) & (tilt <= STEEP_DEG))) if known else None,
        steep=int(np.sum(tilt > STEEP_DEG)) if known else None,
        largest_tilt_deg=float(tilt.max()) if known else None,
        heights_agl_m=network.heights_agl_m,
        dome_percent=None if dome is None else dome.amplitude_percent,
        sigma_dome_percent=None if dome is None or not height > 0 else 100 * dome.sigma_m / height,
        dome_left_open_percent=None if dome is None or not height > 0 else 100 * dome.left_open_m / height,
        dome_m=None if dome is None or not solution.georeference.metric else dome.amplitude_m,
        split_f_px=_finite(estimate.split_f_px),
        split_sigma_f_px=_finite(estimate.split_sigma_f_px),
        split_profile_ratio=_finite(estimate.split_profile_ratio),
        spread_f_px=_finite(estimate.spread_f_px) if estimate.models else None,
        models=tuple(estimate.models),
        coverage=sensor_coverage(solution.observations.pixels, brown.width, brown.height),
        aligned=len(solution.photos),
        used=max(solution.photos_used, len(solution.photos)),
        components=solution.components,
        rms_px=solution.rms_px,
        converged=solution.converged,
        # Too few positions to fit contradict nothing.
        geotag_fault=None if solution.georeference.rms_xy_m is None else solution.georeference.fault,
        held=held,
    )


def reference_sigma_f_px(reference: Reference) -> float:
    """Standard deviation of the reference's f; 0 where it claims to be exact."""
    if reference.fitted_covariance is not None:
        return float(np.sqrt(max(reference.fitted_covariance[0, 0], 0.0)))
    return reference.sigma.get("f", 0.0)


def reference_radial_covariance(reference: Reference) -> FloatArray:
    """Covariance (3, 3) of the reference's K1-K3 in pixel units."""
    brown = reference.comparable_brown
    if brown is not None:
        covariance = reference.fitted_covariance
        if covariance is None and reference.covariance is not None and reference.fitted_brown is None:
            covariance = reference.covariance[: len(BROWN_NAMES), : len(BROWN_NAMES)]
        if covariance is None:
            covariance = np.diag([reference.sigma.get(key, 0.0) ** 2 for key in BROWN_NAMES])
            # Separate sigmas of K1-K3 hide that they compensate each other; f is left out so that
            # its sigma is not counted a second time here.
            covariance[0, 0] = 0.0
        return radial_px_covariance(brown, covariance)[:3, :3]
    f = reference.focal_px or float("inf")
    sigma = [reference.sigma.get(f"k{n}", 0.0) / f ** (2 * n) for n in (1, 2, 3)]
    return np.diag(np.square(sigma))


def line_and_offset(
    survey: Radial, reference: Radial, covariance: FloatArray, radius_px: float, tolerance_px: float
) -> tuple[EquifinalLine | None, Offset | None]:
    """The equifinal line for models with the survey's K3, and where the survey lies on it.

    K3 belongs to the pair: at the survey's own K3 a pair on the line gives the reference's
    profile. Its sigma enters through the pair that would replace it. None, None where K3 is so
    far from the reference's that no pair comes within tolerance.
    """
    try:
        line = equifinal_region(reference, radius_px, tolerance_px, survey.k3_px).line
    except InputError:
        return None, None
    # (K1, K2) after K3 is absorbed into them, by K1, K2, K3.
    absorbed = np.array([[1.0, 0.0, MINIMAX_ALPHA * radius_px**4], [0.0, 1.0, MINIMAX_BETA * radius_px**2]])
    across = np.array([-line.slope, 1.0]) @ absorbed
    return line, Offset(
        k2_px=survey.k2_px - line.slope * survey.k1_px - line.intercept,
        sigma_k2_px=float(np.sqrt(max(across @ covariance @ across, 0.0))),
        inside_k1_px=min(survey.k1_px - line.k1_min, line.k1_max - survey.k1_px),
        sigma_k1_px=float(np.sqrt(max(absorbed[0] @ covariance @ absorbed[0], 0.0))),
    )


def reference_on_line(reference: Radial, survey: Radial, radius_px: float) -> tuple[float, float]:
    """The reference's (K1, K2) at the survey's K3: the point to draw beside the survey's line."""
    pair, _ = best_pair(reference, radius_px, survey.k3_px)
    return pair.k1_px, pair.k2_px


def sensor_coverage(pixels: FloatArray, width: int, height: int) -> Coverage:
    """Share of covered cells of an 8 x 8 grid over the sensor. ``pixels`` (n, 2)."""
    column = np.clip((pixels[:, 0] / width * GRID).astype(int), 0, GRID - 1)
    row = np.clip((pixels[:, 1] / height * GRID).astype(int), 0, GRID - 1)
    covered = np.bincount(row * GRID + column, minlength=GRID * GRID).reshape(GRID, GRID) >= ENOUGH
    outer = np.zeros((GRID, GRID), dtype=bool)
    outer[[0, -1], :] = outer[:, [0, -1]] = True
    # A corner is the two-by-two block of cells there.
    near = np.zeros(GRID, dtype=bool)
    near[[0, 1, -2, -1]] = True
    corner = np.outer(near, near)
    return Coverage(
        centre=float(covered[~outer].mean()),
        edges=float(covered[outer & ~corner].mean()),
        corners=float(covered[corner].mean()),
    )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
