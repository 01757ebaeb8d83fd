"""The field check: photos in, verdict out. Everything but the words for the pilot."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from calib.align.child import Job, Outcome, run_job
from calib.align.engine import Progress, Settings
from calib.equifinal import tolerance_px
from calib.errors import InputError
from calib.evidence import gather_evidence
from calib.judge import judge, judge_held
from calib.photos import LeftOut, Photo, Sorted, read_photos, require_block, sort_photos
from calib.photos.collect import collect
from calib.reference import Reference
from calib.reference_history import condition
from calib.reference_match import match_reference
from calib.references import estimate_of_reference, find_reference, load_reference
from calib.result import CheckResult, Timing


@dataclass(frozen=True)
class Options:
    """``reference``: name or file; None looks for one by camera. ``fixed``: hold the lens at it."""

    reference: str | None = None
    fixed: bool = False
    settings: Settings = field(default_factory=Settings)


def read_set(
    paths: Sequence[Path],
    progress: Progress,
    complete: Callable[[Sequence[Photo]], Sequence[Photo]] | None = None,
) -> Sorted:
    """The photos of one flight of one camera among files and folders.

    ``complete``: fills in what is known of the photos besides their files.

    Raises:
        InputError: nothing usable; one sentence.
    """
    files = collect(paths)
    photos, bad = read_photos(files, lambda done: progress("reading metadata", done, len(files)))
    return sort_photos(photos if complete is None else complete(photos), bad)


def choose_reference(photo: Photo, wanted: str | None) -> tuple[Reference | None, str]:
    """The reference for these photos, converted to their size, and a sentence about it."""
    if wanted is None:
        reference, note = find_reference(photo.camera)
    else:
        reference, note = match_reference(load_reference(wanted), photo.camera, named=True)
    if reference is None:
        return None, note
    taken = None if photo.time is None else photo.time.date()
    return reference, " ".join((note, *condition(reference, taken)))


def check_photos(photos: Sorted, options: Options, progress: Progress) -> CheckResult:
    """Align, calibrate and judge.

    Raises:
        FieldcalError: the photos cannot be used; one sentence.
    """
    require_block(photos)
    started, cpu = time.monotonic(), cpu_s()
    reference, note = choose_reference(photos.used[0], options.reference)
    lens = None if reference is None else reference.lens
    covariance = None if reference is None else reference.lens_covariance
    if options.fixed and lens is None:
        raise InputError(
            f"The lens cannot be held at reference {options.reference}: {note} Calibrate this camera first "
            "(fieldcal calibrate), or check without --fixed."
        )
    job = Job(photos.used, lens, options.settings, reference_covariance=covariance, fixed=options.fixed)
    outcome = run_job(job, progress)
    wall = time.monotonic() - started
    timing = Timing(wall, cpu_s() - cpu, len(photos.used) / max(wall, 1e-9))
    return conclude(outcome, photos.left_out, reference, note, timing)


def conclude(
    outcome: Outcome,
    left_out: tuple[LeftOut, ...],
    reference: Reference | None,
    note: str,
    timing: Timing,
) -> CheckResult:
    """Hold what the alignment found against the rules; a lens that was held stays the reference's."""
    dome = outcome.dome
    metric = outcome.solution.georeference.metric
    tolerance = tolerance_px(dome.flying_height_m if metric else None, 2 * dome.site_radius_m)
    held = outcome.held
    fit = None if held is None else held.fit
    evidence = gather_evidence(
        outcome.solution, outcome.estimate, outcome.network, dome, reference, note, tolerance, fit
    )
    verdict, headline, findings = judge(evidence) if held is None else judge_held(evidence)
    solution, estimate = outcome.solution, outcome.estimate
    if held is not None and reference is not None and reference.lens is not None:
        solution = held.calibrated.solution(
            solution.photos,
            solution.georeference,
            solution.components,
            solution.photos_used,
            solution.left_out,
        )
        estimate = estimate_of_reference(reference, reference.lens, estimate.correlation_factor)
    return CheckResult(
        verdict=verdict,
        headline=headline,
        findings=findings,
        camera=outcome.solution.photos[0].camera,
        solution=solution,
        estimate=estimate,
        network=outcome.network,
        dome=dome,
        reference=reference,
        reference_note=note,
        line=evidence.line,
        what_to_fly=None,
        left_out=left_out,
        timing=timing,
        # An extra pass is planned from the block that was free.
        flown=outcome.flown if held is None else None,
    )


def cpu_s() -> float:
    """CPU seconds of this process and its finished children."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    )
