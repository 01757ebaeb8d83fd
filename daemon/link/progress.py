"""How far the mission is: MISSION_CURRENT first, MISSION_ITEM_REACHED (lossy, repeating) second."""

from __future__ import annotations

from dataclasses import dataclass, replace

from daemon.link.events import Autopilot, Heartbeat, ItemReached, MissionCurrent, MissionState


@dataclass(frozen=True)
class MissionProgress:
    """``item``: being flown, in the numbering of the uploaded items (ArduPilot's home is 0). ``last``:
    number of the last item, None while unknown. ``reached``: highest item reached or passed, -1 none;
    it falls back when the mission starts again. ``mission_id``: as in :class:`MissionCurrent`."""

    item: int = 0
    last: int | None = None
    reached: int = -1
    state: MissionState = MissionState.UNKNOWN
    mission_id: int = 0


@dataclass(frozen=True)
class ProgressFilter:
    """Pure: ``filter.add(event)`` is the next filter; compare ``progress`` to see whether it moved.

    PX4 leaves the mission's state at 0: there it follows from mode, arming and the last item.
    """

    progress: MissionProgress = MissionProgress()
    heartbeat: Heartbeat | None = None

    def add(self, event: Heartbeat | MissionCurrent | ItemReached) -> ProgressFilter:
        if isinstance(event, Heartbeat):
            return replace(self, heartbeat=event)._with(self.progress)
        if isinstance(event, ItemReached):
            if event.item <= self.progress.reached or not self._plausible(event.item):
                return self
            return self._with(replace(self.progress, reached=event.item))
        return self._with(self._current(event))

    def _current(self, event: MissionCurrent) -> MissionProgress:
        now = self.progress
        other_mission = event.mission_id != now.mission_id and 0 not in (event.mission_id, now.mission_id)
        back = other_mission or event.item < now.item
        # Items before the one being flown are done, whether or not that was told.
        reached = event.item - 1 if back else max(now.reached, event.item - 1)
        ardupilot = self._autopilot() is Autopilot.ARDUPILOT
        last = None if event.total is None else event.total - (0 if ardupilot else 1)
        return MissionProgress(event.item, last, reached, event.state, event.mission_id)

    def _with(self, progress: MissionProgress) -> ProgressFilter:
        beat = self.heartbeat
        if beat is not None and beat.autopilot is Autopilot.PX4 and progress.state is not MissionState.NONE:
            progress = replace(progress, state=self._px4_state(progress, beat))
        return replace(self, progress=progress)

    @staticmethod
    def _px4_state(progress: MissionProgress, beat: Heartbeat) -> MissionState:
        last = progress.last
        # A return to launch as the last item is flown in another mode and never told as reached.
        left_at_end = last is not None and progress.item >= last and not beat.in_mission
        if last is not None and (progress.reached >= last or (left_at_end and progress.reached >= last - 1)):
            return MissionState.COMPLETE
        if beat.armed and beat.in_mission:
            return MissionState.ACTIVE
        return MissionState.PAUSED if progress.reached >= 0 else MissionState.NOT_STARTED

    def _autopilot(self) -> Autopilot:
        return self.heartbeat.autopilot if self.heartbeat else Autopilot.OTHER

    def _plausible(self, item: int) -> bool:
        """A late REACHED of a mission that is gone tells nothing of this one."""
        return self.progress.last is None or item <= self.progress.last
