"""Cloud files: read as written, written moved, refused in one sentence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from benchmarks.assess import write_large_ply, write_references
from calib.assess.model import similarity_of
from calib.camera import FloatArray
from calib.clouds import Kind, load_cloud, open_cloud, rewrite
from calib.clouds.sparse import move_sparse
from calib.errors import InputError, OutputError
from calib.similarity import Similarity
from tests.cloud_cases import EPSG, OFFSET, write_las, write_points

N = 500
_XYZ = b"property float x\nproperty float y\nproperty float z\n"


def _points(seed: int = 0) -> FloatArray:
    return OFFSET + np.random.default_rng(seed).uniform(-50, 50, (N, 3))


def _moved() -> Similarity:
    about = similarity_of(np.array([1, -2, 3, 0.4, -0.5, 0.6, 101.0]))
    return Similarity(
        about.scale, about.rotation, about.shift + OFFSET - about.scale * about.rotation @ OFFSET
    )


def _ply(path: Path, xyz: FloatArray, order: str, coordinate: str = "double") -> None:
    kind = {"double": "f8", "float": "f4"}[coordinate]
    sign = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}[order]
    rows = np.zeros(
        len(xyz),
        [(n, sign + kind) for n in "xyz"] + [("red", "u1")] + [(n, sign + "f4") for n in ("nx", "ny", "nz")],
    )
    rows["x"], rows["y"], rows["z"] = xyz.T
    rows["red"], rows["nz"] = 7, 1
    head = [f"format {order} 1.0", f"element vertex {len(xyz)}"]
    head += [f"property {coordinate} {n}" for n in "xyz"] + ["property uchar red"]
    head += [f"property float {n}" for n in ("nx", "ny", "nz")]
    head += ["element face 1", "property list uchar int vertex_index", "end_header"]
    start = ("ply\n" + "\n".join(head) + "\n").encode()
    if sign:
        path.write_bytes(start + rows.tobytes() + b"\x03" + np.arange(3, dtype=sign + "i4").tobytes())
    else:
        body = "".join(" ".join(repr(v) for v in row.tolist()) + "\n" for row in rows)
        path.write_bytes(start + body.encode() + b"3 0 1 2\n")


def _write(path: Path, xyz: FloatArray) -> None:
    name = path.name
    if name.endswith((".las", ".laz")):
        write_las(path, xyz)
    elif name.endswith(".ply"):
        _ply(path, xyz, {"l": "binary_little_endian", "b": "binary_big_endian", "a": "ascii"}[name[0]])
    elif name.endswith(".csv"):
        write_points(path, xyz)
    else:
        np.savetxt(path, np.column_stack([xyz, np.full(len(xyz), 42)]), fmt="%.4f")


@pytest.mark.parametrize("name", ["a.las", "a.laz", "l.ply", "b.ply", "a.ply", "a.csv", "a.xyz"])
def test_read_as_written_and_written_moved(name: str, tmp_path: Path) -> None:
    xyz, path, out = _points(), tmp_path / name, tmp_path / f"out{Path(name).suffix}"
    _write(path, xyz)
    file = open_cloud(path)
    loaded = load_cloud(file)
    assert loaded.total == N
    assert loaded.xyz + loaded.origin == pytest.approx(xyz, abs=0.0007)
    if name.startswith("a.la"):
        assert file.crs is not None
        assert file.crs.to_epsg() == EPSG
    before = path.read_bytes()
    rewrite(file, out, _moved(), size=100)
    again = load_cloud(open_cloud(out))
    assert again.xyz + again.origin == pytest.approx(_moved().apply(xyz), abs=0.0013)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([path.name, out.name])


def test_what_is_not_coordinates_stays(tmp_path: Path) -> None:
    xyz = _points()
    write_las(tmp_path / "a.laz", xyz)
    rewrite(open_cloud(tmp_path / "a.laz"), tmp_path / "b.laz", _moved())
    assert laspy.read(tmp_path / "b.laz").intensity.tolist() == [i % 1000 for i in range(N)]
    _ply(tmp_path / "l.ply", xyz, "binary_little_endian")
    rewrite(open_cloud(tmp_path / "l.ply"), tmp_path / "m.ply", _moved())
    assert (tmp_path / "m.ply").read_bytes()[-13:] == (tmp_path / "l.ply").read_bytes()[-13:]
    _ply(tmp_path / "a.ply", xyz[:2], "ascii")
    rewrite(open_cloud(tmp_path / "a.ply"), tmp_path / "n.ply", _moved())
    row = (tmp_path / "n.ply").read_text().splitlines()[-3].split()
    assert row[3] == "7"
    assert [float(v) for v in row[4:]] == pytest.approx(_moved().rotation[:, 2], abs=1e-6)
    (tmp_path / "t.csv").write_text("id;z;x;y;class\n# a comment\nA;3;1;2;grass\nB;6;4;5;road\n")
    rewrite(
        open_cloud(tmp_path / "t.csv"), tmp_path / "u.csv", Similarity(1.0, np.eye(3), np.array([1, 0, 0.5]))
    )
    assert (tmp_path / "u.csv").read_text().splitlines() == [
        "id;z;x;y;class", "# a comment", "A;3.5000;2.0000;2.0000;grass", "B;6.5000;5.0000;5.0000;road",
    ]  # fmt: skip


def test_geotiff_cells_with_heights_are_points(tmp_path: Path) -> None:
    heights = np.arange(12.0).reshape(3, 4)
    heights[1, 2] = -9999
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", width=4, height=3, count=1, dtype="float32", nodata=-9999,
        crs="EPSG:32630", transform=from_origin(500, 900, 2, 2),
    ) as file:  # fmt: skip
        file.write(heights.astype(np.float32), 1)
    found = open_cloud(tmp_path / "a.tif")
    assert found.kind is Kind.GEOTIFF
    loaded = load_cloud(found)
    points = loaded.xyz + loaded.origin
    assert len(points) == 11
    assert points[0].tolist() == [501, 899, 0]
    assert points[-1].tolist() == [507, 895, 11]
    with pytest.raises(InputError, match="grid cannot be turned"):
        rewrite(found, tmp_path / "b.tif", _moved())


def test_points_without_numbers_are_left_out_and_said(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\nnan 2 3\n4 5 6\n1 inf 3\n")
    loaded = load_cloud(open_cloud(tmp_path / "a.xyz"))
    assert (loaded.total, loaded.not_numbers) == (2, 2)
    assert any("2 of 4" in note for note in loaded.notes)
    (tmp_path / "b.xyz").write_text("nan 2 3\n" * 3)
    with pytest.raises(InputError, match="no point with numbers"):
        load_cloud(open_cloud(tmp_path / "b.xyz"))


@pytest.mark.parametrize("name", ["a.las", "a.xyz"])
def test_larger_clouds_are_thinned_evenly(name: str, tmp_path: Path) -> None:
    xyz = _points()
    _write(tmp_path / name, xyz)
    loaded = load_cloud(open_cloud(tmp_path / name), most=100)
    assert 40 <= len(loaded.xyz) <= 100
    assert loaded.total == N
    assert loaded.step > 1
    assert any("one in" in note for note in loaded.notes)


_ASSESSED = """
import subprocess
import sys
from pathlib import Path
from calib.assess.study import assess_cloud
from calib.assess.truth import read_truth
from calib.clouds import load_cloud, open_cloud
cloud, truth = map(Path, sys.argv[1:])
made = assess_cloud(load_cloud(open_cloud(cloud), 400_000), read_truth(truth, None, None))
assert made.cloud.step > 1 and len(made.cloud.xyz) <= 400_000
assert abs(made.registration.seven.values[2] - 0.4) < 0.05
# Not the usage of resources, in which the memory of the parent counts.
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc")
def test_memory_does_not_grow_with_the_cloud(tmp_path: Path) -> None:
    """Five million points beside three, both thinned to at most 400 000."""
    write_references(tmp_path / "truth.csv", 100)
    write_large_ply(tmp_path / "million.ply", 1_000_000)
    head, body = (tmp_path / "million.ply").read_bytes().split(b"end_header\n", 1)
    peak_mb = []
    for millions in (3, 5):
        with (tmp_path / "large.ply").open("wb") as file:
            file.write(head.replace(b"1000000", b"%d000000" % millions) + b"end_header\n")
            for _ in range(millions):
                file.write(body)
        command = [sys.executable, "-c", _ASSESSED, tmp_path / "large.ply", tmp_path / "truth.csv"]
        ran = subprocess.run(command, check=True, capture_output=True, text=True)
        peak_mb.append(int(ran.stdout) / 1024)
    # Two million points more are 54 MB of file, and 48 MB if all were kept (12 bytes, twice for a while).
    assert peak_mb[1] - peak_mb[0] < 30
    assert peak_mb[1] < 400


def test_coarse_coordinates_are_said(tmp_path: Path) -> None:
    _ply(tmp_path / "l.ply", _points(), "binary_little_endian", "float")
    assert "32 bit" in open_cloud(tmp_path / "l.ply").notes[0]


def _cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
@pytest.mark.parametrize("name", ["a.las", "a.laz", "l.ply", "a.ply"])
def test_cut_off_files_are_refused(name: str, share: float, tmp_path: Path) -> None:
    path = tmp_path / name
    _write(path, _points())
    _cut(path, share)
    with pytest.raises(InputError, match=r"cut off|damaged|no PLY|row of numbers"):
        load_cloud(open_cloud(path))
    # Nothing half-written is left behind either.
    with pytest.raises(InputError):
        rewrite(open_cloud(path), tmp_path / f"out{path.suffix}", _moved())
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"\xff\xd8\xff\xe0\0\0JFIF", "not a point cloud"),
        (b"Dear sir,\nthis is a letter.\n", "not a point cloud"),
        (b"1 2\n3 4\n", "x, y and z are expected"),
        (b"1 2 3\n4 5 six\n", "about line 2"),
        (b"# only\n# comments\n", "not a point cloud"),
        (b"ASTM-E57\0\0", "E57"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\n" + _XYZ + b"end_header\n", "no points"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "begin with vertices"),
        (b"II*\0junk", "damaged"),
        (b"LASF" + bytes(50), "damaged"),
    ],
)  # fmt: skip
def test_what_is_no_cloud_is_refused(content: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "file.dat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        load_cloud(open_cloud(path))


def test_missing_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        open_cloud(tmp_path / "none.las")
    with pytest.raises(InputError, match="folder"):
        open_cloud(tmp_path)
    write_las(tmp_path / "a.las", _points())
    with pytest.raises(OutputError):
        rewrite(open_cloud(tmp_path / "a.las"), tmp_path / "no" / "b.las", _moved())


def test_sparse_model_keeps_its_projections(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 100 80 80 50 50\n")
    (tmp_path / "images.txt").write_text("# x\n1 0.9 0.1 -0.3 0.2 1 2 3 1 a b.jpg\n10 20 1\n")
    (tmp_path / "points3D.txt").write_text("# x\n1 4 5 6 1 2 3 0.5 1 0\n")
    moved = similarity_of(np.array([1, -2, 3, 10, 20, -30, 140.0]))
    move_sparse(tmp_path, tmp_path / "out", moved)

    def ray(folder: Path) -> FloatArray:
        from scipy.spatial.transform import Rotation

        w, x, y, z, *t = (float(v) for v in (folder / "images.txt").read_text().splitlines()[1].split()[1:8])
        point = [float(v) for v in (folder / "points3D.txt").read_text().splitlines()[1].split()[1:4]]
        seen = Rotation.from_quat([x, y, z, w]).as_matrix() @ point + t
        return np.asarray(seen[:2] / seen[2])

    assert ray(tmp_path / "out") == pytest.approx(ray(tmp_path), abs=1e-9)
    assert (tmp_path / "out" / "images.txt").read_text().splitlines()[1].endswith(" 1 a b.jpg")
    with pytest.raises(InputError, match="no COLMAP text model"):
        move_sparse(tmp_path / "none", tmp_path / "out2", moved)
