"""Does the recommended pass cure rendered surveys? From JPEG to verdict and back, as a user does it.

    python -m benchmarks.refly_rendered [--flights 20] [--workers 1]
    python -m benchmarks.refly_rendered --case N

Writes benchmarks/refly_rendered.md, and the raw numbers beside it; flights that are there already are kept,
so a run can be broken off and taken up again.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign import wilson
from benchmarks.refly_world import GIMBAL_DEG, MISSING, POSITION_M
from benchmarks.resumed import asked, read_rows, run_rows
from calib.frames import LocalFrame
from calib.reference_file import write_reference_file
from daemon import cli
from sim.cameras import find_camera
from sim.flights import Flight, rotation_looking
from sim.survey import SurveyOptions, SurveyTruth, lens_corrected, true_reference, write_survey

#: Surveys that look straight down from one height; width of the photos.
RECIPES = ("demo_nadir", "nadir_one_height", "demo_crosshatch")
WIDTH = 640
#: Cameras by name; "corrected": a Phantom 3 that corrects its photos and leaves 1.5 px of no lens model;
#: "rolling": one that reads its rows in 30 ms while it flies on.
LENSES = ("phantom-3", "phantom-4-pro", "corrected", "inspire-1", "rolling")
READOUT_S = 0.03
RELIEFS_M = (2.0, 6.0)
WHAT = """
Surveys straight down from one height, rendered as photos of 640 px width over invented ground, another one
for each: 12, 18 or 24 photos, three cameras, one that corrects its photos and leaves 1.5 px (at full size)
that no lens model follows and one that reads its rows in 30 ms at 8 m/s, rolling ground of 2 or 6 m. Each
is checked by `fieldcal check` against its true lens; the pass that `fieldcal refly` recommends is rendered
over the same ground with errors of 2 m and 2 degrees (standard deviations per axis) in the flying and 5 %
of its photos missing, and `fieldcal check` of both folders gives the verdict. Nothing is shared with the
truth but the photos and the reference (`python -m benchmarks.refly_rendered`; one flight in full: `--case
N`). `tests/test_refly_flown.py` does it once.
"""


@dataclass(frozen=True)
class Row:
    """One flight; figures of the pass are None where there was none. Sigmas, f and dome in percent.

    ``stands_in_the_way``: why there was no pass, or what is flagged and open after it.
    """

    number: int
    recipe: str
    lens: str
    relief_m: float
    photos: int
    before: str
    after: str | None
    pass_photos: int
    flown: int
    seconds: float
    promised: bool
    sigma_before: float | None
    sigma_predicted: float | None
    sigma_after: float | None
    f_off: float | None
    dome_before: float | None
    dome_predicted: float | None
    dome_after: float | None
    stands_in_the_way: str


def flight_of(stations: Sequence[dict[str, Any]], options: SurveyOptions) -> Flight:
    """Stations of a fieldcal.refly/1 as a flight over the simulator's ground, launched at its zero height."""
    frame = LocalFrame(options.latitude_deg, options.longitude_deg)
    latitude, longitude, height, yaw, pitch = (
        np.array([float(s[key]) for s in stations])
        for key in ("lat", "lon", "height_m", "yaw_deg", "pitch_deg")
    )
    centres = frame.enu(latitude, longitude, height)
    # Photos are taken standing.
    return Flight(rotation_looking(yaw, 90.0 + pitch), centres, np.zeros_like(centres))


def options_of(number: int) -> tuple[str, str, SurveyOptions]:
    """Recipe, lens and options of a flight: every lens with every recipe before one comes again."""
    recipe, lens = RECIPES[number % len(RECIPES)], LENSES[number % len(LENSES)]
    options = SurveyOptions(texel_m=0.16, relief_m=RELIEFS_M[(number // 2) % len(RELIEFS_M)])
    if lens == "rolling":
        rendering = replace(find_camera("phantom-3").rendering, readout_s=READOUT_S)
        return recipe, lens, replace(options, camera_model="phantom-3", render=rendering)
    if lens != "corrected":
        return recipe, lens, replace(options, camera_model=lens)
    model = find_camera("phantom-3")
    camera = lens_corrected(model.at(WIDTH, round(WIDTH * 3 / 4)))
    return recipe, lens, replace(options, camera=camera, lens_corrected=True, pattern_px=1.5)


def _size(lens: str) -> tuple[int, int]:
    width, height = find_camera("phantom-3" if lens in ("corrected", "rolling") else lens).default_size
    return WIDTH, round(WIDTH * height / width)


def _said(home: Path, *words: str) -> tuple[int, dict[str, Any]]:
    """Run the command; its exit code and its JSON."""
    told = home / "told.json"
    told.unlink(missing_ok=True)
    with contextlib.redirect_stdout(io.StringIO()):
        code = cli.run([*words, "--json", str(told)])
    return code, json.loads(told.read_text(encoding="utf-8"))


def score(number: int) -> Row:
    """Render, check, plan, fly and check again."""
    recipe, lens, options = options_of(number)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        old, new = home / "old", home / "new"
        truth = write_survey(recipe, old, number, size=_size(lens), options=options, workers=1)
        write_reference_file(true_reference(truth, "truth"), home / "truth.json")
        held = ("--reference", str(home / "truth.json"), "--quiet")
        _, first = _said(home, "check", str(old), *held, "--out", str(home / "first"))
        _, wanted = _said(home, "refly", str(home / "first"))
        both, flown = None, 0
        if wanted["stations"]:
            rng = np.random.default_rng([number, 7])
            stations = [s for s in wanted["stations"] if rng.random() >= MISSING]
            later = replace(
                options, start=options.start + timedelta(minutes=15), position_jitter_m=POSITION_M,
                height_jitter_m=POSITION_M, attitude_jitter_deg=GIMBAL_DEG,
            )  # fmt: skip
            flight = flight_of(stations, later)
            write_survey(recipe, new, number, size=_size(lens), options=later, workers=1, instead=flight)
            flown = len(stations)
            _, both = _said(home, "check", str(old), str(new), *held, "--out", str(home / "both"))
    return _row(number, truth, first, wanted, both, flown)


def _row(
    number: int,
    truth: SurveyTruth,
    first: dict[str, Any],
    wanted: dict[str, Any],
    both: dict[str, Any] | None,
    flown: int,
) -> Row:
    recipe, lens, options = options_of(number)
    against = (
        []
        if both is None
        else [f"{f['rule']} ({f['state']})" for f in both["findings"] if f["state"] != "pass"]
    )
    after = wanted["after"] or {}
    return Row(
        number=number,
        recipe=recipe,
        lens=lens,
        relief_m=options.relief_m,
        photos=len(truth.photos),
        before=first["verdict"],
        after=None if both is None else both["verdict"],
        pass_photos=wanted["photos"],
        flown=flown,
        seconds=wanted["duration_s"],
        promised=wanted["cures"],
        sigma_before=wanted["before"]["sigma_f_percent"],
        sigma_predicted=after.get("sigma_f_percent"),
        sigma_after=None if both is None else _sigma_percent(both),
        f_off=None if both is None else 100 * (both["calibration"]["f_px"] / truth.camera.f_px - 1),
        dome_before=wanted["before"]["dome_percent"],
        dome_predicted=after.get("dome_percent"),
        dome_after=None if both is None else _dome_percent(both),
        stands_in_the_way=wanted["reason"] if both is None else ", ".join(against),
    )


def _sigma_percent(report: dict[str, Any]) -> float:
    return 100 * float(report["calibration"]["sigma"]["f_px"]) / float(report["calibration"]["f_px"])


def _dome_percent(report: dict[str, Any]) -> float | None:
    found = next(f for f in report["findings"] if f["rule"] == "predicted-dome")
    return None if found["sigma"] is None else float(found["sigma"])


def _percent(value: float | None, signed: bool = False) -> str:
    return "-" if value is None else f"{value:+.3f}" if signed else f"{value:.3g}"


def report(rows: Sequence[Row]) -> str:
    """Markdown."""
    sold = [r for r in rows if r.promised]
    cured = sum(r.after == "TRUST" for r in sold)
    low, high = wilson(cured, len(sold))
    ratios = [r.sigma_after / r.sigma_predicted for r in sold if r.sigma_after and r.sigma_predicted]
    within = sum(abs(r.f_off) <= 3 * r.sigma_after for r in sold if r.f_off is not None and r.sigma_after)
    lines = [
        "# The extra pass, flown over rendered ground",
        "",
        WHAT.strip(),
        "",
        f"A pass that cures was promised for {len(sold)} of {len(rows)} surveys; "
        f"**{cured} of {len(sold)} were TRUST after it** (95 %: {low:.0f} to {high:.0f} %).",
    ]
    if ratios:
        lines += [
            f"Sigma of f after the pass over what was predicted: median {np.median(ratios):.2f}, "
            f"{min(ratios):.2f} to {max(ratios):.2f}. f was within three of these sigmas of the truth in "
            f"{within} of {len(sold)}, at worst {max(abs(r.f_off or 0.0) for r in sold):.3f} % off. Passes: "
            f"median {np.median([r.pass_photos for r in sold]):g} photos and "
            f"{np.median([r.seconds for r in sold]):.0f} s.",
        ]
    lines += [
        "",
        "| no. | survey | camera | relief m | before | sigma f % | pass: photos (taken), s "
        "| sigma f %: predicted, after | f off % | dome % H before, predicted, after | verdict | open |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.number} | {r.recipe}, {r.photos} | {r.lens} | {r.relief_m:g} | {r.before} "
        f"| {_percent(r.sigma_before)} | {r.pass_photos} ({r.flown}), {r.seconds:.0f}"
        f"{'' if r.promised else ', no cure promised'} "
        f"| {_percent(r.sigma_predicted)}, {_percent(r.sigma_after)} | {_percent(r.f_off, signed=True)} "
        f"| {_percent(r.dome_before)}, {_percent(r.dome_predicted)}, {_percent(r.dome_after)} "
        f"| {r.after or '-'} | {r.stands_in_the_way or '-'} |"
        for r in rows
    ]
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the campaign, or show one flight."""
    given = asked(__doc__, 20, arguments, workers=1)
    if given.case is not None:
        json.dump(asdict(score(given.case)), sys.stdout, indent=1)
        return
    raw = given.out / "refly_rendered.jsonl"
    known = {row.number: row for row in read_rows(raw, lambda row: Row(**row))}
    rows = run_rows(given.flights, raw, given.workers, score, asdict, known)
    (given.out / "refly_rendered.md").write_text(report(rows))


if __name__ == "__main__":
    main()
