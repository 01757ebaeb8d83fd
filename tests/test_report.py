import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import result_factory

from calib.findings import Finding, State, Verdict
from calib.photos.photo import CameraIdentity, LeftOut, Processing
from calib.report import render_report
from calib.result import CheckResult

EVIL = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>"
EVIL_NAME = "<script>alert(1)<\\script>\"'><img src=x onerror=alert(2)>"


class _Outline(HTMLParser):
    """Tags and attributes of a page, and the text outside scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._quiet = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._quiet = tag in ("script", "style")

    def handle_endtag(self, tag: str) -> None:  # noqa: ARG002
        self._quiet = False

    def handle_data(self, data: str) -> None:
        if not self._quiet:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(self.words).replace("\N{NO-BREAK SPACE}", " ")


@pytest.fixture(scope="module")
def result() -> CheckResult:
    return result_factory.build()


@pytest.fixture(scope="module")
def page(result: CheckResult) -> str:
    return render_report(result)


def test_everything_is_told(page: str, result: CheckResult) -> None:
    text = _Outline(page).text
    assert "REFLY" in text
    assert result.headline in text
    assert result.what_to_fly is not None
    assert result.what_to_fly in text
    for finding in result.findings:
        assert finding.message in text
        assert finding.source in text
    for item in result.left_out:
        assert str(item.path) in text
    assert "(0.214 ± 0.024) %" in text
    assert "2325.02 ± 0.55 px" in text
    assert "Carbonneau & Dietrich 2017, flat wall" in text


def test_what_went_wrong_comes_first(page: str) -> None:
    text = _Outline(page).text
    order = [text.index(word) for word in ("Not in order (2)", "Not known (1)", "In order (8)")]
    assert order == sorted(order)


def test_small_enough_to_mail_and_deterministic(page: str, result: CheckResult) -> None:
    assert len(page.encode()) < 6_000_000
    assert page == render_report(result)


def test_nothing_is_fetched(page: str) -> None:
    for tag, attributes in _Outline(page).tags:
        assert "src" not in attributes, tag
        assert tag not in ("link", "iframe", "object", "embed", "base")
        assert not re.match(r"\w+:|//", attributes.get("href") or "")
    head = page[: page.index("<style>")]
    assert "default-src 'none'" in head
    assert "connect-src" not in head


def test_figures_have_titles_and_words(page: str) -> None:
    tags = _Outline(page).tags
    plots = [attributes for _, attributes in tags if attributes.get("class") == "plot"]
    assert len(plots) == 7
    for plot in plots:
        assert plot["role"] == "img"
        assert len(plot["aria-label"] or "") > 40
    levels = [int(tag[1]) for tag, _ in tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1


@pytest.mark.parametrize("verdict", list(Verdict))
def test_the_verdict_is_a_word_a_sign_and_a_colour(verdict: Verdict) -> None:
    page = render_report(result_factory.build(verdict, points=200))
    header = page[page.index("<header") : page.index("</header>")]
    assert verdict.value.lower() in header
    assert verdict.value.replace("_", " ") in header
    assert "<svg" in header
    assert ("What to fly" in page) == (verdict is not Verdict.TRUST)


def test_text_from_files_stays_text() -> None:
    base = result_factory.build(points=200, make=EVIL, model=EVIL)
    photos = tuple(
        replace(photo, path=Path(f"DCIM/{i}{EVIL_NAME}")) for i, photo in enumerate(base.solution.photos)
    )
    bad = Finding("<rule>", State.FLAG, 1.0, 0.1, "<b>", 1.0, EVIL, EVIL)
    assert base.reference is not None
    page = render_report(
        replace(
            base,
            headline=EVIL,
            what_to_fly=EVIL,
            findings=(bad,),
            camera=CameraIdentity(EVIL, EVIL, EVIL, 4000, 3000, Processing.UNKNOWN),
            solution=replace(base.solution, photos=photos),
            reference=replace(base.reference, name=EVIL, source=EVIL),
            reference_note=EVIL,
            left_out=(LeftOut(Path(EVIL_NAME), EVIL),),
            exports={EVIL: "javascript:alert(1)"},
        )
    )
    outline = _Outline(page)
    tags = [tag for tag, _ in outline.tags]
    clean = [tag for tag, _ in _Outline(render_report(base)).tags]
    assert tags.count("img") == 0
    assert tags.count("script") == clean.count("script")
    assert not any(name.startswith("on") for _, attributes in outline.tags for name in attributes)
    assert not any((attributes.get("href") or ".").startswith("javascript") for _, attributes in outline.tags)


@pytest.mark.parametrize("reference", [True, False])
def test_unknown_numbers_are_said_to_be_unknown(reference: bool) -> None:
    spoiled = result_factory.with_nan_sigmas(
        result_factory.build(Verdict.CANNOT_TELL, reference=reference, gps=False, points=200)
    )
    text = _Outline(render_report(spoiled)).text
    assert "not measured" in text
    assert not re.search(r"\b(nan|inf)\b", text)
    assert "The photos carry no positions." in text


def test_a_result_with_little_in_it_still_renders() -> None:
    base = result_factory.build(Verdict.CANNOT_TELL, reference=False, convergent=0, points=200)
    assert "CANNOT TELL" in render_report(replace(base, findings=(), left_out=(), what_to_fly=None))


def test_nothing_is_in_metres_where_the_geotags_set_no_scale() -> None:
    page = render_report(result_factory.build(gps=False, points=300))
    text = _Outline(page[page.index("<main>") :]).text
    assert not re.search(r"m above ground|cm per pixel|in metres", text)
    assert "% of the flying height" in text
    assert "lengths are in flying heights" in text
    known = render_report(result_factory.build(points=300))
    assert "60 m above ground" in _Outline(known).text


def test_numbers_and_units_stay_together(page: str) -> None:
    body = page[page.index("<main>") : page.index('id="figures"')]
    assert "\N{NO-BREAK SPACE}%" in body
    assert not re.search(r"\d %", body)
    assert "px^" not in body
