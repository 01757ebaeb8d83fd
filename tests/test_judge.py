"""The rules and the verdict, from the eight published flights to what must never happen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import result_factory
from hypothesis import given, settings
from hypothesis import strategies as st
from table3 import FLIGHTS

from calib.camera import radial_profile_px
from calib.equifinal import Radial, profile_deviation
from calib.equifinal_published import P3P_WALL, P3P_WALL_F_PX
from calib.evidence import Coverage, Evidence, gather_evidence, line_and_offset, sensor_coverage
from calib.findings import State, Verdict
from calib.judge import judge
from calib.limits import decide, percent
from calib.reference import Reference
from calib.references import load_reference
from calib.result import CheckResult
from calib.rules import RULES

RULE_IDS = (
    "focal-drift",
    "equifinal-deviation",
    "equifinal-line",
    "opposite-signs",
    "convergent-share",
    "predicted-dome",
    "focal-sigma",
    "cross-validation",
    "model-sensitivity",
    "coverage",
    "alignment",
)
R = 2000.0


def evidence(radial: Radial = P3P_WALL, reference: Radial | None = P3P_WALL, **changes) -> Evidence:
    """A strong flight with a Phantom 3 held against its own wall calibration."""
    covariance = np.diag([1e-11, 1e-18, 1e-25]) ** 2
    good = Evidence(
        f_px=2320.3,
        sigma_f_px=0.3,
        sigma_f_formal_px=0.2,
        radial=radial,
        radial_covariance=covariance,
        nadir=40,
        convergent=8,
        steep=0,
        largest_tilt_deg=38.0,
        heights_agl_m=(60.0,),
        dome_percent=0.02,
        sigma_dome_percent=0.005,
        dome_m=0.012,
        split_f_px=0.3,
        split_sigma_f_px=0.5,
        split_profile_ratio=1.4,
        spread_f_px=0.2,
        models=("brown", "brown without K3", "brown with aspect"),
        coverage=Coverage(1.0, 0.9, 0.8),
        aligned=48,
        used=48,
        components=(48,),
        rms_px=0.4,
    )
    if reference is not None:
        line, offset = line_and_offset(radial, reference, covariance, R, 2.0)
        good = replace(
            good,
            reference_name="wall",
            f_ref_px=P3P_WALL_F_PX,
            sigma_f_ref_px=0.05,
            deviation=profile_deviation(radial, reference, R, covariance),
            line=line,
            offset=offset,
        )
    return replace(good, **changes)


def states(e: Evidence) -> dict[str, State]:
    return {finding.rule: finding.state for finding in judge(e)[2]}


def message(e: Evidence, rule: str) -> str:
    return next(finding.message for finding in judge(e)[2] if finding.rule == rule)


def of_table_3(name: str) -> Evidence:
    f, k1, k2, k3, _ = FLIGHTS[name]
    convergent = 8 if name[1] in "34" else 0
    return evidence(
        Radial(k1 * 1e-8, k2 * 1e-15, k3 * 1e-23),
        f_px=float(f),
        sigma_f_px=0.1,
        sigma_f_formal_px=0.1,
        convergent=convergent,
        heights_agl_m=(60.0, 80.0) if name[1] in "24" else (60.0,),
    )


def test_the_sigma_of_a_loose_reference_says_nothing_of_the_photos():
    """Another body's calibration: f known to half a percent, which would leave room for any dome."""
    loose = {"sigma_f_ref_px": 0.005 * P3P_WALL_F_PX, "sigma_dome_percent": 2.0}
    assert states(evidence(**loose))["predicted-dome"] is State.UNKNOWN
    alone = evidence(**loose, dome_left_open_percent=0.01)
    assert states(alone)["predicted-dome"] is State.PASS
    assert judge(alone)[0] is Verdict.TRUST
    assert states(evidence(**loose, dome_left_open_percent=0.2))["predicted-dome"] is State.UNKNOWN


def test_a_strong_flight_at_its_reference_is_trusted_and_every_rule_is_listed():
    verdict, headline, findings = judge(evidence())
    assert verdict is Verdict.TRUST
    assert "wall" in headline
    assert tuple(finding.rule for finding in findings) == RULE_IDS
    assert all(finding.state is State.PASS for finding in findings)
    assert all(finding.message.endswith(".") and finding.source for finding in findings)


@pytest.mark.parametrize("name", FLIGHTS)
def test_focal_flags_of_the_eight_published_flights(name):
    e = of_table_3(name)
    verdict, _, findings = judge(e)
    focal = findings[0]
    words = {"A1": "far over", "A2": "far over", "B1": "far over", "B2": "far over"}
    if name == "A4":
        assert focal.state is State.PASS
        assert verdict is Verdict.TRUST
    else:
        assert focal.state is State.FLAG
        assert verdict is Verdict.REFLY
        assert words.get(name, "just over") in focal.message
    drift = 100 * (FLIGHTS[name][0] / P3P_WALL_F_PX - 1)
    assert focal.value == pytest.approx(drift)
    flagged = {f.rule for f in findings if f.state is State.FLAG}
    # The distortion of B1 alone is far off over 2000 px, A1's by less; the others agree with the wall.
    assert ("equifinal-deviation" in flagged) == (name in ("A1", "B1"))
    assert ("equifinal-line" in flagged) == (name in ("A1", "B1"))
    assert ("convergent-share" in flagged) == (name[1] in "12")


def test_the_real_nadir_set_is_told_what_is_missing():
    e = evidence(
        reference=None,
        f_px=2900.0,
        sigma_f_px=350.0,
        sigma_f_formal_px=60.0,
        convergent=0,
        largest_tilt_deg=2.0,
        dome_percent=None,
        sigma_dome_percent=0.3,
        dome_m=None,
        spread_f_px=300.0,
    )
    verdict, headline, _ = judge(e)
    assert verdict is Verdict.REFLY
    for words in ("straight down", "one height", "focal length cannot be determined", "12 %"):
        assert words in headline
    assert states(e)["focal-drift"] is State.UNKNOWN
    # The small residual is listed and proves nothing.
    assert states(e)["alignment"] is State.PASS
    assert "15 degrees" in message(replace(e, largest_tilt_deg=15.0), "focal-sigma")
    assert "2 heights" in message(replace(e, heights_agl_m=(60.0, 80.0)), "focal-sigma")


def test_without_a_reference_the_best_network_cannot_be_confirmed():
    alone = evidence(reference=None, dome_percent=None, dome_m=None, reference_note="No reference is known.")
    verdict, headline, _ = judge(alone)
    assert verdict is Verdict.CANNOT_TELL
    assert "no reference" in headline
    assert "--save-reference" in headline
    assert "no reference is known" in message(alone, "focal-drift").lower()
    for weaker in (
        {"sigma_f_px": 0.001 * 2320 * 0.4},
        {"convergent": None},
        {"split_f_px": None, "split_profile_ratio": None},
        {"spread_f_px": None},
        {"sigma_dome_percent": 0.2},
        {"sigma_dome_percent": None},
    ):
        verdict, headline, _ = judge(replace(alone, **weaker))
        assert verdict is Verdict.CANNOT_TELL, weaker
        assert "--save-reference" not in headline, weaker


def test_a_reference_of_another_body_cannot_decide_a_tenth_of_a_percent():
    model_level = evidence(f_px=P3P_WALL_F_PX * 1.003, sigma_f_ref_px=11.6)
    assert states(model_level)["focal-drift"] is State.UNKNOWN
    assert "reference" in message(model_level, "focal-drift")
    gross = replace(model_level, f_px=P3P_WALL_F_PX * 1.09)
    assert states(gross)["focal-drift"] is State.FLAG


def test_same_signs_mean_that_the_method_does_not_apply_and_block_nothing():
    same = Radial(1e-9, 1e-17, 0.0)
    e = evidence(same, same)
    assert states(e)["opposite-signs"] is State.UNKNOWN
    assert states(e)["equifinal-line"] is State.UNKNOWN
    assert states(e)["equifinal-deviation"] is State.PASS
    assert judge(e)[0] is Verdict.TRUST


def test_a_geotag_fault_is_named_and_no_pass_is_sold_for_it():
    fault = "The geotags miss the block by 17 m north"
    e = evidence(geotag_fault=fault)
    verdict, headline, _ = judge(e)
    assert verdict is Verdict.CANNOT_TELL
    assert fault in headline
    assert "do not cure" in headline
    assert judge(replace(e, f_px=2500.0))[0] is Verdict.CANNOT_TELL
    verdict, headline, _ = judge(replace(e, convergent=0))
    assert verdict is Verdict.REFLY
    assert "17 m north" in headline


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"convergent": 2}, "convergent-share"),
        ({"dome_percent": -0.3}, "predicted-dome"),
        ({"split_profile_ratio": 6.0}, "cross-validation"),
        ({"split_f_px": 4.0}, "cross-validation"),
        ({"spread_f_px": 20.0}, "model-sensitivity"),
        ({"coverage": Coverage(1.0, 0.9, 0.1)}, "coverage"),
        ({"f_px": 2330.0}, "focal-drift"),
        ({"sigma_f_px": 20.0}, "focal-sigma"),
    ],
)
def test_each_curable_flag_alone_asks_for_more_photos(change, rule):
    e = evidence(**change)
    assert states(e)[rule] is State.FLAG
    assert judge(e)[0] is Verdict.REFLY


@pytest.mark.parametrize(
    "change",
    [{"aligned": 30}, {"components": (38, 10)}, {"rms_px": 4.0}, {"converged": False}],
)
def test_a_broken_block_is_not_cured_by_flying(change):
    assert judge(evidence(**change))[0] is Verdict.CANNOT_TELL


def test_the_steep_photos_count_and_are_named():
    e = evidence(nadir=0, convergent=2, steep=20)
    assert states(e)["convergent-share"] is State.PASS
    assert "20 of them beyond 45 degrees" in message(e, "convergent-share")


def test_nothing_known_is_no_pass():
    blank = Evidence(2320.0, float("inf"), float("inf"), P3P_WALL, np.zeros((3, 3)))
    verdict, _, findings = judge(blank)
    assert verdict is not Verdict.TRUST
    assert {f.rule for f in findings if f.state is State.PASS} <= {"opposite-signs"}


ORDER = {State.PASS: 0, State.UNKNOWN: 1, State.FLAG: 2}


@given(st.floats(-50, 50), st.floats(0, 20), st.floats(0, 20), st.floats(0.01, 20))
def test_a_larger_sigma_never_decides(value, sigma, more, threshold):
    before, after = decide(value, sigma, threshold), decide(value, sigma + more, threshold)
    assert after in (before, State.UNKNOWN)
    assert decide(-value, sigma, threshold) is before


@given(st.floats(0, 50), st.floats(0, 50), st.floats(0, 20), st.floats(0.01, 20))
def test_a_larger_value_never_looks_better(value, more, sigma, threshold):
    assert ORDER[decide(value, sigma, threshold)] <= ORDER[decide(value + more, sigma, threshold)]


@settings(deadline=None)
@given(st.floats(0.9, 1.1), st.floats(0.01, 30), st.floats(1, 50), st.sampled_from([True, False]))
def test_growing_sigma_never_earns_trust(factor, sigma, grow, with_reference):
    e = evidence(reference=P3P_WALL if with_reference else None, f_px=2320.06 * factor, sigma_f_px=sigma)
    wider = replace(e, sigma_f_px=sigma * grow)
    if judge(wider)[0] is Verdict.TRUST:
        assert judge(e)[0] is Verdict.TRUST
    drift, wider_drift = judge(e)[2][0].state, judge(wider)[2][0].state
    assert wider_drift in (drift, State.UNKNOWN)


@given(st.integers(0, 100), st.integers(1, 100))
def test_more_convergent_photos_never_hurt(oblique, more):
    few = evidence(nadir=50, convergent=oblique)
    many = evidence(nadir=50, convergent=oblique + more)
    assert ORDER[states(many)["convergent-share"]] <= ORDER[states(few)["convergent-share"]]


def test_rules_and_their_identifiers_stay_in_order():
    assert tuple(rule.__name__.replace("_", "-") for rule in RULES) == RULE_IDS


def test_coverage_names_the_empty_part():
    rng = np.random.default_rng(1)
    everywhere = rng.uniform([0, 0], [4000, 3000], (4000, 2))
    assert sensor_coverage(everywhere, 4000, 3000) == Coverage(1.0, 1.0, 1.0)
    middle = everywhere[np.all(np.abs(everywhere - [2000, 1500]) < [1300, 1000], axis=1)]
    thin = sensor_coverage(middle, 4000, 3000)
    assert thin.corners == 0.25  # the innermost of the four cells of each
    assert thin.edges == 0.0
    assert thin.centre > 0.6
    assert "edges and corners" in message(evidence(coverage=thin), "coverage")


@pytest.mark.parametrize(
    ("value", "text"),
    [(12.3, "12 %"), (0.127, "0.13 %"), (9.437, "9.4 %"), (0.0026, "0.0026 %"), (0, "0.0 %")],
)
def test_percentages_read_well(value, text):
    assert percent(value) == text


# --- From a solved block ---------------------------------------------------------------------------


def gathered(result: CheckResult, reference: Reference | None) -> Evidence:
    return gather_evidence(
        result.solution, result.estimate, result.network, result.dome, reference, result.reference_note
    )


def test_evidence_of_a_block_against_its_reference():
    result = result_factory.build(Verdict.REFLY)
    assert result.reference is not None
    e = gathered(result, result.reference)
    assert e.f_ref_px == result.reference.brown.f_px
    assert e.nadir + e.convergent + e.steep == len(result.solution.photos)
    assert e.deviation is not None
    # K1 of this block is 0.8 % off, K2 1.5 %: by hand, at the edge and in the middle.
    r = np.linspace(0, R, 2001)
    gap = radial_profile_px(*e.radial.vector, r) - radial_profile_px(*P3P_WALL.vector, r)
    assert e.deviation.raw_px == pytest.approx(np.abs(gap).max(), rel=1e-3)
    assert e.deviation.sigma_raw_px > 0
    assert states(e)["focal-drift"] is State.FLAG
    assert judge(e)[0] is Verdict.REFLY


def test_evidence_without_reference_positions_or_dome():
    result = result_factory.build(Verdict.CANNOT_TELL, reference=False, gps=False)
    unknown = replace(result.network, tilt_deg=np.full(len(result.network.tilt_deg), np.nan))
    e = gather_evidence(result.solution, result.estimate, unknown, None, None)
    assert e.convergent_share is None
    assert e.deviation is None
    verdict, _, findings = judge(e)
    assert verdict is Verdict.CANNOT_TELL
    assert {f.rule for f in findings if f.state is State.UNKNOWN} >= {
        "focal-drift",
        "equifinal-deviation",
        "equifinal-line",
        "convergent-share",
        "predicted-dome",
    }


def test_a_library_reference_brings_its_body_to_body_spread():
    result = result_factory.build(Verdict.REFLY)
    e = gathered(result, load_reference("dji-phantom-3-professional"))
    assert e.sigma_f_ref_px == pytest.approx(0.005 * P3P_WALL_F_PX, rel=0.01)
    # 4 px at the edge, from K1 alone.
    assert e.deviation.sigma_raw_px == pytest.approx(4.0, rel=0.2)
    assert states(e)["focal-drift"] is State.UNKNOWN
    assert states(e)["equifinal-deviation"] is State.UNKNOWN


def test_the_inspire_is_judged_by_its_published_focal_length_and_lines():
    result = result_factory.build(Verdict.REFLY)
    e = gathered(result, load_reference("dji-inspire-1"))
    assert e.f_ref_px == 2326.07
    assert e.line is not None
    assert e.offset.sigma_k2_px > 0


def test_the_offset_sigma_is_that_of_samples():
    rng = np.random.default_rng(5)
    root = np.diag([4e-11, 1e-17, 4e-25]) @ np.array([[1, 0, 0], [-0.9, 0.4, 0], [0.5, -0.3, 0.2]])
    covariance = root @ root.T
    _, offset = line_and_offset(P3P_WALL, P3P_WALL, covariance, R, 2.0)
    drawn = [
        line_and_offset(Radial(*(P3P_WALL.vector + noise)), P3P_WALL, covariance, R, 2.0)[1].k2_px
        for noise in rng.standard_normal((400, 3)) @ root.T
    ]
    assert np.std(drawn) == pytest.approx(offset.sigma_k2_px, rel=0.15)
    assert abs(offset.k2_px) < 1e-20
