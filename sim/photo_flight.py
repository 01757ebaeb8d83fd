"""A simulated vehicle that flies a plan fast, and its camera's card: photos with a time, without position."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from calib.photos.photo import Position
from mission import encode
from mission.encode import Flavour
from mission.plan import Plan
from sim.faults import LineFaults, Proxy
from sim.vehicle import Faults, PhotoTaken, VehicleOptions, VehicleServer
from sim.vehicle.storage import kept

FIRST_NUMBER = 17


@dataclass
class Card:
    """Photos as a camera on the vehicle takes them, written by a thread. ``clock_s``: camera minus UTC.

    ``drift_ppm``: how much the camera's clock gains since the vehicle's first start. ``skip``: the vehicle's
    photos (counted from 0) for which no file appears. ``by_hand``: so many photos, written at first, that
    no trigger belongs to. ``first``: number of the file of the vehicle's first photo.
    """

    folder: Path
    server: VehicleServer
    clock_s: float = 7203.7
    drift_ppm: float = 0.0
    whole_seconds: bool = False
    skip: frozenset[int] = frozenset()
    by_hand: int = 0
    first: int = FIRST_NUMBER
    written: int = 0
    lock: threading.RLock = field(default_factory=threading.RLock)

    def __post_init__(self) -> None:
        self._set_s = self.server.vehicle.options.boot_utc_s

    def name(self, number: int) -> str:
        """Of the vehicle's photo, counted from 0."""
        return f"DSC{number + self.first:05d}.JPG"

    def number(self, path: Path | str) -> int:
        return int(Path(path).stem[3:]) - self.first

    def write_by_hand(self) -> None:
        """Test shots before the flight, some seconds apart."""
        for n in range(self.by_hand):
            vehicle = self.server.vehicle
            at_s = vehicle.options.boot_utc_s + vehicle.boot_s - 7.3 * (self.by_hand - n)
            bare_photo(self.folder / f"DSC{n:05d}.JPG", self._moment(at_s), -n - 1, self.whole_seconds)

    def write_new(self) -> None:
        with self.lock:
            for number, photo in enumerate(self.server.vehicle.photos[self.written :], start=self.written):
                if number not in self.skip:
                    self._write(number, photo)
                self.written = number + 1

    def _write(self, number: int, photo: PhotoTaken) -> None:
        seed = self.first + number
        bare_photo(self.folder / self.name(number), self._moment(photo.utc_s), seed, self.whole_seconds)

    def _moment(self, utc_s: float) -> datetime:
        """What the camera's clock shows then."""
        gained_s = 1e-6 * self.drift_ppm * (utc_s - self._set_s)
        return datetime.fromtimestamp(utc_s, UTC) + timedelta(seconds=gained_s + self.clock_s)


def bare_photo(path: Path, moment: datetime, seed: int, whole_seconds: bool) -> Path:
    """A small JPEG with a time and without a position, there at once."""
    noise = np.random.default_rng(abs(seed)).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    exif, tags = Image.Exif(), ExifTags.Base
    exif[tags.Make], exif[tags.Model] = "SONY", "ILCE-6000"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[tags.DateTimeOriginal] = moment.strftime("%Y:%m:%d %H:%M:%S")
    if not whole_seconds:
        details[tags.SubsecTimeOriginal] = f"{moment.microsecond // 10_000:02d}"
    part = path.with_suffix(".part")
    Image.fromarray(noise).save(part, "JPEG", exif=exif)
    part.rename(path)
    return path


@dataclass
class PhotoFlight:
    """A vehicle behind a line, and the card in its camera."""

    proxy: Proxy
    server: VehicleServer
    card: Card

    def take_off(self, speed_up: float) -> None:
        """Arm and start; from now on the vehicle's time runs so many times as fast.

        Raises:
            RuntimeError: the vehicle does not arm or start.
        """
        pilot = self.server.vehicle.pilot
        if not pilot.arm(True) or pilot.start_mission() != 0:
            raise RuntimeError("The simulated vehicle does not start.")
        self.server.speed_up = speed_up

    def change_battery(self, off_s: float) -> list[PhotoTaken]:
        """The vehicle starts anew where it took off, at real time; the card's numbers go on.

        Returns the photos taken until then.
        """
        with self.card.lock:
            self.card.write_new()
            before = self.server.vehicle.photos
            self.server.speed_up = 1.0
            self.server.power_cycle(off_s)
            self.card.first, self.card.written = self.card.first + len(before), 0
        return before

    def place_error(self, number: int, position: Position) -> tuple[float, float]:
        """Horizontal and vertical distance of a position from the truth of a photo, m."""
        place = (position.latitude_deg, position.longitude_deg, position.altitude_m or 0.0)
        home = self.server.vehicle.options.home
        at = home.enu(*(np.array([value]) for value in place))[0]
        away = at - np.array(self.server.vehicle.photos[number].at_m)
        return float(np.hypot(away[0], away[1])), abs(float(away[2]))


@contextmanager
def photo_flight(
    flavour: Flavour,
    folder: Path,
    plan: Plan,
    line_faults: LineFaults | None = None,
    faults: Faults | None = None,
    card: Callable[[VehicleServer], Card] | None = None,
    seed: int = 0,
    beside: tuple[str, int] | None = None,
    **options: object,
) -> Iterator[PhotoFlight]:
    """On the ground with the plan on board; the card is filled while it flies."""
    folder.mkdir(exist_ok=True)
    stop = threading.Event()
    with (
        Proxy(line_faults or LineFaults(), seed) as proxy,
        VehicleServer(
            VehicleOptions(flavour, plan.launch, **options),  # type: ignore[arg-type]
            proxy.vehicle_address,
            faults=faults,
            camera=beside,
            seed=seed,
        ) as server,
    ):
        vehicle = server.vehicle
        home = vehicle.telemetry.home_item()
        stored = [kept(flavour, n, item, home) for n, item in enumerate(encode.items(plan, flavour))]
        vehicle.transfer.stored[0] = stored
        made = Card(folder, server) if card is None else card(server)
        made.write_by_hand()

        def fill() -> None:
            while not stop.wait(0.02):
                made.write_new()

        writer = threading.Thread(target=fill, name="card", daemon=True)
        writer.start()
        try:
            yield PhotoFlight(proxy, server, made)
        finally:
            stop.set()
            writer.join(5)
