"""The verdict campaign: its design, its truth, its counting, and a handful of its flights."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.verdict import read_scores, run
from benchmarks.verdict_cases import FACTORS, PAPERS, Case, case
from benchmarks.verdict_rates import Rate, cannot_tell, dome_rate, false_refly, false_trust, rms, settled
from benchmarks.verdict_report import write_report
from benchmarks.verdict_score import Score, score
from benchmarks.verdict_truth import true_dome_percent
from benchmarks.verdict_world import (
    reference_of,
    reference_sigma_f_percent,
    survey_of,
    true_camera,
    true_lens,
)
from calib.similarity import Similarity
from sim.flights import small_rotation
from sim.relief import Relief

ORDINARY = Case(
    number=5,
    part="design",
    pattern="A3",
    lens="dji-phantom-3-professional",
    relief="2 m",
    gps="white 2.5 m",
    noise="0.5 px",
    mismatches="1 %",
    error="none",
    reference="true",
)


def invented(number: int, **changes: object) -> Score:
    """A score without a flight: a good calibration of an observable flight, trusted."""
    good = Score(
        case=case(number),
        verdict="TRUST",
        headline="",
        flagged=(),
        open=(),
        decides=True,
        df_percent=0.02,
        sigma_percent=0.03,
        formal_percent=0.03,
        ideal_sigma_percent=0.03,
        z_f=0.7,
        z_k1=0.1,
        z_k2=0.1,
        z_k3=0.1,
        true_dome_percent=0.01,
        predicted_dome_percent=0.02,
        sigma_dome_percent=0.02,
        ref_df_percent=0.01,
        ref_deviation_px=0.2,
        tolerance_px=2.0,
        factor=1.0,
        split_sigmas=1.0,
        cpu_s=1.0,
    )
    return replace(good, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", list(FACTORS))
def test_every_level_comes_as_often_as_its_weight_says(factor: str) -> None:
    deck = sum(FACTORS[factor].values())
    design = [one for one in map(case, range(40 * deck)) if one.part == "design"][: 20 * deck]
    assert Counter(one.level(factor) for one in design) == {
        level: 20 * weight for level, weight in FACTORS[factor].items()
    }


def test_factors_do_not_go_together() -> None:
    design = [one for one in map(case, range(2000)) if one.part == "design"]
    patterns, references = FACTORS["pattern"], FACTORS["reference"]
    pairs = Counter((one.pattern, one.reference) for one in design)
    cells = sum(patterns.values()) * sum(references.values())
    for pattern, a in patterns.items():
        for reference, b in references.items():
            expected = len(design) * a * b / cells
            assert abs(pairs[pattern, reference] - expected) < 4 * expected**0.5 + 1


def test_a_case_does_not_depend_on_the_length_of_the_campaign() -> None:
    assert case(123) == case(123)
    papers = [one for one in map(case, range(2000)) if one.part == "papers"]
    assert all(one.part == "papers" and one.reference == "true" for one in papers)
    assert set(Counter((one.lens, one.pattern) for one in papers).values()) == {100}
    assert len({(one.lens, one.pattern) for one in papers[: len(PAPERS)]}) == len(PAPERS)
    with pytest.raises(ValueError, match="numbered from 0"):
        case(-1)


def test_what_an_ideal_adjustment_settles() -> None:
    known = reference_sigma_f_percent("dji-phantom-3-professional", "true")
    assert 0.002 < known < 0.03
    assert reference_sigma_f_percent("dji-phantom-3-professional", "wrong body") > 0.4

    def share(sigma: float, drift: float, reference: str = "true") -> float:
        one = invented(0, ideal_sigma_percent=sigma, ref_df_percent=drift)
        return settled(replace(one, case=replace(ORDINARY, reference=reference)))

    assert share(0.005, 0.0) > 0.999
    assert share(0.005, 0.3) > 0.999
    assert share(0.005, -0.3) > 0.999
    assert share(0.03, 0.0) < share(0.015, 0.0)
    assert share(0.005, 0.1) < 0.05
    assert share(0.05, 0.0) < 0.1
    assert share(0.005, 0.0, "none") == 0.0
    # Against draws: the share of decisions of a Gaussian estimate.
    found = np.random.default_rng(0).normal(-0.03, 0.02, 20_000)
    reach = 1.96 * np.hypot(0.02, known)
    decided = (np.abs(found) + reach <= 0.1) | (np.abs(found) - reach > 0.1)
    assert share(0.02, 0.03) == pytest.approx(decided.mean(), abs=0.01)


def site(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-80, 80, (600, 2))
    return np.column_stack([xy, Relief.random(seed, 3.0).height_m(xy[:, 0], xy[:, 1])])


@given(
    seed=st.integers(0, 50),
    dome_m=st.floats(-2.0, 2.0),
    scale=st.floats(0.9, 1.1),
    turn=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    stray=st.integers(0, 12),
)
@settings(max_examples=30, deadline=None)
def test_a_dome_put_in_is_found_through_any_similarity_and_stray_points(
    seed: int, dome_m: float, scale: float, turn: tuple[float, float, float], stray: int
) -> None:
    truth = site(seed)
    rng = np.random.default_rng(seed)
    offset = truth[:, :2] - np.median(truth[:, :2], axis=0)
    radius = float(np.percentile(np.linalg.norm(offset, axis=1), 95))
    bent = truth + rng.normal(0, 0.01, truth.shape)
    bent[:, 2] -= dome_m * np.sum(offset**2, axis=1) / radius**2
    bent[:stray, 2] += rng.uniform(10, 30, stray)
    moved = Similarity(scale, small_rotation(np.array([turn]))[0], np.array([30.0, -20.0, 5.0])).apply(bent)
    found = true_dome_percent(moved, truth, 60.0)
    # The seven parameters take a little of a dome over relief.
    assert found == pytest.approx(100 * dome_m / 60, rel=0.05, abs=0.02)


def test_a_similarity_alone_is_no_dome() -> None:
    truth = site(3)
    moved = Similarity(1.07, small_rotation(np.array([[0.1, -0.2, 1.0]]))[0], np.ones(3)).apply(truth)
    assert true_dome_percent(moved, truth, 60.0) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "trust_wrong", "refly_wrong"),
    [
        ({}, False, True),
        ({"df_percent": -0.2}, True, False),
        ({"df_percent": 0.12}, False, False),  # wrong, but by less than the stated sigma
        ({"true_dome_percent": -0.3}, True, False),
        ({"ref_df_percent": 0.5}, True, False),
        ({"ref_deviation_px": 6.0}, True, False),
        ({"ref_df_percent": 0.5, "decides": False}, False, True),  # its sigma says that it may be off
        ({"ideal_sigma_percent": 0.2}, False, False),  # lucky
        ({"ideal_sigma_percent": 0.04, "decides": False}, False, False),  # too weak to stand alone
    ],
)
def test_what_makes_a_verdict_false(changes: dict[str, object], trust_wrong: bool, refly_wrong: bool) -> None:
    one = invented(0, **changes)
    assert (one.trust_wrong, one.refly_wrong) == (trust_wrong, refly_wrong)
    assert one.false_trust == trust_wrong
    assert replace(one, verdict="REFLY").false_refly == refly_wrong
    silent = replace(one, verdict="CANNOT_TELL")
    assert not silent.false_trust
    assert not silent.false_refly


def test_rates_count_what_they_say() -> None:
    scores = [
        invented(0),
        invented(1, verdict="REFLY"),
        invented(2, verdict="REFLY", df_percent=0.5),
        invented(4, df_percent=0.5, predicted_dome_percent=0.5),
        invented(5, verdict="CANNOT_TELL"),
    ]
    assert false_trust(scores) == Rate(1, 2)
    assert false_refly(scores) == Rate(1, 3)
    assert cannot_tell(scores).hits == sum(s.should_tell and s.verdict == "CANNOT_TELL" for s in scores)
    low, high = Rate(0, 500).interval
    assert low == pytest.approx(0, abs=1e-9)
    assert 0.5 < high < 1.0
    known = [replace(s, case=replace(s.case, reference="true")) for s in scores]
    assert dome_rate(known) == Rate(4, 5)
    assert rms([3.0, 4.0, float("nan")])[0] == pytest.approx(12.5**0.5)


def test_a_run_is_taken_up_where_it_was_broken_off(tmp_path: Path) -> None:
    raw = tmp_path / "verdict.jsonl"
    asked: list[int] = []

    def scored(number: int) -> Score:
        asked.append(number)
        return invented(number)

    run(3, raw, 1, scored)
    raw.write_text(raw.read_text()[:-40])  # the third was being written
    scores = run(5, raw, 1, scored)
    assert asked == [0, 1, 2, 2, 3, 4]
    assert [one.case.number for one in scores] == list(range(5))
    assert read_scores(raw)[4] == invented(4)


def test_the_report_holds_its_figures(tmp_path: Path) -> None:
    scores = [invented(n, verdict=("TRUST", "REFLY", "CANNOT_TELL")[n % 3]) for n in range(40)]
    scores[5] = Score(case(5), "no result", "too few", (), ())
    write_report(scores, tmp_path)
    text = (tmp_path / "verdict.md").read_text()
    named = [part.split(")")[0] for part in text.split("](")[1:]]
    assert len(named) == 5
    for name in named:
        ET.parse(tmp_path / name)
    assert "nan" not in text.replace("dominant", "")


def test_references_are_as_far_off_as_the_case_says() -> None:
    for level, df, deviation in (
        ("true", 0.0, 0.0),
        ("f off by 0.5 %", 0.5, 0.0),
        ("K1 off by 6 px", 0.0, 6.0),
    ):
        one = replace(ORDINARY, reference=level)
        held = reference_of(one, survey_of(one))
        assert held.reference is not None
        assert abs(held.df_percent) == pytest.approx(df, abs=0.06)
        assert held.deviation_px == pytest.approx(deviation, abs=1.0)
    one = replace(ORDINARY, reference="wrong body")
    other = reference_of(one, survey_of(one)).reference
    assert other is not None
    assert other.fitted_covariance is not None
    assert np.sqrt(other.fitted_covariance[0, 0]) == pytest.approx(0.005 * true_camera(one).f_px, rel=0.01)
    assert reference_of(replace(ORDINARY, reference="none"), survey_of(one)).reference is None


def test_the_true_lens_holds_the_pattern_as_far_as_a_field_can() -> None:
    block = survey_of(replace(ORDINARY, error="pattern 1.5 px"))
    lens = true_lens(block)
    rays = lens.brown.unproject(np.random.default_rng(0).uniform([200, 200], [3800, 2800], (500, 2)))
    missing = np.linalg.norm(lens.project(rays) - block.total_px(rays), axis=1)
    pattern = np.linalg.norm(block.total_px(rays) - lens.brown.project(rays), axis=1)
    assert np.sqrt(np.mean(missing**2)) < 0.6 * np.sqrt(np.mean(pattern**2))


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"pattern": "A1"}, "REFLY"),
        ({"noise": "0.3 px"}, "TRUST"),
        ({"reference": "f off by 0.5 %"}, "REFLY"),
        ({"reference": "K1 off by 6 px"}, "REFLY"),
        ({"reference": "none"}, "CANNOT_TELL"),
    ],
)
def test_flights_get_the_verdict_that_they_deserve(changes: dict[str, str], verdict: str) -> None:
    one = score(replace(ORDINARY, **changes))  # type: ignore[arg-type]
    assert one.verdict == verdict, one.headline
    assert not one.false_trust
    assert not one.false_refly
    assert one.sigma_percent == pytest.approx(one.ideal_sigma_percent, rel=0.4)
