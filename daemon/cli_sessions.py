"""``fieldcal sessions``: the flights recorded on this computer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from calib.wording import VERDICT_WORDS, printable
from daemon.output import console, table, write_json
from daemon.session.export import export_session
from daemon.session.library import Summary, find, list_sessions, sessions_folder, summarise
from daemon.session.reader import SessionReader

LIST_SCHEMA, SHOW_SCHEMA = "fieldcal.sessions/1", "fieldcal.session/1"

app = typer.Typer(
    help="List, show and export recorded flights.", invoke_without_command=True, rich_markup_mode=None
)
NameArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="A flight, or the beginning of its name that no other has.")
]
JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE|-", help="Write JSON (-: to stdout and nothing else)."),
]


@app.callback()
def sessions(context: typer.Context) -> None:
    """List, show and export recorded flights."""
    if context.invoked_subcommand is None:
        list_flights()


@app.command("list")
def list_flights(json_to: JsonOption = None) -> None:
    """List all flights, the newest first."""
    summaries, faults = list_sessions()
    if json_to is not None:
        flights = [_summary_json(summary) for summary in summaries]
        write_json({"schema": LIST_SCHEMA, "flights": flights, "faults": list(faults)}, json_to)
        return
    out = console()
    if not summaries and not faults:
        out.print(f"No flight is recorded in {sessions_folder()}.")
        return
    rows = table("name", "date", "photos", "verdict", "state", numbers=("photos",))
    for summary in summaries:
        rows.add_row(
            printable(summary.name),
            f"{summary.created:%Y-%m-%d}",
            str(summary.counts.photos),
            _verdict_words(summary),
            _state(summary),
        )
    out.print(rows)
    for fault in faults:
        out.print(f"Left out: {printable(fault)}")


@app.command()
def show(name: NameArgument, json_to: JsonOption = None) -> None:
    """Show one flight: what was recorded, its verdict, what is unfinished."""
    with SessionReader.open(find(name)) as session:
        if json_to is not None:
            write_json(_session_json(session), json_to)
            return
        summary = summarise(session)
        verdict, plans, provenance = session.latest_verdict(), session.plans(), session.provenance()
        folder = session.folder
    counts = summary.counts
    facts = table("", "")
    facts.show_header = False
    for label, value in (
        ("date", f"{summary.created:%Y-%m-%d %H:%M:%S} UTC"),
        ("state", _state(summary)),
        ("plans", ", ".join(printable(plan.value.name) for plan in plans) or "none"),
        ("triggers", str(counts.triggers)),
        ("photos", str(counts.photos)),
        ("pairings", str(counts.pairings)),
        ("solutions", str(counts.solutions)),
        ("verdicts", str(counts.verdicts)),
        ("events", str(counts.events)),
        ("fieldcal", ", ".join(dict.fromkeys(p.value.versions.get("fieldcal", "?") for p in provenance))),
    ):
        facts.add_row(label, value)
    out = console()
    out.print(printable(summary.name))
    out.print(facts)
    out.print()
    if verdict is None:
        out.print("There is no verdict yet.")
    else:
        out.print(f"{_verdict_words(summary)}: {printable(verdict.value.report['headline'])}")
        if verdict.value.report.get("what_to_fly"):
            out.print(printable(verdict.value.report["what_to_fly"]))
    for sentence in summary.unfinished.sentences():
        out.print(f"Unfinished: {sentence}")
    out.print(f"Folder: {printable(str(folder))}", soft_wrap=True)


@app.command()
def export(
    name: NameArgument,
    out_path: Annotated[
        Path, typer.Option("--out", metavar="FOLDER|FILE.zip", help="Folder or zip file to make.")
    ],
    replace: Annotated[bool, typer.Option("--replace", help="Replace an earlier export there.")] = False,
) -> None:
    """Copy a flight: database, plans, report, exports, and a MANIFEST with checksums."""
    with SessionReader.open(find(name)) as session:
        done = export_session(session, out_path, replace)
    out = console()
    did = "Replaced" if done.replaced else "Wrote"
    size = f"{done.size_bytes / 1e6:.1f} MB" if done.size_bytes >= 1e5 else f"{done.size_bytes / 1e3:.0f} kB"
    out.print(f"{did} {printable(str(done.target))} ({done.files} files, {size}).")


def _verdict_words(summary: Summary) -> str:
    if summary.verdict is None:
        return "-"
    return VERDICT_WORDS[summary.verdict] + ("" if summary.final else " (so far)")


def _state(summary: Summary) -> str:
    if summary.held:
        return "recording"
    return "unfinished" if summary.unfinished.resumable else "finished"


def _summary_json(summary: Summary) -> dict[str, Any]:
    counts, rest = summary.counts, summary.unfinished
    return {
        "name": printable(summary.name),
        "created": summary.created.isoformat(),
        "state": _state(summary),
        "verdict": None if summary.verdict is None else summary.verdict.value,
        "final": summary.final,
        "counts": {
            "plans": counts.plans,
            "events": counts.events,
            "triggers": counts.triggers,
            "photos": counts.photos,
            "pairings": counts.pairings,
            "solutions": counts.solutions,
            "verdicts": counts.verdicts,
        },
        "unfinished": {
            "ended": rest.ended,
            "unseen_photos": rest.unseen_photos,
            "lonely_photos": rest.lonely_photos,
            "lonely_triggers": rest.lonely_triggers,
            "behind": rest.behind,
            "final_verdict": rest.final_verdict,
        },
    }


def _session_json(session: SessionReader) -> dict[str, Any]:
    verdict = session.latest_verdict()
    return {
        "schema": SHOW_SCHEMA,
        **_summary_json(summarise(session)),
        "plans": [
            {
                "name": printable(p.value.name),
                "recorded": p.recorded.isoformat(),
                "bytes": len(p.value.content),
            }
            for p in session.plans()
        ],
        "provenance": [
            {"recorded": p.recorded.isoformat(), "versions": dict(p.value.versions)}
            for p in session.provenance()
        ],
        "report": None if verdict is None else dict(verdict.value.report),
    }
