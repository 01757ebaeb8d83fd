"""Formats against the programs that own them, their published numbers, and files found in the wild."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrations import P3P, cameras, image_rays
from hypothesis import given, settings

from calib.camera import BrownCamera, FloatArray
from calib.errors import FormatError
from calib.formats import (
    FORMATS,
    ReadOptions,
    WriteOptions,
    colmap,
    detect_format,
    metashape,
    micmac,
    odm,
    opencv,
    pix4d,
    vms,
)


def on_plane(rays: FloatArray) -> FloatArray:
    return np.column_stack([rays, np.ones(len(rays))])


# --- OpenCV --------------------------------------------------------------------------------------------


def by_opencv(path: Path, rays: FloatArray) -> FloatArray:
    """Pixels by cv2 from a file that cv2 itself has read, in OpenCV's own pixel convention."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    distortion = storage.getNode("distortion_coefficients").mat()
    assert int(storage.getNode("image_width").real()) > 0
    pixels, _ = cv2.projectPoints(on_plane(rays), np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(pixels.reshape(-1, 2))


@pytest.mark.parametrize("name", ["opencv-yaml", "opencv-xml"])
@settings(deadline=None, max_examples=15)
@given(camera=cameras(k4=0.001, affine=True))
def test_opencv_reads_our_files_and_projects_the_same(
    name: str, camera: BrownCamera, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("cv") / f"camera{FORMATS[name].suffix}"
    path.write_text(FORMATS[name].write(camera, None))
    rays = image_rays(camera)
    # OpenCV's pixels count from the centre of the first pixel.
    assert by_opencv(path, rays) + 0.5 == pytest.approx(camera.project(rays), abs=0.01)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_we_read_what_opencv_writes(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"camera{suffix}"
    matrix = np.array([[2320.0, 0, 1999.5], [0, 2318.0, 1499.5], [0, 0, 1]])
    distortion = np.array([[-0.13, 0.11, 1e-3, -2e-3, -0.02]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Thu Apr 21 10:10:51 2016")
    storage.write("image_width", 4000)
    storage.write("image_height", 3000)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", distortion)
    storage.release()
    camera = opencv.read(path.read_text())
    assert (camera.cx_px, camera.cy_px, camera.b1_px) == (2000.0, 1500.0, 2.0)
    rays = image_rays(camera)
    assert camera.project(rays) - 0.5 == pytest.approx(by_opencv(path, rays), abs=1e-9)


def test_an_opencv_file_of_a_phantom_3() -> None:
    """The layout of OpenCV's calibration sample, as users publish it."""
    text = """<?xml version="1.0"?>
<opencv_storage>
<calibration_time>"Thu Apr 21 10:10:51 2016"</calibration_time>
<image_width>4000</image_width>
<image_height>3000</image_height>
<flags>4</flags>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    2.0302169602090510e+03 0. 1.9995000000000000e+03 0.
    2.0207083572939682e+03 1.4995000000000000e+03 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows>
  <cols>5</cols>
  <dt>d</dt>
  <data>
    -5.5214650277937247e-02 1.4058031250295580e-02
    1.4228436520906643e-03 2.7726335791525055e-03 2.4378664071674177e-04</data></distortion_coefficients>
</opencv_storage>
"""
    camera = opencv.read(text)
    assert (camera.cx_px, camera.cy_px) == (2000.0, 1500.0)
    assert (camera.k1, camera.k3, camera.p2) == pytest.approx((-0.0552146503, 2.43786641e-4, 2.77263358e-3))
    assert detect_format(text).name == "opencv-xml"


def test_ros_camera_info_and_other_names() -> None:
    text = """image_width: 640
image_height: 512
camera_name: thermal
camera_matrix:
  rows: 3
  cols: 3
  data: [770.5, 0.0, 319.5, 0.0, 770.5, 255.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 0.2, 0.001, -0.002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""
    camera = opencv.read(text)
    assert detect_format(text).name == "opencv-yaml"
    assert camera == BrownCamera(640, 512, 770.5, 320.0, 256.0, -0.3, 0.2, p1=0.001, p2=-0.002)
    short = "K: [770.5, 0, 319.5, 0, 770.5, 255.5, 0, 0, 1]\nD: [-0.3, 0.2, 0.001, -0.002]\n"
    assert opencv.read(short, ReadOptions(image_size=(640, 512))) == camera
    with pytest.raises(FormatError, match="give the image size"):
        opencv.read(short)


def test_a_rational_opencv_lens_is_fitted_or_refused() -> None:
    base = "K: [2000, 0, 1999.5, 0, 2000, 1499.5, 0, 0, 1]\nwidth: 4000\nheight: 3000\n"
    camera = opencv.read(base + "D: [0.12, -0.02, 0.0001, 0.0002, 0.001, 0.15, 0.01, 0.0]\n")
    rays = image_rays(camera)
    r2 = (rays**2).sum(-1)
    radial = (1 + 0.12 * r2 - 0.02 * r2**2 + 0.001 * r2**3) / (1 + 0.15 * r2 + 0.01 * r2**2)
    x, y = rays.T
    u = 2000 + 2000 * (x * radial + 2e-4 * x * y + 2e-4 * (r2 + 2 * x * x))
    v = 1500 + 2000 * (y * radial + 1e-4 * (r2 + 2 * y * y) + 4e-4 * x * y)
    assert camera.project(rays) == pytest.approx(np.stack([u, v], -1), abs=0.1)
    with pytest.raises(FormatError, match="best fit misses by up to"):
        opencv.read(base + "D: [25.0, 10.0, 0, 0, 1.0, 25.3, 18.0, 3.0]\n")
    with pytest.raises(FormatError, match="thin-prism"):
        opencv.read(base + "D: [0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0]\n")


# --- COLMAP --------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=20)
@given(camera=cameras(k4=0.001, affine=True))
def test_colmap_reads_our_file_and_projects_the_same(
    camera: BrownCamera, tmp_path_factory: pytest.TempPathFactory
) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has no wheel for this machine")
    folder = tmp_path_factory.mktemp("colmap")
    for name in ("images.txt", "points3D.txt", "frames.txt", "rigs.txt"):
        (folder / name).write_text("")
    (folder / "cameras.txt").write_text(colmap.write(camera))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(folder))
    rays = image_rays(camera)
    pixels = reconstruction.cameras[1].img_from_cam(on_plane(rays))
    assert pixels == pytest.approx(camera.project(rays), abs=0.01)


@pytest.mark.parametrize(
    ("line", "parameters"),
    [
        ("SIMPLE_PINHOLE", [2300.0, 2001.0, 1502.0]),
        ("PINHOLE", [2300.0, 2301.0, 2001.0, 1502.0]),
        ("SIMPLE_RADIAL", [2300.0, 2001.0, 1502.0, -0.1]),
        ("RADIAL", [2300.0, 2001.0, 1502.0, -0.1, 0.05]),
        ("OPENCV", [2300.0, 2301.0, 2001.0, 1502.0, -0.1, 0.05, 1e-3, -2e-3]),
        ("FULL_OPENCV", [2300.0, 2301.0, 2001.0, 1502.0, -0.1, 0.05, 1e-3, -2e-3, -0.01, 0, 0, 0]),
    ],
)
def test_every_colmap_model_reads_as_colmap_means_it(line: str, parameters: list[float]) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has no wheel for this machine")
    text = f"# comment\n7 {line} 4000 3000 {' '.join(map(str, parameters))}\n"
    camera = colmap.read(text)
    theirs = pycolmap.Camera(model=line, width=4000, height=3000, params=parameters)
    rays = image_rays(camera)
    assert camera.project(rays) == pytest.approx(theirs.img_from_cam(on_plane(rays)), abs=1e-8)
    # And back in the same, simplest model.
    assert colmap.write(camera).splitlines()[-1].split()[1] == line


def test_colmap_files_with_several_cameras() -> None:
    text = "1 SIMPLE_PINHOLE 4000 3000 2300 2000 1500\n2 SIMPLE_PINHOLE 640 512 770 320 256\n"
    assert set(colmap.read_all(text)) == {"1", "2"}
    with pytest.raises(FormatError, match="2 cameras"):
        colmap.read(text)
    assert colmap.read(text, ReadOptions(camera_name="2")).width == 640
    with pytest.raises(FormatError, match="no camera '3'"):
        colmap.read(text, ReadOptions(camera_name="3"))
    with pytest.raises(FormatError, match="not of Brown's kind"):
        colmap.read("1 OPENCV_FISHEYE 4000 3000 2300 2300 2000 1500 0 0 0 0\n")
    with pytest.raises(FormatError, match="has 2 parameters; SIMPLE_PINHOLE has 3"):
        colmap.read("1 SIMPLE_PINHOLE 4000 3000 2300 2000\n")


# --- ODM -------------------------------------------------------------------------------------------------


def test_odm_projects_by_opensfm_s_formulas() -> None:
    camera = replace(P3P, p1=2e-4, p2=-3e-4, b1_px=1.5)
    text = odm.write(camera, WriteOptions(make="DJI", model="FC300S"))
    ((name, entry),) = json.loads(text).items()
    assert name == "v2 dji fc300s 4000 3000 brown 0.5800"[: len(name)]
    assert len(name.split(" ")) >= 6
    rays = image_rays(camera)
    x, y = rays.T
    r2 = x * x + y * y
    radial = 1 + r2 * (entry["k1"] + r2 * (entry["k2"] + r2 * entry["k3"]))
    xd = x * radial + 2 * entry["p1"] * x * y + entry["p2"] * (r2 + 2 * x * x)
    yd = y * radial + 2 * entry["p2"] * x * y + entry["p1"] * (r2 + 2 * y * y)
    normalised = np.stack([entry["focal_x"] * xd + entry["c_x"], entry["focal_y"] * yd + entry["c_y"]], -1)
    # denormalized_image_coordinates of OpenSfM, in OpenCV's pixels.
    pixels = normalised * 4000 - 0.5 + np.array([4000, 3000]) / 2
    assert pixels + 0.5 == pytest.approx(camera.project(rays), abs=1e-8)


def test_odm_files_of_other_kinds() -> None:
    perspective = {
        "projection_type": "perspective", "width": 4000, "height": 2250,
        "focal": 0.58, "k1": -0.01, "k2": 0.005, "focal_prior": 0.6,
    }  # fmt: skip
    camera = odm.read(json.dumps({"dji fc300s 4000 2250 perspective 0.5777": perspective}))
    assert camera == BrownCamera(4000, 2250, 2320.0, 2000.0, 1125.0, -0.01, 0.005)
    with pytest.raises(FormatError, match="projection type 'fisheye'"):
        odm.read(json.dumps({"a": {**perspective, "projection_type": "fisheye"}}))
    with pytest.raises(FormatError, match="lacks focal"):
        odm.read(json.dumps({"a": {k: v for k, v in perspective.items() if k != "focal"}}))
    with pytest.raises(FormatError, match="2 cameras"):
        odm.read(json.dumps({"a": perspective, "b": perspective}))


# --- Metashape -----------------------------------------------------------------------------------------


def test_metashape_conventions() -> None:
    """f is the focal length along columns, P1 goes with x, cx and cy count from the centre."""
    text = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>2560</width>
  <height>1920</height>
  <f>1475</f>
  <cx>17</cx>
  <cy>11</cy>
  <b1>0.5</b1>
  <b2>-0.25</b2>
  <k1>-0.27</k1>
  <k3>-0.02</k3>
  <p1>1e-4</p1>
  <p2>2e-4</p2>
  <date>2017-11-14T23:30:12Z</date>
</calibration>
"""
    camera = metashape.read(text)
    assert (camera.f_px, camera.fy_px) == (1475.5, 1475.0)
    rays = np.array([[0.3, -0.2], [-0.5, 0.4]])
    x, y = rays.T
    r2 = x * x + y * y
    radial = 1 - 0.27 * r2 - 0.02 * r2**3
    xd = x * radial + 1e-4 * (r2 + 2 * x * x) + 2 * 2e-4 * x * y
    yd = y * radial + 2e-4 * (r2 + 2 * y * y) + 2 * 1e-4 * x * y
    u = 2560 * 0.5 + 17 + xd * 1475 + xd * 0.5 + yd * -0.25
    v = 1920 * 0.5 + 11 + yd * 1475
    assert camera.project(rays) == pytest.approx(np.stack([u, v], -1), abs=1e-9)


def test_metashape_document_prefers_the_adjusted_calibration() -> None:
    def calibration(kind: str, f: float) -> str:
        return (
            f'<calibration type="frame" class="{kind}"><resolution width="8192" height="5460"/>'
            f"<f>{f}</f><cx>15.5</cx><cy>16.1</cy><k1>-0.0447</k1></calibration>"
        )

    sensor = (
        f'<sensor id="0" label="P1">{calibration("initial", 8198)}{calibration("adjusted", 8196.5)}</sensor>'
    )
    text = f'<document version="2.0.0"><chunk><sensors>{sensor}</sensors></chunk></document>'
    assert metashape.read(text).f_px == 8196.5
    assert detect_format(text).name == "metashape"
    two = text.replace("</sensors>", f'<sensor label="H20">{calibration("initial", 5000)}</sensor></sensors>')
    with pytest.raises(FormatError, match="2 cameras"):
        metashape.read(two)
    assert metashape.read(two, ReadOptions(camera_name="H20")).f_px == 5000
    with pytest.raises(FormatError, match="holds no camera"):
        metashape.read("<document><chunk/></document>")


def test_photoscan_s_old_layout() -> None:
    """fx, fy, skew, an absolute principal point, and P1, P2 in OpenCV's order."""
    text = (
        "<calibration><projection>frame</projection><width>8176</width><height>6132</height>"
        "<fx>4587.25</fx><fy>4586.5</fy><cx>4053.75</cx><cy>2980.0</cy><skew>2.25</skew>"
        "<k1>-0.008</k1><k2>-0.002</k2><k3>0.012</k3><k4>-0.005</k4><p1>-1.4e-3</p1><p2>-4.7e-4</p2></calibration>"
    )
    camera = metashape.read(text)
    assert camera == BrownCamera(
        8176, 6132, 4587.25, 4053.75, 2980.0, -0.008, -0.002, 0.012, -0.005, -1.4e-3, -4.7e-4, 0.75, 2.25
    )


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("frame<", "fisheye<"), "projection 'fisheye'"),
        (("<p1>0", "<p3>0.1</p3><p1>0"), "P3"),
        (("<f>2000</f>", ""), "<f> is missing"),
        (("<f>2000", "<f>two"), "<f> is 'two'"),
        (("<f>2000", "<f>nan"), "<f> is 'nan'"),
        (("<f>2000", "<f>-2000"), "which no camera has"),
        (("<width>4000", "<width>4000.5"), "cannot be"),
    ],
)
def test_metashape_files_that_cannot_be_used(change: tuple[str, str], why: str) -> None:
    text = (
        "<calibration><projection>frame</projection><width>4000</width><height>3000</height>"
        "<f>2000</f><p1>0</p1></calibration>"
    )
    assert metashape.read(text).f_px == 2000
    with pytest.raises(FormatError, match=why):
        metashape.read(text.replace(*change))


# --- Pix4D ---------------------------------------------------------------------------------------------

PIX4D = """Pix4D camera calibration file 0
#Focal Length mm assuming a sensor width of 17.49998592000000030566x13.12498944000000200560mm
F 15.01175404934517487732
#Principal Point mm
Px 8.48210511970419922534
Py 6.33434629978042273990
#Symmetrical Lens Distortion Coeffs
K1 0.03833474118270804865
K2 -0.01750917966495743258
K3 0.02049798716391852335
#Tangential Lens Distortion Coeffs
T1 0.00240851666319534747
T2 0.00292562392135245920
"""


def test_pix4d_agrees_with_the_same_project_s_camera_matrix() -> None:
    """EasyIDP's published maize project: this .cam and the K of calibrated_camera_parameters.txt."""
    camera = pix4d.read(PIX4D, ReadOptions(image_size=(4608, 3456)))
    assert camera.f_px == pytest.approx(3952.81247514184087776812, abs=1e-6)
    assert camera.cx_px == pytest.approx(2233.46124792750424603582, abs=1e-6)
    assert camera.cy_px == pytest.approx(1667.92521335858214115433, abs=1e-6)
    assert (camera.k1, camera.p1) == (0.03833474118270804865, 0.00240851666319534747)


def test_pix4d_needs_the_image_size_and_the_right_file() -> None:
    with pytest.raises(FormatError, match="give the image size"):
        pix4d.read(PIX4D)
    with pytest.raises(FormatError, match="proportions"):
        pix4d.read(PIX4D, ReadOptions(image_size=(3456, 4608)))
    with pytest.raises(FormatError, match="lacks F"):
        pix4d.read(PIX4D.replace("\nF ", "\nG "), ReadOptions(image_size=(4608, 3456)))
    with pytest.raises(FormatError, match="_pix4d_calibrated"):
        pix4d.read("camera_calibration_file 0\nSYM_DIST 0 0 0 0\n")
    rig = PIX4D + PIX4D.replace("file 0", "file 1")
    with pytest.raises(FormatError, match="2 cameras"):
        pix4d.read(rig, ReadOptions(image_size=(4608, 3456)))
    assert pix4d.read(rig, ReadOptions(image_size=(4608, 3456), camera_name="1")).width == 4608


# --- MicMac ----------------------------------------------------------------------------------------------


def autocal(distortion: str, convention: str = "eConvApero_DistM2C", f: str = "1127.334") -> str:
    return (
        "<ExportAPERO><CalibrationInternConique>"
        f"<KnownConv>{convention}</KnownConv><PP>1039.03 1026.08</PP><F>{f}</F><SzIm>2048 2048</SzIm>"
        f"<CalibDistortion>{distortion}</CalibDistortion>"
        "</CalibrationInternConique></ExportAPERO>"
    )


RADIAL = "<CoeffDist>-1.407e-07</CoeffDist><CoeffDist>3.653e-14</CoeffDist><CoeffDist>-4.656e-21</CoeffDist>"


def test_micmac_radial_about_the_principal_point() -> None:
    camera = micmac.read(autocal(f"<ModRad><CDist>1039.03 1026.08</CDist>{RADIAL}</ModRad>"))
    assert (camera.k1_px, camera.k2_px, camera.k3_px) == pytest.approx((-1.407e-7, 3.653e-14, -4.656e-21))
    unif = "".join(f"<Params>{v}</Params>" for v in (-1.407e-7, 3.653e-14, -4.656e-21, 0, 0))
    same = micmac.read(
        autocal(f"<ModUnif><TypeModele>eModele_DRad_PPaEqPPs</TypeModele>{unif}<Etats>2048</Etats></ModUnif>")
    )
    assert same == camera


def test_micmac_s_own_formula_with_all_terms_and_another_centre() -> None:
    text = autocal(
        "<ModPhgrStd><RadialePart><CDist>1042.79 1023.34</CDist>"
        "<CoeffDist>-2e-08</CoeffDist><CoeffDist>1e-15</CoeffDist></RadialePart>"
        "<P1>2e-8</P1><P2>-3e-8</P2><b1>1e-4</b1><b2>-5e-5</b2></ModPhgrStd>"
    )
    camera = micmac.read(text)
    rays = image_rays(camera)
    dx, dy = (np.array([1039.03, 1026.08]) + 1127.334 * rays - [1042.79, 1023.34]).T
    r2 = dx * dx + dy * dy
    radial = r2 * (-2e-8 + r2 * 1e-15)
    u = 1042.79 + dx + dx * radial + 2e-8 * (2 * dx**2 + r2) - 6e-8 * dx * dy + 1e-4 * dx - 5e-5 * dy
    v = 1023.34 + dy + dy * radial - 3e-8 * (2 * dy**2 + r2) + 4e-8 * dx * dy
    assert camera.project(rays) == pytest.approx(np.stack([u, v], -1), abs=0.1)


def test_micmac_s_other_direction_is_fitted() -> None:
    weak = "<ModRad><CDist>1039.03 1026.08</CDist><CoeffDist>1e-9</CoeffDist></ModRad>"
    camera = micmac.read(autocal(weak, "eConvApero_DistC2M"))
    pixels = camera.project(image_rays(camera))
    d = pixels - [1039.03, 1026.08]
    corrected = d * (1 + 1e-9 * (d**2).sum(-1, keepdims=True))
    assert image_rays(camera) * 1127.334 == pytest.approx(corrected, abs=0.01)
    assert camera.k1 < 0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (autocal("<ModGrid/>"), "<ModGrid>"),
        (autocal("<ModUnif><TypeModele>eModeleEbner</TypeModele></ModUnif>"), "eModeleEbner"),
        (autocal("<ModNoDist/>", "eConvOriLib"), "convention 'eConvOriLib'"),
        (autocal("<ModNoDist/>", f="1 2 3"), "<F> has 3 numbers"),
        ("<ExportAPERO/>", "no <CalibrationInternConique>"),
        (autocal("<ModRad><CDist>1039 1026</CDist><CoeffDist>x</CoeffDist></ModRad>"), "<CoeffDist> is 'x'"),
    ],
)
def test_micmac_files_that_cannot_be_used(text: str, why: str) -> None:
    with pytest.raises(FormatError, match=why):
        micmac.read(text)


def test_micmac_without_distortion() -> None:
    assert micmac.read(autocal("<ModNoDist/>")) == BrownCamera(2048, 2048, 1127.334, 1039.03, 1026.08)


# --- Australis and VMS -----------------------------------------------------------------------------------

#: Layout of a published Australis report.
AUSTRALIS = """Australis Bundle Adjustment Results: Camera Parameters

Project:  {project}
Adjustment: Free-Network
Number of Points: 145
Number of Images: 9
RMS of Image coords:    0.47 (um)

Results for Camera 1    WASP-LT  Camera 3   Lens

Sensor Size        Pixel Size (mm)
  H    648           0.007
  V    494           0.007

 Camera    Initial      Total        Final      Initial      Final
Variable    Value     Adjustment     Value     Std. Error   Std. Error

    C      8.0000      0.30937      8.3094     1.0e+003     6.782e-003 (mm)
   XP      0.0000     -0.02804     -0.0280     1.0e+003     6.879e-003 (mm)
   YP      0.0000      0.02142      0.0214     1.0e+003     7.204e-003 (mm)
   K1   0.00000e+000   1.674e-003   1.67381e-003   1.0e+003   1.238e-004
   K2   0.00000e+000  -7.808e-006  -7.80809e-006   1.0e+003   3.066e-005
   K3   0.00000e+000  -1.229e-006  -1.22907e-006   1.0e+003   2.327e-006
   P1   0.00000e+000   1.752e-005   1.75249e-005   1.0e+003   3.496e-005
   P2   0.00000e+000  -8.641e-006  -8.64105e-006   1.0e+003   3.400e-005
   B1   0.00000e+000  -4.343e-004  -4.34298e-004   1.0e+003   1.100e-004
   B2   0.00000e+000   1.797e-005   1.79692e-005   1.0e+003   1.101e-004

Maximum Observational Radial Distance Encountered:   2.9 mm
"""


def test_an_australis_report_by_fraser_s_formulas() -> None:
    text = AUSTRALIS.format(project="VMS")
    assert detect_format(text).name == "vms"
    fit = vms.read_fit(text)
    assert fit.misfit_px < 0.1
    pixels = fit.camera.project(image_rays(fit.camera))
    # Measured coordinates in mm, y up, reduced to the principal point.
    x = (pixels[:, 0] - 324) * 0.007 + 0.0280
    y = -(pixels[:, 1] - 247) * 0.007 - 0.0214
    r2 = x * x + y * y
    radial = r2 * (1.67381e-3 + r2 * (-7.80809e-6 - 1.22907e-6 * r2))
    p1, p2, b1, b2 = 1.75249e-5, -8.64105e-6, -4.34298e-4, 1.79692e-5
    corrected_x = x + x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y + b1 * x + b2 * y
    corrected_y = y + y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    rays_mm = np.stack([corrected_x, -corrected_y], -1)
    assert image_rays(fit.camera) * 8.3094 / 0.007 == pytest.approx(rays_mm / 0.007, abs=0.15)


def test_the_same_report_by_metashape_distorts_the_other_way() -> None:
    text = AUSTRALIS.format(project="exported by Agisoft Metashape")
    assert detect_format(text).name == "australis"
    camera = FORMATS["australis"].read(text, None)
    assert camera.k1 == pytest.approx(1.67381e-3 * 8.3094**2)
    assert vms.read(AUSTRALIS.format(project="VMS")).k1 < 0
    assert (camera.cx_px, camera.cy_px) == pytest.approx((324 - 4.0, 247 - 0.0214 / 0.007))


def test_a_report_that_names_no_program_is_refused() -> None:
    text = AUSTRALIS.format(project="camera3.aus")
    with pytest.raises(FormatError, match="which program wrote it"):
        detect_format(text).read(text, None)
    with pytest.raises(FormatError, match="which program wrote it"):
        vms.read(text)


def test_vms_numbers_as_a_plain_list() -> None:
    """[SEN] Table 2, RGB, VMS, subset; image and pixel size from the paper's text."""
    text = (
        "VMS Phantom 4 Pro RGB\nPD 8.84\nPPx 1.82e-2\nPPy -3.20e-3\n"
        "K1 1.80e-4\nK2 -1.15e-5\nK3 1.96e-7\nP1 3.01e-5\nP2 1.85e-5\n"
    )
    assert detect_format(text).name == "vms"
    with pytest.raises(FormatError, match="give both"):
        vms.read(text)
    options = ReadOptions(image_size=(5472, 3648), pixel_size_mm=0.00241)
    fit = vms.read_fit(text, options)
    assert fit.camera.f_px == pytest.approx(8.84 / 0.00241)
    assert fit.camera.k1 < 0 < fit.camera.k2
    assert 0.1 < fit.misfit_px < 0.5
    with pytest.raises(FormatError, match=r"0\.05 px allowed"):
        vms.read(text, replace(options, tolerance_px=0.05))
    with pytest.raises(FormatError, match="square"):
        vms.read(text + "H 5472 0.00241\nV 3648 0.00250\n")
