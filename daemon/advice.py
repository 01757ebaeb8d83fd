"""What a check's outcome means for the pilot."""

from __future__ import annotations

import numpy as np

from calib import frames
from calib.findings import Verdict
from calib.result import CheckResult
from mission.advice import describe_circle


def what_to_fly(result: CheckResult) -> str | None:
    """Advice for the pilot where flying can cure what was flagged."""
    if result.verdict is not Verdict.REFLY:
        return None
    georeference = result.solution.georeference
    if not georeference.trusted or georeference.origin_wgs84 is None:
        advice = describe_circle(None)
        if georeference.fault is not None:
            advice += " This is for the calibration only: it cures nothing about the geotags."
        return advice
    frame = frames.LocalFrame(*georeference.origin_wgs84)
    middle = frame.geodetic(np.median(result.solution.points_m, axis=0)[None])[0]
    return describe_circle(result.dome.flying_height_m, (float(middle[0]), float(middle[1])))
