"""The calibrations of one body over time: order, drift, pairs, averages, age, verified files."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from calib.brownfit import fit_brown
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.check import choose_reference
from calib.errors import InputError
from calib.field import FIELD_NAMES, LENS_NAMES, Lens
from calib.formats import read_calibration
from calib.photos.photo import CameraIdentity, Photo, Processing
from calib.reference import Reference
from calib.reference_history import (
    Entry,
    average,
    body_history,
    change,
    changes,
    condition,
    trends,
    verified_camera,
)
from calib.references import load_reference, save_reference
from daemon import cli

TRUTH = BrownCamera(4000, 3000, 2320.0, 2004.0, 1496.0, k1=-0.136, k2=0.115, k3=-0.018, p1=2e-4, p2=-1e-4)
SIGMAS = {"f": 0.4, "cx": 0.5, "cy": 0.5, "k1": 3e-5, "k2": 8e-5, "k3": 6e-5, "p1": 5e-6, "p2": 5e-6}


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path / "store"


def covariance_35() -> FloatArray:
    sigma = np.array([SIGMAS.get(name, 0.0) for name in LENS_NAMES])
    sigma[-len(FIELD_NAMES) :] = 0.01
    matrix = np.diag(sigma**2)
    i, j = LENS_NAMES.index("k1"), LENS_NAMES.index("k2")
    matrix[i, j] = matrix[j, i] = -0.9 * sigma[i] * sigma[j]
    return matrix


def made(
    name: str, day: str | None, df_px: float = 0.0, seed: int | None = None, **more: object
) -> Reference:
    """A calibration whose f is off by ``df_px``, and with a seed by chance as well."""
    covariance = covariance_35()
    vector = Lens(TRUTH).vector
    if seed is not None:
        vector = np.random.default_rng(seed).multivariate_normal(vector, covariance)
    vector[0] += df_px
    lens = Lens(TRUTH).with_vector(vector)
    fitted, jacobian = fit_brown(lens)
    reference = Reference(
        name=name,
        make="DJI",
        model="FC300X",
        width=4000,
        height=3000,
        processing=Processing.RAW,
        source="fieldcal calibrate wall",
        brown=lens.brown,
        field_px=lens.field_px,
        sigma={n: SIGMAS[n] for n in BROWN_NAMES if n in SIGMAS},
        covariance=covariance,
        serial="B7",
        date=day,
        exif_models=("FC300X",),
        fitted_brown=fitted,
        fitted_covariance=jacobian @ covariance @ jacobian.T,
    )
    return replace(reference, **more)  # type: ignore[arg-type]


def entry(reference: Reference) -> Entry:
    return Entry(
        reference.name, reference, None if reference.date is None else date.fromisoformat(reference.date)
    )


def test_everything_of_a_body_in_order_of_time() -> None:
    save_reference(made("mine", "2025-03-01", temperature_c=4.0))
    save_reference(made("mine", "2025-09-01", temperature_c=21.0))
    save_reference(made("other-name", "2025-06-01"))
    save_reference(made("other-body", "2025-07-01", serial="C8"))
    save_reference(
        made(
            "other-size",
            "2025-07-01",
            width=2000,
            height=1500,
            brown=TRUTH.scaled(2000, 1500),
            fitted_brown=None,
            field_px=None,
        )
    )
    entries, faults = body_history("mine")
    assert faults == ()
    assert [e.label for e in entries] == ["mine (1)", "other-name", "mine"]
    assert [e.reference.temperature_c for e in entries] == [4.0, None, 21.0]


def test_drift_is_told_from_chance() -> None:
    """Over seeds: the same lens is called different about as often as the limit says, a moved one always."""
    same = [change(entry(made("a", None, seed=s)), entry(made("b", None, seed=s + 500))) for s in range(120)]
    assert sum(c.different for c in same) <= 5
    spread = np.array([c.f_percent / c.sigma_percent for c in same])
    assert 0.8 < spread.std() < 1.2
    chances = np.array([c.chance for c in same])
    assert 0.35 < chances.mean() < 0.65
    moved = change(entry(made("a", "2025-01-01")), entry(made("b", "2025-01-02", df_px=4.6)))
    assert moved.different
    assert moved.pair
    assert moved.f_percent == pytest.approx(100 * 4.6 / 2320, rel=1e-3)
    assert moved.sigma_percent == pytest.approx(100 * 0.4 * 2**0.5 / 2320, rel=0.2)


def test_trend_with_temperature_and_time() -> None:
    years = [made(f"y{i}", f"{2021 + i}-05-01", 0.8 * i, seed=i, temperature_c=20.0 - i) for i in range(5)]
    by_time, by_warmth = trends([entry(r) for r in years])
    assert by_time.unit == "year"
    assert by_time.slope_percent == pytest.approx(100 * 0.8 / 2320, abs=3 * by_time.sigma_percent)
    assert by_time.significant
    assert by_warmth.slope_percent < 0
    assert trends([entry(r) for r in years[:2]]) == ()


def test_average_is_better_than_its_parts() -> None:
    misses, claimed = [], []
    for seed in range(40):
        parts = [entry(made(f"p{i}", f"2025-05-0{i + 1}", seed=100 * seed + i)) for i in range(4)]
        mean = average(parts, "mean")
        assert mean.fitted_covariance is not None
        misses.append((mean.f_px or 0) - fit_brown(Lens(TRUTH))[0].f_px)
        claimed.append(float(np.sqrt(mean.fitted_covariance[0, 0])))
    assert np.std(misses) == pytest.approx(0.2, rel=0.35)
    # The claim grows with the scatter, so it is a little above the plain one.
    assert 0.18 < np.mean(claimed) < 0.32
    assert mean.date == "2025-05-04"
    assert "p0 (2025-05-01" in mean.provenance
    save_reference(mean)
    assert load_reference("mean").covariance == pytest.approx(mean.covariance)


def test_contradicting_calibrations_are_not_averaged() -> None:
    a, b, c = made("a", "2025-01-01"), made("b", "2025-01-02", 0.1), made("c", "2025-01-03", 5.0)
    with pytest.raises(InputError, match=r"a and c contradict|b and c contradict"):
        average([entry(a), entry(b), entry(c)], "mean")
    with pytest.raises(InputError, match="not of one camera body"):
        average([entry(a), entry(replace(b, serial="C8"))], "mean")
    with pytest.raises(InputError, match="at least two"):
        average([entry(a)], "mean")


def test_check_says_that_a_reference_aged_or_moved() -> None:
    save_reference(made("mine", "2023-03-01"))
    save_reference(made("mine", "2023-09-01", df_px=4.6))
    said = condition(load_reference("mine"), date(2025, 3, 1))
    assert len(said) == 2
    assert "1.5 years older" in said[0]
    assert "moved by +0.198 %" in said[1]
    from datetime import datetime

    camera = CameraIdentity("DJI", "FC300X", "B7", 4000, 3000, Processing.RAW)
    photo = Photo(Path("a.jpg"), camera, time=datetime(2025, 3, 1, 12, 0))
    reference, note = choose_reference(photo, None)
    assert reference is not None
    assert note.startswith("Held against reference mine.")
    assert "calibrate again" in note
    assert condition(made("mine", "2025-03-01", serial=None), date(2025, 3, 2)) == ()
    assert condition(load_reference("dji-inspire-1"), date(2025, 3, 2)) == ()


def test_verified_only_what_deserves_it() -> None:
    assert verified_camera(made("a", "2025-01-01")).f_px == pytest.approx(2320, abs=0.5)
    with pytest.raises(InputError, match="without a covariance"):
        verified_camera(made("a", None, covariance=None, fitted_covariance=None))
    with pytest.raises(InputError, match="is needed"):
        verified_camera(made("a", None, fitted_covariance=np.eye(11) * 25))


def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_reference(made("before", "2025-05-01", temperature_c=12.0))
    save_reference(made("after", "2025-05-02", df_px=0.2, temperature_c=14.0))
    assert cli.run(["cameras", "history", "after"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "2025-05-01 before 12" in printed
    assert (
        "no more than chance explains; a pair before and after: the survey between them is framed" in printed
    )
    assert cli.run(["cameras", "history", "after", "--json", "-"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["schema"] == "fieldcal.history/1"
    assert data["changes"][0]["before_and_after"] is True
    assert cli.run(["cameras", "compare", "before", "after"]) == 0
    assert "chance explains" in " ".join(capsys.readouterr().out.split())
    assert cli.run(["cameras", "average", "before", "after", "--name", "mean"]) == 0
    capsys.readouterr()
    out = tmp_path / "verified"
    assert cli.run(["cameras", "verified", "mean", "--out", str(out)]) == 0
    words = (out / "PROVENANCE.txt").read_text(encoding="utf-8")
    for file in ("cameras.json", "metashape.xml"):
        assert hashlib.sha256((out / file).read_bytes()).hexdigest() in words
        assert read_calibration(out / file)[1].f_px == pytest.approx(2320.1, abs=0.5)
    assert "average of 2 calibrations" in words
    capsys.readouterr()
    assert cli.run(["cameras", "average", "before", "before", "--name", "x"]) == 2
    assert cli.run(["cameras", "history", "nobody"]) == 2
    assert cli.run(["cameras", "verified", "dji-inspire-1", "--out", str(tmp_path / "v")]) == 2
    assert not (tmp_path / "v").exists()


def test_changes_from_each_to_the_next() -> None:
    entries = [entry(made(n, f"2025-0{i + 1}-01")) for i, n in enumerate("abc")]
    assert [(c.before, c.after) for c in changes(entries)] == [("a", "b"), ("b", "c")]
