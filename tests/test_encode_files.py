"""Mission files: what goes in comes out, other programs' readers take them, damaged ones say why."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.errors import FieldcalError, FormatError, InputError, OutputError
from calib.frames import LocalFrame
from mission import encode
from mission.encode import Flavour, wpml, wpml_read
from mission.encode import constants as mav
from mission.fence import Circle, Fence
from mission.plan import Plan, Shot, Waypoint, stations
from tests.mission_plans import (
    LAUNCH,
    angle_deg,
    line,
    orbit,
    place_loss_m,
    plan_of,
    plans,
    same_photos,
    triggered,
)

DOCS = Path(__file__).resolve().parent.parent / "docs" / "plan-formats.md"
PLAN = plan_of(*line(), *orbit())
FENCE = Fence(
    keep_in=(((47.0, 8.4), (47.1, 8.4), (47.1, 8.6)),),
    keep_out=(((47.0, 8.5), (47.001, 8.5), (47.001, 8.501), (47.0, 8.501)),),
    circles=(Circle(47.0, 8.5, 500.0), Circle(47.01, 8.5, 20.5, inside=False)),
)
both = pytest.mark.parametrize("flavour", encode.FLAVOURS)
quick = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _losses() -> list[tuple[str, Flavour, float, float, float]]:
    """(suffix, flavour, place m, yaw deg, pitch deg) of the documentation's table."""
    found = []
    for suffix, flavour, *numbers in re.findall(
        r"^\| `(\.\w+)` ?(\w*) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", DOCS.read_text(), re.MULTILINE
    ):
        place, yaw, pitch = map(float, numbers)
        found.append((suffix, flavour or "ardupilot", place, yaw, pitch))
    return found


LOSSES = _losses()
each_format = pytest.mark.parametrize(
    ("suffix", "flavour", "place_m", "yaw_deg", "pitch_deg"), LOSSES, ids=lambda v: str(v)
)


def test_the_documentation_lists_every_format() -> None:
    assert {loss[0] for loss in LOSSES} == set(encode.READABLE)
    rows = re.findall(r"^\| `(\.\w+)` \| [^|]+ \| (yes|no) \|", DOCS.read_text(), re.MULTILINE)
    assert {suffix for suffix, _ in rows} == set(encode.SUFFIXES)
    assert {suffix for suffix, read in rows if read == "yes"} == set(encode.READABLE)


@each_format
@quick
@given(plan=plans())
def test_any_plan_comes_back(
    suffix: str,
    flavour: Flavour,
    place_m: float,
    yaw_deg: float,
    pitch_deg: float,
    plan: Plan,
    tmp_path: Path,
) -> None:
    path = tmp_path / f"mission{suffix}"
    encode.write(plan, path, flavour=flavour)
    back = encode.read(path, launch=plan.launch)
    more = place_loss_m(plan) - 0.01 if flavour == "ardupilot" and suffix in (".plan", ".waypoints") else 0.0
    want = triggered(plan) if suffix in (".plan", ".waypoints") else stations(plan)
    same_photos(want, back.stations, place_m + more, yaw_deg, pitch_deg)


@each_format
def test_the_losses_are_real(
    suffix: str, flavour: Flavour, place_m: float, yaw_deg: float, pitch_deg: float, tmp_path: Path
) -> None:
    """What the table calls lost is lost: it promises no less than it could."""
    plan = plan_of(
        *(Waypoint(i * 0.37, i * 0.71, 30.0049 + i, 10.499, -50.499, Shot.STOP) for i in range(12))
    )
    path = tmp_path / f"mission{suffix}"
    encode.write(plan, path, flavour=flavour)
    back = encode.read(path, launch=plan.launch).stations
    pairs = list(zip(stations(plan), back, strict=True))
    assert max(abs(a.east_m - b.east_m) for a, b in pairs) > 0.2 * place_m
    if yaw_deg > 0.1:
        assert max(angle_deg(a.yaw_deg, b.yaw_deg) for a, b in pairs) > 0.9 * yaw_deg
    if pitch_deg > 0.1:
        assert max(abs(a.pitch_deg - b.pitch_deg) for a, b in pairs) > 0.9 * pitch_deg


@both
def test_the_launch_point_comes_back(flavour: Flavour, tmp_path: Path) -> None:
    for suffix in (".plan", ".waypoints", ".kmz"):
        path = tmp_path / f"m{suffix}"
        encode.write(PLAN, path, flavour=flavour)
        back = encode.read(path)
        assert back.launch.latitude_deg == pytest.approx(LAUNCH.latitude_deg, abs=1e-7)
        assert back.launch.longitude_deg == pytest.approx(LAUNCH.longitude_deg, abs=1e-7)
        if (suffix, flavour) == (".waypoints", "px4"):
            assert any("no home" in note for note in back.notes)
        else:
            assert back.launch.altitude_m == pytest.approx(LAUNCH.altitude_m, abs=0.01)
            assert not back.notes
        assert len(back.stations) == len(stations(PLAN))


def test_the_fence_comes_back_and_the_rest_is_said(tmp_path: Path) -> None:
    path = tmp_path / "m.plan"
    assert not any("fence" in note for note in encode.write(PLAN, path, fence=FENCE))
    assert encode.read(path).fence == FENCE
    low = Fence(ceiling_m=50.0)
    assert any("ceiling" in note for note in encode.write(PLAN, path, fence=low))
    assert encode.read(path).fence is None
    for suffix in (".waypoints", ".kmz", ".csv"):
        notes = encode.write(PLAN, tmp_path / f"m{suffix}", fence=FENCE)
        assert any("hold no fence" in note for note in notes), suffix


@both
def test_the_plan_file_is_qgroundcontrols(flavour: Flavour, tmp_path: Path) -> None:
    path = tmp_path / "m.plan"
    encode.write(PLAN, path, flavour=flavour)
    whole = json.loads(path.read_text())
    assert (whole["fileType"], whole["version"]) == ("Plan", 1)
    mission = whole["mission"]
    assert mission["version"] == whole["geoFence"]["version"] == whole["rallyPoints"]["version"] == 2
    assert mission["firmwareType"] == {"ardupilot": 3, "px4": 12}[flavour]
    assert mission["plannedHomePosition"] == [47.0, 8.5, 430.0]
    assert mission["items"][0]["command"] == mav.NAV_TAKEOFF, "home is no item here"
    assert [item["doJumpId"] for item in mission["items"]] == list(range(1, len(mission["items"]) + 1))
    for item in mission["items"]:
        assert item["type"] == "SimpleItem"
        assert len(item["params"]) == 7
        if item["frame"] == 3:
            assert item["AltitudeMode"] == 1
            assert item["Altitude"] == item["params"][6]


# --- Other programs' readers ---------------------------------------------------------------------


@both
def test_pymavlink_loads_the_waypoints(flavour: Flavour, tmp_path: Path) -> None:
    mavwp = pytest.importorskip("pymavlink.mavwp", reason="pip install fieldcal[flight]")
    path = tmp_path / "m.waypoints"
    encode.write(PLAN, path, flavour=flavour)
    loader = mavwp.MAVWPLoader()
    items = encode.items(PLAN, flavour)
    assert loader.load(str(path)) == len(items)
    for index, item in enumerate(items):
        theirs = loader.wp(index)
        assert (theirs.command, theirs.frame) == (item.command, item.frame)
        scale = 1e7 if item.has_place else 1
        assert (round(theirs.x * scale), round(theirs.y * scale)) == (item.x, item.y)
        assert theirs.z == pytest.approx(item.z, abs=1e-5)


@pytest.fixture(scope="module")
def mission_raw() -> Any:
    """MAVSDK's reader wants a system, for which a heartbeat is enough."""
    pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")
    mavsdk = pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")
    from mavsdk.plugins.mission_raw import MissionRaw

    from sim.faults.ends import free_port
    from tests.mission_server import MissionServer

    found: dict[Flavour, Any] = {}
    with MissionServer("ardupilot", free_port()) as copter, MissionServer("px4", free_port()) as px4:
        clients = []
        for server in (copter, px4):
            kind = mavsdk.ComponentType.GROUND_STATION
            clients.append(mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind)))
            clients[-1].add_any_connection(server.url)
            system = clients[-1].first_autopilot(10.0)
            assert system is not None
            found[server.flavour] = MissionRaw(system)
        yield found
        for client in clients:
            client.destroy()


@both
def test_mavsdk_reads_the_plan_and_the_waypoints(flavour: Flavour, mission_raw: Any, tmp_path: Path) -> None:
    reader, items = mission_raw[flavour], encode.items(PLAN, flavour)
    encode.write(PLAN, tmp_path / "m.plan", flavour=flavour, fence=FENCE)
    encode.write(PLAN, tmp_path / "m.waypoints", flavour=flavour)
    plan = reader.import_qgroundcontrol_mission(str(tmp_path / "m.plan"))
    text = reader.import_mission_planner_mission(str(tmp_path / "m.waypoints"))
    assert len(plan.geofence_items) == 3 + 4 + 2
    # MAVSDK 4.1 puts home before ArduPilot's .waypoints, which have it already.
    once = text.mission_items[1:] if flavour == "ardupilot" else text.mission_items
    for found in (plan.mission_items, once):
        assert len(found) == len(items)
        back = [
            encode.Item(i.command, i.frame, i.param1, i.param2, i.param3, i.param4, i.x, i.y, i.z)
            for i in found
        ]
        back[0] = items[0] if flavour == "ardupilot" else back[0]  # its home is in frame 5
        assert encode.compare(items, back, flavour) == []
        assert len(encode.stations_of_items(back, LAUNCH, flavour)) == len(stations(PLAN))


# --- Foreign and damaged files -------------------------------------------------------------------


def test_exchanged_latitude_and_longitude_are_put_right(tmp_path: Path) -> None:
    path = tmp_path / "m.waypoints"
    encode.write(PLAN, path)
    lines = path.read_text().splitlines()
    for index in range(2, len(lines)):
        fields = lines[index].split("\t")
        if fields[3] == str(mav.NAV_WAYPOINT):
            fields[8], fields[9] = fields[9], fields[8]
        lines[index] = "\t".join(fields)
    path.write_text("\n".join(lines))
    back = encode.read(path)
    assert any("exchanged" in note for note in back.notes)
    same_photos(triggered(PLAN), back.stations, 0.01, 1e-4, 0.5)


def test_home_exchanged_as_well_is_found_where_the_launch_is_known(tmp_path: Path) -> None:
    path = tmp_path / "m.waypoints"
    path.write_text("QGC WPL 110\n0 1 0 16 0 0 0 0 8.5 47 430 1\n1 0 3 16 0 0 0 0 8.5001 47.0001 50 1\n")
    back = encode.read(path, launch=LAUNCH)
    assert any("2 places were exchanged" in note for note in back.notes)


def test_surveys_unfold_and_structure_scans_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.plan"
    encode.write(PLAN, path)
    whole = json.loads(path.read_text())
    items = whole["mission"]["items"]
    survey = {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "TransectStyleComplexItem": {"Items": items},
    }
    whole["mission"]["items"] = [survey]
    path.write_text(json.dumps(whole))
    same_photos(triggered(PLAN), encode.read(path).stations, 0.01, 1e-4, 0.5)
    whole["mission"]["items"] = [{"type": "ComplexItem", "complexItemType": "StructureScan"}]
    path.write_text(json.dumps(whole))
    with pytest.raises(FormatError, match="StructureScan"):
        encode.read(path)


def _kmz(*members: tuple[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return out.getvalue()


_ENTITY = b'<?xml version="1.0"?><!DOCTYPE k [<!ENTITY a "aaaa">]><kml>&a;</kml>'


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("m.plan", b"{", "is not JSON"),
        ("m.plan", b'{"fileType": "Params"}', "not a QGroundControl plan"),
        ("m.plan", b'{"fileType": "Plan", "mission": {"version": 1}}', "version 2"),
        ("m.plan", b"\xff\xfe\x00", "is not text"),
        ("m.plan", b"[" * 100_000, "is not JSON"),
        ("m.waypoints", b"QGC WPL 100\n", "does not start with"),
        ("m.waypoints", b"QGC WPL 110\n", "holds no items"),
        ("m.waypoints", b"QGC WPL 110\n0 1 0 16 0 0\n", "6 fields instead of 12"),
        ("m.waypoints", b"QGC WPL 110\n0 1 0 16 0 0 0 0 x 8 0 1\n", "not a number"),
        ("m.waypoints", b"QGC WPL 110\n0 1 0 16 0 0 0 0 91 191 0 1\n", "no latitude and longitude"),
        ("m.waypoints", b"QGC WPL 110\n0 1 2 178 0 0 0 0 0 0 0 1\n", "holds no place"),
        ("m.kmz", b"no zip at all", "is not a zip archive"),
        ("m.kmz", b"PK\x05\x06" + 18 * b"\0", "no DJI wayline"),
        ("m.kmz", _kmz(("doc.kml", b"<kml/>")), "no DJI wayline"),
        ("m.kmz", _kmz(("../../etc/passwd", b"x"), (wpml.WAYLINES, b"<kml/>")), "climb out"),
        ("m.kmz", _kmz(("/etc/passwd", b"x"), (wpml.WAYLINES, b"<kml/>")), "climb out"),
        ("m.kmz", _kmz((wpml.WAYLINES, b"<kml>")), "not well-formed"),
        ("m.kmz", _kmz((wpml.WAYLINES, _ENTITY)), "document type"),
        ("m.kmz", _kmz((wpml.WAYLINES, b"<kml><Document/></kml>")), "no waypoints"),
        ("m.csv", b"a,b\n1,2\n", "lacks Litchi's columns"),
        ("m.txt", b"", "cannot be read as a mission"),
    ],
)
def test_damaged_files_say_what_is_wrong(name: str, data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=words) as caught:
        encode.read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", encode.READABLE)
def test_photos_without_end_are_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"m{suffix}"
    encode.write(plan_of(*line(length=100.0, spacing=7.77)), path)
    gap = f"{(101 if suffix in ('.plan', '.waypoints') else 100) / 13:.6f}"[:7].encode()
    raw = path.read_bytes()
    if suffix == ".kmz":
        raw = zipfile.ZipFile(io.BytesIO(raw)).read(wpml.WAYLINES)
    damaged = re.sub(re.escape(gap) + rb"\d*", b"0.000001", raw)
    assert damaged != raw
    path.write_bytes(_kmz((wpml.WAYLINES, damaged)) if suffix == ".kmz" else damaged)
    with pytest.raises(FormatError, match="photos on one leg"):
        encode.read(path)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wpml_read, "LARGEST_MEMBER_BYTES", 1000)
    path = tmp_path / "m.kmz"
    path.write_bytes(_kmz((wpml.WAYLINES, b" " * 100_000)))
    with pytest.raises(FormatError, match="of more than"):
        encode.read(path)


@pytest.mark.parametrize("suffix", encode.READABLE)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damage_is_one_sentence_or_read(suffix: str, data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / f"m{suffix}"
    encode.write(plan_of(*line(), *orbit(3)), path, fence=FENCE)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(raw) - 1))
        raw[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    path.write_bytes(bytes(raw))
    said = ""
    try:
        encode.read(path)
    except FieldcalError as error:
        said = str(error)
    assert "\n" not in said


# --- Writing -------------------------------------------------------------------------------------


def test_unknown_endings_and_unwritable_places(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.txt"):
        encode.write(PLAN, tmp_path / "m.txt")
    for suffix in encode.SUFFIXES:
        with pytest.raises(OutputError, match="no such folder"):
            encode.write(PLAN, tmp_path / "none" / f"m{suffix}")


@pytest.mark.parametrize("suffix", encode.SUFFIXES)
def test_files_are_whole_and_always_the_same(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"m{suffix}"
    path.write_text("old")
    encode.write(PLAN, path)
    first = path.read_bytes()
    encode.write(PLAN, path)
    assert path.read_bytes() == first
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", encode.SUFFIXES)
def test_a_refused_plan_leaves_the_old_file(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"m{suffix}"
    path.write_text("old")
    with pytest.raises(InputError):
        encode.write(plan_of(*line()[:1]), path)
    assert path.read_text() == "old"


def test_kml_shows_path_photos_and_footprints(tmp_path: Path) -> None:
    path = tmp_path / "m.kml"
    encode.write(PLAN, path)
    text = path.read_text()
    photos = len(stations(PLAN))
    assert text.count("<heading>") == photos
    assert text.count("<Polygon>") == photos
    assert "<LineString>" in text
    places = re.findall(r"<Point>\s*<altitudeMode>absolute</altitudeMode>\s*<coordinates>([^<]+)<", text)
    longitude, latitude, altitude = map(float, places[0].split(","))
    assert (latitude, longitude) == pytest.approx((47.0, 8.5), abs=1e-7)
    assert altitude == pytest.approx(490.0, abs=1e-3)


def test_names_cannot_break_the_markup(tmp_path: Path) -> None:
    odd = plan_of(Waypoint(0, 0, 10, shot=Shot.STOP, pattern="<&>\x00"))
    for suffix in (".kml", ".kmz"):
        encode.write(odd, tmp_path / f"m{suffix}")
    assert "&lt;&amp;&gt;" in (tmp_path / "m.kml").read_text()
    assert len(encode.read(tmp_path / "m.kmz").stations) == 1


@pytest.mark.parametrize(
    ("camera", "kind"),
    [("DJI M3E", 77), ("M30T wide", 67), ("M3TD", 91), ("Zenmuse H20", 60), ("ILCE-7R", 77)],
)
def test_the_waylines_name_the_drone(camera: str, kind: int) -> None:
    plan = Plan("p", LocalFrame(1, 2), PLAN.camera, camera, PLAN.vehicle, orbit(), 30.0)
    data, notes = wpml.kmz(plan)
    for name in (wpml.TEMPLATE, wpml.WAYLINES):
        text = zipfile.ZipFile(io.BytesIO(data)).read(name).decode()
        assert f"<wpml:droneEnumValue>{kind}</wpml:droneEnumValue>" in text
    assert any("does not say which DJI drone" in note for note in notes) == (camera == "ILCE-7R")
