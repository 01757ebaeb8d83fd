"""Wind, a receiver's errors and a power cycle in the air, as the simulated vehicle has them. No sockets."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from mission import encode
from mission.encode import Flavour
from sim.vehicle import Faults, Gnss, Wind
from sim.vehicle.receiver import VERTICAL
from tests.mission_plans import LAUNCH
from tests.test_vehicle_behaviour import Ground


def flown(flavour: Flavour = "ardupilot", faults: Faults | None = None, **options: Any) -> Ground:
    ground = Ground(flavour, faults, **options)
    for name in ("GLOBAL_POSITION_INT", "GPS_RAW_INT", "ATTITUDE"):
        ground.vehicle.telemetry.want(name, 5.0)
    ground.start()
    ground.until(lambda: ground.vehicle.done)
    return ground


def told_m(message: Any) -> tuple[float, float, float]:
    longitude = getattr(message, "lng", None) or message.lon
    alt_m = getattr(message, "alt_msl", None) or message.alt / 1e3
    place = (np.array([v]) for v in (message.lat * 1e-7, longitude * 1e-7, alt_m))
    east, north, up = LAUNCH.enu(*place)[0].tolist()
    return east, north, up


def test_wind_sways_leans_and_shifts_photos_but_not_by_much() -> None:
    calm, blown = flown(), flown(wind=Wind(8.0, 0.0, 2.5))
    still, moved = calm.vehicle.photos, blown.vehicle.photos
    # A gust at the end of a line may give one photo more or less; those of the orbit are taken in hover.
    assert abs(len(still) - len(moved)) <= 1
    away = [math.dist(one.at_m, other.at_m) for one, other in zip(still[-6:], moved[-6:], strict=True)]
    assert 0.05 < np.median(away) < 1.0
    assert max(away) < 2.5
    late = [other.boot_s - one.boot_s for one, other in zip(still[:6], moved[:6], strict=True)]
    assert np.std(np.diff(late)) > 0.02
    # Northerly wind of 8 m/s is 6.4 degrees of lean, forward where the nose looks north.
    leans = [
        math.degrees(-m.pitch) * math.cos(m.yaw) + math.degrees(m.roll) * -math.sin(m.yaw)
        for m in blown.heard
        if m.get_type() == "ATTITUDE" and 20 < m.time_boot_ms / 1e3 < 60
    ]
    assert 4.0 < np.median(leans) < 12.0
    assert blown.vehicle.body.at_m[2] == 0.0


def test_against_strong_wind_it_is_slow() -> None:
    assert flown(wind=Wind(14.0, 90.0)).vehicle.boot_s > flown().vehicle.boot_s + 5


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_told_places_err_as_stated_and_the_truth_is_kept_apart(flavour: Flavour) -> None:
    ratios: list[tuple[float, float]] = []
    for seed_drift in (0.9, 1.2, 1.5):
        ground = flown(flavour, gnss=Gnss(0.5, seed_drift))
        raw = next(m for m in ground.heard if m.get_type() == "GPS_RAW_INT")
        sigma_m = math.hypot(0.5, seed_drift)
        assert raw.h_acc == pytest.approx(1e3 * sigma_m, abs=1)
        assert raw.v_acc == pytest.approx(1e3 * VERTICAL * sigma_m, abs=1)
        kind = "CAMERA_FEEDBACK" if flavour == "ardupilot" else "CAMERA_IMAGE_CAPTURED"
        messages = [m for m in ground.heard if m.get_type() == kind]
        assert len(messages) == len(ground.vehicle.photos)
        for photo, message in zip(ground.vehicle.photos, messages, strict=True):
            told = told_m(message)
            assert math.dist(told, photo.believed_m) < 0.03
            error = np.subtract(told, photo.at_m)
            ratios.append((float(np.hypot(*error[:2])) / sigma_m, abs(float(error[2])) / sigma_m / VERTICAL))
    worst = np.max(ratios, axis=0)
    assert worst.min() > 0.5
    assert worst.max() < 4.5


def test_a_jump_goes_away_and_comes_back_and_velocity_does_not_show_it() -> None:
    ground = flown(gnss=Gnss(jump_every_s=15.0))
    assert ground.vehicle.receiver.jumps >= 2
    places = [m for m in ground.heard if m.get_type() == "GLOBAL_POSITION_INT"]
    steps = []
    for one, other in pairwise(places):
        passed_s = (other.time_boot_ms - one.time_boot_ms) / 1e3
        moved = np.subtract(told_m(other), told_m(one))[:2]
        flew = np.array([one.vy + other.vy, one.vx + other.vx]) / 200 * passed_s
        steps.append(float(np.hypot(*(moved - flew))))
    jumped = [step for step in steps if step > 1.0]
    assert 2 <= len(jumped) <= 2 * ground.vehicle.receiver.jumps
    assert all(2.5 < step < 10 for step in jumped)
    assert any(math.dist(p.at_m, p.believed_m) > 2.5 for p in ground.vehicle.photos)


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_power_cycle_in_the_air_begins_clock_numbers_and_streams_anew(flavour: Flavour) -> None:
    ground = flown(flavour, Faults(power_cycles_s=(30.0,), off_s=2.0))
    photos = ground.vehicle.photos
    (again,) = [n for n in range(1, len(photos)) if photos[n].index <= photos[n - 1].index]
    first = 1 if flavour == "ardupilot" else 0
    assert photos[again].index == first
    assert photos[again].boot_s < photos[again - 1].boot_s
    # The date goes on, and the vehicle kept on flying.
    assert all(a.utc_s < b.utc_s for a, b in pairwise(photos))
    assert min(photo.at_m[2] for photo in photos) > 20
    streamed = [n for n, m in enumerate(ground.heard) if m.get_type() == "ATTITUDE"]
    photo_messages = [
        n for n, m in enumerate(ground.heard) if m.get_type() in ("CAMERA_FEEDBACK", "CAMERA_TRIGGER")
    ]
    assert max(streamed) < photo_messages[again]
