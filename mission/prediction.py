"""What a planned mission will tell about its camera, before take-off, and the photos that cure it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import Polygon

from calib.align.network import height_levels
from calib.brownfit import fit_brown
from calib.camera import BrownCamera, FloatArray
from calib.equifinal import Radial
from calib.evidence import CONVERGENT_DEG, STEEP_DEG, Evidence
from calib.findings import State, Verdict
from calib.limits import DOME_LIMIT_PERCENT, decide, percent
from calib.network_design import lens_information
from calib.network_views import seen_points
from calib.propagation import radial_px_covariance
from calib.rules_network import convergent_share, focal_sigma
from mission.plan import Plan, Station, stations
from mission.planned_network import (
    Assumptions,
    PlannedNetwork,
    ground_heights_m,
    ground_points,
    planned_network,
    poses,
)
from mission.terrain_height import LevelGround, Terrain

#: Places of the area at which overlap and ground resolution are looked at.
PLACES = 3000


@dataclass(frozen=True)
class Prediction:
    """What the calibration of a planned mission is expected to be worth.

    Sigmas contain the measured model error. ``sigma_k_px`` are those of K1-K3 in pixel units
    (px^-2, px^-4, px^-6). ``dome_*``: sigma of the terrain's dome at the site's edge, and in percent
    of the flying height: what the lens leaves open and what the block would bend were it known.
    ``gsd_*``: ground resolution, over the area, of the sharpest photo of each place.
    ``least_views``: photos that see the worst place of the area, ``least_views_at_m`` (east, north).
    ``verdict``: what the check will say at best, given a good reference; ``reason`` in one sentence.
    """

    sigma_f_percent: float
    sigma_k_px: tuple[float, float, float]
    k1_k2_correlation: float
    dome_sigma_m: float
    dome_percent: float
    convergent_share: float
    photos: int
    height_agl_m: float
    gsd_worst_m: float
    gsd_mean_m: float
    least_views: int
    least_views_at_m: tuple[float, float]
    verdict: Verdict
    reason: str


def predict(
    plan: Plan,
    terrain: Terrain | None = None,
    area: Polygon | None = None,
    assumptions: Assumptions | None = None,
) -> Prediction:
    """Predict what an alignment of the plan's photos will know of the camera.

    Args:
        terrain: None: level ground at the launch point's height.
        area: east, north in metres around the launch point; None: hull of the stations.

    Raises:
        InputError: fewer than two photos, or no two that overlap.
    """
    photos = stations(plan)
    ground = LevelGround() if terrain is None else terrain
    return predict_stations(photos, plan.camera, ground, area, assumptions or Assumptions())


def predict_stations(
    photos: Sequence[Station],
    camera: BrownCamera,
    terrain: Terrain,
    area: Polygon | None,
    assumptions: Assumptions,
    planned: PlannedNetwork | None = None,
) -> Prediction:
    """:func:`predict` for photos without a plan around them. ``planned``: their network, where known."""
    planned = planned or planned_network(photos, camera, terrain, assumptions)
    net, factor = planned.network, assumptions.model_error_factor
    information = lens_information(net, planned.known, planned.functionals)
    jacobian = fit_brown(net.lens)[1]
    brown = factor**2 * jacobian @ information.covariance @ jacobian.T
    radial = radial_px_covariance(camera, brown)[:3, :3]
    sigma_k = np.sqrt(np.diag(radial))
    sigma_f = math.sqrt(brown[0, 0])
    dome_m = factor * float(information.sigma[0])
    tilt = np.array([90.0 + s.pitch_deg for s in photos])
    rotations, centres = poses(photos)
    agl = centres[:, 2] - ground_heights_m(terrain, centres)
    views, at, gsd_m = _cover(rotations, centres, camera, terrain, area)
    evidence = Evidence(
        f_px=camera.f_px,
        sigma_f_px=sigma_f,
        sigma_f_formal_px=sigma_f / factor,
        radial=Radial.of(camera),
        radial_covariance=radial,
        # The best that can come: a reference that is exact.
        f_ref_px=camera.f_px,
        nadir=int((tilt < CONVERGENT_DEG).sum()),
        convergent=int(((tilt >= CONVERGENT_DEG) & (tilt <= STEEP_DEG)).sum()),
        steep=int((tilt > STEEP_DEG).sum()),
        largest_tilt_deg=float(tilt.max()),
        heights_agl_m=height_levels(agl),
    )
    dome_percent = 100 * dome_m / planned.height_agl_m
    verdict, reason = _expected(evidence, dome_percent)
    return Prediction(
        sigma_f_percent=100 * sigma_f / camera.f_px,
        sigma_k_px=(float(sigma_k[0]), float(sigma_k[1]), float(sigma_k[2])),
        k1_k2_correlation=float(radial[0, 1] / (sigma_k[0] * sigma_k[1])),
        dome_sigma_m=dome_m,
        dome_percent=dome_percent,
        convergent_share=evidence.convergent_share or 0.0,
        photos=len(photos),
        height_agl_m=planned.height_agl_m,
        gsd_worst_m=float(gsd_m.max()),
        gsd_mean_m=float(gsd_m.mean()),
        least_views=views,
        least_views_at_m=at,
        verdict=verdict,
        reason=reason,
    )


def _cover(
    rotations: FloatArray,
    centres_m: FloatArray,
    camera: BrownCamera,
    terrain: Terrain,
    area: Polygon | None,
) -> tuple[int, tuple[float, float], FloatArray]:
    """Views of the worst place of the area, where it is, and the best GSD of each place seen (n,)."""
    if area is None:
        hull = shapely.MultiPoint(centres_m[:, :2]).convex_hull
        area = hull if isinstance(hull, Polygon) else hull.buffer(1.0)
    places = ground_points(area, area.area / PLACES, terrain)
    photo, place = seen_points(camera, rotations, centres_m, places)
    counts = np.bincount(place, minlength=len(places))
    worst = int(counts.argmin())
    distance = np.linalg.norm(centres_m[photo] - places[place], axis=1)
    best = np.full(len(places), np.inf)
    np.minimum.at(best, place, distance / camera.f_px)
    seen = best[np.isfinite(best)]
    return int(counts[worst]), (float(places[worst, 0]), float(places[worst, 1])), seen


def _expected(evidence: Evidence, dome_percent: float) -> tuple[Verdict, str]:
    """The verdict to expect when nothing is wrong with camera and photos, by the check's own rules."""
    findings = (focal_sigma(evidence), convergent_share(evidence))
    dome = decide(0.0, dome_percent, DOME_LIMIT_PERCENT)
    for finding in findings:
        if finding.state is State.FLAG:
            return Verdict.REFLY, finding.message
    if findings[0].state is not State.PASS:
        return Verdict.CANNOT_TELL, findings[0].message
    if dome is not State.PASS:
        return (
            Verdict.CANNOT_TELL,
            f"The site may be bent by {percent(dome_percent)} of the flying height (1 sigma); "
            f"{DOME_LIMIT_PERCENT:g} % can not be told apart from that.",
        )
    return (
        Verdict.TRUST,
        f"The focal length will be known to {percent(100 * evidence.sigma_f_px / evidence.f_px)} (1 sigma) "
        f"and the site's bending to {percent(dome_percent)} of the flying height.",
    )
