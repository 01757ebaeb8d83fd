"""The plan sheet in a real browser: no errors, no requests, no sideways scrolling."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from mission_sites import FRAME, Hills, make_site
from PIL import Image
from shapely import box

from mission.compose import compose_with_notes
from mission.fence import Circle, Fence
from mission.limits import check_limits
from mission.planned import Planned
from mission.predict import predict
from mission.sheet import render_sheet
from mission.sheet_png import render_picture
from mission.space import Structure


def _planned() -> Planned:
    zone = Circle(FRAME.latitude_deg, FRAME.longitude_deg, 180.0)
    barn = Structure(box(20, 30, 30, 40), 8.0, 8.0, "<barn> & 'co'")
    site = make_site(
        box(-50, -50, 50, 50), fence=Fence(circles=(zone,)), structures=(barn,), terrain=Hills(6, 200)
    )
    made = compose_with_notes(["nadir", "fan"], site)
    return Planned(
        site,
        made.plan,
        predict(made.plan, site.terrain, site.area),
        check_limits(made.plan, site),
        (*made.notes, "Note with <markup>."),
    )


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_sheet_draws_cleanly(tmp_path: Path) -> None:
    text = render_sheet(_planned())
    assert "<barn>" not in text
    assert "<markup>" not in text
    page = tmp_path / "sheet.html"
    page.write_text(text, encoding="utf-8")
    with Browser(tmp_path / "profile") as browser:
        for width in (360, 900):
            browser.open(page, width, mobile=width < 500)
            assert browser.errors == []
            assert [url for url in browser.requests if not url.startswith("data:")][-1] == page.as_uri()
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
            drawn = "[...document.querySelectorAll('.plot')].filter(p => p.querySelector('.main-svg')).length"
            assert browser.evaluate(drawn) == 3


def test_the_sheet_is_the_same_for_the_same_plan() -> None:
    planned = _planned()
    assert render_sheet(planned) == render_sheet(planned)
    assert np.isfinite(planned.timing.duration_s)


def test_the_picture_shows_path_photos_and_text() -> None:
    planned = _planned()
    data = render_picture(planned)
    assert data == render_picture(planned)
    with Image.open(io.BytesIO(data)) as opened:
        picture = np.asarray(opened.convert("RGB")).astype(int)
    assert picture.shape[1] > picture.shape[0] > 1000
    assert 20e3 < len(data) < 2e6
    rows, columns = picture.shape[:2]

    def drawn(top: float, bottom: float, left: float, right: float, colour: tuple[int, int, int]) -> int:
        part = picture[int(top * rows) : int(bottom * rows), int(left * columns) : int(right * columns)]
        return int((np.abs(part - colour).sum(axis=2) < 40).sum())

    blue, orange = (0, 80, 140), (176, 48, 0)
    assert drawn(0.15, 0.6, 0.05, 0.35, blue) > 300  # photos
    assert drawn(0.15, 0.6, 0.05, 0.35, orange) > 100  # the fan
    assert drawn(0.65, 0.95, 0.05, 0.65, blue) > 300  # heights
    assert drawn(0.15, 0.95, 0.70, 1.0, (0, 0, 0)) + drawn(0.15, 0.95, 0.70, 1.0, (34, 34, 34)) > 500  # words
