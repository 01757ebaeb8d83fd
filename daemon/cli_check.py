"""``fieldcal check``: photos of one flight in, a verdict out."""

from __future__ import annotations

import sys
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from calib.check import Options, check_photos, read_set
from calib.errors import InputError
from calib.files import check_file_writable, output_folder, write_text_atomic
from calib.findings import State
from calib.onsite_rules import REFERENCE_SIGMA_PERCENT
from calib.output import write_outputs
from calib.photos.sort import require_block
from calib.references import check_saving, load_reference, reference_from_estimate, save_reference
from calib.report_json import report_json
from calib.result import CheckResult
from calib.wording import VERDICT_WORDS, printable
from daemon.advice import what_to_fly
from daemon.output import console, write_stdout
from daemon.pass_book import PassFinder
from daemon.progress import progress_line
from daemon.terminal import print_summary

DEFAULT_OUT = Path("fieldcal-out")


def check(
    photos: Annotated[
        list[Path], typer.Argument(metavar="PATH...", help="Photos, or folders of photos.", readable=False)
    ],
    reference: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Hold the calibration against this reference.")
    ] = None,
    fixed: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE", help="Hold the lens at this reference: nothing is self-calibrated."
        ),
    ] = None,
    with_folder: Annotated[
        Path | None,
        typer.Option(
            "--with", metavar="CHECK_OUTPUT", help="These photos are the extra pass for this check's survey."
        ),
    ] = None,
    save_reference_as: Annotated[
        str | None,
        typer.Option("--save-reference", metavar="NAME", help="Keep this calibration as a reference."),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Where the report and the exports go.", readable=False)
    ] = DEFAULT_OUT,
    json_to: Annotated[
        str | None,
        typer.Option("--json", metavar="FILE|-", help="Also write report.json here, or to stdout."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Only the verdict; no progress.")] = False,
) -> int:
    """Can this survey's camera calibration be trusted? Exit code 0 TRUST, 3 REFLY, 4 CANNOT TELL."""
    # What can be refused at once is refused before a minute's work.
    if fixed is not None and (reference is not None or save_reference_as is not None):
        raise InputError(
            "--fixed names the reference to hold the lens at; leave --reference and --save-reference away."
        )
    reference = reference if fixed is None else fixed
    if save_reference_as is not None:
        check_saving(save_reference_as)
    if reference is not None:
        load_reference(reference)
    passes = PassFinder(with_folder, out)
    passes.check_folder()
    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    with progress_line(hidden, "starting") as report:
        found = read_set(photos, report, passes.complete)
        require_block(found)
        with output_folder(out):
            # The file may be meant for the output folder, which is there only from here on.
            if json_to is not None and json_to != "-":
                check_file_writable(Path(json_to))
            result = check_photos(found, Options(reference, fixed is not None), report)
            result = replace(result, what_to_fly=what_to_fly(result), extra_pass=passes.extra_pass)
            result = replace(result, exports=write_outputs(result, out))
    if json_to == "-":
        write_stdout(report_json(result))
    elif json_to is not None:
        write_text_atomic(Path(json_to), report_json(result))
    _show(result, (*found.notes, *passes.notes), out, quiet, to_stderr=json_to == "-")
    if save_reference_as is not None:
        print(printable(_save(result, save_reference_as)), file=sys.stderr)
    return result.verdict.exit_code


def _save(result: CheckResult, name: str) -> str:
    estimate = result.estimate
    sigma = 100 * estimate.sigma_f_px / estimate.brown.f_px
    broken = [
        f.rule
        for f in result.findings
        if f.state is State.FLAG and f.rule in ("alignment", "cross-validation")
    ]
    if sigma > REFERENCE_SIGMA_PERCENT or broken:
        why = (
            f"its focal length is known to {sigma:.2f} % only, and {REFERENCE_SIGMA_PERCENT} % is needed"
            if sigma > REFERENCE_SIGMA_PERCENT
            else f"it is flagged for {', '.join(broken)}"
        )
        return f"fieldcal: not saved as reference {name}: {why}."
    times = [p.time for p in result.solution.photos if p.time is not None]
    day = (min(times).date() if times else date.today()).isoformat()
    path = save_reference(
        reference_from_estimate(
            name,
            estimate,
            result.camera,
            day,
            source=f"self-calibration of {len(result.solution.photos)} photos by fieldcal check",
            provenance=f"{result.network.nadir} nadir and {result.network.convergent} convergent photos, "
            f"{result.solution.rms_px:.2f} px rms, sigma f {sigma:.3f} %",
        )
    )
    return f"fieldcal: saved as reference {name} ({path})."


def _show(
    result: CheckResult, notes: tuple[str, ...], out: Path, quiet: bool, to_stderr: bool = False
) -> None:
    """Say the outcome on stdout, or on stderr where stdout is for the JSON."""
    if not quiet:
        print_summary(result, console(to_stderr), out / "report.html", notes)
    elif not to_stderr:
        print(f"{VERDICT_WORDS[result.verdict]}: {printable(result.headline)}")
