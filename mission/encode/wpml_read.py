"""DJI wayline KMZ -> photos. The archive is read in memory, member by member, nothing is unpacked."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from calib.camera import FloatArray
from calib.errors import FormatError
from calib.frames import LocalFrame
from mission.encode.markup import child, children, local, parse, text_of
from mission.encode.readplan import ReadPlan, latitude_longitude, number, photos_on_leg
from mission.encode.wpml import TEMPLATE, WAYLINES
from mission.plan import Station

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

WHAT = "The KMZ file"
LARGEST_MEMBER_BYTES = 64 * 1024 * 1024
MOST_MEMBERS = 10_000


def read(data: bytes, launch: LocalFrame | None = None) -> ReadPlan:
    """Stations of a DJI wayline file.

    Args:
        launch: the origin where the file names no reference take-off point.

    Raises:
        FormatError: not a zip, not a wayline file, one that climbs out of its folder or is too large.
    """
    waylines, template = _members(data)
    root = parse(waylines, WAYLINES)
    folders = children(child(root, "Document") or root, "Folder")
    marks = [mark for folder in folders for mark in children(folder, "Placemark")]
    if not marks:
        raise FormatError(f"{WHAT} holds no waypoints: it is no DJI wayline.")
    notes: list[str] = []
    if len(folders) > 1:
        notes.append(f"The file holds {len(folders)} routes: they were read one after the other.")
    places = np.array([_place(mark) for mark in marks])
    launch = _launch(template, launch, places, notes)
    heights = np.array([number(text_of(m, "executeHeight"), "executeHeight") for m in marks])
    mode = text_of(folders[0], "executeHeightMode")
    if mode not in ("WGS84", "relativeToStartPoint", None):
        notes.append(f"The heights are of the kind {mode}: they were taken as above the take-off point.")
    altitude = heights if mode == "WGS84" else heights + launch.altitude_m
    at = launch.enu(places[:, 0], places[:, 1], altitude)
    flight = _Flight(at, marks, launch, notes)
    flight.run()
    return ReadPlan(tuple(flight.found), launch, None, tuple(notes))


def _members(data: bytes) -> tuple[bytes, bytes | None]:
    """The bytes of waylines.wpml and, where there is one, of template.kml."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            infos = archive.infolist()
            if len(infos) > MOST_MEMBERS:
                raise FormatError(f"{WHAT} holds {len(infos)} files, which no wayline has: it is not read.")
            for info in infos:
                path = PurePosixPath(info.filename.replace("\\", "/"))
                if path.is_absolute() or ".." in path.parts or ":" in info.filename:
                    raise FormatError(
                        f"{WHAT} holds {info.filename[:60]!r}, which would climb out of its folder: "
                        "it is not read."
                    )
            by_name = {info.filename.replace("\\", "/").lower(): info for info in infos}
            waylines = by_name.get(WAYLINES) or by_name.get("waylines.wpml")
            if waylines is None:
                raise FormatError(f"{WHAT} is a zip without {WAYLINES}: it is no DJI wayline.")
            template = by_name.get(TEMPLATE)
            edited = None if template is None else _unpacked(archive, template)
            return _unpacked(archive, waylines), edited
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise FormatError(f"{WHAT} is not a zip archive that can be read: export it again.") from error


def _unpacked(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    with archive.open(info) as member:
        data = member.read(LARGEST_MEMBER_BYTES + 1)
    if len(data) > LARGEST_MEMBER_BYTES:
        raise FormatError(
            f"{WHAT} holds {info.filename} of more than {LARGEST_MEMBER_BYTES >> 20} MB: it is not read."
        )
    return data


def _place(mark: Element) -> tuple[float, float]:
    fields = (text_of(mark, "Point", "coordinates") or "").split(",")
    if len(fields) < 2:
        raise FormatError(f"{WHAT} has a waypoint without longitude and latitude.")
    longitude, latitude = (number(value.strip(), "A coordinate") for value in fields[:2])
    latitude_longitude(latitude, longitude, WHAT)
    return latitude, longitude


def _launch(
    template: bytes | None, launch: LocalFrame | None, places: FloatArray, notes: list[str]
) -> LocalFrame:
    if launch is not None:
        return launch
    if template is not None:
        root = parse(template, TEMPLATE)
        reference = text_of(root, "Document", "missionConfig", "takeOffRefPoint")
        if reference:
            values = [number(v.strip(), "takeOffRefPoint") for v in reference.split(",")]
            if len(values) == 3:
                latitude_longitude(values[0], values[1], WHAT)
                return LocalFrame(*values)
    notes.append("The file does not say where the flight starts: the first waypoint is the origin.")
    return LocalFrame(float(places[0, 0]), float(places[0, 1]))


@dataclass
class _Flight:
    """The wayline flown in the mind. ``at_m``: waypoints (n, 3)."""

    at_m: FloatArray
    marks: list[Element]
    launch: LocalFrame
    notes: list[str]
    yaw_deg: float = 0.0
    gimbal_yaw_deg: float = 0.0
    gimbal_from_north: bool = False
    pitch_deg: float = -90.0
    found: list[Station] = field(default_factory=list)

    def run(self) -> None:
        groups = [g for mark in self.marks for g in children(mark, "actionGroup")]
        spans = [(_index(g, "actionGroupStartIndex"), _index(g, "actionGroupEndIndex"), g) for g in groups]
        starting: dict[int, list[tuple[int, Element]]] = {}
        for start, end, group in spans:
            starting.setdefault(start, []).append((end, group))
        running: list[tuple[int, float]] = []  # last waypoint, distance
        for index in range(len(self.marks)):
            self._head(index)
            running = [(end, gap) for end, gap in running if end > index]
            for end, group in starting.get(index, []):
                kind = text_of(group, "actionTrigger", "actionTriggerType")
                if kind == "reachPoint":
                    for action in children(group, "action"):
                        self._act(action, index)
                elif kind == "multipleDistance" and _has(group, "takePhoto"):
                    gap = number(text_of(group, "actionTrigger", "actionTriggerParam"), "A photo distance")
                    if gap > 0:
                        running.append((end, gap))
                elif kind == "multipleTiming" and _has(group, "takePhoto"):
                    self._note("Photos by time have no known places: they were left out.")
            for _, gap in running:
                self._leg(index, gap)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def _head(self, index: int) -> None:
        mark = self.marks[index]
        mode = text_of(mark, "waypointHeadingParam", "waypointHeadingMode")
        if mode == "smoothTransition":
            angle = text_of(mark, "waypointHeadingParam", "waypointHeadingAngle")
            self.yaw_deg = number(angle, "waypointHeadingAngle") % 360
        elif mode == "followWayline":
            self._look(self.at_m[min(index + 1, len(self.marks) - 1)] - self.at_m[index])
        elif mode == "towardPOI":
            text = text_of(mark, "waypointHeadingParam", "waypointPoiPoint") or ""
            values = [number(v.strip(), "waypointPoiPoint") for v in text.split(",")]
            if len(values) >= 2:
                poi = self.launch.enu(np.array(values[:1]), np.array(values[1:2]), np.zeros(1))[0]
                self._look(poi - self.at_m[index])
        pitch = text_of(mark, "waypointGimbalHeadingParam", "waypointGimbalPitchAngle")
        if pitch is not None:
            self.pitch_deg = number(pitch, "waypointGimbalPitchAngle")

    def _look(self, way_m: FloatArray) -> None:
        if math.hypot(way_m[0], way_m[1]) > 0.01:
            self.yaw_deg = float(np.degrees(np.arctan2(way_m[0], way_m[1])) % 360)

    def _act(self, action: Element, index: int) -> None:
        function = text_of(action, "actionActuatorFunc")
        params = child(action, "actionActuatorFuncParam")
        values = {} if params is None else {local(p): (p.text or "").strip() for p in params}
        if function == "rotateYaw":
            self.yaw_deg = number(values.get("aircraftHeading"), "aircraftHeading") % 360
        elif function == "gimbalRotate":
            if values.get("gimbalPitchRotateEnable", "1") != "0":
                self.pitch_deg = number(values.get("gimbalPitchRotateAngle"), "gimbalPitchRotateAngle")
            if values.get("gimbalYawRotateEnable", "0") != "0":
                self.gimbal_yaw_deg = number(values.get("gimbalYawRotateAngle"), "gimbalYawRotateAngle")
                self.gimbal_from_north = values.get("gimbalHeadingYawBase") == "north"
        elif function == "orientedShoot":
            self.pitch_deg = number(values.get("gimbalPitchRotateAngle"), "gimbalPitchRotateAngle")
            self.yaw_deg = number(values.get("aircraftHeading"), "aircraftHeading") % 360
            self._photo(self.at_m[index])
        elif function == "takePhoto":
            self._photo(self.at_m[index])

    def _leg(self, index: int, gap_m: float) -> None:
        """Photos by distance between the ends of the leg that starts here."""
        if index + 1 >= len(self.marks):
            return
        way = self.at_m[index + 1] - self.at_m[index]
        length = float(np.linalg.norm(way))
        photos_on_leg(length, gap_m, WHAT)
        for step in range(1, math.ceil(length / gap_m - 0.5)):
            self._photo(self.at_m[index] + step * gap_m / length * way)

    def _photo(self, at_m: FloatArray) -> None:
        nose = 0.0 if self.gimbal_from_north else self.yaw_deg
        yaw = (nose + self.gimbal_yaw_deg) % 360
        self.found.append(Station(float(at_m[0]), float(at_m[1]), float(at_m[2]), yaw, self.pitch_deg))


def _index(group: Element, name: str) -> int:
    value = number(text_of(group, name), name)
    if value % 1 or not 0 <= value <= 65535:
        raise FormatError(f"{WHAT} has the {name} {value:g}, which no waypoint has.")
    return int(value)


def _has(group: Element, function: str) -> bool:
    return any(text_of(action, "actionActuatorFunc") == function for action in children(group, "action"))
