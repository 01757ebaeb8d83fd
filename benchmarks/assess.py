"""`fieldcal assess` against CloudCompare on the same files, and against the clock.

`python -m benchmarks.assess` writes benchmarks/assess.md: 20 million points as LAZ (whole command, wall
and CPU seconds, peak memory), with `--large` a PLY of 3 GB as well, and, where CloudCompare is installed, its
registration and its distances to the mesh. `--folder` says where the files may lie for the while.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from scipy.spatial import Delaunay

from benchmarks.cost import measure
from calib.assess.model import Surface, similarity_of
from calib.assess.register import register
from calib.camera import FloatArray
from calib.clouds import load_cloud, open_cloud
from calib.similarity import Similarity

HERE = Path(__file__).parent
#: M7 of both parts, about the middle: m, degrees, percent.
VALUES = np.array([0.3, -0.2, 0.4, 0.2, 0.1, -0.15, 100.3])
#: A PLY of 3.1 GB, and points written at a time.
LARGE_POINTS, _PIECE = 115_000_000, 1_000_000
_OFFSET = np.array([500_000.0, 5_600_000.0, 100.0])


def ground_m(x: FloatArray, y: FloatArray) -> FloatArray:
    """Hills of some metres, (n,), (n,) -> (n,)."""
    height: FloatArray = 2.5 * np.sin(x / 22) + 2 * np.cos(y / 24 + x / 50)
    return height


def write_large(path: Path, points: int, half_m: float = 100.0) -> None:
    """A LAZ or LAS file of random points over the hills, with 3 cm of noise, moved by ``VALUES``."""
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = _OFFSET, np.full(3, 0.001)
    with laspy.open(path, mode="w", header=header, do_compress=path.suffix == ".laz") as file:
        for xyz in _pieces(points, half_m):
            record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
            record.x, record.y, record.z = xyz.T
            file.write_points(record)


def write_large_ply(path: Path, points: int, half_m: float = 100.0) -> None:
    """The same as a binary PLY of doubles with a colour, 27 bytes a point."""
    row = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {points}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {colour}\n" for colour in ("red", "green", "blue")) + "end_header\n"
    with path.open("wb") as file:
        file.write(head.encode())
        for xyz in _pieces(points, half_m):
            rows = np.zeros(len(xyz), row)
            rows["xyz"] = xyz
            rows.tofile(file)


def _pieces(points: int, half_m: float) -> Iterator[FloatArray]:
    rng = np.random.default_rng(0)
    for start in range(0, points, _PIECE):
        n = min(_PIECE, points - start)
        xy = rng.uniform(-half_m, half_m, (n, 2))
        xyz = similarity_of(VALUES).apply(np.column_stack([xy, ground_m(*xy.T)]))
        xyz[:, 2] += 0.03 * rng.normal(size=n)
        yield xyz + _OFFSET


def write_references(path: Path, count: int, half_m: float = 90.0) -> None:
    xy = np.random.default_rng(1).uniform(-half_m, half_m, (count, 2))
    xyz = np.column_stack([xy, ground_m(*xy.T)]) + _OFFSET
    rows = [f"P{i},{x:.4f},{y:.4f},{z:.4f}" for i, (x, y, z) in enumerate(xyz.tolist())]
    path.write_text("\n".join(["name,x,y,z", *rows]) + "\n")


@dataclass(frozen=True)
class Timed:
    """One file through the command: what it is, its size, what it took, and the load of the machine."""

    kind: str
    points: int
    gigabytes: float
    cpu_s: float
    wall_s: float
    peak_mb: float
    load: float


def timed(kind: str, points: int, work: Path) -> Timed:
    """The whole command, report and start of Python included.

    Raises:
        SystemExit: the command did not end well.
    """
    cloud = work / f"large.{kind.lower()}"
    (write_large_ply if kind == "PLY" else write_large)(cloud, points)
    write_references(work / "truth.csv", 500)
    cost = measure(
        [
            sys.executable, "-m", "daemon.cli", "assess", str(cloud), "--truth",
            str(work / "truth.csv"), "--out", str(work / "out"), "--quiet",
        ]
    )  # fmt: skip
    size = cloud.stat().st_size
    cloud.unlink()
    if cost.code != 0:
        raise SystemExit(f"fieldcal assess ended with exit code {cost.code}.")
    load = os.getloadavg()[0]
    return Timed(kind, points, size / 1e9, cost.cpu_s, cost.wall_s, cost.peak_mb, load)


# --- CloudCompare ----------------------------------------------------------------------------------


def cloudcompare() -> str | None:
    """CloudCompare's command, None where it is not installed."""
    return shutil.which("CloudCompare") or shutil.which("cloudcompare.CloudCompare")


@dataclass(frozen=True)
class Peer:
    """Ours beside CloudCompare's on the same files, metres.

    ``registration_m``: largest difference of the two transformed reference points. ``distance_m``: largest
    difference of the distances to the mesh; means and standard deviations of both.
    """

    registration_m: float
    ours_m: float
    theirs_m: float
    distance_m: float
    mean_m: tuple[float, float]
    std_m: tuple[float, float]


def _run(command: str, *arguments: str) -> None:
    # Without a screen of its own Qt draws nowhere.
    env = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    subprocess.run(
        [command, "-SILENT", "-AUTO_SAVE", "OFF", *arguments],
        check=True,
        env=env,
        capture_output=True,
        timeout=300,
    )


def compare(command: str, work: Path) -> Peer:
    """Registration of exact copies, and signed distances of a noisy cloud to the mesh of the points."""
    rng = np.random.default_rng(2)
    dense = rng.uniform(-60, 60, (60_000, 2))
    true = np.column_stack([dense, ground_m(*dense.T)])
    model = similarity_of(VALUES).apply(true)
    reference = true[(np.abs(dense) < 50).all(axis=1)][:1500]
    np.savetxt(work / "model.xyz", model, fmt="%.9f")
    np.savetxt(work / "reference.xyz", reference, fmt="%.9f")
    _run(
        command, "-O", str(work / "reference.xyz"), "-O", str(work / "model.xyz"), "-ICP", "-ITER", "200",
        "-ADJUST_SCALE", "-RANDOM_SAMPLING_LIMIT", "100000",
    )  # fmt: skip
    (found,) = work.glob("*REGISTRATION_MATRIX*.txt")
    matrix = np.loadtxt(found)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    theirs = Similarity(scale, matrix[:3, :3] / scale, matrix[:3, 3]).apply(reference)
    loaded = load_cloud(open_cloud(work / "model.xyz"))
    fitted = register(reference, loaded, np.ones(len(reference), bool))
    ours = fitted.seven.similarity.apply(reference - fitted.origin) + fitted.origin
    exact = similarity_of(VALUES).apply(reference)
    apart, our_gap, their_gap = (
        float(np.abs(a - b).max()) for a, b in ((ours, theirs), (ours, exact), (theirs, exact))
    )
    return Peer(apart, our_gap, their_gap, *_distances(command, work, rng))


def _distances(
    command: str, work: Path, rng: np.random.Generator
) -> tuple[float, tuple[float, float], tuple[float, float]]:
    corners = rng.uniform(-50, 50, (600, 2))
    mesh = np.column_stack([corners, ground_m(*corners.T)])
    at = rng.uniform(-40, 40, (20_000, 2))
    surface = Surface(mesh)
    cloud = np.column_stack([at, surface.height_m(at) + 0.05 * rng.normal(size=len(at))])
    triangles = Delaunay(corners).simplices
    a, b, c = (mesh[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    # All upwards, so that above is positive in CloudCompare, too.
    triangles[normal[:, 2] < 0] = triangles[normal[:, 2] < 0][:, ::-1]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(mesh)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    body = "".join(f"{x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in mesh.tolist())
    faces = "".join(f"3 {i} {j} {k}\n" for i, j, k in triangles.tolist())
    (work / "mesh.ply").write_text(head + body + faces)
    np.savetxt(work / "cloud.xyz", cloud, fmt="%.9f")
    _run(
        command, "-C_EXPORT_FMT", "ASC", "-PREC", "9", "-NO_TIMESTAMP", "-O", str(work / "cloud.xyz"), "-O",
        str(work / "mesh.ply"), "-C2M_DIST", "-SAVE_CLOUDS",
    )  # fmt: skip
    (written,) = [path for path in work.glob("*.asc") if "C2M" in path.name]
    theirs = np.loadtxt(written, usecols=-1, comments="/")
    # CloudCompare measures along the triangle's normal, we along the vertical.
    index = Delaunay(corners).find_simplex(at)
    tilt = np.abs(normal[index, 2]) / np.linalg.norm(normal[index], axis=1)
    ours = surface.signed_distance_m(cloud) * tilt
    # Over a ridge a neighbouring triangle is nearer than the one below: counted where it is not.
    inner = np.abs(ours - theirs) <= np.percentile(np.abs(ours - theirs), 95)
    return (
        float(np.abs(ours - theirs)[inner].max()),
        (float(ours.mean()), float(theirs.mean())),
        (float(ours.std()), float(theirs.std())),
    )


_TIME = (
    "Whole command, report and Python's start included, 500 reference points. Of more than 50 million points "
    "every second, third, ... is taken, which the report says: memory does not grow with the file. {cores} "
    "cores; the load is what else they had to do, and wall seconds are longer for it."
)
_BESIDE = "## Beside CloudCompare"
_PEER = (
    "Registration: 1500 points that are in a cloud of 60 000 exactly, seven parameters unknown. Distances: "
    "20 000 points, 5 cm of noise, to the mesh of 600 points; ours, which are vertical, times the cosine of "
    "the triangle's slope, because CloudCompare measures along its normal; 95 % of the points, because the "
    "others have a neighbouring triangle that is nearer than the one below them."
)


def page(rows: list[Timed], peer: Peer | None, old: str = "") -> str:
    """The page; without CloudCompare what the ``old`` page says of it stays."""
    lines = ["# Assessment: against the clock, and beside CloudCompare", "", (__doc__ or "").split("\n\n")[1]]
    if rows:
        lines += ["## Time and memory", "", _TIME.format(cores=os.cpu_count()), ""]
        lines += ["| file | points | GB | CPU s | wall s | load | peak MB |", "|---|---|---|---|---|---|---|"]
        lines += [
            f"| {r.kind} | {r.points} | {r.gigabytes:.2f} | {r.cpu_s:.0f} | {r.wall_s:.0f} | {r.load:.1f} "
            f"| {r.peak_mb:.0f} |"
            for r in rows
        ]
        lines.append("")
    if peer is None:
        _, _, kept = old.partition(_BESIDE)
        return "\n".join([*lines, _BESIDE]) + (kept or "\n\nNot installed where this was made.\n")
    lines += [_BESIDE, ""]
    found = {
        "registration, ours against CloudCompare's, largest": (peer.registration_m,),
        "registration, ours against the truth, largest": (peer.ours_m,),
        "registration, CloudCompare's against the truth, largest": (peer.theirs_m,),
        "distance to the mesh, difference, largest of 95 %": (peer.distance_m,),
        "distance, mean, ours and CloudCompare's": peer.mean_m,
        "distance, standard deviation, ours and CloudCompare's": peer.std_m,
    }
    lines += [_PEER, "", "| quantity | mm |", "|---|---|"]
    lines += [
        f"| {name} | {', '.join(f'{1000 * value:.3f}' for value in values)} |"
        for name, values in found.items()
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=20_000_000)
    parser.add_argument("--large", action="store_true", help=f"a PLY of {LARGE_POINTS} points as well")
    parser.add_argument("--no-time", action="store_true", help="only the comparison")
    parser.add_argument("--folder", type=Path, help="for the files, which are removed again")
    given = parser.parse_args()
    sizes = [] if given.no_time else [("LAZ", given.points)] + [("PLY", LARGE_POINTS)] * given.large
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        work = Path(folder)
        command = cloudcompare()
        peer = None if command is None else compare(command, work)
        rows = [timed(kind, points, work) for kind, points in sizes]
    out = HERE / "assess.md"
    old = out.read_text(encoding="utf-8") if out.exists() else ""
    out.write_text(page(rows, peer, old), encoding="utf-8")


if __name__ == "__main__":
    main()
