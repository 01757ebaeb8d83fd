"""A check's results in their folder, all of them or none."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from calib.export import EXPORT_FILES, write_exports
from calib.files import check_writable, output_errors, settle
from calib.flown_file import NETWORK_FILE, flown_check, network_bytes
from calib.report import render_report
from calib.report_json import report_json
from calib.result import CheckResult

REPORT_HTML, REPORT_JSON, EXPORTS = "report.html", "report.json", "exports"


def write_outputs(result: CheckResult, out_dir: Path) -> dict[str, str]:
    """Write ``report.html``, ``report.json``, ``network.npz`` and the ``exports`` folder into ``out_dir``.

    Everything is written beside its place first and moved there at the end, ``report.json`` last;
    if anything fails, the files of an earlier check stay as they were.

    Returns:
        the exports: name -> file relative to ``out_dir`` (as in ``report.json``).

    Raises:
        OutputError: not a folder, not writable, disk full.
    """
    check_writable(out_dir)
    with output_errors(out_dir):
        stage = Path(tempfile.mkdtemp(prefix=".fieldcal-", dir=out_dir))
        try:
            fresh = stage / EXPORTS
            exports = {name: f"{EXPORTS}/{file}" for name, file in write_exports(result, fresh).items()}
            complete = replace(result, exports=exports)
            (stage / REPORT_HTML).write_text(render_report(complete), encoding="utf-8")
            (stage / REPORT_JSON).write_text(report_json(complete), encoding="utf-8")
            flown = flown_check(complete)
            if flown is not None:
                (stage / NETWORK_FILE).write_bytes(network_bytes(flown))
            for path in sorted(stage.rglob("*")):
                if path.is_file():
                    with path.open("rb") as file:
                        settle(file.fileno())
            with output_errors(out_dir / EXPORTS):
                _move_exports(fresh, out_dir / EXPORTS)
            # A network of earlier photos must not stay beside a report that is not theirs.
            if flown is None:
                (out_dir / NETWORK_FILE).unlink(missing_ok=True)
            for name in (*(() if flown is None else (NETWORK_FILE,)), REPORT_HTML, REPORT_JSON):
                (stage / name).replace(out_dir / name)
        finally:
            shutil.rmtree(stage, ignore_errors=True)
    return exports


def _move_exports(fresh: Path, place: Path) -> None:
    """Move the new files to their places and remove those that an earlier check had and this has not.

    Only files of our own names are touched: the user may keep others beside them.
    """
    renewed = {path.relative_to(fresh).as_posix() for path in fresh.rglob("*") if path.is_file()}
    for name in sorted(renewed):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (fresh / name).replace(place / name)
    for name in set(EXPORT_FILES) - renewed:
        (place / name).unlink(missing_ok=True)
