"""The photos of a recommended pass among those of a card: known again, and checked with the survey's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from photos_synthetic import gps, write_photo
from result_factory import build

from calib.errors import FormatError, InputError
from calib.extra_pass import ExtraPass, Knowledge, extra_pass_words, knowledge_of
from calib.findings import Verdict
from calib.frames import LocalFrame
from calib.photos import CameraIdentity, GimbalAngles, Photo, Position, read_photo, sort_photos
from calib.references import store_folder
from calib.report import render_report
from calib.report_json import check_report
from daemon import pass_book
from daemon.pass_book import PassFinder
from mission.plan import Station, looking_inwards
from mission.refly_record import PASS_FILE, PassRecord, read_record, record_text
from mission.refly_taken import Taken, taken

CAMERA = CameraIdentity("DJI", "FC300X", "42", 4000, 3000)
LAUNCH = LocalFrame(46.5, 6.25)
START = datetime(2026, 5, 12, 10, 0, 0)
MADE = datetime(2026, 5, 12, 9, 0, 0, tzinfo=UTC)
ORBIT = tuple(looking_inwards(np.array([40.0, 40.0]), 62.0, 42.0, np.arange(0, 360, 45.0), 35.0, "orbit"))
SURVEY = tuple(
    Station(20.0 * (i % 5), 20.0 * (i // 5), 60.0, 0.0 if i // 5 % 2 else 180.0, -90.0) for i in range(20)
)


def _photos(
    stations: Sequence[Station], first: int, after: timedelta, seed: int, gimbal: bool = True
) -> list[Photo]:
    """Stations flown with 2 m and 2 degrees of error, positions measured to 2.5 m."""
    rng = np.random.default_rng(seed)
    made = []
    for i, s in enumerate(stations):
        enu = np.array([s.east_m, s.north_m, s.height_m]) + rng.normal(size=3) * [3.2, 3.2, 2.0]
        latitude, longitude, _ = LAUNCH.geodetic(enu[None])[0]
        yaw, pitch = np.array([s.yaw_deg, s.pitch_deg]) + rng.normal(0, 2.0, 2)
        made.append(
            Photo(
                path=Path(f"/card/DJI_{first + i:04d}.JPG"),
                camera=CAMERA,
                position=Position(float(latitude), float(longitude), 400.0 + enu[2], float(enu[2])),
                gimbal=GimbalAngles(yaw, max(pitch, -90.0), 0.0) if gimbal else None,
                time=START + after + timedelta(seconds=5 * i),
                fingerprint=f"{seed}-{i}",
            )
        )
    return made


OLD = _photos(SURVEY, 1, timedelta(), 1)
NEW = _photos(ORBIT, 21, timedelta(minutes=20), 2)


def _record(*passes: Sequence[Station], old: Sequence[Photo] = OLD, **changes: Any) -> PassRecord:
    files = [
        {"path": str(p.path), "fingerprint": p.fingerprint, "time": p.time and p.time.isoformat()}
        for p in old
    ]
    known = {"sigma_f_percent": 0.31, "dome_percent": 0.072}
    then = {"sigma_f_percent": 0.02, "dome_percent": 0.015}
    data: dict[str, Any] = {
        "schema": "fieldcal.pass/1", "made": MADE, "camera": CAMERA.name, "width": 4000, "height": 3000,
        "height_agl_m": 60.0, "launch": {"lat": LAUNCH.latitude_deg, "lon": LAUNCH.longitude_deg},
        "before": known, "survey": files,
        "passes": [
            {
                "predicted": then,
                "stations": [
                    {k: getattr(s, k) for k in ("east_m", "north_m", "height_m", "yaw_deg", "pitch_deg")}
                    for s in stations
                ],
            }
            for stations in passes or (ORBIT,)
        ],
    }  # fmt: skip
    return PassRecord.model_validate(data | changes)


def _found(record: PassRecord, photos: Sequence[Photo], named: bool = False) -> Taken:
    found = taken(record, photos, named)
    assert found is not None
    return found


# --- Which photos are the pass's -------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2, 12))
def test_every_photo_of_the_pass_goes_to_its_station(seed: int) -> None:
    new = _photos(ORBIT, 21, timedelta(minutes=20), seed)
    found = _found(_record(), [*OLD, *new])
    assert found.photos == tuple(new)
    assert found.survey == tuple(OLD)


def test_a_station_without_a_photo_stays_without() -> None:
    """One is missing; two that were taken besides are not taken for it."""
    besides = _photos(SURVEY[:2], 40, timedelta(minutes=25), 5)
    found = _found(_record(), [*OLD, *NEW[:2], *NEW[3:], *besides])
    assert found.photos == (*NEW[:2], None, *NEW[3:])
    assert found.count == 7


def test_names_that_start_again_and_moved_files_do_not_matter() -> None:
    """The card was emptied: the pass has the survey's names, and the survey lies in another folder."""
    new = [replace(p, path=Path(f"/card/{o.path.name}")) for p, o in zip(NEW, OLD, strict=False)]
    old = [replace(p, path=Path("/home/x") / p.path.name) for p in OLD]
    found = _found(_record(), [*old, *new])
    assert (found.photos, found.survey) == (tuple(new), tuple(old))


def test_without_fingerprints_names_and_times_tell_the_survey() -> None:
    old = [replace(p, fingerprint="") for p in OLD]
    found = _found(_record(old=old), [*old, *NEW])
    assert (found.count, len(found.survey)) == (8, 20)


def test_without_camera_angles_the_places_tell() -> None:
    new = _photos(ORBIT, 21, timedelta(minutes=20), 2, gimbal=False)
    assert _found(_record(), [*OLD, *new]).photos == tuple(new)


def test_of_several_ways_the_one_that_was_flown_is_found() -> None:
    arc = tuple(looking_inwards(np.array([40.0, 40.0]), 75.0, 30.0, np.arange(0, 150, 37.0), 25.0, "arc"))
    found = _found(_record(arc, ORBIT), [*OLD, *NEW])
    assert found.flown.planned == tuple(replace(s, pattern="") for s in ORBIT)
    assert found.count == 8


@pytest.mark.parametrize(
    "photos",
    [
        OLD,  # The survey alone.
        [*OLD, *_photos(SURVEY, 21, timedelta(days=2), 3)],  # Flown again two days later.
        [*OLD, *(replace(p, camera=replace(CAMERA, model="FC220")) for p in NEW)],
        [*OLD, *(replace(p, time=START - timedelta(minutes=5)) for p in NEW)],
        [*OLD, *(replace(p, position=None) for p in NEW)],
        NEW[:3],  # Too few to be sure without the survey.
        # A dense flight without angles came by the same places.
        [*OLD, *_photos([s for s in ORBIT for _ in range(4)], 21, timedelta(hours=1), 4, gimbal=False)],
    ],
)  # fmt: skip
def test_what_is_not_the_pass_is_not_taken_for_it(photos: list[Photo]) -> None:
    assert taken(_record(), photos) is None


def test_only_the_new_photos_are_enough() -> None:
    found = _found(_record(), NEW)
    assert (found.count, found.survey) == (8, ())
    assert _found(_record(), NEW[:3], named=True).count == 3
    assert _found(_record(), OLD, named=True).count == 0


# --- As one flight ---------------------------------------------------------------------------------


def test_a_pass_flown_the_next_day_stays_with_its_survey(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    tomorrow = _photos(ORBIT, 21, timedelta(days=1), 2)
    (tmp_path / PASS_FILE).write_text(record_text(_record()))
    finder = PassFinder(None, tmp_path)
    joined = finder.complete([*OLD, *tomorrow])
    assert len(sort_photos(joined).used) == 28
    assert len(sort_photos([*OLD, *tomorrow]).used) == 20
    assert finder.extra_pass is not None
    assert finder.extra_pass.found == tuple(p.path for p in tomorrow)
    assert finder.notes == []


def test_a_second_pass_counts_after_a_first(tmp_path: Path, monkeypatch: Any) -> None:
    """The first one's photos are part of the survey that the second completes."""
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    passes = store_folder() / pass_book.FOLDER
    passes.mkdir(parents=True)
    second = ORBIT[::3]
    later = _photos(second, 40, timedelta(minutes=50), 7)
    (passes / "1.json").write_text(record_text(_record()))
    again = _record(second, old=[*OLD, *NEW], made=MADE + timedelta(minutes=30))
    (passes / "2.json").write_text(record_text(again))
    (passes / "3.json").write_text("{}")  # Damaged: as if it were not there.
    finder = PassFinder(None, tmp_path)
    finder.complete([*OLD, *NEW, *later])
    assert finder.extra_pass is not None
    assert finder.extra_pass.photos == tuple(p.path for p in later)


def test_the_survey_is_taken_along_where_only_the_pass_is_given(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    old = [
        read_photo(
            write_photo(
                tmp_path / f"{p.path.stem}.jpg", make="DJI", model="FC300X", seed=i,
                position=gps(p.position.latitude_deg, p.position.longitude_deg) if p.position else None,
            )
        )
        for i, p in enumerate(OLD[:4])
    ]  # fmt: skip
    camera = old[0].camera
    new = [replace(p, camera=camera) for p in NEW]
    record = _record(old=old, camera=camera.name, width=camera.width, height=camera.height)
    (tmp_path / PASS_FILE).write_text(record_text(record))
    finder = PassFinder(tmp_path, tmp_path / "out")
    finder.check_folder()
    photos = finder.complete(new)
    assert [p.path for p in photos] == [p.path for p in (*new, *old)]
    assert all(p.joined for p in photos)
    assert "4 photos of the survey" in finder.notes[0]
    # Another picture under one of the names, and one that is gone.
    write_photo(old[0].path, make="DJI", model="FC300X", seed=99)
    old[1].path.unlink()
    finder = PassFinder(tmp_path, tmp_path / "out")
    assert len(finder.complete(new)) == 10
    assert "2 of the 4 photos" in finder.notes[1]


def test_a_folder_without_a_pass_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--with takes the folder"):
        PassFinder(tmp_path, tmp_path).check_folder()
    (tmp_path / PASS_FILE).write_text(record_text(_record())[:-40])
    with pytest.raises(FormatError, match="damaged"):
        PassFinder(tmp_path, tmp_path).check_folder()


def test_a_record_comes_back_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / PASS_FILE).write_text(record_text(_record(ORBIT, ORBIT[:4])))
    assert read_record(tmp_path / PASS_FILE) == _record(ORBIT, ORBIT[:4])


# --- What is said of it ----------------------------------------------------------------------------


def test_before_predicted_and_now_are_said() -> None:
    result = build(Verdict.TRUST)
    there = tuple(photo.path for photo in result.solution.photos[:6])
    extra = ExtraPass((*there, None, Path("/card/LOST.JPG")), Knowledge(0.31, 0.072), Knowledge(0.02, 0.015))
    result = replace(result, extra_pass=extra)
    words = str(extra_pass_words(result))
    now = knowledge_of(result)
    assert words.startswith("7 of the 8 photos of the recommended pass were found")
    assert "station 7 has none" in words
    assert "1 of them could not be used (LOST.JPG)" in words
    assert "0.31 % before, 0.020 % predicted" in words
    told = check_report(result).extra_pass
    assert told is not None
    assert told.now.sigma_f_percent == pytest.approx(now.sigma_f_percent)
    assert (told.photos[6], told.not_used) == (None, ["/card/LOST.JPG"])
    assert "The extra pass</h2>" in render_report(result)
    assert check_report(replace(result, extra_pass=None)).extra_pass is None
