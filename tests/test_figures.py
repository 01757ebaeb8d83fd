from dataclasses import replace

import numpy as np
import pytest
import result_factory

from calib.figures import (
    camera_network_figure,
    correlation_figure,
    coverage_figure,
    dome_figure,
    equifinal_figure,
    error_ellipse,
    profile_figure,
    residual_figure,
)
from calib.figures.sensor import ARROW_CELLS, mean_residuals, residual_exaggeration
from calib.figures.site import MOST_POINTS, relative_unit
from calib.findings import Verdict
from calib.propagation import radial_px, radial_px_covariance
from calib.result import CheckResult


@pytest.fixture(scope="module")
def result() -> CheckResult:
    return result_factory.build()


def _trace(figure: object, name: str) -> object:
    return next(trace for trace in figure.data if trace.name == name)  # type: ignore[attr-defined]


def test_the_ellipse_holds_95_percent() -> None:
    brown = result_factory.p3p_camera()
    centre = radial_px(brown)[:2]
    covariance = radial_px_covariance(brown, result_factory.brown_covariance())[:2, :2]
    outline = error_ellipse(centre, covariance)
    assert outline is not None
    # Every point of the outline lies at the chi-square distance, in whitened coordinates.
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.inv(covariance / np.outer(scale, scale))
    away = (outline - centre) / scale
    assert np.einsum("ni,ij,nj->n", away, inverse, away) == pytest.approx(5.991, rel=1e-6)
    drawn = np.random.default_rng(5).multivariate_normal([0, 0], covariance / np.outer(scale, scale), 20000)
    inside = np.einsum("ni,ij,nj->n", drawn, inverse, drawn) <= 5.991
    assert 0.94 < inside.mean() < 0.96


def test_no_ellipse_without_a_covariance() -> None:
    assert error_ellipse(np.zeros(2), np.full((2, 2), np.nan)) is None
    assert error_ellipse(np.zeros(2), np.zeros((2, 2))) is None


def test_equifinal_plane_shows_line_band_domain_reference_and_flight(result: CheckResult) -> None:
    figure = equifinal_figure(result.estimate, result.reference, result.line)
    assert figure is not None
    names = {trace.name for trace in figure.data}
    assert names == {"band", "equifinal line", "domain", "95 % of this flight", "reference", "this flight"}
    line = _trace(figure, "equifinal line")
    x, y = np.array(line.x, float) * 1e-8, np.array(line.y, float) * 1e-15  # type: ignore[attr-defined]
    assert y == pytest.approx(-2.7364e-7 * x - 3.4086e-15, rel=1e-4)
    low, high = figure.layout.xaxis.range
    flight = _trace(figure, "this flight")
    assert low < flight.x[0] < high  # type: ignore[attr-defined]


def test_a_hopeless_ellipse_does_not_hide_the_line(result: CheckResult) -> None:
    wild = replace(result.estimate, covariance=result_factory.brown_covariance(400))
    figure = equifinal_figure(wild, result.reference, result.line)
    assert figure is not None
    low, high = figure.layout.xaxis.range
    assert high - low < 3 * 0.25


def test_equifinal_plane_needs_something_to_compare() -> None:
    lonely = result_factory.with_nan_sigmas(result_factory.build(reference=False, points=200))
    assert equifinal_figure(lonely.estimate, None, None) is None
    assert correlation_figure(lonely.estimate.covariance) is None
    assert dome_figure(lonely.dome) is None


def test_profiles_are_those_of_the_cameras(result: CheckResult) -> None:
    figure = profile_figure(result.estimate, result.reference, 2.0)
    here, there = _trace(figure, "this flight"), _trace(figure, "reference")
    difference = _trace(figure, "difference")
    assert np.array(here.x, float).max() == pytest.approx(2500)  # type: ignore[attr-defined]
    expected = np.array(here.y, float) - np.array(there.y, float)  # type: ignore[attr-defined]
    assert np.array(difference.y, float) == pytest.approx(expected, abs=1e-4)  # type: ignore[attr-defined]


def test_coverage_counts_every_observation(result: CheckResult) -> None:
    figure = coverage_figure(result.solution)
    heat = next(trace for trace in figure.data if trace.type == "heatmap")
    assert np.array(heat.z, float).sum() == len(result.solution.observations)


def test_residual_arrows_stay_in_their_cells(result: CheckResult) -> None:
    _, mean = mean_residuals(result.solution)
    longest = np.hypot(*mean.T).max() * residual_exaggeration(result.solution)
    cell = result.solution.lens.brown.width / ARROW_CELLS
    assert 0.3 * cell < longest <= 0.9 * cell
    assert len(residual_figure(result.solution).data) == 2


def test_mean_residuals_are_means(result: CheckResult) -> None:
    shifted = replace(
        result.solution, residuals_px=np.full((len(result.solution.observations), 2), [0.2, -0.1])
    )
    _, mean = mean_residuals(shifted)
    assert mean == pytest.approx(np.full(mean.shape, [0.2, -0.1]))


def test_outliers_do_not_count(result: CheckResult) -> None:
    n = len(result.solution.observations)
    residuals, weights = np.zeros((n, 2)), np.ones(n)
    residuals[::7], weights[::7] = 100, 0.0
    _, mean = mean_residuals(replace(result.solution, residuals_px=residuals, weights=weights))
    assert np.abs(mean).max() == 0
    assert residual_exaggeration(replace(result.solution, residuals_px=0 * residuals)) == 1


def test_network_marks_the_convergent_photos(result: CheckResult) -> None:
    figure = camera_network_figure(result.solution, result.network)
    assert len(_trace(figure, "convergent photos").x) == 8  # type: ignore[attr-defined]
    assert len(_trace(figure, "other photos").x) == 18  # type: ignore[attr-defined]
    assert figure.layout.yaxis.scaleanchor == "x"


def test_big_clouds_are_thinned_and_outliers_dropped(result: CheckResult) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-70, 70, (50_001, 3))
    points[0] = [9e6, 0, 0]
    points[1] = np.nan
    figure = camera_network_figure(replace(result.solution, points_m=points), result.network)
    x = np.array(_trace(figure, "points").x, float)  # type: ignore[attr-defined]
    assert MOST_POINTS / 2 < len(x) <= MOST_POINTS
    assert np.abs(x).max() <= 70


def test_dome_in_centimetres(result: CheckResult) -> None:
    figure = dome_figure(result.dome)
    assert figure is not None
    heat = next(trace for trace in figure.data if trace.type == "heatmap")
    assert np.nanmax(np.array(heat.z, float)) == pytest.approx(4.6, abs=0.01)


def test_verdicts_share_the_figures() -> None:
    for verdict in Verdict:
        other = result_factory.build(verdict, points=200)
        assert equifinal_figure(other.estimate, other.reference, other.line) is not None


def test_without_a_scale_the_site_is_drawn_in_flying_heights(result: CheckResult) -> None:
    unit = relative_unit(60.0)
    metres = camera_network_figure(result.solution, result.network)
    relative = camera_network_figure(result.solution, result.network, unit)
    assert metres.layout.xaxis.title.text == "east (m)"
    assert relative.layout.xaxis.title.text == "across (flying heights)"
    for axis in "xy":
        before, after = (np.asarray(_trace(f, "convergent photos")[axis], float) for f in (metres, relative))
        assert np.ptp(after) == pytest.approx(np.ptp(before) / 60, rel=1e-5)
    assert abs(float(np.median(np.asarray(relative.data[0].marker.color, float)))) < 0.01
    dome = dome_figure(result.dome, unit)
    assert dome is not None
    # 9.2 cm over 60 m are 0.153 %; the map shows half of it in the middle.
    assert np.nanmax(np.abs(np.asarray(dome.data[0].z, float))) == pytest.approx(
        100 * np.nanmax(np.abs(result.dome.grid_difference_m)) / 60, rel=1e-5
    )
