"""``python -m sim.demo``: a drone that nobody flew, a lens that is known, a verdict that is not told.

Renders a survey over invented farmland, checks its nadir photos alone and then with the eight
convergent ones, and compares the focal lengths found with the true one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from calib.errors import FieldcalError, OutputError
from calib.findings import Verdict
from calib.reference import Reference
from calib.reference_file import write_reference_file
from sim.survey import SurveyOptions, SurveyTruth, read_truth, true_reference, write_survey

RECIPE, SEED = "demo", 1
OPTIONS = SurveyOptions(apart=True)


@dataclass(frozen=True)
class Step:
    """One check of the demonstration: which photos, and the verdict that they deserve."""

    name: str
    title: str
    folders: tuple[str, ...]
    expected: Verdict


STEPS = (
    Step("nadir-only", "12 photos straight down", ("nadir",), Verdict.REFLY),
    Step(
        "with-convergent",
        "the same and 8 convergent photos",
        ("nadir", "convergent"),
        Verdict.TRUST,
    ),
)


def photographed(folder: Path, size: tuple[int, int], console: Console) -> SurveyTruth:
    """The survey's photos: those of an earlier run if they are complete, else rendered now.

    Nothing else in ``folder`` is touched.
    """
    try:
        truth = read_truth(folder)
    except (FileNotFoundError, json.JSONDecodeError, KeyError, TypeError):
        truth = None
    if (
        truth is not None
        and (truth.recipe, truth.seed, truth.camera.width, truth.camera.height) == (RECIPE, SEED, *size)
        and all((folder / name).is_file() for name in truth.photos)
    ):
        console.print(f"Photos of an earlier run are in {folder}: used again.")
        return truth
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(f"Rendering photos of {size[0]} x {size[1]} px", total=None)
        truth = write_survey(
            RECIPE,
            folder,
            SEED,
            size=size,
            options=OPTIONS,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    console.print(f"{len(truth.photos)} photos rendered into {folder}.")
    return truth


def reference_of(truth: SurveyTruth) -> Reference:
    """The true lens as the reference that a calibration on site would have given."""
    return true_reference(truth, "demo-truth")


def check(step: Step, photos: Path, reference: Path, out: Path, console: Console) -> bool:
    """Run ``fieldcal check`` as a user would, tell what came of it; whether it is as expected."""
    report = out / "report.json"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "daemon.cli", "check", *(str(photos / name) for name in step.folders)]
    command += ["--reference", str(reference), "--out", str(out), "--json", str(report)]
    console.rule(step.title)
    code = subprocess.run(command, check=False).returncode
    if not report.is_file():
        console.print(f"[red]The check gave no report (exit code {code}).[/red]")
        return False
    found = json.loads(report.read_text(encoding="utf-8"))
    right = found["verdict"] == step.expected.value and code == step.expected.exit_code
    mark = "[green]as it should be[/green]" if right else f"[red]expected {step.expected.value}[/red]"
    console.print(f"{step.title}: {found['verdict']}, exit code {code}, {mark}")
    return right


def compare(truth: SurveyTruth, out: Path, console: Console) -> None:
    """Print the true focal length against those found."""
    console.rule("True lens against found")
    true_f = truth.camera.f_px
    console.print(f"{'true':>16}: f = {true_f:8.2f} px")
    for step in STEPS:
        report = out / step.name / "report.json"
        if not report.is_file():
            continue
        calibration = json.loads(report.read_text(encoding="utf-8"))["calibration"]
        f, sigma = calibration["f_px"], calibration["sigma"]["f_px"]
        off = 100 * (f / true_f - 1)
        spread = "unknown" if sigma is None else f"{sigma:.2f} px"
        console.print(f"{step.name:>16}: f = {f:8.2f} px, sigma {spread}: {off:+.3f} % off the truth")


def show(out: Path, console: Console) -> None:
    """Name the reports; open the last one where there is a screen."""
    pages = [page for step in STEPS for page in sorted((out / step.name).glob("*.html"))]
    for page in pages:
        console.print(f"Report: {page}", soft_wrap=True)
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    opener = shutil.which("xdg-open")
    if pages and screen and opener:
        subprocess.Popen(
            [opener, str(pages[-1])],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0 only if every verdict is the expected one."""
    parser = argparse.ArgumentParser(prog="python -m sim.demo", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("demo-out"), help="folder for photos and reports")
    parser.add_argument("--width", type=int, default=1600, help="width of the photos in px (default: 1600)")
    chosen = parser.parse_args(arguments)
    if not 320 <= chosen.width <= 4000:
        parser.error("--width must be from 320 to 4000")
    size = (chosen.width // 4 * 4, chosen.width // 4 * 3)
    console = Console()
    out: Path = chosen.out
    # One folder for each size: photos of another size would be taken for a second camera's.
    photos = out / f"photos-{size[0]}x{size[1]}"
    try:
        truth = photographed(photos, size, console)
        reference = out / "true-lens.json"
        write_reference_file(reference_of(truth), reference)
    except OSError as error:
        raise OutputError(f"The demonstration cannot write to {out}: {error.strerror}.") from error
    right = [check(step, photos, reference, out / step.name, console) for step in STEPS]
    compare(truth, out, console)
    show(out, console)
    return 0 if all(right) else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except FieldcalError as problem:
        print(problem, file=sys.stderr)
        sys.exit(problem.exit_code)
