"""Surveys whose lens is held at a reference: what their photos still say about it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from align_blocks import solved
from check_process import Survey, check, findings, report_of, true_lens
from test_judge import evidence

from calib.align.held import Held, held_block
from calib.align.uncertainty import estimate
from calib.field import LENS_NAMES, Lens
from calib.findings import State, Verdict
from calib.judge import judge_held
from calib.solution import HeldFit

pytest_plugins = ("check_fixtures",)

KNOWN = np.zeros((len(LENS_NAMES), len(LENS_NAMES)))
KNOWN[0, 0] = 0.2**2


def at(flight: str, gps_m: float = 2.5, **wrong: float) -> tuple[Lens, Held]:
    """A flight held at the true lens, or at one whose parameters are larger by the given shares."""
    block, calibrated = solved(flight, 3, 900, gps_sigma_m=gps_m)
    true = block.lens.brown
    changed = {name: getattr(true, name) * (1 + share) for name, share in wrong.items()}
    lens = Lens(replace(true, **changed))
    return lens, held_block(calibrated, estimate(calibrated), lens, KNOWN, 60.0)


@pytest.mark.parametrize("flight", ["A1", "A3"])
def test_the_true_lens_is_not_contradicted_and_stays_untouched(flight: str) -> None:
    lens, held = at(flight)
    assert held.calibrated.adjusted.state.lens.vector == pytest.approx(lens.vector, abs=0)
    assert not held.calibrated.adjusted.free.any()
    assert held.fit.move_p > 0.01
    assert 4 <= len(held.fit.ring_mean_px) <= 8
    assert np.all(np.abs(held.fit.ring_mean_px) < 5 * held.fit.ring_sigma_px)
    assert np.all(np.diff(held.fit.ring_radius_px) > 0)


@pytest.mark.parametrize(
    ("flight", "wrong"), [("A1", {"f_px": 0.01}), ("A1", {"k1": 0.03}), ("A3", {"f_px": 0.003})]
)
def test_a_wrong_lens_is_contradicted(flight: str, wrong: dict[str, float]) -> None:
    fit = at(flight, **wrong)[1].fit
    assert fit.move_p < 1e-6
    if flight == "A3":
        assert fit.move_percent == pytest.approx(-0.3, abs=0.06)


def test_what_the_photos_cannot_see_is_not_claimed() -> None:
    """A hundredth of a percent in f shows in no nadir flight."""
    assert at("A1", f_px=1e-4)[1].fit.move_p > 0.01


def test_precise_positions_show_a_dome() -> None:
    """Half a metre of dome by a wrong K1, against receivers of 2.5 m and of 3 cm."""
    loose = at("A1", k1=0.1)[1].fit
    assert loose.sigma_position_dome_percent is not None
    assert loose.sigma_position_dome_percent > 1
    fine = at("A1", gps_m=0.03)[1].fit
    assert fine.position_dome_percent is not None
    assert fine.sigma_position_dome_percent is not None
    assert abs(fine.position_dome_percent) < 3 * fine.sigma_position_dome_percent < 0.6


def fit(**changes: object) -> HeldFit:
    good = HeldFit(0.05, 0.4, np.array([500.0, 1500.0]), np.array([0.01, 0.02]), np.full(2, 0.01), 0.01, 3.0)
    return replace(good, **changes)  # type: ignore[arg-type]


def test_the_verdict_says_what_was_verified() -> None:
    verdict, headline, found = judge_held(evidence(held=fit()))
    assert verdict is Verdict.TRUST
    assert "wall" in headline
    assert len(found) == 6
    wide = evidence(held=fit(), sigma_dome_percent=0.4)
    verdict, headline, _ = judge_held(wide)
    assert verdict is Verdict.CANNOT_TELL
    assert "as good as the reference" in headline
    assert "0.78 %" in headline
    # Precise positions can take the dome's place.
    sure = replace(wide, held=fit(sigma_position_dome_percent=0.03))
    assert judge_held(sure)[0] is Verdict.TRUST
    for bad in (
        fit(move_p=1e-5),
        fit(ring_mean_px=np.array([0.0, 0.8])),
        fit(position_dome_percent=0.5, sigma_position_dome_percent=0.05),
    ):
        assert judge_held(evidence(held=bad))[0] is Verdict.REFLY
    assert judge_held(evidence(held=fit(), geotag_fault="The geotags contradict."))[0] is Verdict.CANNOT_TELL


def test_nadir_photos_are_checked_with_their_lens_held(small: Survey, home: Path) -> None:
    lens = true_lens(small.truth, home / "lens.json")
    camera = small.truth.camera
    f_px = camera.f_px
    ran = check(home, *small.nadir, "--fixed", lens, "--json", "-", "--quiet")
    assert ran.code in (0, 4), ran.err
    report = json.loads(ran.out)
    assert report["calibration"]["f_px"] == pytest.approx(f_px, rel=1e-9)
    assert findings(report)["reference-fit"]["state"] == State.PASS.value
    assert report_of(home)["verdict"] == report["verdict"]

    other = true_lens(small.truth, home / "other.json", brown=replace(camera, f_px=1.02 * f_px))
    ran = check(home, *small.nadir, "--fixed", other, "--json", "-", "--quiet")
    assert ran.code == 3
    assert findings(json.loads(ran.out))["reference-fit"]["state"] == State.FLAG.value


def test_two_ways_to_treat_the_reference_are_refused(home: Path, card: Path) -> None:
    ran = check(home, card, "--fixed", "dji-inspire-1", "--reference", "dji-inspire-1")
    assert ran.code == 2
    assert "--fixed names the reference" in ran.err
