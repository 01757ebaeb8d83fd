"""The upload transaction against the simulated vehicle over real sockets, in both flavours."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from calib.errors import FormatError, InputError, OutputError
from daemon.link import upload as transaction
from daemon.link.upload import NotAllowedError, Outcome, Result, Terms
from daemon.link.vehicle_mission import read_held, write_held
from mission import encode
from mission.encode import Flavour
from mission.encode.fence_items import compare_fence, fence_items
from mission.fence import Circle, Fence
from sim.faults import LineFaults, Moment, MomentKind, random_recipe
from sim.vehicle import Faults
from sim.vehicle.pilot import Mode
from tests.link_flights import BRISK, NEW, OLD, OTHER, Flight, flight, until

FENCE = Fence(
    keep_in=(((47.01, 8.49), (47.01, 8.51), (46.99, 8.51), (46.99, 8.49)),),
    circles=(Circle(47.002, 8.502, 12.5, inside=False),),
)
#: Seeds of the campaign in miniature: every kind of fault three times or more.
SEEDS = range(24)


def harmless(sent: list[Any]) -> bool:
    """Nothing that arms, starts, changes a mode or a setting was sent."""
    names = Counter(message.get_type() for message in sent)
    commands = {message.command for message in sent if message.get_type() == "COMMAND_LONG"}
    others = set(names) - {
        *("HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK"),
        *("MISSION_CLEAR_ALL", "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "PARAM_REQUEST_READ"),
    }
    current = {message.current for message in sent if message.get_type() == "MISSION_ITEM_INT"}
    return not others and commands <= {511, 512} and current <= {0, 1} and names["HEARTBEAT"] > 0


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_mission_and_its_fence(flavour: Flavour, tmp_path: Path) -> None:
    with flight(flavour, tmp_path) as f:
        steps: list[tuple[str, int, int]] = []
        mission = replace(f.new, fence=fence_items(FENCE))
        result = transaction.upload(
            f.link, mission, lambda: True, tmp_path / "kept", BRISK, lambda *step: steps.append(step)
        )
        assert result.outcome is Outcome.UPLOADED, result.message
        assert f.holds(mission.items)
        assert compare_fence(mission.fence or (), f.server.vehicle.transfer.stored[1]) == []
        assert len(mission.fence or ()) == 5
        vehicle = f.server.vehicle
        assert (vehicle.pilot.armed, vehicle.pilot.mode) == (False, Mode.MANUAL)
        assert harmless(f.sent)
        # What it held before was kept, and can be brought back.
        assert result.kept is not None
        before = read_held(result.kept)
        assert encode.compare(f.old, before.mission, flavour) == []
        assert before.fence == ()
        back = transaction.Mission("kept", flavour, before.mission, before.fence)
        assert (
            transaction.upload(f.link, back, lambda: True, tmp_path / "kept", BRISK).outcome
            is Outcome.UPLOADED
        )
        assert f.holds(f.old)
        assert vehicle.transfer.stored[1] == []
        assert len(list((tmp_path / "kept").glob("*.json"))) == 2
        names = {name for name, _, _ in steps}
        assert names <= {"reading the old mission", "reading the old fence", "uploading", "reading back"}


def test_without_the_word_nothing_is_sent(tmp_path: Path) -> None:
    with flight("ardupilot", tmp_path) as f:
        result = f.upload(word=lambda: False)
        assert result.outcome is Outcome.REFUSED
        assert not [m for m in f.sent if m.get_type().startswith("MISSION_")]
        assert f.holds(f.old)
        assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_only_disarmed_or_holding(flavour: Flavour, tmp_path: Path) -> None:
    holding = replace(BRISK, holding=True)
    with flight(flavour, tmp_path) as f:
        pilot = f.server.vehicle.pilot
        pilot.arm(True)
        until(lambda: "armed" in (transaction.why_not(f.link.state, f.link.now_s()) or ""))
        with pytest.raises(NotAllowedError, match="land and disarm it first"):
            f.upload()
        with pytest.raises(NotAllowedError, match="does not hold"):
            f.upload(holding)
        assert not [m for m in f.sent if m.get_type().startswith("MISSION_")]
        pilot.set_mode(Mode.HOLD)
        until(lambda: transaction.why_not(f.link.state, f.link.now_s(), True) is None)
        with pytest.raises(NotAllowedError):
            f.upload()
        done = f.upload(holding)
        assert done.outcome is Outcome.UPLOADED
        # It would begin the new mission in its middle, and fieldcal does not touch that.
        assert ("restart the mission" in done.message) is (flavour == "ardupilot")
        assert (pilot.armed, pilot.mode) == (True, Mode.HOLD)
        assert harmless(f.sent)


def test_armed_while_the_operator_thinks(tmp_path: Path) -> None:
    with flight("px4", tmp_path) as f:

        def word() -> bool:
            f.server.vehicle.pilot.arm(True)  # no heartbeat has told it yet
            return True

        with pytest.raises(NotAllowedError, match="armed"):
            f.upload(word=word)
        assert f.holds(f.old)


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_refused_item_and_the_old_mission_is_back(flavour: Flavour, tmp_path: Path) -> None:
    with flight(flavour, tmp_path, faults=Faults(reject_item=7)) as f:
        result = f.upload()
        # ArduPilot has stored six items by then, PX4 none.
        assert result.outcome is (Outcome.RESTORED if flavour == "ardupilot" else Outcome.INTACT)
        assert "refused the mission at item 7" in result.message
        assert f.holds(f.old)
        assert result.kept is not None
        assert result.kept.exists()
        assert f.upload().outcome is Outcome.UPLOADED


def test_an_empty_vehicle_is_empty_again(tmp_path: Path) -> None:
    with flight("ardupilot", tmp_path, faults=Faults(reject_item=7)) as f:
        f.server.vehicle.transfer.stored[0] = []
        result = f.upload()
        assert result.outcome is Outcome.RESTORED
        assert f.server.vehicle.transfer.mission == []


def test_an_interrupted_upload_is_undone(tmp_path: Path) -> None:
    """Ctrl-C in the middle: the old mission comes back before the program ends."""
    with flight("ardupilot", tmp_path, LineFaults(delay_s=0.05)) as f:

        def interrupt(step: str, done: int, total: int) -> None:
            del total
            if step == "uploading" and done > 5:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            transaction.upload(f.link, f.new, lambda: True, tmp_path / "kept", BRISK, interrupt)
        assert f.holds(f.old)
        # A marker stays, as after a kill, until an upload has come to its end.
        assert transaction.cut_off(tmp_path / "kept") is not None
        assert f.upload().outcome is Outcome.UPLOADED
        assert transaction.cut_off(tmp_path / "kept") is None


def test_a_link_that_does_not_come_back_is_said(tmp_path: Path) -> None:
    forever = LineFaults(moments=(Moment(25, MomentKind.CUT, 1e9),))
    with flight("ardupilot", tmp_path, forever) as f:
        result = f.upload(replace(BRISK, restore_s=3.0))
        assert result.outcome is Outcome.UNSURE
        assert "DO NOT FLY" in result.message
        assert result.kept is not None
        assert transaction.cut_off(tmp_path / "kept") == result.kept
        assert encode.compare(f.old, read_held(result.kept).mission, "ardupilot") == []


def test_an_old_mission_that_cannot_be_kept_stays(tmp_path: Path) -> None:
    with flight("px4", tmp_path) as f:
        (tmp_path / "kept").write_text("a file")
        with pytest.raises(OutputError):
            f.upload()
        assert f.holds(f.old)
        assert not [m for m in f.sent if m.get_type() == "MISSION_COUNT"]


def test_another_autopilots_mission(tmp_path: Path) -> None:
    with flight("px4", tmp_path) as f:
        wrong = transaction.Mission("x", "ardupilot", encode.items(NEW, "ardupilot"))
        with pytest.raises(NotAllowedError, match="written for ardupilot"):
            transaction.upload(f.link, wrong, lambda: True, tmp_path, Terms())


@pytest.mark.slow
def test_the_old_mission_is_intact_after_every_failed_upload(tmp_path: Path) -> None:
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda seed: _faulty(seed, tmp_path / str(seed)), SEEDS))
    for seed, (result, held, sent) in zip(SEEDS, found, strict=True):
        text = f"seed {seed}: {result}, the vehicle holds the {held} mission"
        expected = "new" if result is not None and result.outcome is Outcome.UPLOADED else "old"
        assert held == expected, text
        assert result is None or result.outcome is not Outcome.UNSURE, text
        assert harmless(sent), text
    outcomes = Counter(None if result is None else result.outcome for result, _, _ in found)
    assert outcomes[Outcome.UPLOADED] >= 8, outcomes
    assert outcomes[Outcome.RESTORED] >= 3, outcomes


def _faulty(seed: int, folder: Path) -> tuple[Result | None, str, list[Any]]:
    """(None: not begun, what the vehicle holds at the end, what was sent)."""
    flavour = encode.FLAVOURS[seed // 6 % 2]
    items, old = encode.items(NEW, flavour), encode.items(OLD, flavour)
    recipe = random_recipe(seed, len(items), len(old), longest_s=5.0)
    with flight(flavour, folder, recipe.line, recipe.vehicle, seed) as f:
        try:
            result: Result | None = f.upload()
        except NotAllowedError:
            result = None
        return result, _held(f), f.sent


def _held(f: Flight) -> str:
    for name, plan in (("old", OLD), ("new", NEW), ("other", OTHER)):
        if f.holds(encode.items(plan, f.flavour)):
            return name
    return "mixed"


def test_a_kept_mission_survives_its_file(tmp_path: Path) -> None:
    held = transaction.Held("px4", encode.items(NEW, "px4"), fence_items(FENCE))
    one, other = write_held(held, tmp_path), write_held(held, tmp_path)
    assert one != other
    again = read_held(one)
    assert held.differences(again) == []
    assert again.differences(replace(again, mission=again.mission[:-1])) != []
    assert again.differences(replace(again, fence=())) != []
    assert one.with_suffix(".waypoints").read_text().startswith("QGC WPL 110")
    text = json.loads(one.read_text())
    for damaged in ({**text, "mission": [{"command": 1}]}, {**text, "schema": "x"}, []):
        one.write_text(json.dumps(damaged))
        with pytest.raises(FormatError, match="not a mission kept"):
            read_held(one)
    with pytest.raises(InputError):
        read_held(tmp_path / "none.json")
