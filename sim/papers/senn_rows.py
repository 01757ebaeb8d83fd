"""[SEN] Table 2: the eight printed calibrations in one direction, compared by what they do to a picture."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from calib.brownfit import image_grid_rays, turned_rays
from calib.camera import BrownCamera, FloatArray
from calib.convert import radial_in_focal_units
from calib.correction import CorrectionModel, fit_from_correction
from calib.equifinal import image_radius_px, without_scale
from calib.field import Lens
from sim.papers import plots, published
from sim.papers.common import Place, Section

Key = tuple[str, str, str]


def camera_of(key: Key, flipped: bool = False) -> tuple[BrownCamera, float]:
    """A row as Brown's model, undistorted to distorted, and what the conversion costs at worst, px.

    VMS corrects measured positions, Metashape distorts ideal ones. ``flipped``: the VMS row taken over with
    the signs of K and P turned, as is tempting.
    """
    width, height, pitch_mm = published.SENSORS[key[0]]
    c, xp, yp, k1, k2, k3, p1, p2 = published.TABLE_2[key]
    f = c / pitch_mm
    cx, cy = width / 2 + xp / pitch_mm, height / 2 - yp / pitch_mm
    radial = radial_in_focal_units((k1, k2, k3), c)
    if key[1] == "VMS" and not flipped:
        # y is up in the table: P2, which goes with y there, changes its sign with it.
        fit = fit_from_correction(CorrectionModel(width, height, f, cx, cy, radial, p1 * c, -p2 * c))
        return fit.camera, fit.misfit_px
    sign = -1.0 if key[1] == "VMS" else 1.0
    a, b, d = (sign * k for k in radial)
    # P1 goes with x in the table and with y in Brown's model as it is used here.
    return BrownCamera(width, height, f, cx, cy, k1=a, k2=b, k3=d, p1=sign * -p2 * c, p2=sign * p1 * c), 0.0


def profile_px(camera: BrownCamera, r_px: FloatArray) -> FloatArray:
    """Radial displacement (n,) at ideal radii (n,), K4 of the conversion included."""
    r = r_px / camera.f_px
    return np.asarray(
        camera.f_px * (camera.k1 * r**3 + camera.k2 * r**5 + camera.k3 * r**7 + camera.k4 * r**9)
    )


def mapping_px(one: BrownCamera, other: BrownCamera) -> float:
    """Rms distance of two projections over the image, px, the best turn of the camera taken out."""
    rays = image_grid_rays(Lens(other))
    difference = (one.project(rays) - other.project(rays)).ravel()
    by_ray = other.derivatives(rays)[1]
    turn, _ = np.linalg.qr((by_ray @ turned_rays(rays)).reshape(-1, 3))
    rest = difference - turn @ (turn.T @ difference)
    return float(np.sqrt(rest @ rest / len(rays)))


def section(place: Place) -> Section:
    """The eight rows."""
    page = Section("9. The eight calibrations of [SEN] Table 2")
    page.say(
        "Four of a thermal, four of an RGB camera, by VMS and by Metashape, in mm (xp to the right, yp up in "
        "all, as it seems). As printed, the K of the two programs have opposite signs: VMS corrects measured "
        "positions, Metashape distorts ideal ones. Here all are in Metashape's direction, the VMS rows by "
        "fitting K1-K4 and P1, P2 to the inverse over the whole image (*misfit*: what that costs at worst). "
        "Profiles at the half width R, in px, as they are and with the best multiple of r taken out, which "
        "is a change of f (*shape*)."
    )
    rows = []
    for key in published.TABLE_2:
        camera, misfit = camera_of(key)
        radius = np.linspace(0, image_radius_px(camera), 101)[1:]
        profile = profile_px(camera, radius)
        printed, pitch = published.TABLE_2[key], published.SENSORS[key[0]][2]
        as_k1 = camera.k1 / (camera.f_px * pitch) ** 2
        rows.append(
            (
                *(" ".join(key), f"{camera.f_px:.1f}", f"{printed[3]:+.2e}", f"{as_k1:+.2e}"),
                *(f"{profile[-1]:+.2f}", f"{without_scale(profile, radius)[-1]:+.2f}"),
                f"{misfit:.2f}" if misfit else "-",
            )
        )
    page.table(
        (
            *("calibration", "f px", "K1 mm^-2 printed", "in one direction"),
            *("profile at R", "shape at R", "misfit px"),
        ),
        rows,
    )
    page.say(
        "Pairs of them: largest difference of the profiles and of their shapes within R, and rms difference "
        "of the whole projection over the picture with the best turn of the camera taken out, px. *Signs "
        "turned*: the same with the VMS row taken over by turning the signs of K and P."
    )
    pairs: list[tuple[str, ...]] = []
    shapes: dict[tuple[Key, Key], float] = {}
    for one, other in _pairs():
        a, b = camera_of(one)[0], camera_of(other)[0]
        radius = np.linspace(0, image_radius_px(a), 101)[1:]
        difference = profile_px(a, radius) - profile_px(b, radius)
        shape = float(np.abs(without_scale(difference, radius)).max())
        shapes[(one, other)] = shape
        naive = camera_of(one, True)[0], camera_of(other, True)[0]
        turned = mapping_px(*naive) if "VMS" in (one[1], other[1]) else None
        pairs.append(
            (
                f"{one[0]}: {one[1]} {one[2]}, {other[1]} {other[2]}",
                f"{100 * (a.f_px / b.f_px - 1):+.2f}",
                f"{np.abs(difference).max():.2f}",
                f"{shape:.2f}",
                f"{mapping_px(a, b):.2f}",
                "-" if turned is None else f"{turned:.2f}",
            )
        )
    page.table(
        ("pair", "f %", "profile px", "shape px", "projection px", "signs turned px"),
        pairs,
    )
    _said(page, shapes)
    page.figure(_figure(place), "[SEN] fig. 5 and 6 again, from Table 2: radial profiles in one direction.")
    return page


def _pairs() -> list[tuple[Key, Key]]:
    found = []
    for sensor in published.SENSORS:
        vms, meta = ([(sensor, program, s) for s in ("subset", "add6")] for program in ("VMS", "Metashape"))
        found += [*zip(vms, meta, strict=True), *pairwise(vms), *pairwise(meta)]
    return found


def _said(page: Section, shapes: dict[tuple[Key, Key], float]) -> None:
    across = [v for (a, b), v in shapes.items() if a[1] != b[1] and a[0] == "RGB"]
    thermal = [v for (a, b), v in shapes.items() if a[1] != b[1] and a[0] == "thermal"]
    within = [v for (a, b), v in shapes.items() if a[1] == b[1] and a[0] == "RGB"]
    signs = [np.sign(camera_of(key)[0].k1) for key in published.TABLE_2]
    same = "all eight have the same sign of K1" if len(set(signs)) == 1 else "the signs of K1 still differ"
    page.say(
        f"**The same:** in one direction {same}, and the RGB camera's profiles have one shape, as fig. 5 "
        f"shows: to {min(across):.1f}-{max(across):.1f} px of 5472 between the programs, to "
        f"{min(within):.1f}-{max(within):.1f} px within one; the paper, too, finds pairs of one program the "
        f"more alike. The thermal camera's agree to {min(thermal):.2f}-{max(thermal):.2f} px of 640 between "
        "the programs. **Different:** whole projections differ by more than profiles do, for f, principal "
        "point and decentring differ as well.",
    )


def _figure(place: Place) -> Path:
    made, axes = plots.figure(2, height=3.6)
    looks = {"VMS": plots.OURS, "Metashape": plots.THEIRS}
    for axis, sensor in zip(axes, ("RGB", "thermal"), strict=True):
        for key in published.TABLE_2:
            if key[0] != sensor:
                continue
            camera, _ = camera_of(key)
            r = np.linspace(0, image_radius_px(camera), 200)
            dash = "-" if key[2] == "subset" else "--"
            axis.plot(r, profile_px(camera, r), dash, color=looks[key[1]], label=" ".join(key[1:]))
        axis.set(title=sensor, xlabel="r px", ylabel="radial px" if sensor == "RGB" else "")
        axis.legend()
    return plots.save(made, place.figures, "senn-table2")
