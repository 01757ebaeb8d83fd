"""KML 2.2 for eyes: the path, the photos with their headings, and what each sees on flat ground.

Definition: OGC 07-147r2. Not meant to be flown: nothing reads it back.
"""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray
from calib.frames import rotation_cam_from_world
from calib.photos.photo import GimbalAngles
from mission.encode.items import check_plan
from mission.encode.markup import Node, decimal, document
from mission.plan import Plan, Station, stations

#: A corner of the image that meets the ground farther away than this many heights is not drawn.
FARTHEST_HEIGHTS = 10.0


def text(plan: Plan) -> str:
    """The document. Heights are absolute where the launch point's altitude is known, else above ground.

    Raises:
        InputError: a line without an end or a spacing.
    """
    check_plan(plan)
    photos = stations(plan)
    where = _coordinates(plan, np.array([[s.east_m, s.north_m, s.height_m] for s in photos]).reshape(-1, 3))
    path = _coordinates(plan, plan.path_m)
    launch = _coordinates(plan, np.zeros((1, 3)))[0]
    folder: list[Node] = [("name", "Photos")]
    folder += [
        _photo(i, s, at, _mode(plan)) for i, (s, at) in enumerate(zip(photos, where, strict=True), start=1)
    ]
    ground: list[Node] = [("name", "On the ground (flat, at the launch height)"), ("visibility", "0")]
    ground += [f for i, s in enumerate(photos, start=1) for f in _footprint(plan, i, s)]
    line: list[Node] = [("tessellate", "1"), ("altitudeMode", _mode(plan)), ("coordinates", " ".join(path))]
    return document(
        (
            'kml xmlns="http://www.opengis.net/kml/2.2"',
            [
                (
                    "Document",
                    [
                        ("name", plan.name),
                        _style(),
                        (
                            "Placemark",
                            [("name", "Launch"), ("Point", [("coordinates", launch)])],
                        ),
                        (
                            "Placemark",
                            [("name", "Path"), ("styleUrl", "#path"), ("LineString", line)],
                        ),
                        ("Folder", folder),
                        ("Folder", ground),
                    ],
                )
            ],
        )
    )


def _mode(plan: Plan) -> str:
    return "absolute" if plan.launch.altitude_m else "relativeToGround"


def _style() -> Node:
    return (
        'Style id="path"',
        [("LineStyle", [("color", "ff00a5ff"), ("width", "2")]), ("PolyStyle", [("fill", "0")])],
    )


def _coordinates(plan: Plan, enu_m: FloatArray) -> list[str]:
    """longitude,latitude,altitude for each row of (n, 3)."""
    if not len(enu_m):
        return []
    return [
        f"{decimal((longitude + 180) % 360 - 180, 8)},{decimal(latitude, 8)},{decimal(altitude, 3)}"
        for latitude, longitude, altitude in plan.launch.geodetic(enu_m).tolist()
    ]


def _photo(index: int, station: Station, at: str, mode: str) -> Node:
    values = {
        "pattern": station.pattern,
        "height_m": decimal(station.height_m, 3),
        "yaw_deg": decimal(station.yaw_deg % 360, 3),
        "pitch_deg": decimal(station.pitch_deg, 3),
    }
    data: list[Node] = [(f'Data name="{name}"', [("value", value)]) for name, value in values.items()]
    return (
        "Placemark",
        [
            ("name", str(index)),
            ("Style", [("IconStyle", [("scale", "0.5"), ("heading", values["yaw_deg"])])]),
            ("ExtendedData", data),
            ("Point", [("altitudeMode", mode), ("coordinates", at)]),
        ],
    )


def _footprint(plan: Plan, index: int, station: Station) -> list[Node]:
    """What the photo sees at the launch point's height; nothing where it sees the horizon."""
    camera = plan.camera
    width, height = camera.width - 0.5, camera.height - 0.5
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    rays = camera.unproject(corners)
    gimbal = GimbalAngles(station.yaw_deg, station.pitch_deg, 0.0)
    world = np.column_stack([rays, np.ones(4)]) @ rotation_cam_from_world(gimbal)
    if station.height_m <= 0 or not np.isfinite(world).all() or (world[:, 2] >= 0).any():
        return []
    offset = world * (station.height_m / -world[:, 2])[:, None]
    if np.linalg.norm(offset, axis=1).max() > FARTHEST_HEIGHTS * station.height_m:
        return []
    ring = np.array([station.east_m, station.north_m, station.height_m]) + offset
    places = _coordinates(plan, np.vstack([ring, ring[:1]]))
    return [
        (
            "Placemark",
            [
                ("name", str(index)),
                ("visibility", "0"),
                ("styleUrl", "#path"),
                (
                    "Polygon",
                    [
                        ("altitudeMode", "clampToGround"),
                        ("outerBoundaryIs", [("LinearRing", [("coordinates", " ".join(places))])]),
                    ],
                ),
            ],
        )
    ]
