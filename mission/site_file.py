"""The site file: TOML that keeps everything a mission is planned from.

Relative paths in it are relative to the file. Keys are checked one by one; whatever is wrong is
said in one sentence that names the key and the file.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from calib.errors import InputError

_MOST_BYTES = 1_000_000

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
#: 0.8 and 80 (percent) mean the same.
_share = BeforeValidator(lambda v: v / 100 if isinstance(v, (int, float)) and v >= 1 else v)
Overlap = Annotated[float, _share, Field(ge=0.1, le=0.95)]
#: A file, LAT,LON,RADIUS, WKT, or corners as [latitude, longitude].
Outline = str | list[tuple[Latitude, Longitude]]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class VehicleKeys(_Strict):
    """``[vehicle]``; see :class:`mission.plan.Vehicle` for units and meaning."""

    speed_m_s: Annotated[float, Field(gt=0, le=60)] | None = None
    climb_m_s: Annotated[float, Field(gt=0, le=30)] | None = None
    descent_m_s: Annotated[float, Field(gt=0, le=30)] | None = None
    acceleration_m_s2: Annotated[float, Field(gt=0, le=30)] | None = None
    endurance_s: Annotated[float, Field(gt=0, le=86_400)] | None = None
    reserve_share: Annotated[float, _share, Field(ge=0, lt=1)] | None = None
    settle_s: Annotated[float, Field(ge=0, le=60)] | None = None
    gimbal_lowest_deg: Annotated[float, Field(ge=-135, le=0)] | None = None
    gimbal_highest_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    camera_interval_s: Annotated[float, Field(gt=0, le=120)] | None = None
    most_items: Annotated[int, Field(gt=0, le=65_535)] | None = None


class WindKeys(_Strict):
    """``[wind]``: speed in m/s, and where it comes from, degrees clockwise from north."""

    speed_m_s: Annotated[float, Field(ge=0, le=40)]
    from_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0


class FenceKeys(_Strict):
    """One ``[[fence]]``: a zone to stay in or out of."""

    keep: Literal["in", "out"]
    outline: Outline


class StructureKeys(_Strict):
    """One ``[[structure]]``: something that stands up, height above its ground in m."""

    outline: Outline
    height_m: Positive
    name: str = "structure"


class WallKeys(_Strict):
    """``[wall]``: from and to, as [latitude, longitude], and its height in m."""

    start: tuple[Latitude, Longitude]
    end: tuple[Latitude, Longitude]
    height_m: Positive = 6.0
    distance_m: Annotated[float, Field(ge=2, le=100)] | None = None


class PatternKeys(_Strict):
    """``[pattern]``: what single patterns can be told."""

    heading_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    second_height_m: Positive | None = None
    oblique_tilt_deg: Annotated[float, Field(ge=1, le=45)] | None = None
    poi: tuple[Latitude, Longitude] | None = None
    tilt_deg: Annotated[float, Field(ge=1, le=80)] | None = None
    radius_m: Positive | None = None
    photos: Annotated[int, Field(ge=1, le=400)] | None = None
    arc_deg: tuple[float, float] | None = None
    clockwise: bool | None = None
    rings: Annotated[int, Field(ge=1, le=12)] | None = None


class SiteFile(_Strict):
    """All keys of a site file; None: not given there."""

    name: str | None = None
    area: Outline | None = None
    launch: tuple[Latitude, Longitude] | None = None
    camera: str | None = None
    mechanical_shutter: bool | None = None
    height_m: Annotated[float, Field(gt=0, le=5000)] | None = None
    gsd_cm: Annotated[float, Field(gt=0, le=1000)] | None = None
    forward_overlap: Overlap | None = None
    side_overlap: Overlap | None = None
    dem: str | None = None
    ceiling_m: Positive | None = None
    clearance_m: Annotated[float, Field(ge=0, le=1000)] | None = None
    standoff_m: Annotated[float, Field(ge=0, le=1000)] | None = None
    fence_margin_m: Annotated[float, Field(ge=0, le=1000)] | None = None
    vehicle: VehicleKeys = VehicleKeys()
    wind: WindKeys | None = None
    fence: tuple[FenceKeys, ...] = ()
    structure: tuple[StructureKeys, ...] = ()
    wall: WallKeys | None = None
    pattern: PatternKeys = PatternKeys()


def read_site_file(path: Path) -> SiteFile:
    """Read and check a site file; files named in it come back relative to where we are.

    Raises:
        InputError: not readable, no TOML, or a key that is unknown or wrong.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise InputError(f"The site file {path} is larger than a megabyte; that is no site file.")
        keys = tomllib.loads(data.decode("utf-8-sig"))
    except OSError as error:
        raise InputError(
            f"The site file {path} cannot be read: {(error.strerror or str(error)).lower()}."
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"The site file {path} is no TOML: {error}.") from error
    return _placed(checked(keys, f"the site file {path}"), path.parent)


def checked(keys: dict[str, Any], source: str, names: Mapping[str, str] | None = None) -> SiteFile:
    """Keys as a SiteFile. ``names``: what the user calls a key, where that is not a key of a file.

    Raises:
        InputError: the first mistake, as one sentence naming key and ``source``.
    """
    try:
        found = SiteFile.model_validate(keys)
    except ValidationError as error:
        raise InputError(_sentence(error, source, names or {})) from error
    if found.height_m is not None and found.gsd_cm is not None:
        raise InputError(f"Both height_m and gsd_cm are given in {source}; give one of them.")
    return found


def overlaid(under: SiteFile, over: SiteFile) -> SiteFile:
    """What ``over`` gives, and the rest from ``under``; zones and structures of both."""
    update: dict[str, Any] = {}
    for key in SiteFile.model_fields:
        given = getattr(over, key)
        if key in ("fence", "structure"):
            update[key] = (*getattr(under, key), *given)
        elif key in ("vehicle", "pattern"):
            kept = getattr(under, key)
            new = {k: v for k, v in given.model_dump().items() if v is not None}
            update[key] = kept.model_copy(update=new)
        elif given is not None:
            update[key] = given
    if over.height_m is not None:
        update["gsd_cm"] = None
    if over.gsd_cm is not None:
        update["height_m"] = None
    return under.model_copy(update=update)


def _sentence(error: ValidationError, source: str, names: Mapping[str, str]) -> str:
    first = error.errors()[0]
    place = [
        part
        for part in first["loc"]
        if part != "str" and not str(part).startswith(("list[", "tuple[", "function-"))
    ]
    key = ".".join(str(part + 1 if isinstance(part, int) else part) for part in place)
    if first["type"] == "extra_forbidden":
        known = _known_keys(place[:-1])
        return f"There is no key {key} in {source}; known here: {', '.join(known)}."
    if first["type"] == "missing":
        return f"The key {key} is missing in {source}."
    message = str(first["msg"])
    given = first.get("input")
    shown = f", not {given!r}" if isinstance(given, (str, int, float, bool)) else ""
    what = names.get(".".join(str(part) for part in place if isinstance(part, str)), f"key {key}")
    return f"The {what} in {source} is wrong: {message[:1].lower()}{message[1:]}{shown}."


def _known_keys(place: list[int | str]) -> list[str]:
    models: dict[str, type[BaseModel]] = {
        "vehicle": VehicleKeys,
        "wind": WindKeys,
        "fence": FenceKeys,
        "structure": StructureKeys,
        "wall": WallKeys,
        "pattern": PatternKeys,
    }
    model = models.get(str(place[0]), SiteFile) if place else SiteFile
    return sorted(model.model_fields)


def _placed(site: SiteFile, folder: Path) -> SiteFile:
    """The same with the files it names found from its own folder."""

    def outline(given: Outline) -> Outline:
        return _beside(given, folder) if isinstance(given, str) else given

    update: dict[str, Any] = {
        "fence": tuple(z.model_copy(update={"outline": outline(z.outline)}) for z in site.fence),
        "structure": tuple(s.model_copy(update={"outline": outline(s.outline)}) for s in site.structure),
    }
    if site.area is not None:
        update["area"] = outline(site.area)
    for key in ("dem", "camera"):
        given = getattr(site, key)
        if given is not None:
            update[key] = _beside(given, folder)
    return site.model_copy(update=update)


def _beside(given: str, folder: Path) -> str:
    """The path from ``folder``, where there is such a file; names, circles and WKT stay as they are."""
    path = Path(given).expanduser()
    beside = folder / path
    looks_like_file = "/" in given or (path.suffix != "" and path.suffix[1:2].isalpha())
    is_text = given.lstrip()[:1].isdigit() or "(" in given
    if not path.is_absolute() and (beside.is_file() or (looks_like_file and not is_text)):
        return str(beside)
    return given
