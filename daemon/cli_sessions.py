"""``fieldcal sessions``: the flights recorded on this computer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.errors import InputError
from calib.wording import VERDICT_WORDS, printable
from daemon.capture.tagging import Kind, tag_photos
from daemon.output import JsonOption, console, table, write_json
from daemon.session.as_json import session_json, state_of, summary_json
from daemon.session.export import export_session
from daemon.session.library import Summary, find, list_sessions, sessions_folder, summarise
from daemon.session.reader import SessionReader

LIST_SCHEMA = "fieldcal.sessions/1"

app = typer.Typer(
    help="List, show, geotag and export recorded flights.", invoke_without_command=True, rich_markup_mode=None
)
NameArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="A flight, or the beginning of its name that no other has.")
]


@app.callback()
def sessions(context: typer.Context) -> None:
    """List, show, geotag and export recorded flights."""
    if context.invoked_subcommand is None:
        list_flights()


@app.command("list")
def list_flights(json_to: JsonOption = None) -> None:
    """List all flights, the newest first."""
    summaries, faults = list_sessions()
    if json_to is not None:
        flights = [summary_json(summary) for summary in summaries]
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
            state_of(summary),
        )
    out.print(rows)
    for fault in faults:
        out.print(f"Left out: {printable(fault)}")


@app.command()
def show(name: NameArgument, json_to: JsonOption = None) -> None:
    """Show one flight: what was recorded, its verdict, what is unfinished."""
    with SessionReader.open(find(name)) as session:
        if json_to is not None:
            write_json(session_json(session), json_to)
            return
        summary = summarise(session)
        verdict, plans, provenance = session.latest_verdict(), session.plans(), session.provenance()
        folder = session.folder
    counts = summary.counts
    facts = table("", "")
    facts.show_header = False
    for label, value in (
        ("date", f"{summary.created:%Y-%m-%d %H:%M:%S} UTC"),
        ("state", state_of(summary)),
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


@app.command()
def geotag(
    name: NameArgument,
    out_dir: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where to (default: the flight's folder).")
    ] = None,
    kind: Annotated[Kind, typer.Option("--as", help="Copies of the photos, or XMP files.")] = Kind.SIDECARS,
) -> None:
    """Write the positions from the vehicle's link for photos that have none; originals stay as they are."""
    with SessionReader.open(find(name)) as session:
        if not session.counts().triggers:
            raise InputError(f"No vehicle told of photos in flight {session.folder.name}: nothing to write.")
        folder = out_dir or session.folder / kind.value
        done = tag_photos(session, folder, kind)
    console().print(printable(done.sentence(folder)), soft_wrap=True)


def _verdict_words(summary: Summary) -> str:
    if summary.verdict is None:
        return "-"
    return VERDICT_WORDS[summary.verdict] + ("" if summary.final else " (so far)")
