"""``fieldcal correct``: shift, scale and tilt taken out of a cloud, and what then remains."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from calib.assess.remedy import Bar, Correction, correction
from calib.assess.words import SEVEN_WORDS
from calib.camera import FloatArray
from calib.clouds import load_cloud, open_cloud, rewrite
from calib.clouds.sparse import move_sparse
from calib.control_files import read_points
from calib.errors import InputError
from calib.files import check_file_writable
from calib.wording import path_text, quantity
from daemon.output import JsonOption, console, table, write_json
from daemon.terminal import paragraph

SCHEMA = "fieldcal.correction/1"


def correct_command(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="LAS, LAZ, PLY, XYZ or CSV.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The corrected cloud, same format.")],
    point: Annotated[
        str | None,
        typer.Option("--point", metavar="P=X,Y,Z", help="A point in the cloud and where it truly is: shift."),
    ] = None,
    bar: Annotated[
        list[str] | None,
        typer.Option("--bar", metavar="P:P=M", help="Two points and their true distance: scale. Repeatable."),
    ] = None,
    level: Annotated[
        list[str] | None,
        typer.Option("--level", metavar="P:P", help="Two points at one height: tilt. Give it twice."),
    ] = None,
    dem: Annotated[
        Path | None, typer.Option("--dem", metavar="FILE", help="A trusted height model: tilt and height.")
    ] = None,
    measured: Annotated[
        Path | None,
        typer.Option("--measured", metavar="FILE", help="Points picked in the cloud by name: CSV."),
    ] = None,
    reading_sigma_m: Annotated[
        float, typer.Option("--reading-sigma", metavar="M", help="How well a point is picked in the cloud.")
    ] = 0.02,
    sparse: Annotated[
        Path | None,
        typer.Option("--sparse", metavar="DIR", help="A COLMAP text model to be corrected as well."),
    ] = None,
    sparse_out: Annotated[
        Path | None, typer.Option("--sparse-out", metavar="DIR", help="Folder for the corrected model.")
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Shift, scale and level a cloud by a point, bars, levels or a height model; say what remains.

    P is x,y,z in the cloud, or a name of --measured.
    """
    if not (np.isfinite(reading_sigma_m) and reading_sigma_m > 0):
        raise InputError(f"--reading-sigma must be a positive number of metres, not {reading_sigma_m:g}.")
    if (sparse is None) != (sparse_out is None):
        raise InputError("--sparse and --sparse-out belong together.")
    file = open_cloud(cloud)
    if out.exists() and out.resolve() == cloud.resolve():
        raise InputError(f"{out} is the cloud itself, which is never changed; give another name.")
    if out.suffix.lower() != cloud.suffix.lower():
        raise InputError(f"{out} must end as the cloud does ({cloud.suffix}): the format stays.")
    check_file_writable(out)
    names = {} if measured is None else {p.name: np.array(p.xyz_m) for p in read_points(measured)}
    bars = [_bar(text, names, True) for text in bar or []]
    levels = [_bar(text, names, False) for text in level or []]
    at = None if point is None else _point(point, names)
    height_model = None if dem is None else load_cloud(open_cloud(dem))
    made = correction(load_cloud(file), at, bars, levels, height_model, reading_sigma_m)
    rewrite(file, out, made.moved)
    if sparse is not None and sparse_out is not None:
        move_sparse(sparse, sparse_out, made.moved)
    if json_to is not None:
        write_json(_as_json(made, out), json_to)
    if json_to != "-":
        _show(made, out)


def _place(text: str, names: Mapping[str, FloatArray], option: str) -> FloatArray:
    if text.strip() in names:
        return names[text.strip()]
    try:
        numbers = np.array([float(cell) for cell in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(f"{option}: {text} is neither x,y,z nor a name in --measured.")
    return numbers


def _point(text: str, names: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    there, sign, true = text.partition("=")
    if not sign:
        raise InputError("--point needs both places: P=X,Y,Z.")
    return _place(there, names, "--point"), _place(true, {}, "--point")


def _bar(text: str, names: Mapping[str, FloatArray], with_length: bool) -> Bar:
    option = "--bar" if with_length else "--level"
    ends, sign, length = text.partition("=")
    start, colon, end = ends.partition(":")
    if not colon or bool(sign) != with_length:
        raise InputError(f"{option} needs {'P:P=LENGTH' if with_length else 'P:P'}, not {text}.")
    try:
        metres = float(length) if with_length else None
    except ValueError:
        metres = float("nan")
    if metres is not None and not (np.isfinite(metres) and metres > 0):
        raise InputError(f"{option}: {length} is no length in metres.")
    made = Bar(ends, _place(start, names, option), _place(end, names, option), metres)
    if not made.measured_m > 0:
        raise InputError(f"{option}: both ends of {ends} are the same place.")
    return made


def _as_json(made: Correction, out: Path) -> dict[str, object]:
    return {
        "schema": SCHEMA,
        "written": path_text(out),
        "scale": made.moved.scale,
        "rotation": made.moved.rotation.tolist(),
        "shift_m": made.moved.shift.tolist(),
        "tilt_deg": made.tilt_deg,
        "remains": [
            {"name": r.name, "fixed_by": r.fixed_by, "sigma": r.sigma, "at_edge_m": r.at_edge_m}
            for r in made.remains
        ],
        "notes": list(made.notes),
    }


def _show(made: Correction, out: Path) -> None:
    say = console()
    done = []
    if made.shift_m is not None:
        done.append(f"shifted by {', '.join(f'{v:+.3f}' for v in made.shift_m)} m")
    if made.scale is not None:
        done.append(f"scaled by {made.scale:.6f}")
    if made.tilt_deg is not None:
        done.append(f"tilted by {made.tilt_deg:.3f} degrees")
    paragraph(say, f"The cloud was {', '.join(done)}.")
    say.print()
    rows = table("what remains", "", "fixed by", "1 sigma", "at the edge", numbers=("at the edge",))
    for left in made.remains:
        words, unit = SEVEN_WORDS[left.name]
        size = quantity(left.sigma, None, unit, 2)
        edge = quantity(left.at_edge_m, None, "m", 2)
        if left.fixed_by is None:
            rows.add_row(words, left.name, "nothing", f"up to {size}", f"up to {edge}")
        else:
            rows.add_row(words, left.name, left.fixed_by, size, edge)
    say.print(rows)
    if any(left.fixed_by is None for left in made.remains):
        paragraph(
            say,
            'Fixed by nothing: still as it was. "Up to" is the worst of eight published flights without '
            "control; fieldcal assess measures it against reference points.",
            "dim",
        )
    paragraph(say, "No shift, scale or tilt takes out a dome, a dish or noise.", "dim")
    for note in made.notes:
        paragraph(say, note)
    say.print(Text(f"Wrote {path_text(out)}"), soft_wrap=True)
