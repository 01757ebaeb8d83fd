"""A recommended pass as it is remembered: ``pass.json``, schema "fieldcal.pass/1".

By it the photos of the pass are known again when they come on a card (:mod:`mission.refly_taken`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from calib.errors import FormatError, InputError
from calib.extra_pass import Knowledge
from calib.flown_file import SurveyPhoto
from calib.frames import LocalFrame
from calib.wording import printable
from mission.plan import Station

if TYPE_CHECKING:
    from mission.refly import Refly
    from mission.refly_search import Found

PASS_FILE = "pass.json"
SCHEMA: Final = "fieldcal.pass/1"
_LARGEST_BYTES = 20_000_000

NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Positive = Annotated[FiniteFloat, Field(gt=0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Launch(_Part):
    lat: Annotated[FiniteFloat, Field(ge=-90, le=90)]
    lon: Annotated[FiniteFloat, Field(ge=-180, le=180)]


class _Station(_Part):
    """Metres around the launch point, as :class:`mission.plan.Station`."""

    east_m: FiniteFloat
    north_m: FiniteFloat
    height_m: FiniteFloat
    yaw_deg: FiniteFloat
    pitch_deg: Annotated[FiniteFloat, Field(ge=-90, le=90)]


class _Known(_Part):
    sigma_f_percent: NotNegative
    dome_percent: NotNegative


class Pass(_Part):
    """One way to fly it. ``stations``: around the launch point; ``predicted``: what is to be known then."""

    predicted: _Known
    stations: Annotated[tuple[_Station, ...], Field(min_length=1)]

    @property
    def planned(self) -> tuple[Station, ...]:
        """The stations."""
        return tuple(Station(**dict(s)) for s in self.stations)

    @property
    def knowledge(self) -> Knowledge:
        """What is to be known when it is flown."""
        return Knowledge(**dict(self.predicted))


class PassRecord(_Part):
    """A pass and the survey that it completes.

    ``passes``: the recommended one first, then those that would do instead; ``survey``: its photos.
    """

    format: Literal["fieldcal.pass/1"] = Field(alias="schema")
    made: AwareDatetime
    camera: str
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    height_agl_m: Positive
    launch: _Launch
    before: _Known
    passes: Annotated[tuple[Pass, ...], Field(min_length=1)]
    survey: tuple[SurveyPhoto, ...]

    @property
    def knowledge(self) -> Knowledge:
        """What is known without the pass."""
        return Knowledge(**dict(self.before))

    @property
    def frame(self) -> LocalFrame:
        """Around the launch point."""
        return LocalFrame(self.launch.lat, self.launch.lon)


def pass_record(found: Refly, made: AwareDatetime) -> PassRecord | None:
    """What there is to remember; None where nothing is to be flown, or the check did not keep its photos."""
    check, site = found.check, found.flown.site
    if found.found is None or found.plan is None or not check.files:
        return None
    lens = check.flown.network.lens.brown
    others = [a.found for a in found.alternatives if a.found is not None]
    return PassRecord(
        schema=SCHEMA,
        made=made,
        camera=printable(check.camera_name),
        width=lens.width,
        height=lens.height,
        height_agl_m=check.height_agl_m,
        launch=_Launch(lat=site.frame.latitude_deg, lon=site.frame.longitude_deg),
        before=_Known(sigma_f_percent=check.sigma_f_percent, dome_percent=check.dome_percent),
        passes=tuple(_pass(one) for one in (found.found, *others)),
        survey=check.files,
    )


def _pass(found: Found) -> Pass:
    return Pass(
        predicted=_Known(sigma_f_percent=found.worth.sigma_f_percent, dome_percent=found.worth.dome_percent),
        stations=tuple(
            _Station(**{name: getattr(s, name) for name in _Station.model_fields}) for s in found.stations
        ),
    )


def record_text(record: PassRecord) -> str:
    """The file's content."""
    return record.model_dump_json(by_alias=True, indent=1) + "\n"


def read_record(path: Path) -> PassRecord:
    """Read ``pass.json``.

    Raises:
        InputError: not there or not readable. FormatError: not such a file, or damaged.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {(error.strerror or str(error)).lower()}.") from error
    try:
        return PassRecord.model_validate_json(data)
    except ValidationError as error:
        raise FormatError(
            f"{path} is no recommended pass ({SCHEMA}), or it is damaged: run fieldcal refly again."
        ) from error
