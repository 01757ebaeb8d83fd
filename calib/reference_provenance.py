"""What goes with a verified calibration: where it comes from, how well it is known, and checksums."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from calib.camera import BrownCamera
from calib.evidence import reference_sigma_f_px
from calib.files import output_errors
from calib.reference import Reference
from calib.reference_history import Change, Entry, Trend, body_history, changes, describe

#: Format of calib.formats -> file.
VERIFIED_FILES = {"odm": "cameras.json", "metashape": "metashape.xml"}
PROVENANCE_FILE = "PROVENANCE.txt"


def provenance_text(reference: Reference, brown: BrownCamera, folder: Path) -> str:
    """The words beside the files of ``VERIFIED_FILES`` in ``folder``, which must be there.

    Raises:
        OutputError: a file cannot be read back.
    """
    sigma = 100 * reference_sigma_f_px(reference) / brown.f_px
    lines = [
        f"Calibration {reference.name}, verified by fieldcal {metadata.version('fieldcal')}",
        "",
        f"camera       {f'{reference.make} {reference.model}'.strip() or 'not named'}",
        f"body         {reference.serial or 'not known'}",
        f"images       {brown.width} x {brown.height} px, {reference.processing.value}",
        f"date         {reference.date or 'not known'}",
        "temperature  "
        + ("not known" if reference.temperature_c is None else f"{reference.temperature_c:g} degrees C"),
        f"f            {brown.f_px:.3f} px, known to {sigma:.4f} % (1 sigma)",
        f"source       {reference.source}",
        f"how          {reference.provenance or 'not known'}",
        "",
        "Use it fixed only for photos of this body, image size, zoom, focus and processing.",
    ]
    entries, _ = body_history(reference.name)
    steps = changes(entries)
    if steps:
        lines += ["", "Calibrations of this body, one after the other:"]
        lines += [f"  {describe(step)}" for step in steps]
    lines += ["", "SHA-256:"]
    for file in VERIFIED_FILES.values():
        with output_errors(folder / file):
            digest = hashlib.sha256((folder / file).read_bytes()).hexdigest()
        lines.append(f"  {digest}  {file}")
    return "\n".join(lines) + "\n"


def history_dict(
    name: str, entries: Sequence[Entry], steps: Sequence[Change], found: Sequence[Trend]
) -> dict[str, Any]:
    """The history of a body as plain data, schema ``fieldcal.history/1``."""
    return {
        "schema": "fieldcal.history/1",
        "name": name,
        "calibrations": [
            {
                "label": entry.label,
                "date": entry.reference.date,
                "temperature_c": entry.reference.temperature_c,
                "f_px": entry.reference.f_px,
                "sigma_f_px": reference_sigma_f_px(entry.reference) or None,
                "source": entry.reference.source,
                "provenance": entry.reference.provenance,
            }
            for entry in entries
        ],
        "changes": [
            {
                "before": step.before,
                "after": step.after,
                "days": step.days,
                "f_percent": step.f_percent,
                "sigma_percent": step.sigma_percent,
                "profile_px": step.deviation.raw_px,
                "sigma_profile_px": step.deviation.sigma_raw_px,
                "profile_scale_removed_px": step.deviation.linear_removed_px,
                "chance": step.chance,
                "different": step.different,
                "before_and_after": step.pair,
            }
            for step in steps
        ],
        "trends": [
            {
                "per": trend.unit,
                "slope_percent": trend.slope_percent,
                "sigma_percent": trend.sigma_percent,
                "count": trend.count,
                "significant": trend.significant,
            }
            for trend in found
        ],
    }
