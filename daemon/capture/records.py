"""What pairing takes and gives. Times in s; the two clocks are the vehicle's and the camera's."""

from __future__ import annotations

from dataclasses import dataclass

#: A pair at least this probable is called sure.
SURE = 0.9925


@dataclass(frozen=True)
class Trigger:
    """One exposure as the vehicle reports it.

    ``key`` identifies it for the caller and is unique within a flight. ``image_index`` is the
    camera's or autopilot's count for this shot, ``completed_captures`` the count of confirmed
    exposures, given only where the source really counts (feedback pin); None: not known.
    Position (WGS84 degrees, m) and attitude (roll, pitch, yaw in degrees) are passed through.
    """

    key: int
    time_s: float
    sigma_s: float = 0.02
    image_index: int | None = None
    completed_captures: int | None = None
    position: tuple[float, float, float] | None = None
    attitude_deg: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Shot:
    """One photo file: camera clock in s (cut off to ``resolution_s``, as EXIF does), place in the file
    order (the number in its name where it has one)."""

    name: str
    time_s: float
    resolution_s: float = 1.0
    order: int = 0


@dataclass(frozen=True)
class Pair:
    """``probability``: that this photo was taken by this trigger, over all clocks considered."""

    trigger: Trigger
    shot: Shot
    probability: float

    @property
    def sure(self) -> bool:
        return self.probability >= SURE


@dataclass(frozen=True)
class KnownClock:
    """What is known beforehand: camera time minus vehicle time, in s (one photo of a clock gives it)."""

    offset_s: float
    sigma_s: float


@dataclass(frozen=True)
class ClockFit:
    """camera time = vehicle time + offset_s + drift * (vehicle time - reference_s).

    ``drift`` has no unit (1e-6 is 1 ppm). The sigmas are those of the likeliest alignment, the
    offset's widened by the spread over the alternatives. ``jitter_s``: spread of single pairs.
    """

    offset_s: float
    offset_sigma_s: float
    drift: float
    drift_sigma: float
    reference_s: float
    jitter_s: float

    def camera_s(self, vehicle_s: float) -> float:
        """Camera time of a vehicle time."""
        return vehicle_s + self.offset_s + self.drift * (vehicle_s - self.reference_s)


@dataclass(frozen=True)
class Alternative:
    """Another clock that explains the times nearly as well."""

    offset_s: float
    probability: float


@dataclass(frozen=True)
class Pairing:
    """Pairs in the order of time, and all that is left over.

    ``clock`` is None where nothing could be paired. ``alternatives`` has every clock considered
    with more than 0.1 % probability, the chosen one first.
    """

    pairs: tuple[Pair, ...]
    triggers_without_photo: tuple[Trigger, ...]
    photos_without_trigger: tuple[Shot, ...]
    clock: ClockFit | None
    alternatives: tuple[Alternative, ...] = ()

    @property
    def sure_pairs(self) -> tuple[Pair, ...]:
        return tuple(pair for pair in self.pairs if pair.sure)

    @property
    def ambiguous(self) -> bool:
        """No clock is sure: a different offset explains the times about as well."""
        return bool(self.alternatives) and self.alternatives[0].probability < SURE

    @property
    def advice(self) -> str:
        """One sentence on what would settle an ambiguous pairing; "" where it is not ambiguous."""
        if self.clock is None:
            return "No photo could be paired: check that photos and triggers are of the same flight."
        if not self.ambiguous:
            return ""
        return (
            "The intervals do not tell which photo is the first: one photo of the vehicle's clock, "
            "or one trigger known to belong to one photo, would settle it."
        )
