"""``fieldcal plan``: from an area, a camera and limits to a mission whose quality is predicted."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from calib.errors import InputError
from calib.files import check_file_writable
from daemon.output import JsonOption, console, write_json
from daemon.plan_output import plan_json, print_ending, print_plan
from mission.compose import compose_with_notes
from mission.encode import SUFFIXES, write
from mission.limits import check_limits, hard_violations
from mission.patterns import DESCRIPTIONS, pattern_names
from mission.plan import Station
from mission.planned import Planned
from mission.predict import fix, predict
from mission.reroute import allowed_station, rerouted
from mission.site_build import build_site
from mission.site_file import SiteFile, checked, overlaid, read_site_file
from mission.split import split

SHEET, PICTURE = ".html", ".png"
#: What the user calls the keys of a site file on the command line.
_OPTIONS = {
    "name": "--name",
    "area": "--area",
    "launch": "--launch",
    "camera": "--camera",
    "height_m": "--height",
    "gsd_cm": "--gsd",
    "forward_overlap": "--forward-overlap",
    "side_overlap": "--side-overlap",
    "dem": "--dem",
    "ceiling_m": "--ceiling",
    "clearance_m": "--clearance",
    "standoff_m": "--standoff",
    "fence_margin_m": "--fence-margin",
    "wind.speed_m_s": "--wind",
    "wind.from_deg": "--wind",
    "fence.outline": "--keep-in or --keep-out",
    "structure.outline": "--structure",
    "structure.height_m": "--structure",
    "wall.start": "--wall",
    "wall.end": "--wall",
    "wall.height_m": "--wall",
    "wall.distance_m": "--wall-distance",
    "vehicle.speed_m_s": "--speed",
    "vehicle.climb_m_s": "--climb",
    "vehicle.descent_m_s": "--descent",
    "vehicle.acceleration_m_s2": "--acceleration",
    "vehicle.endurance_s": "--endurance",
    "vehicle.reserve_share": "--reserve",
    "vehicle.settle_s": "--settle",
    "vehicle.gimbal_lowest_deg": "--gimbal",
    "vehicle.gimbal_highest_deg": "--gimbal",
    "vehicle.camera_interval_s": "--camera-interval",
    "vehicle.most_items": "--most-items",
    "pattern.heading_deg": "--heading",
    "pattern.second_height_m": "--second-height",
    "pattern.oblique_tilt_deg": "--oblique-tilt",
    "pattern.poi": "--poi",
    "pattern.tilt_deg": "--tilt",
    "pattern.radius_m": "--radius",
    "pattern.photos": "--photos",
    "pattern.arc_deg": "--arc",
    "pattern.clockwise": "--clockwise",
    "pattern.rings": "--rings",
}
_HELP_PATTERNS = "; ".join(f"{name}: {text}" for name, text in DESCRIPTIONS.items())


def plan(
    pattern: Annotated[
        str, typer.Argument(metavar="PATTERN[+PATTERN...]", help=f"What to fly. {_HELP_PATTERNS}.")
    ],
    area: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|LAT,LON,RADIUS",
            help="Area: KML, KMZ, GeoJSON, GeoPackage, shapefile, WKT, or a circle (degrees, m).",
        ),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="A known camera or a calibration file.")
    ] = None,
    height: Annotated[float | None, typer.Option(metavar="M", help="Height above ground, m.")] = None,
    gsd: Annotated[
        float | None, typer.Option(metavar="CM", help="Ground resolution, cm per pixel, instead of a height.")
    ] = None,
    site: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Site file (TOML); options here win over it.")
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help=f"Write the mission, once or several times: {', '.join(SUFFIXES)}; "
            f"{SHEET}, {PICTURE}: the plan sheet.",
        ),
    ] = None,
    repair: Annotated[
        bool, typer.Option("--fix", help="Add the fewest convergent photos that make it calibrate.")
    ] = False,
    batteries: Annotated[
        bool, typer.Option("--split", help="Several missions where one battery is not enough.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write a plan that breaks a hard limit.")] = False,
    json_target: JsonOption = None,
    autopilot: Annotated[
        Literal["ardupilot", "px4"], typer.Option(help="Whose mission items .plan and .waypoints get.")
    ] = "ardupilot",
    name: Annotated[str | None, typer.Option(help="Name of the mission.")] = None,
    launch: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="Launch point (default: middle of the area).")
    ] = None,
    forward_overlap: Annotated[
        float | None, typer.Option(metavar="%", help="Overlap along the lines (default 80).")
    ] = None,
    side_overlap: Annotated[
        float | None, typer.Option(metavar="%", help="Overlap across the lines (default 70).")
    ] = None,
    dem: Annotated[
        str | None, typer.Option(metavar="FILE", help="Terrain model: GeoTIFF or SRTM .hgt (default: flat).")
    ] = None,
    ceiling: Annotated[
        float | None, typer.Option(metavar="M", help="Highest above the launch point.")
    ] = None,
    clearance: Annotated[
        float | None, typer.Option(metavar="M", help="Least height above ground (default 10).")
    ] = None,
    standoff: Annotated[
        float | None, typer.Option(metavar="M", help="Least distance from structures (default 10).")
    ] = None,
    fence_margin: Annotated[
        float | None, typer.Option(metavar="M", help="Planned distance from the fence (default 5).")
    ] = None,
    keep_in: Annotated[
        list[str] | None, typer.Option(metavar="FILE|LAT,LON,RADIUS", help="Zone to stay in, several times.")
    ] = None,
    keep_out: Annotated[
        list[str] | None, typer.Option(metavar="FILE|LAT,LON,RADIUS", help="Zone to stay out of.")
    ] = None,
    structure: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE@HEIGHT|LAT,LON,RADIUS@HEIGHT", help="Something that stands up, height in m."
        ),
    ] = None,
    wind: Annotated[str | None, typer.Option(metavar="SPEED[,FROM]", help="Wind, m/s and degrees.")] = None,
    speed: Annotated[float | None, typer.Option(metavar="M/S", help="Speed (default 8).")] = None,
    climb: Annotated[float | None, typer.Option(metavar="M/S", help="Climb rate (default 3).")] = None,
    descent: Annotated[float | None, typer.Option(metavar="M/S", help="Descent rate (default 2).")] = None,
    acceleration: Annotated[
        float | None, typer.Option(metavar="M/S2", help="Acceleration (default 2).")
    ] = None,
    endurance: Annotated[
        float | None, typer.Option(metavar="MIN", help="Usable time of one battery (default 20).")
    ] = None,
    reserve: Annotated[
        float | None, typer.Option(metavar="%", help="Share kept for extra passes and landing (default 25).")
    ] = None,
    settle: Annotated[
        float | None, typer.Option(metavar="S", help="From arriving to a photo from standing (default 2).")
    ] = None,
    gimbal: Annotated[
        str | None, typer.Option(metavar="LOWEST,HIGHEST", help="The gimbal's pitch range (default -90,0).")
    ] = None,
    camera_interval: Annotated[
        float | None, typer.Option(metavar="S", help="Fastest the camera takes photos (default 2).")
    ] = None,
    most_items: Annotated[
        int | None, typer.Option(metavar="N", help="Mission items the autopilot holds (default 650).")
    ] = None,
    heading: Annotated[
        float | None, typer.Option(metavar="DEG", help="Heading of the lines (default: the best).")
    ] = None,
    second_height: Annotated[
        float | None, typer.Option(metavar="M", help="Height of height2 (default 4/3 of the first).")
    ] = None,
    oblique_tilt: Annotated[
        float | None, typer.Option(metavar="DEG", help="Off nadir, of the oblique grid (default 15).")
    ] = None,
    poi: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="Point of interest (default: middle of the area).")
    ] = None,
    tilt: Annotated[
        float | None, typer.Option(metavar="DEG", help="Off nadir, of orbit (default 35) and fan (40).")
    ] = None,
    radius: Annotated[float | None, typer.Option(metavar="M", help="Radius of the orbit.")] = None,
    photos: Annotated[int | None, typer.Option(metavar="N", help="Photos of orbit (24) or fan (8).")] = None,
    arc: Annotated[
        str | None, typer.Option(metavar="FROM,TO", help="Part of the orbit, azimuths of its stations.")
    ] = None,
    clockwise: Annotated[
        bool | None,
        typer.Option("--clockwise/--counter-clockwise", help="Direction of the orbit (default: shorter)."),
    ] = None,
    rings: Annotated[int | None, typer.Option(metavar="N", help="Rings around the building (3).")] = None,
    wall: Annotated[
        str | None, typer.Option(metavar="LAT,LON,LAT,LON[,HEIGHT]", help="Wall for the wall passes.")
    ] = None,
    wall_distance: Annotated[
        float | None, typer.Option(metavar="M", help="Distance from the wall (default 10).")
    ] = None,
) -> None:
    """Plan a mission, predict what its calibration will be worth, hold it against every limit."""
    names = pattern_names(pattern)
    outputs = _checked_outputs(out or [], json_target)
    given: dict[str, Any] = {
        "name": name, "area": area, "launch": _numbers(launch, "--launch", 2), "camera": camera,
        "height_m": height, "gsd_cm": gsd, "forward_overlap": forward_overlap, "side_overlap": side_overlap,
        "dem": dem, "ceiling_m": ceiling, "clearance_m": clearance, "standoff_m": standoff,
        "fence_margin_m": fence_margin, "wind": _wind(wind),
        "fence": [{"keep": "in", "outline": z} for z in keep_in or []]
        + [{"keep": "out", "outline": z} for z in keep_out or []],
        "structure": [_structure(s) for s in structure or []],
        "wall": _wall(wall, wall_distance),
        "vehicle": {
            "speed_m_s": speed, "climb_m_s": climb, "descent_m_s": descent,
            "acceleration_m_s2": acceleration, "endurance_s": None if endurance is None else 60 * endurance,
            "reserve_share": reserve, "settle_s": settle, "camera_interval_s": camera_interval,
            "most_items": most_items, **_gimbal(gimbal),
        },
        "pattern": {
            "heading_deg": heading, "second_height_m": second_height, "oblique_tilt_deg": oblique_tilt,
            "poi": _numbers(poi, "--poi", 2), "tilt_deg": tilt, "radius_m": radius, "photos": photos,
            "arc_deg": _numbers(arc, "--arc", 2), "clockwise": clockwise, "rings": rings,
        },
    }  # fmt: skip
    options = checked(given, "the command line", {k: f"option {v}" for k, v in _OPTIONS.items()})
    keys = options if site is None else overlaid(read_site_file(site), options)
    _keep_inputs(outputs, [keys.area, keys.camera, keys.dem, site, *(z.outline for z in keys.fence)])
    planned = make_plan(names, keys, repair, str(site) if site else "the command line")
    parts = split(planned) if batteries else (planned,)
    _deliver(planned, parts, outputs, _Delivery(json_target, autopilot, force))


def make_plan(names: tuple[str, ...], keys: SiteFile, repair: bool, source: str) -> Planned:
    """Compose, predict, repair where asked, and hold against the limits.

    Raises:
        InputError: nothing can be planned from these keys.
    """
    site = build_site(keys, source)
    composition = compose_with_notes(names, site)
    plan, notes = composition.plan, list(composition.notes)
    if keys.launch is None:
        notes.append("No launch point is given: the middle of the area is taken.")
    added: tuple[Station, ...] = ()
    if repair:
        repaired = fix(plan, site.terrain, site.area, allowed_station(site))
        plan, prediction, added = rerouted(repaired.plan, site), repaired.after, repaired.added
        notes.append(repaired.reason)
        if repaired.binding_limit is not None:
            notes.append(repaired.binding_limit)
    else:
        prediction = predict(plan, site.terrain, site.area)
    return Planned(site, plan, prediction, check_limits(plan, site), tuple(notes), added)


@dataclass(frozen=True)
class _Delivery:
    json_target: str | None
    autopilot: Literal["ardupilot", "px4"]
    force: bool


def _deliver(whole: Planned, parts: tuple[Planned, ...], outputs: list[Path], how: _Delivery) -> None:
    broken = [finding for part in parts for finding in hard_violations(part.findings)]
    withheld = bool(broken) and not how.force
    losses: list[str] = []
    written: list[Path] = []
    for number, part in enumerate(parts, 1):
        for path in outputs:
            target = path if len(parts) == 1 else path.with_stem(f"{path.stem}-{number}")
            if withheld and path.suffix.lower() not in (SHEET, PICTURE):
                continue
            losses += _write(part, target, how.autopilot)
            written.append(target)
    if how.json_target is not None:
        write_json(plan_json(whole, parts), how.json_target)
    if how.json_target != "-":
        out = console()
        print_plan(whole, parts, out)
        print_ending(out, written, list(dict.fromkeys(losses)))
    if withheld:
        what = (
            "The plan is not written"
            if any(path.suffix.lower() in SUFFIXES for path in outputs)
            else "The plan is not to be flown"
        )
        more = f" ({len(broken) - 1} more)" if len(broken) > 1 else ""
        raise InputError(f"{what}: {broken[0].message}{more} --force writes it all the same.")


def _write(planned: Planned, path: Path, autopilot: Literal["ardupilot", "px4"]) -> list[str]:
    """One file by its ending; what it cannot hold, in sentences. Drawing libraries are slow to load."""
    if path.suffix.lower() == SHEET:
        from mission.sheet import write_sheet

        write_sheet(planned, path)
        return []
    if path.suffix.lower() == PICTURE:
        from mission.sheet_png import write_picture

        write_picture(planned, path)
        return []
    fence = None if planned.site.fence.is_empty else planned.site.fence
    return write(planned.plan, path, fence=fence, flavour=autopilot)


def _checked_outputs(out: list[Path], json_target: str | None) -> list[Path]:
    """What can be refused at once is refused before the work."""
    for path in out:
        if path.suffix.lower() not in (*SUFFIXES, SHEET, PICTURE):
            known = ", ".join([*SUFFIXES, SHEET, PICTURE])
            raise InputError(f"{path.name}: there is no format with that ending; there are {known}.")
        check_file_writable(path)
    if json_target is not None and json_target != "-":
        check_file_writable(Path(json_target))
    return out


def _keep_inputs(outputs: list[Path], inputs: list[Any]) -> None:
    """Refuse to write over what the plan is made from: an area is a .kml, too."""
    given = {
        Path(i).expanduser().resolve() for i in inputs if isinstance(i, (str, Path)) and len(str(i)) < 4096
    }
    for path in outputs:
        if path.resolve() in given:
            raise InputError(
                f"{path} is an input of this plan and would be overwritten; choose another name."
            )


def _numbers(text: str | None, option: str, *counts: int) -> list[float] | None:
    if text is None:
        return None
    try:
        found = [float(word) for word in re.split(r"\s*,\s*", text.strip())]
    except ValueError:
        found = []
    if len(found) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        raise InputError(f"{option} takes {wanted} numbers with commas between them, not {text!r}.")
    return found


def _wind(text: str | None) -> dict[str, float] | None:
    found = _numbers(text, "--wind", 1, 2)
    return None if found is None else dict(zip(("speed_m_s", "from_deg"), found, strict=False))


def _gimbal(text: str | None) -> dict[str, float]:
    found = _numbers(text, "--gimbal", 2)
    return {} if found is None else {"gimbal_lowest_deg": found[0], "gimbal_highest_deg": found[1]}


def _structure(text: str) -> dict[str, Any]:
    given, at, height = text.rpartition("@")
    try:
        if not at:
            raise ValueError
        return {"outline": given, "height_m": float(height)}
    except ValueError:
        raise InputError(
            "--structure takes an outline and a height, as house.kml@8.5 or 54.77,-1.58,10@8.5, "
            f"not {text!r}."
        ) from None


def _wall(text: str | None, distance_m: float | None) -> dict[str, Any] | None:
    found = _numbers(text, "--wall", 4, 5)
    if found is None:
        if distance_m is not None:
            raise InputError("--wall-distance goes with --wall.")
        return None
    wall: dict[str, Any] = {"start": found[:2], "end": found[2:4], "distance_m": distance_m}
    if len(found) == 5:
        wall["height_m"] = found[4]
    return wall
