"""Positions that jump: photos taken then are known worse, and say so, also those that were placed before."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.capture.jumps import UNWATCHED_M
from daemon.capture.recent import Recent
from daemon.capture.trigger_book import PLACED, TriggerBook, places_of
from daemon.link import events as ev
from daemon.session.store import Session
from tests.test_capture_book import BASE, HOME, UTC_S, circle, position, report

Shift = Callable[[float], float]


def track(shift_m: Shift, until_s: float, noise_m: float = 0.0, speed: bool = True) -> list[ev.Position]:
    """Every 0.2 s; shifted eastwards."""
    rng = np.random.default_rng(4)
    found = []
    for boot_s in np.arange(1.0, until_s, 0.2).tolist():
        at, _ = circle(boot_s)
        told = at + [shift_m(boot_s), 0.0, 0.0] + rng.normal(0, noise_m, 3) * [1, 1, 1.6]
        latitude, longitude, altitude = HOME.geodetic(told[None])[0].tolist()
        flies = (8 * math.cos(0.4 * boot_s), -8 * math.sin(0.4 * boot_s), 0.0) if speed else (0.0, 0.0, 0.0)
        one = replace(position(boot_s), latitude_deg=latitude, longitude_deg=longitude)
        found.append(replace(one, altitude_msl_m=altitude, velocity_enu_m_s=flies))
    return found


def listened(positions: list[ev.Position]) -> Recent:
    recent = Recent()
    recent.add(ev.GnssFix(3, 14, 1.3, 2.1))
    for one in positions:
        recent.add(one)
    return recent


def between(since_s: float, until_s: float, size_m: float = 5.0) -> Shift:
    return lambda boot_s: size_m if since_s <= boot_s < until_s else 0.0


@pytest.mark.parametrize("speed", [True, False])
@pytest.mark.parametrize("noise_m", [0.0, 0.3])
def test_a_jump_there_and_back_is_in_doubt_for_so_long(speed: bool, noise_m: float) -> None:
    recent = listened(track(between(80.1, 90.1), 120.0, noise_m, speed))
    (first, *_) = news = recent.news()
    assert len(news) == 1
    assert first.horizontal_m == pytest.approx(5.0, abs=4 * noise_m + 0.3)
    for boot_s, doubted in ((78.0, False), (80.05, True), (80.5, True), (89.7, True), (90.9, False)):
        across, _ = recent.jumps.at(boot_s)
        assert (across > 3) == doubted, boot_s
    tag, calm = recent.at(92.5, 0.0), recent.at(100.0, 0.0)
    assert tag is not None
    assert calm is not None
    assert recent.jumps.looking_back() == []


def test_noise_turns_and_late_messages_are_no_jumps() -> None:
    positions = track(lambda _: 0.0, 400.0, 0.3)
    positions[50], positions[52] = positions[52], positions[50]
    recent = listened([p for n, p in enumerate(positions) if n % 7])
    assert recent.news() == []
    assert recent.jumps.at(200.0) == (0.0, 0.0)


def test_after_a_hole_a_step_casts_doubt_on_both_sides_and_lasting_ones_settle() -> None:
    whole = track(between(70.0, 95.0), 200.0)
    recent = listened([p for p in whole if not 65 < p.vehicle_boot_s < 80])
    assert recent.jumps.at(60.0)[0] == 0
    assert recent.jumps.at(85.0)[0] == pytest.approx(5.0, abs=0.5)
    assert recent.jumps.at(110.0)[0] == pytest.approx(5.0, abs=0.5)
    assert recent.jumps.at(170.0)[0] == 0
    (back,) = recent.jumps.looking_back()
    assert back.holds(85.0)
    assert not back.holds(64.0)


def test_between_two_holes_nothing_is_sure() -> None:
    whole = track(lambda _: 0.0, 130.0)
    recent = listened([p for p in whole if not (70 < p.vehicle_boot_s < 75 or 85 < p.vehicle_boot_s < 90)])
    assert recent.jumps.at(80.0) == (UNWATCHED_M, UNWATCHED_M)
    assert recent.jumps.at(69.0) == (0.0, 0.0)


def test_steps_within_the_stated_sigma_are_none() -> None:
    assert listened(track(between(80.0, 90.0, 1.0), 120.0)).news() == []


@pytest.mark.parametrize(
    ("fix", "across_m", "up_m"),
    [
        (ev.GnssFix(3, 9, 2.4, 4.0), 2.4, 4.0),
        (ev.GnssFix(3, 9, None, None, 2.0, 3.0), 3.8, 6.3),
        (ev.GnssFix(3, 9, None, None, 0.6, 0.9), 1.5, 3.0),
        (ev.GnssFix(1, 0, None, None), 30.0, 30.0),
    ],
)
def test_sigmas_are_what_the_receiver_tells(fix: ev.GnssFix, across_m: float, up_m: float) -> None:
    recent = Recent()
    recent.add(fix)
    for one in track(lambda _: 0.0, 20.0):
        recent.add(one)
    tag = recent.at(15.03, 0.0)
    assert tag is not None
    assert tag.position.sigma_horizontal_m == pytest.approx(across_m, abs=0.05)
    assert tag.position.sigma_vertical_m == pytest.approx(up_m, abs=0.05)


def test_a_photo_in_a_hole_is_told_with_less_trust() -> None:
    recent = listened([p for p in track(lambda _: 0.0, 130.0) if not 100 < p.vehicle_boot_s < 110])
    told = report(1, 105.0)
    inside, outside = recent.told(told, 105.0, 0.0), recent.told(told, 112.0, 0.0)
    assert inside is not None
    assert outside is not None
    assert inside.position.sigma_horizontal_m == pytest.approx(math.hypot(1.3, UNWATCHED_M))
    assert outside.position.sigma_horizontal_m == pytest.approx(1.3)


def test_photos_placed_before_a_jump_was_seen_are_recorded_anew(tmp_path: Path) -> None:
    """The link comes while the position is away; only its return tells."""
    recent = Recent()
    recent.add(ev.GnssFix(3, 14, 1.3, 2.1))
    with Session.create(tmp_path / "record") as session:
        book, sigmas = TriggerBook(session), []
        assert book.hear(report(1, 8.0), UTC_S + 8.0, BASE)
        for one in track(between(0.0, 20.0), 40.0):
            recent.add(one)
            book.place(recent, BASE, UTC_S + one.vehicle_boot_s)
            if book.places:
                sigmas.append(book.places[1].position.sigma_horizontal_m or 0.0)
        assert sigmas[0] < 2.0
        assert sigmas[-1] > 4.5
        assert places_of(session) == book.places
        assert TriggerBook(session).places == book.places


def test_a_track_of_nothing_but_steps_is_doubted_and_costs_no_memory(tmp_path: Path) -> None:
    """A place told once in two seconds: each photo is recorded anew a few times, not for ever."""
    recent = Recent()
    recent.add(ev.GnssFix(3, 14, 1.3, 2.1))
    with Session.create(tmp_path / "record") as session:
        book = TriggerBook(session)
        for n, one in enumerate(track(lambda _: 0.0, 300.0, speed=False)):
            recent.add(replace(position(2.0 * (n // 10)), vehicle_boot_s=one.vehicle_boot_s))
            if n % 10 == 5:
                assert book.hear(report(n // 10, one.vehicle_boot_s), UTC_S + one.vehicle_boot_s, BASE)
            book.place(recent, BASE, UTC_S + one.vehicle_boot_s)
        assert len(recent.jumps.doubts) <= 130
        assert 140 <= len(session.events(PLACED)) <= 4 * 150
        assert len(recent.news()) <= 11
