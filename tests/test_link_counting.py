"""Photos, items and clocks out of reports that repeat, skip, come late or contradict."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from daemon.link import events as ev
from daemon.link.clock import ClockOffset, OffsetSample, TimeBase
from daemon.link.modes import heartbeat
from daemon.link.progress import ProgressFilter
from daemon.link.triggers import TriggerFilter

FEEDBACK, TRIGGER, CAPTURED, CAMERA = ev.PhotoSource
UTC_S = 1_780_000_000.0


def feedback(index: int, utc_s: float) -> ev.PhotoReport:
    return ev.PhotoReport(FEEDBACK, 1, 0, index, None, UTC_S + utc_s, height_m=50.0)


def test_a_repeated_feedback_is_one_photo() -> None:
    photos = TriggerFilter()
    first = photos.add(feedback(1, 10.0), 0.0)
    assert first is not None
    assert first.number == 1
    assert all(photos.add(feedback(1, 10.0), 0.2 * n) is None for n in range(100))
    assert photos.add(feedback(2, 12.0), 21.0) is not None
    assert len(photos.photos) == 2


def test_late_feedback_is_neither_doubled_nor_a_restart() -> None:
    photos = TriggerFilter()
    for index in (1, 3, 2, 3, 1, 5, 4):
        photos.add(feedback(index, 10.0 * index), 10.0 * index)
    assert sorted(p.indices[0][1] for p in photos.photos) == [1, 2, 3, 4, 5]
    assert photos.lost() == ()


def test_numbers_start_again_with_the_vehicle() -> None:
    photos = TriggerFilter()
    for index in (1, 2, 3):
        photos.add(feedback(index, 10.0 * index), 10.0 * index)
    for index in (1, 2, 3, 3):
        photos.add(feedback(index, 500.0 + 10.0 * index), 500.0 + 10.0 * index)
    assert len(photos.photos) == 6
    photos.restarted()
    photos.add(replace(feedback(1, 0.0), utc_s=None, vehicle_boot_s=3.0), 900.0)
    assert len(photos.photos) == 7


def test_a_photo_told_again_after_the_restart_was_noticed_is_the_same() -> None:
    """The numbers tell at once that the vehicle began anew, its clock some seconds later."""
    photos = TriggerFilter()
    for index in (1, 2, 4):
        photos.add(feedback(index, 10.0 * index), 10.0 * index)
    assert photos.add(feedback(1, 60.0), 60.0) is not None
    photos.restarted(64.0)
    assert photos.add(feedback(1, 60.0), 65.0) is None
    assert photos.add(feedback(3, 70.0), 70.0) is not None
    assert len(photos.photos) == 5
    assert photos.lost() == (3, 2)
    photos.restarted(200.0)
    assert photos.add(feedback(3, 70.0), 200.5) is None
    assert photos.add(feedback(4, 210.0), 210.0) is not None
    assert len(photos.photos) == 6


def test_the_second_source_may_tell_after_the_restart_was_noticed() -> None:
    photos = TriggerFilter()
    for index in (0, 1):
        photos.add(ev.PhotoReport(TRIGGER, 1, 0, index, 50.0 + index, None), 50.0 + index)
    photos.add(ev.PhotoReport(TRIGGER, 1, 0, 5, 12.0, None), 100.0)
    photos.restarted(100.5)
    assert photos.add(ev.PhotoReport(CAPTURED, 1, 0, 5, 12.0, UTC_S, confirmed=True), 100.7) is not None
    # Of the new start, though its clock reads what it read for a photo long ago.
    assert photos.add(ev.PhotoReport(CAPTURED, 1, 0, 6, 50.0, None, confirmed=True), 138.0) is not None
    assert len(photos.photos) == 4


def test_lost_numbers_are_told() -> None:
    photos = TriggerFilter()
    for index in (2, 3, 6, 8):
        photos.add(feedback(index, 10.0 * index), 10.0 * index)
    assert photos.lost() == (4, 5, 7)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_two_sources_of_one_photo_are_one(flavour: str, seed: int) -> None:
    """A fifth of all messages lost, a fifth doubled, arrival late by up to 0.4 s: exact all the same."""
    rng = random.Random(seed)
    arrivals: list[tuple[float, ev.PhotoReport]] = []
    at, truth = 100.0, {}
    for number in range(150):
        at += rng.choice([0.8, 1.0, 2.0, 2.1, 15.0])
        truth[number] = at
        if flavour == "ardupilot":
            pair = [
                feedback(number + 1, at),
                ev.PhotoReport(CAMERA, 100, 0, number + 40, None, UTC_S + at + 0.3, confirmed=True),
            ]
        else:
            pair = [
                ev.PhotoReport(TRIGGER, 1, 0, number, at, None),
                ev.PhotoReport(CAPTURED, 1, 0, number, math.floor(at * 1e3) / 1e3, None, confirmed=True),
            ]
        for report in pair:
            for _ in range(2 if rng.random() < 0.2 else 1):
                if rng.random() < 0.8:
                    arrivals.append((at + rng.uniform(0, 0.4), report))
    photos = TriggerFilter()
    for heard_s, report in sorted(arrivals, key=lambda pair: pair[0]):
        photos.add(report, heard_s)
    first = FEEDBACK if flavour == "ardupilot" else TRIGGER
    shift = {FEEDBACK: 1, TRIGGER: 0, CAPTURED: 0, CAMERA: 40}
    told = sorted({n - shift[s] for _, r in arrivals for s, n in ((r.source, r.index),)})
    found = sorted(p.indices[0][1] - shift[p.indices[0][0]] for p in photos.photos)
    assert found == told
    for photo in photos.photos:
        assert len({index - shift[source] for source, index in photo.indices}) == 1
    gaps = [n for n in range(told[0], told[-1]) if n not in told]
    assert [n - shift[first] for n in photos.lost()] == gaps


def test_two_cameras_are_two_photos() -> None:
    photos = TriggerFilter()
    photos.add(feedback(1, 10.0), 10.0)
    photos.add(replace(feedback(1, 10.0), camera=1), 10.0)
    assert len(photos.photos) == 2


def test_a_camera_that_reports_failure_is_no_second_photo() -> None:
    photos = TriggerFilter()
    photos.add(feedback(1, 10.0), 10.0)
    merged = photos.add(ev.PhotoReport(CAMERA, 100, 0, 0, None, UTC_S + 10.4, confirmed=False), 10.5)
    assert merged is not None
    assert (merged.number, merged.revision, merged.confirmed) == (1, 1, False)


def test_progress_where_reached_skips_and_repeats() -> None:
    state = ProgressFilter().add(heartbeat(3, 129, 3))
    state = state.add(ev.MissionCurrent(1, 9, ev.MissionState.ACTIVE, 0))
    for event in (ev.ItemReached(1), ev.ItemReached(4), ev.ItemReached(4), ev.ItemReached(2)):
        state = state.add(event)
    assert (state.progress.reached, state.progress.last) == (4, 9)
    state = state.add(ev.MissionCurrent(8, 9, ev.MissionState.ACTIVE, 0))
    assert state.progress.reached == 7
    state = state.add(ev.ItemReached(200))  # of another mission
    assert state.progress.reached == 7
    again = state.add(ev.MissionCurrent(1, 9, ev.MissionState.ACTIVE, 0))
    assert (again.progress.item, again.progress.reached) == (1, 0)


def test_px4s_state_is_worked_out() -> None:
    flying, holding = heartbeat(12, 129, 4 << 16 | 4 << 24), heartbeat(12, 129, 4 << 16 | 3 << 24)
    state = ProgressFilter().add(flying).add(ev.MissionCurrent(3, 6, ev.MissionState.UNKNOWN, 0))
    assert (state.progress.state, state.progress.last) == (ev.MissionState.ACTIVE, 5)
    assert state.add(holding).progress.state is ev.MissionState.PAUSED
    assert state.add(ev.ItemReached(5)).progress.state is ev.MissionState.COMPLETE
    at_end = state.add(ev.MissionCurrent(5, 6, ev.MissionState.UNKNOWN, 0))
    assert at_end.progress.state is ev.MissionState.ACTIVE
    assert at_end.add(heartbeat(12, 129, 4 << 16 | 5 << 24)).progress.state is ev.MissionState.COMPLETE


def timesync(
    base: TimeBase, rng: random.Random, seconds: range, offset_s: float, drift_ppm: float = 0.0
) -> TimeBase:
    """One question a second, answers delayed unevenly, one in ten by half a second."""
    for second in seconds:
        there, back = rng.uniform(0.001, 0.02), rng.uniform(0.001, 0.02)
        if rng.random() < 0.1:
            back += 0.5
        asked = float(second)
        vehicle = (asked + there) * (1 + drift_ppm * 1e-6) + offset_s
        base = base.with_timesync(asked, vehicle, asked + there + back)
    return base


@pytest.mark.parametrize("seed", range(10))
def test_the_time_base_is_within_its_stated_bound(seed: int) -> None:
    rng = random.Random(seed)
    base = timesync(TimeBase(), rng, range(100), 1000.0, drift_ppm=40.0)
    found = base.boot_of_local(100.0)
    assert found is not None
    truth = 100.0 * (1 + 40e-6) + 1000.0
    assert abs(found[0] - truth) <= found[1]
    assert found[1] < 0.02


def test_outliers_move_nothing_and_a_step_is_followed() -> None:
    rng = random.Random(1)
    base = timesync(TimeBase(), rng, range(60), 1000.0)
    before = base.boot_of_local(60.0)
    liar = base.with_timesync(60.0, 5000.0, 60.01).with_timesync(61.0, 7000.0, 61.01)
    assert liar.boot_of_local(60.0) == before
    after = timesync(liar, rng, range(62, 72), -50.0)  # the vehicle started anew
    found = after.boot_of_local(72.0)
    assert found is not None
    assert found[0] == pytest.approx(22.0, abs=0.02)
    assert after.boot_from_local.steps == 1


def test_clocks_that_do_not_run_alike_have_no_offset() -> None:
    clock = ClockOffset()
    for second in range(40):  # a simulation at ten times real time
        clock = clock.add(OffsetSample(float(second), 9.0 * second, 0.005))
    assert clock.at(40.0) is None


def test_utc_and_back() -> None:
    base = TimeBase()
    assert base.utc_of_boot(1.0) is None
    for boot in range(10):
        base = base.with_system_time(float(boot), None if boot < 3 else UTC_S + boot + 0.0004)
    found = base.utc_of_boot(20.0)
    assert found is not None
    assert found[0] == pytest.approx(UTC_S + 20.0, abs=found[1])
    assert found[1] < 0.21
    assert base.boot_of_utc(UTC_S + 20.0) == pytest.approx(20.0, abs=0.002)
