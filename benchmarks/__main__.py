"""`make bench`: fieldcal's check beside pycolmap's default pipeline, in one run on the same photos.

CPU seconds, wall seconds and peak memory of whole processes; sigma f of both networks of tie
points under one noise model (our adjustment, its formal sigma with the noise found). Where the
COLMAP command is installed it runs too. Ratios are what counts: machines differ. The photo sets
are those of FIELDCAL_DATA. Results: benchmarks/speed.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import colmap_command
from benchmarks.cost import Cost, measure
from calib.align.adjust import State
from calib.align.engine import Aligner
from calib.align.grow import free_network_priors
from calib.align.selfcal import Calibrated, calibrate, with_lens_priors
from calib.brownfit import fit_brown
from calib.camera import BrownCamera
from calib.errors import AlignmentError
from calib.field import Lens
from calib.photos import collect, read_photos
from calib.solution import Observations

HERE = Path(__file__).parent


def fieldcal(photos: Path, work: Path) -> tuple[Cost, dict[str, Any]]:
    """The check as a user runs it, report and exports included."""
    out = work / "report"
    cost = measure(
        [sys.executable, "-m", "daemon.cli", "check", str(photos), "--quiet", "--out", str(out)],
    )
    return cost, json.loads((out / "report.json").read_text())


def peer_sigma_percent(result: Path, nominal_f_px: float) -> float:
    """Formal sigma of f, percent, of the peer's tie points under our adjustment and noise model."""
    data = np.load(result)
    width, height = int(data["width"]), int(data["height"])
    rows = data["observations"]
    order = np.argsort(rows[:, 1], kind="stable")
    rows = rows[order]
    obs = Observations(rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2:4], np.full(len(rows), 1.0))
    fx, fy, cx, cy, k1, k2, p1, p2 = data["params"]
    lens = Lens(BrownCamera(width, height, fx, cx, cy, k1, k2, p1=p1, p2=p2, b1_px=fx - fy))
    centres = data["centres"]
    extent = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    priors = with_lens_priors(
        free_network_priors(len(centres), lens, extent, centres), width, height, nominal_f_px
    )
    solved = calibrate(obs, State(lens, data["rotations"], centres, data["points"]), priors)
    return _formal_percent(solved)


def _formal_percent(solved: Calibrated) -> float:
    """Formal sigma of the f that is reported, percent, before any inflation."""
    fitted, jacobian = fit_brown(solved.adjusted.state.lens)
    return 100 * float(np.sqrt(jacobian[0] @ solved.adjusted.covariance @ jacobian[0])) / fitted.f_px


@dataclass(frozen=True)
class Comparison:
    """Both sides on one photo set; the peer's figures are None where it gave no model."""

    photos: int
    ours: Cost
    theirs: Cost
    aligned: int
    f_px: float
    sigma_f_px: float
    peer_aligned: int
    peer_f_px: float | None = None
    peer_rms_px: float | None = None
    peer_sigma_percent: float | None = None
    command: tuple[Cost, int, float | None] | None = None


def compare(photos: Path) -> Comparison:
    """One photo set on both sides."""
    found, _ = read_photos(collect([photos]))
    nominal = float(np.median([p.focal_px or 0.8 * p.camera.width for p in found]))
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        ours, report = fieldcal(photos, work)
        theirs = measure([sys.executable, "-m", "benchmarks.peer", str(photos), str(work / "peer.npz")])
        row = Comparison(
            photos=len(found),
            ours=ours,
            theirs=theirs,
            aligned=report["alignment"]["aligned"],
            f_px=report["calibration"]["f_px"],
            sigma_f_px=report["calibration"]["sigma"]["f_px"],
            peer_aligned=0,
            command=colmap_command.run(photos, work) if colmap_command.installed() else None,
        )
        if theirs.code != 0:
            return row
        data = np.load(work / "peer.npz")
        if not int(data["aligned"]):
            return row
        try:
            sigma = peer_sigma_percent(work / "peer.npz", nominal)
        except AlignmentError:
            sigma = None
        return replace(
            row,
            peer_aligned=int(data["aligned"]),
            peer_f_px=float(data["params"][0]),
            peer_rms_px=float(data["mean_reprojection_px"]),
            peer_sigma_percent=sigma,
        )


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def own_sigma_percent(photos: Path) -> float:
    """Formal sigma f of our tie points, percent, before any inflation."""
    found, _ = read_photos(collect([photos]))
    aligner = Aligner()
    aligner.add_all(found)
    return _formal_percent(aligner.solve().calibrated)


def main() -> None:
    """Compare on every real set and write benchmarks/speed.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", nargs="*", help="names of sets (default: all)")
    parser.add_argument("--out", type=Path, default=HERE / "speed.md")
    given = parser.parse_args()
    data = os.environ.get("FIELDCAL_DATA")
    if not data:
        sys.exit("FIELDCAL_DATA does not name the folder of real photo sets; nothing to compare on.")
    commands: list[str] = []
    names = given.sets or sorted(p.name for p in Path(data).iterdir() if p.is_dir())
    lines = [
        "# fieldcal check beside pycolmap's default pipeline",
        "",
        f"Whole processes on {os.cpu_count()} cores ({platform.machine()}), one after the other on the same "
        "photos; fieldcal includes its report and exports. pycolmap: default options, full size, pairs by "
        "position, OPENCV camera. `sigma f`: formal, of both networks of tie points under fieldcal's own "
        "adjustment and the noise found in each. Made by `make bench`.",
        "",
        "| set | photos | fieldcal CPU s | pycolmap CPU s | ratio | wall s | peak MB | aligned | sigma f % "
        "| pycolmap's own f px (residual px) | fieldcal's f px |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        print(f"{name} ...", file=sys.stderr, flush=True)
        row = compare(Path(data) / name)
        sigma = own_sigma_percent(Path(data) / name)
        lines.append(
            f"| {name} | {row.photos} | {row.ours.cpu_s:.0f} | {row.theirs.cpu_s:.0f} "
            f"| {row.theirs.cpu_s / row.ours.cpu_s:.1f} | {row.ours.wall_s:.0f} / {row.theirs.wall_s:.0f} "
            f"| {row.ours.peak_mb:.0f} / {row.theirs.peak_mb:.0f} | {row.aligned} / {row.peer_aligned} "
            f"| {sigma:.4f} / {_shown(row.peer_sigma_percent, 4)} "
            f"| {_shown(row.peer_f_px, 1)} ({_shown(row.peer_rms_px, 2)}) "
            f"| {row.f_px:.1f} ± {row.sigma_f_px:.1f} |"
        )
        if row.command is not None:
            cost, aligned, f_px = row.command
            commands.append(
                f"| {name} | {cost.cpu_s:.0f} | {cost.cpu_s / row.ours.cpu_s:.1f} | {cost.wall_s:.0f} "
                f"| {cost.peak_mb:.0f} | {aligned} | {_shown(f_px, 1)} |"
            )
        given.out.write_text("\n".join(lines) + "\n")
    lines += ["", "## The COLMAP command of the system", ""]
    if commands:
        lines += ["Default options, no graphics processor, pairs by position, OPENCV camera.", ""]
        lines += ["| set | CPU s | ratio to fieldcal | wall s | peak MB | aligned | f px |"]
        lines += ["|---|---|---|---|---|---|---|", *commands]
    else:
        lines.append("Not installed where this was made.")
    given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
