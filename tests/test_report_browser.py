"""The report in a real browser: no errors, no requests, no sideways scrolling."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import result_factory
from browser import CHROMIUM, Browser

from calib.findings import Verdict
from calib.report import render_report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render_report(result_factory.build()), encoding="utf-8")
    return path


def _draws_cleanly(browser: Browser, page: Path, width: int) -> int:
    """Opens the page, checks that it is quiet and fits, and counts its figures."""
    browser.errors.clear()
    browser.requests.clear()
    browser.open(page, width, mobile=width < 500)
    assert browser.errors == []
    assert [url for url in browser.requests if not url.startswith("data:")] == [page.as_uri()]
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    plots = browser.evaluate("document.querySelectorAll('.plot').length")
    assert plots == browser.evaluate(
        "[...document.querySelectorAll('.plot')].filter(p => p.querySelectorAll('.main-svg').length).length"
    )
    return int(plots)


@pytest.mark.parametrize("width", [360, 1200])
def test_draws_without_errors_or_requests(browser: Browser, page: Path, width: int) -> None:
    assert _draws_cleanly(browser, page, width) == 7


def test_draws_what_is_left_where_little_is_known(browser: Browser, tmp_path: Path) -> None:
    lonely = result_factory.build(Verdict.CANNOT_TELL, reference=False, gps=False)
    page = tmp_path / "report.html"
    page.write_text(render_report(result_factory.with_nan_sigmas(lonely)), encoding="utf-8")
    assert _draws_cleanly(browser, page, 360) == 4


def test_readable_on_a_phone(browser: Browser, page: Path) -> None:
    browser.open(page, 360, mobile=True)
    smallest = browser.evaluate(
        "Math.min(...[...document.querySelectorAll('main :is(p, li, td, dd, code, figcaption)')]"
        ".map(e => parseFloat(getComputedStyle(e).fontSize)))"
    )
    assert smallest >= 16
    # Every drawing fits its place.
    spill = browser.evaluate(
        "Math.max(...[...document.querySelectorAll('.plot')].map(p => p.scrollWidth - p.clientWidth))"
    )
    assert spill <= 1


def test_injected_scripts_do_not_run(browser: Browser, page: Path, tmp_path: Path) -> None:
    """The content security policy holds even if something slipped through the escaping."""
    hostile = tmp_path / "hostile.html"
    text = page.read_text(encoding="utf-8")
    hostile.write_text(text.replace("<main>", "<main><script>window.owned = 1</script>"), encoding="utf-8")
    browser.open(hostile, 800)
    assert browser.evaluate("window.owned === undefined")
    assert browser.evaluate("typeof Plotly") == "object"


def test_prints_on_a4(browser: Browser, page: Path) -> None:
    browser.open(page, 1200)
    pdf = browser.pdf()
    assert pdf.startswith(b"%PDF")
    assert 3 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page\r") <= 12
    # Back to the screen's size afterwards.
    assert browser.evaluate("document.querySelector('.plot').clientWidth") > 640
    assert browser.evaluate("document.documentElement.scrollWidth") <= 1200
