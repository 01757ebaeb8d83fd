"""The camera at work: hears of photos, makes them one after the other, says how far behind it is."""

from __future__ import annotations

import random
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from daemon.link import events as ev
from daemon.link.decode import MOUNT_PARAMETERS
from daemon.link.live import Link
from daemon.link.transfer import ReadParameters
from sim.tether.offering import Offering
from sim.tether.shutter import Exposure, Shutter
from sim.tether.studio import Studio, StudioOptions
from sim.truth import SurveyTruth

#: Without a word about home for so long, it is taken to be under the vehicle.
HOME_S = 12.0
_LOOK_S = 0.1
#: Two photos at once: the work is done inside numpy and OpenCV.
_WORKERS = 2


@dataclass(frozen=True)
class Count:
    """``triggers``: photos told of; ``due``: those to be made, ``written`` of them so far. ``behind_s``: age
    of the oldest that is not written; ``worst_s``: longest from hearing of a photo to its file.
    ``interpolated``: poses that were not told with the photo."""

    triggers: int = 0
    due: int = 0
    written: int = 0
    behind_s: float = 0.0
    worst_s: float = 0.0
    interpolated: int = 0


class Camera:
    """Context manager; leaving it gives up photos that are not begun and writes the truth of the rest.

    Args:
        tell: called now and then with the count.
        offering: is told of each file that is there.
    """

    def __init__(
        self,
        link: Link,
        options: StudioOptions,
        out: Path,
        *,
        miss_share: float = 0.0,
        tell: Callable[[Count], None] = lambda _: None,
        offering: Offering | None = None,
    ) -> None:
        self.shutter = Shutter(random.Random(options.seed), miss_share)
        self.truth: SurveyTruth | None = None
        self.worst_s = 0.0
        self._link, self._options, self._out, self._tell = link, options, out, tell
        self._offering = offering
        self._pool = ThreadPoolExecutor(_WORKERS, thread_name_prefix="photo")
        self._studio: Future[Studio] | None = None
        self._held: deque[Exposure] = deque()
        self._due: deque[tuple[Exposure, Future[float]]] = deque()
        self._exposed = self._interpolated = self._begun = self._written = 0
        self._first_utc_s: float | None = None
        self._asked_mount = self._flew = self._landed = False
        self._since_s = time.monotonic()

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)
        if self.ground_ready and self._studio is not None:
            self.truth = self._studio.result().write_truth()

    @property
    def ground_ready(self) -> bool:
        studio = self._studio
        return studio is not None and studio.done() and not studio.cancelled() and studio.exception() is None

    @property
    def landed(self) -> bool:
        """The vehicle was armed and is not any more."""
        return self._landed

    @property
    def count(self) -> Count:
        undone = [exposure for exposure, _ in list(self._due)[:1]] + list(self._held)[:1]
        behind_s = self._link.now_s() - undone[0].heard_s if undone else 0.0
        return Count(
            *(len(self.shutter.filter.photos), self._exposed, self._written),
            *(behind_s, self.worst_s, self._interpolated),
        )

    def step(self) -> None:
        """Take in what was heard, begin what is known, for a moment.

        Raises:
            OSError: a photo cannot be written.
            InputError: the world cannot be made.
        """
        until = time.monotonic() + _LOOK_S
        for heard in self._link.events(wait_s=_LOOK_S):
            self._watch(heard.event)
            self.shutter.hear(heard.event, heard.at_s)
            if time.monotonic() > until:
                break
        self._make_ground()
        for exposure in self.shutter.exposures(self._link.state.time_base, self._link.now_s()):
            self._exposed += 1
            self._interpolated += not exposure.pose.told
            self._held.append(exposure)
        self._begin()
        self._count_written()
        self._tell(self.count)

    def finish(self) -> None:
        """Make the photos that were heard of, however long it takes."""
        while self._due or self._held or self.shutter.waiting:
            self.step()

    def _watch(self, event: ev.Event) -> None:
        if isinstance(event, ev.Heartbeat):
            self._landed = self._flew and not event.armed
            self._flew = self._flew or event.armed
            if not self._asked_mount:
                self._asked_mount = True
                self._ask_mount()

    def _ask_mount(self) -> None:
        """A gimbal's angles mean what the kind of mount says."""
        vehicle, names = self._link.state.system_id, MOUNT_PARAMETERS[self._link.state.autopilot]
        if vehicle is not None and names:
            self._link.run(ReadParameters(vehicle, names))

    def _make_ground(self) -> None:
        if self._studio is not None:
            return
        home = self._link.state.last(ev.HomePosition)
        if home is None and time.monotonic() - self._since_s > HOME_S:
            position = self._link.state.last(ev.Position)
            if position is not None:
                altitude_m = position.altitude_msl_m - position.height_m
                home = ev.HomePosition(position.latitude_deg, position.longitude_deg, altitude_m)
        if home is not None:
            self._studio = self._pool.submit(Studio, self._options, self._out, home)

    def _begin(self) -> None:
        """What was exposed goes to the workers, once there is a ground to be seen."""
        if self._studio is None or not self._studio.done():
            return
        studio = self._studio.result()
        while self._held:
            exposure = self._held.popleft()
            self._first_utc_s = exposure.utc_s if self._first_utc_s is None else self._first_utc_s
            self._begun += 1
            work = self._pool.submit(self._take, studio, self._begun, exposure, self._first_utc_s)
            self._due.append((exposure, work))

    def _take(self, studio: Studio, number: int, exposure: Exposure, first_utc_s: float) -> float:
        """When the photo was there, on the link's clock. Runs in the pool."""
        name = studio.take(number, exposure, first_utc_s)
        if self._offering is not None:
            self._offering.tell(number - 1, name, exposure)
        return self._link.now_s()

    def _count_written(self) -> None:
        while self._due and self._due[0][1].done():
            exposure, done = self._due.popleft()
            self.worst_s = max(self.worst_s, done.result() - exposure.heard_s)
            self._written += 1
