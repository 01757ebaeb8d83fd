import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
import result_factory
from rich.console import Console

from calib.findings import Finding, State, Verdict
from calib.photos.photo import LeftOut
from calib.result import CheckResult
from daemon.terminal import print_summary


def _printed(
    result: CheckResult, width: int = 120, encoding: str = "utf-8", report: Path | None = None
) -> str:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding, write_through=True)
    print_summary(result, Console(file=stream, width=width), report)
    return raw.getvalue().decode(encoding)


@pytest.mark.parametrize("verdict", list(Verdict))
def test_says_what_matters_in_80_columns(verdict: Verdict) -> None:
    result = result_factory.build(verdict, points=200)
    text = _printed(result, report=Path("/tmp/out/report.html"))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) < 30
    assert verdict.value.replace("_", " ") in lines[1]
    for finding in result.findings:
        assert finding.rule in text
    assert ("What to fly" in text) == (verdict is not Verdict.TRUST)
    assert lines[-1] == "Report: /tmp/out/report.html"


def test_flags_come_first() -> None:
    text = _printed(result_factory.build(points=200))
    assert text.index("✗ focal-drift") < text.index("? coverage") < text.index("✓ alignment")


def test_narrow_terminals_wrap() -> None:
    text = _printed(result_factory.build(points=200), width=50)
    assert max(map(len, text.splitlines())) <= 50


def test_terminals_without_unicode_get_plain_signs() -> None:
    text = _printed(result_factory.build(points=200), encoding="ascii")
    assert "!! focal-drift" in text
    assert "ok alignment" in text


def test_text_from_files_is_neither_markup_nor_control() -> None:
    base = result_factory.build(points=200, make="[bold]x[/nope]", model="\x1b[31mred")
    bad = Finding("rule", State.FLAG, None, None, "", None, "", "[link=file:///etc]y[/link] \x1b]0;t\x07")
    text = _printed(replace(base, findings=(bad,)))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "[bold]x[/nope]" in text
    assert "[link=file:///etc]" in text


def test_a_long_path_stays_on_one_line() -> None:
    path = Path("/media/" + "long-name/" * 12 + "report.html")
    text = _printed(result_factory.build(points=200), width=60, report=path)
    assert f"Report: {path}" in text.splitlines()


def test_no_colour_where_the_user_declines(monkeypatch: pytest.MonkeyPatch) -> None:
    result = result_factory.build(points=200)
    shown = {}
    for declined in (False, True):
        if declined:
            monkeypatch.setenv("NO_COLOR", "1")
        else:
            monkeypatch.delenv("NO_COLOR", raising=False)
        stream = io.StringIO()
        print_summary(result, Console(file=stream, width=80, force_terminal=True, color_system="standard"))
        shown[declined] = stream.getvalue()
    assert "\x1b[1;31m" in shown[False]
    assert not re.search(r"\x1b\[[0-9;]*[34][0-7]", shown[True])


def test_what_was_left_out_is_named_with_its_reason() -> None:
    text = _printed(result_factory.build(points=200))
    assert "  DJI_0027.JPG: taken below 10 m, at take-off or landing" in text
    assert "  DJI_0028.JPG, DJI_0029.JPG: the horizon is in the picture" in text


def test_many_left_out_are_shortened() -> None:
    result = result_factory.build(points=200)
    many = tuple(LeftOut(Path(f"{i:03d}.JPG"), f"reason {i // 10 if i < 20 else i}") for i in range(40))
    text = _printed(replace(result, left_out=many))
    assert "000.JPG, 001.JPG, 002.JPG and 7 more: reason 0" in text
    assert "17 more, named in the report" in text


def test_numbers_stay_with_their_units() -> None:
    message = "Known to " + "very " * 8 + "well 0.1 % of it, to 12.5 px and to 3 sigma, by 18 photos. " * 4
    finding = Finding("rule", State.FLAG, None, None, "", None, "", message)
    for width in range(30, 81):
        text = _printed(replace(result_factory.build(points=50), findings=(finding,)), width=width)
        for line in text[text.index("✗ rule") : text.index("What to fly")].splitlines():
            assert not re.search(r"\d$", line), (width, line)
        assert max(map(len, text.splitlines())) <= width
