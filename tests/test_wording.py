import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.photos.photo import CameraIdentity
from calib.wording import (
    camera_name,
    html_text,
    path_text,
    printable,
    quantity,
    unit_text,
    with_bound_units,
)


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "text"),
    [
        (0.214, 0.024, "%", "(0.214 ± 0.024) %"),
        (2325.0214, 0.553, "px", "2325.02 ± 0.55 px"),
        (-2.5e-8, 1e-10, "px⁻²", "(−2.500 ± 0.010) × 10⁻⁸ px⁻²"),
        (3.2e-17, None, "px⁻⁴", "3.2 × 10⁻¹⁷ px⁻⁴"),
        (30.8, None, "%", "30.8 %"),
        (150.0, 20.0, "px", "150 ± 20 px"),
        (0.0, None, "", "0"),
        (1.0, math.nan, "m", "1 m"),
        (math.nan, 1.0, "m", "not measured"),
        (None, None, "m", "not measured"),
    ],
)
def test_quantity(value: float | None, sigma: float | None, unit: str, text: str) -> None:
    assert quantity(value, sigma, unit) == text


@given(
    st.floats(-1e300, 1e300) | st.sampled_from([math.nan, math.inf, -math.inf]),
    st.none() | st.floats(min_value=0),
)
def test_quantity_always_reads_back(value: float, sigma: float | None) -> None:
    text = quantity(value, sigma)
    if not math.isfinite(value):
        assert text == "not measured"
        return
    found = re.match(r"\(?(−?[\d.]+)(?: ± ([\d.]+)\)?)?(?: × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?$", text)
    assert found is not None
    power = int((found[3] or "0").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")))
    back = float(found[1].replace("−", "-")) * 10.0**power if power > -300 else 0.0
    shown = sigma is not None and math.isfinite(sigma) and sigma > 1e-290
    room = max(abs(value) * 1e-3, (sigma or 0) * 0.06 if shown else 0.0, 1e-280)
    assert abs(back - value) <= room


def test_names_do_not_repeat_the_maker() -> None:
    assert camera_name(CameraIdentity("DJI", "FC300X", None, 1, 1)) == "DJI FC300X"
    assert camera_name(CameraIdentity("Canon", "Canon EOS 5D", None, 1, 1)) == "Canon EOS 5D"
    assert camera_name(CameraIdentity("", "", None, 1, 1)) == "Unknown camera"


def test_text_from_files_is_tamed() -> None:
    assert printable("a\x00b\x1b[31mc\nd\u202ee") == "a\ufffdb\ufffd[31mc d\ufffde"
    assert html_text("<b>\"'&") == "&lt;b&gt;&quot;&#x27;&amp;"


def test_paths_that_are_no_utf8_can_be_written() -> None:
    path_text(Path("DCIM/\udcff.JPG")).encode("utf-8")


def test_units_for_people() -> None:
    assert unit_text("px^-4") == "px⁻⁴"
    assert unit_text("% H") == "% of the height"
    assert unit_text("px") == "px"
    assert quantity(0.214, 0.024, unit_text("% H")) == "(0.214 ± 0.024) % of the height"


def test_units_are_bound_to_their_numbers_only() -> None:
    space = "\N{NO-BREAK SPACE}"
    assert with_bound_units("known to 0.1 % at 60 m, 3 more") == f"known to 0.1{space}% at 60{space}m, 3 more"
