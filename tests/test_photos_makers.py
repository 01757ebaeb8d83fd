"""What different makers' files say, written synthetically and read back."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from photos_synthetic import claim_size, gps, packet, write_photo
from PIL.TiffImagePlugin import IFDRational

from calib.frames import rotation_cam_from_world, tilt_deg
from calib.photos import AltitudeDatum, GimbalAngles, Photo, Processing, read_photo

NAN = IFDRational(0, 0)


def read(tmp_path: Path, size: tuple[int, int] | None = None, name: str = "photo.jpg", **kwargs) -> Photo:
    path = write_photo(tmp_path / name, **kwargs)
    if size is not None:
        claim_size(path, *size)
    return read_photo(path)


DJI_RTK = """drone-dji:GpsStatus="RTK" drone-dji:AltitudeType="RtkAlt"
 drone-dji:GpsLatitude="+43.36511377" drone-dji:GpsLongtitude="+141.81345593"
 drone-dji:AbsoluteAltitude="+116.56" drone-dji:RelativeAltitude="+69.95"
 drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="-79.00" drone-dji:GimbalPitchDegree="-89.90"
 drone-dji:FlightRollDegree="-2.50" drone-dji:FlightYawDegree="-78.60" drone-dji:FlightPitchDegree="-4.50"
 drone-dji:CalibratedFocalLength="3666.666504" drone-dji:CalibratedOpticalCenterX="2432.000000"
 drone-dji:CalibratedOpticalCenterY="1824.000000" drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01274"
 drone-dji:RtkStdLat="0.01122" drone-dji:RtkStdHgt="0.02394" drone-dji:DewarpFlag="0"
 drone-dji:DewarpData="2018-03-13;3659.78,3653.17,-7.71,45.90,-0.269478,0.115681,-0.0000875619,-0.000306,-0.0357"
 drone-dji:DroneSerialNumber="0V2DG1" drone-dji:CameraSerialNumber="CAM77" """


def test_dji_rtk(tmp_path):
    photo = read(
        tmp_path,
        (4864, 3648),
        make="DJI",
        model="FC6310R",
        photo={0x920A: IFDRational(88, 10), 0xA405: 24, 0x9003: "2018:11:20 10:11:12"},
        position=gps(43.365, 141.8134, 116.5),
        xmp=packet("", DJI_RTK),
    )
    camera, position = photo.camera, photo.position
    assert (camera.make, camera.model, camera.serial) == ("DJI", "FC6310R", "CAM77")
    assert (camera.width, camera.height, camera.focal_mm) == (4864, 3648, 8.8)
    assert camera.processing is Processing.RAW
    assert position is not None
    assert (position.latitude_deg, position.longitude_deg) == (43.36511377, 141.81345593)
    assert (position.altitude_m, position.height_above_launch_m) == (116.56, 69.95)
    assert position.altitude_datum is AltitudeDatum.ELLIPSOID
    assert (position.sigma_horizontal_m, position.sigma_vertical_m) == (0.01274, 0.02394)
    assert photo.gimbal == GimbalAngles(-79.0, -89.9, 0.0)
    assert photo.aircraft == GimbalAngles(-78.6, -4.5, -2.5)
    assert photo.focal_px == 3659.78
    assert photo.factory["k1"] == -0.269478
    assert photo.factory["cx_px"] == pytest.approx(2432 - 7.71)
    assert photo.factory["cy_px"] == pytest.approx(1824 + 45.90)
    assert photo.factory["calibrated_f_px"] == pytest.approx(3666.666504)


def test_dji_dewarped_uses_the_designed_focal_length(tmp_path):
    attributes = DJI_RTK.replace('DewarpFlag="0"', 'DewarpFlag="1"')
    photo = read(tmp_path, (4864, 3648), make="DJI", model="FC6310R", xmp=packet("", attributes))
    assert photo.camera.processing is Processing.LENS_CORRECTED
    assert photo.focal_px == pytest.approx(3666.666504)


def test_dji_as_elements_and_in_other_case(tmp_path):
    body = (
        "<drone-dji:RelativeAltitude>+46.00</drone-dji:RelativeAltitude>"
        "<drone-dji:gimbalyawdegree>+84.20</drone-dji:gimbalyawdegree>"
        "<Drone-DJI:GimbalPitchDegree>-44.50</Drone-DJI:GimbalPitchDegree><drone-dji:SelfData/>"
    )
    photo = read(tmp_path, make="DJI", model="FC7303", position=gps(44.5, -64.3, 46.0), xmp=packet(body))
    assert photo.gimbal == GimbalAngles(84.2, -44.5, 0.0)
    assert photo.position is not None
    assert photo.position.height_above_launch_m == 46.0
    assert photo.position.longitude_deg == pytest.approx(-64.3, abs=1e-7)


def test_dji_zero_angles_are_no_angles(tmp_path):
    attributes = " ".join(f'drone-dji:Gimbal{axis}Degree="+0.00"' for axis in ("Roll", "Yaw", "Pitch"))
    assert read(tmp_path, make="DJI", model="FC7303", xmp=packet("", attributes)).gimbal is None


def test_dji_upside_down_at_nadir_still_looks_down(tmp_path):
    degrees = {"Roll": "+180.00", "Yaw": "+30.00", "Pitch": "-90.00"}
    attributes = " ".join(f'drone-dji:Gimbal{axis}Degree="{value}"' for axis, value in degrees.items())
    photo = read(tmp_path, make="DJI", model="H30T", xmp=packet("", attributes))
    assert photo.gimbal is not None
    assert tilt_deg(photo.gimbal) < 1e-6
    turned = rotation_cam_from_world(GimbalAngles(-150.0, -90.0, 0.0))
    np.testing.assert_allclose(rotation_cam_from_world(photo.gimbal), turned, atol=1e-12)


def test_dji_single_positions_get_no_optimistic_sigma(tmp_path):
    for flag, sigma in (("16", 1.0), ("0", None), ("34", 0.01274)):
        attributes = DJI_RTK.replace('RtkFlag="50"', f'RtkFlag="{flag}"')
        position = read(tmp_path, make="DJI", model="M3E", xmp=packet("", attributes)).position
        assert position is not None
        assert position.sigma_horizontal_m == sigma


@pytest.mark.parametrize(
    ("size", "expected"),
    [((4000, 3000), 2310.4), ((4000, 2250), 2310.4), ((2000, 1500), 1155.2), ((3000, 4000), 2310.4)],
)
def test_phantom_3_focal_length_at_every_format(tmp_path, size, expected):
    photo = read(
        tmp_path,
        size,
        make="DJI",
        model="FC300X",
        photo={0x920A: IFDRational(361, 100), 0xA405: 20, 0xA404: NAN},
    )
    assert photo.focal_px == pytest.approx(expected, abs=1)
    assert photo.camera.processing is Processing.LENS_CORRECTED


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((4000, 3000), 24 / 43.2666 * 5000),
        # The wider format is a crop of the same frame: same lens, same focal length.
        ((4000, 2250), 24 / 43.2666 * 5000),
        ((5472, 3648), 24 / 43.2666 * 6576.5),
        ((3000, 4000), 24 / 43.2666 * 5000),
    ],
)
def test_equivalent_focal_length_of_unknown_cameras(tmp_path, size, expected):
    photo = read(tmp_path, size, make="Acme", model="One", photo={0xA405: 24})
    assert photo.focal_px == pytest.approx(expected, rel=1e-3)
    assert photo.camera.processing is Processing.UNKNOWN


def test_focal_plane_resolution_follows_a_resized_image(tmp_path):
    tags = {
        0x920A: IFDRational(45, 10),
        0xA20E: IFDRational(4000000, 244),
        0xA210: 2,
        0xA002: 4000,
        0xA003: 3000,
    }
    full = read(tmp_path, (4000, 3000), make="Canon", model="Canon PowerShot SX999", photo=tags)
    small = read(tmp_path, (1000, 750), make="Canon", model="Canon PowerShot SX999", photo=tags)
    assert full.focal_px == pytest.approx(4.5 * 16393.44 / 25.4, rel=1e-4)
    assert small.focal_px == pytest.approx(full.focal_px / 4)


def test_nonsense_of_the_maker_gives_way_to_exif(tmp_path):
    attributes = 'drone-dji:CalibratedFocalLength="9000" drone-dji:CalibratedOpticalCenterX="2000"'
    tags = {0x920A: IFDRational(361, 100), 0xA405: 20}
    photo = read(tmp_path, (4000, 3000), make="DJI", model="FC330", photo=tags, xmp=packet("", attributes))
    assert photo.focal_px == pytest.approx(2310.4, abs=1)
    absurd = read(tmp_path, (4000, 3000), make="Acme", model="X", photo={0xA405: 60000})
    assert absurd.focal_px is None


def test_digital_zoom_counts(tmp_path):
    tags = {0x920A: IFDRational(361, 100), 0xA404: IFDRational(2)}
    photo = read(tmp_path, (4000, 3000), make="DJI", model="FC330", photo=tags)
    assert photo.focal_px == pytest.approx(2 * 2310.4, abs=1)
    assert photo.camera.focal_mm == pytest.approx(7.22)


def test_autel_both_ways(tmp_path):
    by_the_book = 'Camera:Yaw="10" Camera:Pitch="30" Camera:Roll="0"'
    photo = read(tmp_path, make="Autel Robotics", model="XT701", xmp=packet("", by_the_book))
    assert photo.gimbal is not None
    assert (photo.gimbal.yaw_deg, photo.gimbal.pitch_deg) == pytest.approx((10, -60))
    like_dji = 'tiff:Make="Autel Robotics" Camera:Yaw="10" Camera:Pitch="-60" Camera:Roll="0"'
    photo = read(tmp_path, make="Camera", model="XL715", xmp=packet("", like_dji))
    assert photo.gimbal == GimbalAngles(10, -60, 0)
    own = 'drone:GimbalYawDegree="5" drone:GimbalPitchDegree="-70" drone:RelativeAltitude="31.5"'
    photo = read(tmp_path, make="Autel Robotics", model="XT705", position=gps(1, 2, 3), xmp=packet("", own))
    assert photo.gimbal == GimbalAngles(5, -70, 0)
    assert photo.position is not None
    assert photo.position.height_above_launch_m == 31.5


def test_parrot_anafi(tmp_path):
    body = (
        "<drone-parrot:CameraRollDegree>-0.322913</drone-parrot:CameraRollDegree>"
        "<drone-parrot:CameraPitchDegree>-78.362686</drone-parrot:CameraPitchDegree>"
        "<drone-parrot:CameraYawDegree>176.310745</drone-parrot:CameraYawDegree>"
        "<Camera:Pitch>11.6</Camera:Pitch><Camera:Yaw>176.3</Camera:Yaw><Camera:Roll>0</Camera:Roll>"
        "<Camera:AboveGroundAltitude>25512/1000</Camera:AboveGroundAltitude>"
        "<Camera:GPSXYAccuracy>1.5</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>9/4</Camera:GPSZAccuracy>"
    )
    photo = read(
        tmp_path,
        (5344, 4016),
        make="Parrot",
        model="Anafi",
        photo={0x920A: IFDRational(404, 100), 0xA405: 23},
        position=gps(48.8, 2.3, 60),
        xmp=packet(body),
    )
    assert photo.gimbal == GimbalAngles(176.310745, -78.362686, -0.322913)
    assert photo.position is not None
    assert photo.position.height_above_launch_m == pytest.approx(25.512)
    assert (photo.position.sigma_horizontal_m, photo.position.sigma_vertical_m) == (1.5, 2.25)
    assert photo.focal_px == pytest.approx(3607, abs=3)


def test_parrot_sequoia_pix4d_tags(tmp_path):
    attributes = (
        'Camera:Pitch="-3.5" Camera:Roll="0" Camera:Yaw="170" Camera:PrincipalPoint="2.4,1.8"'
        ' Camera:PerspectiveFocalLength="3.98" Camera:PerspectiveDistortion="-0.1,0.1,-0.06,0,0"'
    )
    photo = read(tmp_path, (1280, 960), make="Parrot", model="Sequoia", xmp=packet("", attributes))
    assert photo.gimbal is not None
    # Looks 3.5 degrees backwards past nadir.
    assert tilt_deg(photo.gimbal) == pytest.approx(3.5)
    heading_of_top = -rotation_cam_from_world(photo.gimbal)[1]
    assert np.degrees(np.arctan2(heading_of_top[0], heading_of_top[1])) == pytest.approx(170)
    assert photo.focal_px == pytest.approx(3.98 / 4.8 * 1280)
    assert photo.factory["pix4d_k1"] == -0.1


def test_bands_of_a_multispectral_camera(tmp_path):
    as_sequence = "<Camera:BandName><rdf:Seq><rdf:li>NIR</rdf:li></rdf:Seq></Camera:BandName>"
    assert read(tmp_path, make="Parrot", model="Sequoia", xmp=packet(as_sequence)).camera.band == "NIR"
    source = packet("", 'drone-dji:ImageSource="ZoomCamera"')
    assert read(tmp_path, make="DJI", model="M3T", xmp=source).camera.band == "ZoomCamera"
    assert read(tmp_path, make="DJI", model="M3T").camera.band == ""


def test_sensefly_roll_counts_the_other_way(tmp_path):
    attributes = 'Camera:Pitch="0" Camera:Roll="10" Camera:Yaw="0" Camera:GPSXYAccuracy="0.03"'
    looks = []
    for make in ("senseFly", "Acme"):
        photo = read(
            tmp_path, make=make, model="S.O.D.A.", position=gps(46, 6, 500), xmp=packet("", attributes)
        )
        assert photo.gimbal is not None
        looks.append(rotation_cam_from_world(photo.gimbal)[2])
    np.testing.assert_allclose(looks[0], looks[1] * [-1, 1, 1], atol=1e-12)
    assert abs(looks[0][0]) == pytest.approx(np.sin(np.radians(10)))


@pytest.mark.parametrize("nested", [False, True])
def test_skydio(tmp_path, nested):
    yaw_pitch_roll = {"Roll": "0.186841", "Pitch": "-7.468572", "Yaw": "127.444323"}
    members = "".join(f"<drone-skydio:{k}>{v}</drone-skydio:{k}>" for k, v in yaw_pitch_roll.items())
    attributes = " ".join(f'drone-skydio:{k}="{v}"' for k, v in yaw_pitch_roll.items())
    tag = "drone-skydio:CameraOrientationNED"
    orientation = f'<{tag} rdf:parseType="Resource">{members}</{tag}>' if nested else f"<{tag} {attributes}/>"
    body = (
        '<drone-skydio:CameraOrientationFLU drone-skydio:Yaw="1" drone-skydio:Pitch="2"/>'
        f"{orientation}<drone-skydio:Latitude>40.7</drone-skydio:Latitude>"
        "<drone-skydio:Longitude>-111.9</drone-skydio:Longitude>"
        "<drone-skydio:AbsoluteAltitude>1034.44</drone-skydio:AbsoluteAltitude>"
        "<drone-skydio:CalibratedFocalLengthX>2376.5625</drone-skydio:CalibratedFocalLengthX>"
        "<drone-skydio:CalibratedOpticalCenterX>2027.5</drone-skydio:CalibratedOpticalCenterX>"
    )
    photo = read(tmp_path, (4056, 3040), make="Skydio", model="2", xmp=packet(body))
    assert photo.gimbal == GimbalAngles(127.444323, -7.468572, 0.186841)
    assert photo.position is not None
    assert photo.position.altitude_m == 1034.44
    assert photo.position.altitude_datum is AltitudeDatum.ELLIPSOID
    assert photo.focal_px == 2376.5625


def test_phone_with_a_stated_accuracy(tmp_path):
    photo = read(
        tmp_path,
        (4032, 3024),
        make="Apple",
        model="iPhone 12",
        main={0x0112: 6},
        photo={0x9003: "2024:05:06 07:08:09", 0x9291: "123", 0xA405: 26, 0xA431: "X1"},
        position=gps(-33.5, -70.25, -12.5, t31=IFDRational(47, 10)),
    )
    assert photo.position is not None
    assert photo.position.latitude_deg == pytest.approx(-33.5, abs=1e-7)
    assert photo.position.longitude_deg == pytest.approx(-70.25, abs=1e-7)
    assert photo.position.altitude_m == -12.5
    assert photo.position.sigma_horizontal_m == 4.7
    assert photo.time == datetime(2024, 5, 6, 7, 8, 9, 123000)
    assert photo.time_resolution_s == pytest.approx(0.001)
    assert photo.orientation == 6
    assert photo.camera.serial == "X1"


def test_gps_time_sharpens_the_camera_clock_only_where_it_agrees(tmp_path):
    def time_of(original: str, stamp: tuple[float, ...]) -> tuple[datetime | None, float]:
        position = gps(46, 6, t29="2024:05:06", t7=tuple(IFDRational(round(v * 100), 100) for v in stamp))
        photo = read(tmp_path, photo={0x9003: original} if original else None, position=position)
        return photo.time, photo.time_resolution_s

    assert time_of("2024:05:06 12:30:10", (7, 0, 10.25)) == (datetime(2024, 5, 6, 12, 30, 10, 250000), 1e-3)
    assert time_of("2024:05:06 12:30:10", (7, 0, 16.25)) == (datetime(2024, 5, 6, 12, 30, 10), 1.0)
    assert time_of("2024:05:06 12:30:10", (7, 0, 10)) == (datetime(2024, 5, 6, 12, 30, 10), 1.0)
    assert time_of("", (7, 0, 10.25)) == (datetime(2024, 5, 6, 7, 0, 10, 250000), 1e-3)
    assert time_of("0000:00:00 00:00:00", (7, 0, 10)) == (datetime(2024, 5, 6, 7, 0, 10), 1.0)


def test_dji_exposure_time_in_xmp(tmp_path):
    photo = read(
        tmp_path,
        make="DJI",
        model="M3E",
        photo={0x9003: "2022:11:22 15:04:09"},
        xmp=packet("", 'drone-dji:UTCAtExposure="2022-11-22T07:04:09.541320"'),
    )
    assert photo.time == datetime(2022, 11, 22, 15, 4, 9, 541320)
    assert photo.time_resolution_s <= 0.01


@pytest.mark.parametrize(
    ("make", "model", "software", "attributes", "name", "expected"),
    [
        ("DJI", "FC330", "", "", "a.jpg", Processing.LENS_CORRECTED),
        ("Hasselblad", "L1D-20c", "", "", "a.jpg", Processing.LENS_CORRECTED),
        ("DJI", "FC6520", "", "", "a.jpg", Processing.UNKNOWN),
        ("DJI", "M3E", "", "", "a.jpg", Processing.UNKNOWN),
        ("DJI", "M3E", "", 'drone-dji:DewarpFlag="0"', "a.jpg", Processing.RAW),
        ("DJI", "FC330", "Adobe Lightroom 6", "", "a.jpg", Processing.UNKNOWN),
        (
            "DJI",
            "FC330",
            "Adobe Lightroom 6",
            'crs:LensProfileEnable="1"',
            "a.jpg",
            Processing.LENS_CORRECTED,
        ),
        ("DJI", "FC6360", "", "", "a.tif", Processing.RAW),
        ("Canon", "Canon PowerShot S100", "", "", "a.jpg", Processing.UNKNOWN),
    ],
)
def test_processing(tmp_path, make, model, software, attributes, name, expected):
    photo = read(
        tmp_path, name=name, make=make, model=model, main={0x0131: software}, xmp=packet("", attributes)
    )
    assert photo.camera.processing is expected
