"""Which photos are kept, which are left out and why."""

from __future__ import annotations

import os
import time as clock
from collections import Counter
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.errors import InputError
from calib.frames import LocalFrame
from calib.photos import (
    CameraIdentity,
    GimbalAngles,
    LeftOut,
    Photo,
    Position,
    Processing,
    Sorted,
    collect,
    read_photo,
    read_photos,
    require_block,
    sort_photos,
)

CAMERA = CameraIdentity("DJI", "FC330", None, 4000, 3000, Processing.LENS_CORRECTED, 3.61)
START = datetime(2024, 5, 6, 10, 0, 0)
SITE = LocalFrame(46.5, 6.25, 400.0)
NADIR = GimbalAngles(45.0, -90.0, 0.0)


def photo(
    number: int, enu: tuple[float, float, float], after_s: float, gimbal: GimbalAngles | None = NADIR
) -> Photo:
    latitude, longitude, altitude = SITE.geodetic(np.array([enu]))[0]
    return Photo(
        path=Path(f"DJI_{number:04d}.JPG"),
        camera=CAMERA,
        position=Position(latitude, longitude, altitude, enu[2]),
        gimbal=gimbal,
        time=START + timedelta(seconds=after_s),
        focal_px=2310.4,
    )


def grid(
    first: int = 1,
    east: float = 0.0,
    height: float = 60.0,
    after_s: float = 0.0,
    rows: int = 5,
    gimbal: GimbalAngles | None = NADIR,
) -> list[Photo]:
    return [
        photo(
            first + 6 * row + column,
            (east + 20.0 * row, 20.0 * column, height),
            after_s + 3.0 * (6 * row + column),
            gimbal,
        )
        for row in range(rows)
        for column in range(6)
    ]


def orbit(first: int, pitch: float, height: float, after_s: float, count: int = 8) -> list[Photo]:
    photos = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        place = (40 + 60 * np.sin(angle), 50 + 60 * np.cos(angle), height)
        facing = GimbalAngles(float(np.degrees(angle)) - 180, pitch, 0.0)
        photos.append(photo(first + i, place, after_s + 4.0 * i, facing))
    return photos


def reasons(result: Sorted) -> dict[str, str]:
    return {item.path.name: item.reason for item in result.left_out}


def assert_all_kept(photos: list[Photo]) -> Sorted:
    result = sort_photos(photos)
    assert result.left_out == ()
    assert len(result.used) == len(photos)
    require_block(result)
    return result


def test_a_plain_survey_is_kept_in_order_of_time():
    photos = grid()
    result = assert_all_kept(photos[::-1])
    assert list(result.used) == photos
    assert result.notes == ()


@pytest.mark.parametrize("pitch", [-70.0, -50.0, -30.0, -20.0])
@pytest.mark.parametrize("height", [12.0, 60.0, 90.0])
def test_oblique_orbits_at_other_heights_after_a_battery_change_are_kept(pitch, height):
    assert_all_kept(grid() + orbit(100, pitch, height, after_s=40 * 60))


def test_a_second_battery_after_recharging_is_the_same_survey():
    assert_all_kept(grid() + grid(100, east=100.0, after_s=2 * 3600))


def test_photos_without_any_metadata_are_kept():
    bare = [replace(p, position=None, gimbal=None, time=None) for p in grid()]
    notes = assert_all_kept(bare).notes
    assert len(notes) == 3
    assert any("No photo has a position" in note for note in notes)


def test_single_photos_without_metadata_are_kept():
    photos = grid()
    photos[4] = replace(photos[4], position=None)
    photos[9] = replace(photos[9], position=None, gimbal=None, time=None)
    photos[11] = replace(photos[11], time=None)
    photos[13] = replace(
        photos[13], position=replace(photos[13].position, height_above_launch_m=None, altitude_m=None)
    )
    notes = assert_all_kept(photos).notes
    assert sum("of 30 photos have no" in note for note in notes) == 3


def test_a_stale_position_without_angles_does_not_count_as_hovering():
    photos = [replace(p, gimbal=None) for p in grid()]
    photos[5:12] = [replace(p, position=photos[5].position) for p in photos[5:12]]
    assert_all_kept(photos)


def test_duplicates():
    photos = [replace(p, fingerprint=f"f{i}") for i, p in enumerate(grid())]
    copies = [
        replace(photos[3], path=Path("copy/DJI_0004 (1).JPG"), time=None),  # same image data
        replace(photos[6], path=Path("copy/DJI_0007.JPG"), fingerprint="saved anew"),
    ]
    result = sort_photos(photos + copies)
    assert reasons(result) == {
        "DJI_0004 (1).JPG": "a copy of DJI_0004.JPG",
        "DJI_0007.JPG": "a copy of DJI_0007.JPG",
    }
    assert list(result.used) == photos


def test_other_camera_size_body_zoom_and_processing():
    def other(first: int, **changes: object) -> list[Photo]:
        return [replace(p, camera=replace(CAMERA, **{"serial": "A", **changes})) for p in grid(first, rows=1)]

    mine = [replace(p, camera=replace(CAMERA, serial="A")) for p in grid()]
    mine[0] = replace(mine[0], camera=CAMERA)  # one photo that lacks the serial number
    result = sort_photos(
        mine
        + other(100, model="FC220")
        + other(200, height=2250)
        + other(300, serial="B")
        + other(400, focal_mm=7.2)
        + other(500, processing=Processing.RAW)
        + other(600, band="NIR")
    )
    assert {p.path.name for p in result.used} == {p.path.name for p in mine}
    found = reasons(result)
    assert "another camera (DJI FC220, 4000 x 3000)" in found["DJI_0100.JPG"]
    assert "4000 x 2250 instead of 4000 x 3000" in found["DJI_0200.JPG"]
    assert "serial number B" in found["DJI_0300.JPG"]
    assert "7.2 mm instead of 3.61 mm" in found["DJI_0400.JPG"]
    assert "raw instead of lens-corrected" in found["DJI_0500.JPG"]
    assert "another camera of the same body (NIR)" in found["DJI_0600.JPG"]
    assert len(found) == 36
    assert "To check another, give its photos alone" in result.notes[0]


def test_focal_lengths_that_differ_by_rounding_are_one():
    photos = [
        replace(p, camera=replace(CAMERA, focal_mm=3.61 + 1e-3 * (i % 3))) for i, p in enumerate(grid())
    ]
    assert_all_kept(photos)


def test_digital_zoom_shows_in_the_focal_length_in_px():
    photos = grid()
    photos[20:24] = [replace(p, focal_px=4620.8) for p in photos[20:24]]
    result = sort_photos(photos)
    assert {item.reason for item in result.left_out} == {
        "taken at another focal length (4621 px instead of 2310 px)"
    }
    assert len(result.left_out) == 4


def test_another_site_on_the_card():
    result = sort_photos(grid() + grid(100, east=2300.0, after_s=1800, rows=3))
    assert len(result.used) == 30
    assert len(result.left_out) == 18
    assert "another flight (18 photos, 2.2 km away)" in set(reasons(result).values())
    assert "2 flights were found" in result.notes[0]
    assert "DJI_0001.JPG to DJI_0030.JPG" in result.notes[0]


def test_the_same_site_on_another_day():
    result = sort_photos(grid(rows=3) + grid(100, after_s=5 * 24 * 3600))
    assert {p.path.name for p in result.used} == {p.path.name for p in grid(100)}
    assert set(reasons(result).values()) == {"another flight (18 photos, 5 days earlier)"}


def test_flights_without_positions_are_told_apart_by_pauses():
    photos = [replace(p, position=None) for p in grid() + grid(100, after_s=6 * 3600, rows=2)]
    result = sort_photos(photos)
    assert len(result.used) == 30
    assert len(result.left_out) == 12
    assert "6.0 hours later" in result.left_out[0].reason


def test_a_wide_site_is_one_site():
    """A fixed wing's lines, 250 m apart over 3 km."""
    photos = [photo(n, (250.0 * (n % 12), 300.0 * (n // 12), 120.0), 5.0 * n) for n in range(60)]
    assert_all_kept(photos)


def test_one_wild_position_is_dropped_but_not_its_photo():
    photos = grid()
    photos[7] = replace(photos[7], position=replace(photos[7].position, latitude_deg=47.0))
    result = sort_photos(photos)
    assert result.left_out == ()
    assert len(result.used) == 30
    assert [p.position is None for p in result.used] == [i == 7 for i in range(30)]
    assert any("DJI_0008.JPG" in note for note in result.notes)


def test_take_off_and_landing():
    on_ground = [
        photo(n, (40.0, 50.0, h), s) for n, h, s in [(900, 0.2, -60), (901, 1.5, -50), (902, 0.0, 200)]
    ]
    result = sort_photos(grid() + on_ground)
    assert set(reasons(result)) == {"DJI_0900.JPG", "DJI_0901.JPG", "DJI_0902.JPG"}
    assert "take-off or landing (1.5 m above launch, the survey at 60 m)" in reasons(result)["DJI_0901.JPG"]


def test_low_flights_and_flights_below_launch_are_no_take_off():
    assert_all_kept(grid(height=4.0))
    assert_all_kept(grid(height=-30.0))
    assert_all_kept(grid(height=60.0) + grid(100, height=8.0, after_s=600))


def test_horizon_shots():
    level = [
        photo(900 + i, (10.0 * i, 0.0, 60.0), 300.0 + i, GimbalAngles(0.0, -5.0 * i, 0.0)) for i in range(4)
    ]
    result = sort_photos(grid() + level)
    # Pitch 0, -5 and -10 look at the horizon; -15 is the limit and stays.
    assert set(reasons(result)) == {"DJI_0900.JPG", "DJI_0901.JPG", "DJI_0902.JPG"}
    assert "gimbal pitch -5 degrees" in reasons(result)["DJI_0901.JPG"]


def test_a_wall_is_no_horizon():
    wall = [photo(n, (2.0 * n, 0.0, 10.0), 3.0 * n, GimbalAngles(0.0, -3.0, 0.0)) for n in range(24)]
    result = assert_all_kept(wall)
    assert "look at the horizon" in result.notes[0]


def test_hovering():
    hover = [photo(900 + i, (100.0, 0.05 * i, 60.0), 120.0 + 2 * i) for i in range(6)]
    result = sort_photos(grid() + hover)
    assert set(reasons(result)) == {f"DJI_{n:04d}.JPG" for n in range(901, 906)}
    assert "same spot in the same direction as DJI_0900.JPG" in reasons(result)["DJI_0901.JPG"]


def test_all_at_one_spot():
    jitter = np.random.default_rng(0).normal(0, 0.2, (12, 3))
    photos = [
        photo(i, (row[0], row[1], row[2] + 30), 2.0 * i, GimbalAngles(30.0 * i - 180, -40.0, 0.0))
        for i, row in enumerate(jitter)
    ]
    with pytest.raises(InputError, match="All 12 photos were taken from one spot"):
        require_block(sort_photos(photos))
    rising = [photo(i, (0.0, 0.0, 10.0 + 3 * i), 2.0 * i) for i in range(12)]
    require_block(sort_photos(rising))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few(count):
    unreadable = [LeftOut(Path("x.JPG"), "truncated")]
    with pytest.raises(
        InputError, match=r"usable; .* at least three .*1 left out, for example x.JPG: truncated"
    ):
        require_block(sort_photos(grid()[:count], unreadable))
    require_block(sort_photos(grid()[:3]))


optional_time = st.none() | st.datetimes(datetime(2000, 1, 1), datetime(2030, 1, 1))
optional_position = st.none() | st.builds(
    Position,
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.none() | st.floats(-100, 9000),
    st.none() | st.floats(-50, 500),
)
optional_gimbal = st.none() | st.builds(
    GimbalAngles, st.floats(-180, 180), st.floats(-180, 180), st.floats(-180, 180)
)
camera = st.builds(
    CameraIdentity,
    st.sampled_from(["DJI", ""]),
    st.just("X"),
    st.none() | st.just("1"),
    st.just(40),
    st.just(30),
    st.sampled_from(Processing),
    st.none() | st.floats(1, 100),
)
some_photo = st.builds(
    Photo,
    st.integers(0, 10**6).map(lambda n: Path(f"{n}.jpg")),
    camera,
    optional_position,
    optional_gimbal,
    optional_time,
    focal_px=st.none() | st.floats(10, 1e5),
    fingerprint=st.sampled_from(["", "a", "b"]),
)
anything = st.lists(some_photo, max_size=12, unique_by=lambda p: p.path)


@given(anything)
def test_every_photo_is_either_used_or_left_out_with_a_reason(photos):
    result = sort_photos(photos)
    names = [p.path for p in result.used] + [item.path for item in result.left_out]
    assert Counter(names) == Counter(p.path for p in photos)
    assert all(item.reason for item in result.left_out)
    assert sort_photos(photos[::-1]) == result
    if photos:
        assert result.used


def real_set(name: str) -> list[Photo]:
    root = os.environ.get("FIELDCAL_DATA")
    if not root or not (Path(root) / name).is_dir():
        pytest.skip("FIELDCAL_DATA names no folder with the real photo sets")
    photos, left_out = read_photos(collect([Path(root) / name]))
    assert left_out == []
    return photos


@pytest.mark.parametrize(
    ("name", "count", "model", "focal_px", "processing", "span_s"),
    [
        ("brighton_beach", 18, "FC300S", 2311, Processing.LENS_CORRECTED, 124),
        ("caliterra_slice", 18, "Canon PowerShot SX260 HS", 2904, Processing.UNKNOWN, 36),
        ("lewis_oblique", 22, "Canon PowerShot S100", 2795, Processing.UNKNOWN, 431),
    ],
)
def test_real_sets_are_kept_whole(name, count, model, focal_px, processing, span_s):
    result = sort_photos(real_set(name))
    require_block(result)
    assert (len(result.used), result.left_out) == (count, ())
    first, last = result.used[0], result.used[-1]
    assert first.camera.model == model
    assert first.camera.processing is processing
    assert first.focal_px == pytest.approx(focal_px, rel=2e-3)
    assert first.time is not None
    assert last.time is not None
    assert (last.time - first.time).total_seconds() == span_s
    assert all(p.position is not None and p.position.altitude_m is not None for p in result.used)


def test_brighton_beach_is_nadir_at_40_m():
    photos = real_set("brighton_beach")
    for p in photos:
        assert p.gimbal is not None
        assert p.gimbal.pitch_deg == pytest.approx(-89.9, abs=0.2)
        assert p.position is not None
        assert p.position.height_above_launch_m == pytest.approx(40, abs=0.5)


def test_reading_is_fast():
    photos = real_set("brighton_beach")
    start = clock.perf_counter()
    for p in photos:
        read_photo(p.path)
    # About 2 ms a photo here; the bound leaves room for a loaded machine.
    assert (clock.perf_counter() - start) / len(photos) < 0.02


def test_sorting_thousands_is_fast():
    photos = [photo(n, (20.0 * (n % 60), 20.0 * (n // 60), 60.0), 2.0 * n) for n in range(3000)]
    elsewhere = [photo(n + 5000, (9000.0 + n, 0.0, 60.0), 9000.0 + n) for n in range(1000)]
    start = clock.perf_counter()
    assert len(sort_photos(photos + elsewhere).used) == 3000
    assert clock.perf_counter() - start < 5
