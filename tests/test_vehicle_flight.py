"""The simulated vehicle against MAVSDK: a plan is uploaded, flown fast, and every photo counted once."""

from __future__ import annotations

import asyncio
import math
from collections import Counter

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")
pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")

from daemon.link import events as ev
from daemon.link.decode import Context, decode, is_known
from daemon.link.message import Message
from daemon.link.progress import ProgressFilter
from daemon.link.triggers import Trigger, TriggerFilter
from mission import encode
from mission.encode import Flavour
from sim.faults.ends import free_port
from sim.vehicle import Faults, VehicleOptions, VehicleServer
from tests.mission_plans import LAUNCH, angle_deg, line, orbit, plan_of, triggered
from tests.vehicle_client import Client, client, from_mavsdk_items

PLAN = plan_of(*line(60.0, 10.0, 30.0), *orbit(6, radius=25.0, height=30.0), speed_m_s=5.0)
STREAMS = {30: 5.0, 33: 5.0, 2: 1.0, 42: 2.0, 147: 1.0, 1: 1.0, 285: 2.0, 24: 1.0, 242: 0.5}
SPEED_UP = 20.0
FEEDBACK, TRIGGER, CAPTURED, CAMERA = ev.PhotoSource


async def _fly(server: VehicleServer, url: str, flavour: Flavour) -> Client:
    sent = encode.items(PLAN, flavour)
    async with client(url) as one:
        await one.upload(sent)
        held = from_mavsdk_items(await asyncio.wait_for(one.mission.download_mission(), 15))
        assert encode.compare(sent, held, flavour) == []
        for message, rate in STREAMS.items():
            unasked = (flavour, message) == ("px4", 42)  # MISSION_CURRENT comes by itself
            assert await one.command(511, message, 1e6 / rate) == (4 if unasked else 0)
        if flavour == "ardupilot":  # the last photo again and again
            assert await one.command(511, 180, 1e6 / 5) == 0
        assert await one.command(400, 1) == 0
        assert await one.command(300) == 0
        server.speed_up = SPEED_UP
        await one.until(lambda: server.vehicle.done, 120)
        await asyncio.sleep(0.3)
    return one


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_plan_is_flown_and_each_photo_counted_once(flavour: Flavour) -> None:
    port = free_port()
    faults = Faults(drop_share=0.25, repeat_share=0.25, delay_s=0.01, jitter_s=0.01)
    options = VehicleOptions(flavour, LAUNCH, camera_component=flavour == "ardupilot")
    with VehicleServer(options, ("127.0.0.1", port), faults=faults, seed=3) as server:
        heard = asyncio.run(_fly(server, f"udpin://127.0.0.1:{port}", flavour)).heard
    truth, want = server.vehicle.photos, triggered(PLAN)
    assert len(truth) == len(want)
    for photo, station in zip(truth, want, strict=True):
        assert math.dist(photo.at_m, (station.east_m, station.north_m, station.height_m)) < 1.0
        assert angle_deg(photo.yaw_deg, station.yaw_deg) < 3
        assert abs(photo.pitch_deg - station.pitch_deg) <= 0.51

    context = Context(ev.Autopilot(flavour), servo_mount=True)
    triggers, progress = TriggerFilter(), ProgressFilter()
    kinds: Counter[str] = Counter()
    for at, message in heard:
        assert is_known(message.name), message.name
        kinds[message.name] += 1
        event = decode(message, context)
        if isinstance(event, ev.PhotoReport):
            triggers.add(event, at * SPEED_UP)
        elif isinstance(event, ev.Heartbeat | ev.MissionCurrent | ev.ItemReached):
            progress = progress.add(event)
    told = {_index(photo): photo for photo in triggers.photos}
    assert len(told) == len(triggers.photos)
    assert set(told) == _numbers_heard(heard, flavour)
    assert set(triggers.lost()) == set(range(min(told), max(told))) - set(told)
    if flavour == "ardupilot":  # repeated until the next photo, no one is lost
        assert set(told) == {p.index for p in truth}
    utc_s = server.vehicle.options.boot_utc_s
    for photo in truth:
        if photo.index in told:
            _same_photo(told[photo.index], photo.boot_s, utc_s, photo.at_m)
    assert progress.progress.state is ev.MissionState.COMPLETE
    if flavour == "ardupilot":
        assert kinds["CAMERA_FEEDBACK"] > 2 * len(truth)


def _numbers_heard(heard: list[tuple[float, Message]], flavour: Flavour) -> set[int]:
    """What came over the link at all, read apart from the decode table."""
    fields = {"CAMERA_FEEDBACK": "img_idx", "CAMERA_TRIGGER": "seq", "CAMERA_IMAGE_CAPTURED": "image_index"}
    camera_counts_from = 1 if flavour == "ardupilot" else 0
    found = set()
    for _, message in heard:
        if message.name in fields and (message.name, message.integer("time_usec")) != ("CAMERA_FEEDBACK", 0):
            shift = camera_counts_from if message.name == "CAMERA_IMAGE_CAPTURED" else 0
            found.add(message.integer(fields[message.name]) + shift)
    return found


def _index(photo: Trigger) -> int:
    """The vehicle's own number, whoever told it."""
    for source, first in ((FEEDBACK, 0), (TRIGGER, 0), (CAPTURED, 0), (CAMERA, 1)):
        index = photo.index(source)
        if index is not None:
            return index + first
    raise AssertionError("a photo without a number")


def _same_photo(told: Trigger, boot_s: float, boot_utc_s: float, at_m: tuple[float, float, float]) -> None:
    if told.utc_s is not None:
        assert told.utc_s - boot_utc_s == pytest.approx(boot_s, abs=1e-3)
    else:
        assert told.vehicle_boot_s == pytest.approx(boot_s, abs=1e-3)
    if told.latitude_deg is not None and told.longitude_deg is not None and told.altitude_msl_m is not None:
        place = (np.array([v]) for v in (told.latitude_deg, told.longitude_deg, told.altitude_msl_m))
        assert math.dist(LAUNCH.enu(*place)[0].tolist(), at_m) < 0.05
