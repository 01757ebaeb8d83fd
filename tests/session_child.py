"""A process that writes a flight's record and says over a pipe what was acknowledged, until it is killed."""

from __future__ import annotations

import json
import random
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from daemon.session.rows import (
    ClockName,
    Event,
    Pair,
    Pairing,
    PhotoFile,
    Plan,
    SolutionRecord,
    Stamp,
    Trigger,
)
from daemon.session.store import Session


def write_until_killed(folder: Path, seed: int, pipe: Connection) -> None:
    """Write rows of all kinds at random; each is sent as (table, seq, content) once it is acknowledged."""
    rng = random.Random(seed)
    with Session.resume(folder) as session:
        while True:
            if rng.random() < 0.2:
                with session.batch():
                    rows = [_write(session, rng, seed) for _ in range(rng.randint(2, 6))]
            else:
                rows = [_write(session, rng, seed)]
            pipe.send_bytes(json.dumps(rows).encode())


def _write(session: Session, rng: random.Random, seed: int) -> tuple[str, int, Any]:
    token = rng.getrandbits(48)
    at = Stamp(rng.random() * 1e9, ClockName.BOOT)
    kind = rng.choice(["events", "triggers", "photos", "plans", "solutions", "pairings"])
    if kind == "events":
        noise = "x" * rng.choice([0, 10, 5000])
        return kind, session.add_event(Event("test", at, {"token": token, "noise": noise})).seq, token
    if kind == "triggers":
        return kind, session.add_trigger(Trigger(f"{seed}/{token}", at)).seq, f"{seed}/{token}"
    if kind == "photos":
        photo = PhotoFile(Path(f"{seed}-{token}.jpg"), f"{token:064x}", token)
        return kind, session.add_photo(photo).seq, token
    if kind == "plans":
        content = rng.randbytes(rng.choice([10, 20_000]))
        return kind, session.add_plan(Plan(str(token), content)).seq, [str(token), content.hex()]
    if kind == "solutions":
        return kind, session.add_solution(SolutionRecord(0, {"token": token})).seq, token
    counts = session.counts()
    few = min(counts.photos, counts.triggers, 20)
    pairs = tuple(Pair(n, n, 0.5, False) for n in range(1, few + 1))
    pairing = Pairing(pairs, counts.photos, counts.triggers, {"token": token})
    return kind, session.add_pairing(pairing).seq, [token, few]
