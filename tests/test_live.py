"""Live status over real zenoh sessions on this computer's own network."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from calib.errors import InputError
from daemon.live.bus import Bus
from daemon.live.commands import Command, Commands, daemon_token, make_command, read_token
from daemon.live.fleet import Fleet, Vehicle
from daemon.live.network import leave, open_session
from daemon.live.schemas import Capture, Link, Log, Progress, Status, Verdict
from daemon.live.settings import Settings
from daemon.live.topics import QUERIES, TOPICS, topic_of, vehicle_name

T0 = datetime(2026, 5, 31, 10, tzinfo=UTC)
TOKEN = "a-token-of-good-length"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def status(vehicle: str, phase: str = "collecting") -> Status:
    return Status.model_validate({"vehicle": vehicle, "phase": phase, "session": "flight-1", "since": T0})


def verdict(vehicle: str, final: bool = False) -> Verdict:
    return Verdict(
        vehicle=vehicle, verdict="REFLY", final=final, at=T0, headline="Fly a circle.", photos=12, f_px=2300.5
    )


def until(what: Callable[[], bool], timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


def one(fleet: Fleet) -> Vehicle:
    (vehicle,) = fleet.vehicles()
    return vehicle


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    answers = {
        "session": lambda _: (b"{}", "application/json"),
        "report": lambda asked: (f"report {asked.get('format', 'json')}".encode(), "application/json"),
        "plan": lambda _: _none(),
    }
    with Bus("p3p", Settings(listen=(endpoint,)), answers) as made:
        yield made


def _none() -> tuple[bytes, str]:
    raise ValueError("There is no plan.")


def test_every_message_travels_and_late_joiners_get_the_last(bus: Bus, endpoint: str) -> None:
    messages = [
        status("p3p"),
        Link(vehicle="p3p", connected=True, battery=0.5),
        Capture(vehicle="p3p", triggers=10, confirmed=9, photos=8, warning="1 photo is missing."),
        Progress(vehicle="p3p", photos=8, aligned=7, stage="matching", done=3, of=9),
        verdict("p3p"),
        Log(vehicle="p3p", at=T0, level="info", text="Hello."),
    ]
    assert [topic_of(m).name for m in messages] == list(TOPICS)
    for message in messages:
        bus.tell(message)
    time.sleep(0.6)  # Everything is said; now somebody comes.
    with Fleet(Settings(connect=(endpoint,))) as fleet:
        fleet.wait(30, lambda found: bool(found) and len(found[0].heard) == len(TOPICS))
        found = one(fleet)
        assert (found.name, found.alive) == ("p3p", True)
        for message in messages:
            heard = found.heard[topic_of(message).name]
            assert heard.message.model_dump(exclude={"sent"}) == message.model_dump(exclude={"sent"})
            assert not heard.stale
            assert 0 <= heard.age_s < 10
        assert [line.text for line in found.log] == ["Hello."]
        # And from now on what is new, at once.
        bus.tell(status("p3p", "ended"))
        until(lambda: one(fleet).heard["status"].message.phase == "ended")  # type: ignore[attr-defined]


def test_what_holds_is_repeated_and_what_hurries_is_held_back(bus: Bus, endpoint: str) -> None:
    received: list[tuple[str, str]] = []
    session = open_session(Settings(connect=(endpoint,)))
    try:
        session.declare_subscriber(
            "fieldcal/p3p/*", lambda s: received.append((str(s.key_expr), str(s.encoding)))
        )
        time.sleep(0.5)
        before = time.monotonic()
        bus.tell(status("p3p"))
        for n in range(200):
            bus.tell(Capture(vehicle="p3p", photos=n))
            time.sleep(0.005)
        time.sleep(2.5)
    finally:
        past_s = time.monotonic() - before
        leave(session)
    kinds = [key.rsplit("/", 1)[1] for key, _ in received]
    assert 2 <= kinds.count("status") <= past_s / TOPICS["status"].every_s + 2
    assert 2 <= kinds.count("capture") <= past_s / TOPICS["capture"].least_s + 2
    assert ("fieldcal/p3p/status", "application/json;fieldcal.status/1") in received


def test_a_daemon_that_goes_is_seen_to_go(endpoint: str) -> None:
    bus = Bus("one", Settings(listen=(endpoint,)))
    bus.tell(status("one"))
    with Fleet(Settings(connect=(endpoint,))) as fleet:
        fleet.wait(30)
        assert one(fleet).alive
        bus.close()
        until(lambda: not one(fleet).alive)
        assert one(fleet).heard["status"].message.vehicle == "one"


def test_staleness_is_by_the_listeners_clock(bus: Bus, endpoint: str) -> None:
    now = [0.0]
    bus.tell(status("p3p"))
    bus.tell(verdict("p3p"))
    with Fleet(Settings(connect=(endpoint,)), clock=lambda: now[0]) as fleet:
        for _ in range(20):
            fleet.ask(0.5)
            if fleet.vehicles():
                break
        bus.close()
        now[0] = 100.0
        heard = one(fleet).heard
        assert heard["status"].stale
        assert heard["status"].age_s > 90
        assert not heard["verdict"].stale  # A verdict stays true.


def test_a_fleet_of_two_and_one_of_it(endpoint: str) -> None:
    second = f"tcp/127.0.0.1:{free_port()}"
    with Bus("a", Settings(listen=(endpoint,))) as first, Bus("b", Settings(listen=(second,))) as other:
        first.tell(status("a"))
        other.tell(status("b"))
        both = Settings(connect=(endpoint, second))
        with Fleet(both) as fleet, Fleet(both, "b") as only:
            fleet.wait(30, lambda found: len(found) == 2)
            assert [v.name for v in fleet.vehicles()] == ["a", "b"]
            only.wait(30)
            assert [v.name for v in only.vehicles()] == ["b"]


@pytest.mark.usefixtures("bus")
def test_what_can_be_asked_for(endpoint: str) -> None:
    with Fleet(Settings(connect=(endpoint,))) as fleet:
        fleet.wait(30, lambda found: any(v.alive for v in found))
        assert fleet.query("p3p", "session") == b"{}"
        assert fleet.query("p3p", "report", "format=html") == b"report html"
        with pytest.raises(InputError, match="There is no plan"):
            fleet.query("p3p", "plan")
        with pytest.raises(InputError, match="nobody is not there"):
            fleet.query("nobody", "session", timeout_s=0.5)
        with pytest.raises(InputError, match="takes no commands"):
            fleet.command("p3p", "finish", TOKEN, timeout_s=0.5)


def test_commands_only_with_the_token(endpoint: str) -> None:
    done: list[str] = []

    def finish() -> str:
        done.append("finish")
        return "Concluding."

    commands = Commands("p3p", TOKEN, {"finish": finish})
    with (
        Bus("p3p", Settings(listen=(endpoint,)), commands=commands),
        Fleet(Settings(connect=(endpoint,))) as fleet,
    ):
        fleet.wait(30, lambda found: any(v.alive for v in found))
        with pytest.raises(InputError, match="Refused"):
            fleet.command("p3p", "finish", "another-token-of-length")
        with pytest.raises(InputError, match="nothing called 'arm'"):
            fleet.command("p3p", "arm", TOKEN)
        assert done == []
        assert fleet.command("p3p", "finish", TOKEN) == "Concluding."
        assert done == ["finish"]


def test_commands_that_are_old_repeated_changed_or_for_another() -> None:
    commands = Commands("p3p", TOKEN, {"finish": lambda: "done"})
    good = make_command("p3p", "finish", TOKEN)

    def take(command: Command) -> str:
        return commands.take(command.model_dump_json(by_alias=True).encode())

    assert TOKEN not in good.model_dump_json()
    assert take(good) == "done"
    late = datetime.now(UTC) - timedelta(minutes=5)
    for bad in (
        good,
        good.model_copy(update={"nonce": "other"}),
        make_command("p4p", "finish", TOKEN),
        make_command("p3p", "finish", TOKEN).model_copy(update={"sent": late}).signed(TOKEN),
        make_command("p3p", "finish", TOKEN).model_copy(update={"sent": datetime(2026, 1, 1)}).signed(TOKEN),
        make_command("p3p", "finish", TOKEN).model_copy(update={"mac": "ü"}),
    ):
        with pytest.raises(ValueError, match="Refused"):
            take(bad)
    for junk in (b"", b"{}", b"\xff", b"[]"):
        with pytest.raises(ValueError, match="Refused"):
            commands.take(junk)


def test_the_token_is_made_once_and_kept_private(tmp_path: Path) -> None:
    file = tmp_path / "data" / "token"
    token = daemon_token(file)
    assert daemon_token(file) == token
    assert file.stat().st_mode & 0o777 == 0o600
    file.chmod(0o644)
    with pytest.raises(InputError, match="chmod 600"):
        daemon_token(file)
    file.write_text("short")
    with pytest.raises(InputError, match="too short"):
        read_token(file)
    with pytest.raises(InputError, match="cannot be read"):
        read_token(tmp_path / "none")


def test_junk_on_the_bus_is_passed_over(bus: Bus, endpoint: str) -> None:
    bus.tell(status("p3p"))
    stranger = open_session(Settings(connect=(endpoint,)))
    try:
        with Fleet(Settings(connect=(endpoint,))) as fleet:
            fleet.wait(30)
            newer = json.dumps({"schema": "fieldcal.status/2", "vehicle": "p3p"})
            for payload in (b"\xff", b"{}", newer.encode()):
                stranger.put("fieldcal/p3p/status", payload)
            time.sleep(0.3)
            assert one(fleet).heard["status"].message.model_dump()["phase"] == "collecting"
    finally:
        leave(stranger)


@pytest.mark.usefixtures("bus")
def test_what_makes_no_sense_is_refused_in_a_sentence(endpoint: str, tmp_path: Path) -> None:
    for settings in (
        Settings(listen=(endpoint,)),  # in use
        Settings(listen=("nonsense",)),
        Settings(connect=("tcp",)),
        Settings(config=tmp_path / "none.json5"),
    ):
        with pytest.raises(InputError) as error:
            open_session(settings)
        text = str(error.value)
        assert "/root" not in text
        assert ".rs" not in text
        assert text.count("\n") == 0


def test_a_dead_network_costs_nothing(endpoint: str) -> None:
    """Told at full rate to somebody who is not there."""
    with Bus(
        "p3p", Settings(connect=(endpoint,), mode="peer", listen=(f"tcp/127.0.0.1:{free_port()}",))
    ) as bus:
        before = time.monotonic()
        for n in range(1000):
            bus.tell(Log(vehicle="p3p", at=T0, level="info", text=str(n)))
        assert time.monotonic() - before < 5.0


def test_names_are_one_chunk_of_a_key() -> None:
    assert vehicle_name("Größe 3 / P3P**") == "groe-3-p3p"
    assert vehicle_name("$*?#/") == "vehicle"
    for name in ("Meine Drohne", "a/b", "*", "P3P-1"):
        key = TOPICS["status"].key(vehicle_name(name))
        assert str(zenoh.KeyExpr(key)) == key
        assert key.count("/") == 2
        assert "*" not in key


def test_the_docs_have_the_table() -> None:
    page = (Path(__file__).parent.parent / "docs" / "live.md").read_text(encoding="utf-8")
    for topic in TOPICS.values():
        stale = "-" if topic.stale_s is None else f"{topic.stale_s:g} s"
        key = topic.key("<vehicle>")
        assert f"| `{key}` | `{topic.schema_name}` | {topic.every_s:g} s | {stale} |" in page
    for name in (*QUERIES, "alive", "command"):
        assert f"| `fieldcal/<vehicle>/{name}` |" in page
