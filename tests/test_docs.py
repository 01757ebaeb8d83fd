"""The documentation against the program: commands, options, numbers, schemas and links."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from calib import limits
from calib.camera import BrownCamera
from calib.equifinal import STRICT_TOLERANCE_PX
from calib.errors import FieldcalError
from calib.export import CALIBRATIONS, GEO, METASHAPE_REFERENCE, NOT_WRITTEN
from calib.findings import Verdict
from calib.formats import FORMATS
from calib.report_json import CheckReport
from calib.wording import HELD_TITLES, RULE_TITLES
from daemon import cli
from daemon.cli_check import REFERENCE_SIGMA_PERCENT
from mission.patterns import DESCRIPTIONS
from mission.site_file import SiteFile

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]

COMMANDS = (
    (),
    ("check",),
    ("assess",),
    ("correct",),
    ("adjust-k",),
    ("equifinal",),
    ("perturb",),
    ("plan",),
    ("refly",),
    ("calibrate",),
    *(("calibrate", sub) for sub in ("wall", "orbit", "control", "mark")),
    ("cameras",),
    *(
        ("cameras", sub)
        for sub in ("list", "show", "compare", "import", "export", "history", "average", "verified")
    ),
    ("sim",),
    *(("sim", sub) for sub in ("list", "survey", "vehicle", "camera")),
    ("upload",),
    ("doctor",),
    ("sessions",),
    *(("sessions", sub) for sub in ("list", "show", "export", "geotag")),
    ("run",),
    ("status",),
)
#: Options of other programs that the docs mention, and the other side of a switch.
FOREIGN = {"--cameras", "--counter-clockwise", "--geo", "--strict"}
FOREIGN |= {"--enable", "--find-links", "--home-dir", "--no-deps", "--no-index", "--now", "--only-binary"}
FOREIGN |= {"--require-hashes", "--shell", "--system"}
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
_FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _blocks(kind: str) -> list[tuple[str, str]]:
    """(page, text) of all code blocks whose info string is ``kind``."""
    return [(name, body) for name in NAMES for info, body in _FENCE.findall(_text(name)) if info == kind]


def _rows(name: str, header: str) -> list[list[str]]:
    """Cells of the table under the line ``header``, without backticks."""
    lines = iter(_text(name).splitlines())
    assert any(line.strip() == header for line in lines), f"{name} has no table {header}"
    next(lines)
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append([cell.strip().strip("`") for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
    assert rows
    return rows


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder to work in, an empty store, and a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("FIELDCAL_SESSIONS", str(tmp_path / "sessions"))
    monkeypatch.setenv("COLUMNS", "80")


@pytest.fixture(scope="module")
def options() -> dict[tuple[str, ...], set[str]]:
    """Options of every command, from its --help."""
    found = {}
    for command in COMMANDS:
        with contextlib.redirect_stdout(io.StringIO()) as out:
            assert cli.run([*command, "--help"]) == 0
        said = out.getvalue()
        found[command] = set(re.findall(r"^\s+(--[a-z][a-z0-9-]*)", said, re.MULTILINE))
        found[command] |= set(re.findall(r"(?<= / )--[a-z-]+", said))
    return found


# --- Commands ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("page", "block"), _blocks("sh run"))
def test_runnable_commands_run(page: str, block: str) -> None:
    for line in block.splitlines():
        words = shlex.split(line, comments=True)
        assert words[0] == "fieldcal", f"{page}: only fieldcal's own commands are run"
        assert cli.run(words[1:]) == 0, f"{page}: {line}"


@pytest.mark.parametrize(("page", "block"), _blocks("console run"))
def test_commands_print_what_the_docs_show(page: str, block: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Line by line; "..." in the docs stands for any number of lines."""
    for session in block.split("$ ")[1:]:
        line, _, shown = session.partition("\n")
        assert cli.run(shlex.split(line)[1:]) == 0, f"{page}: {line}"
        printed = "".join(f"{text.rstrip()}\n" for text in capsys.readouterr().out.splitlines())
        pattern = "".join(
            r"(?:.*\n)*?" if text == "..." else re.escape(text) + r"\n" for text in shown.splitlines()
        )
        assert re.fullmatch(pattern, printed), f"{page}: {line} prints\n{printed}"


def test_there_is_something_to_run() -> None:
    assert len(_blocks("sh run")) >= 1
    assert len(_blocks("console run")) >= 3


@pytest.mark.parametrize("name", NAMES)
def test_no_option_is_invented(name: str, options: dict[tuple[str, ...], set[str]]) -> None:
    known = set().union(*options.values()) | FOREIGN
    code = " ".join(_FENCE.sub(" ", _text(name)).split("`")[1::2])
    code += " ".join(body for _, body in _FENCE.findall(_text(name)))
    assert set(_OPTION.findall(code)) <= known


@pytest.mark.parametrize(
    ("page", "commands"),
    [
        ("docs/check.md", [("check",)]),
        ("docs/assess.md", [("assess",), ("correct",), ("adjust-k",)]),
        ("docs/equifinal.md", [("equifinal",)]),
        ("docs/perturb.md", [("perturb",)]),
        ("docs/planning.md", [("plan",)]),
        ("docs/refly.md", [("refly",)]),
        ("docs/cameras.md", [("cameras", "import"), ("cameras", "export")]),
        ("docs/simulator.md", [("sim", "survey"), ("sim", "vehicle"), ("sim", "camera")]),
        ("docs/upload.md", [("upload",), ("doctor",)]),
        ("docs/sessions.md", [("sessions", "export"), ("sessions", "geotag")]),
        ("docs/run.md", [("run",)]),
        ("docs/live.md", [("status",)]),
        ("docs/calibrate.md", [("calibrate", sub) for sub in ("wall", "orbit", "control", "mark")]),
    ],
)
def test_no_option_is_left_out(
    page: str, commands: list[tuple[str, ...]], options: dict[tuple[str, ...], set[str]]
) -> None:
    for command in commands:
        assert options[command] - {"--help"} <= set(_OPTION.findall(_text(page)))
        assert len(options[command]) > 2


@pytest.mark.parametrize("name", NAMES)
def test_shown_commands_use_options_of_their_own(name: str, options: dict[tuple[str, ...], set[str]]) -> None:
    for line in re.findall(
        r"^(?:\$ )?fieldcal (.*)$", "\n".join(b for _, b in _FENCE.findall(_text(name))), re.M
    ):
        words = line.split()
        command = tuple(words[: 2 if words[0] in ("calibrate", "cameras", "sim", "sessions") else 1])
        assert command in COMMANDS, line
        assert set(_OPTION.findall(line)) <= options[command], line


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", _text("Makefile"), re.MULTILINE))
    code = [
        c
        for name in NAMES
        for c in [*_text(name).split("`")[1::2], *(b for _, b in _FENCE.findall(_text(name)))]
    ]
    mentioned = {target for text in code for target in re.findall(r"^make ([a-z]+)", text, re.MULTILINE)}
    assert {"demo", "test", "lint", "lock"} <= mentioned <= targets


# --- Numbers -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("page", "header"),
    [("README.md", "| code | meaning |"), ("docs/check.md", "| code | verdict | meaning |")],
)
def test_exit_codes(page: str, header: str) -> None:
    documented = {int(row[0]): row[1] for row in _rows(page, header)}
    assert set(documented) == {
        *(verdict.exit_code for verdict in Verdict),
        FieldcalError.exit_code,
        cli.DEFECT,
        cli.INTERRUPTED,
    }
    assert str(cli.READER_GONE) in " ".join(" ".join(row) for row in _rows(page, header))
    for verdict in Verdict:
        assert documented[verdict.exit_code].startswith(verdict.value.replace("_", " "))


def test_findings_and_thresholds() -> None:
    rows = _rows("docs/check.md", "| finding | threshold | what it says, and what to do when it is flagged |")
    assert [row[0] for row in rows] == list(RULE_TITLES)
    held = _rows("docs/check.md", "| finding | threshold | what it says |")
    assert {name for row in held for name in row[0].split(", ")} >= set(HELD_TITLES)
    assert {row[0]: row[1] for row in rows} == {
        "focal-drift": f"{limits.FOCAL_LIMIT_PERCENT:g} %",
        "equifinal-deviation": f"{STRICT_TOLERANCE_PX:g} px",
        "equifinal-line": "band of the line",
        "opposite-signs": "0",
        "convergent-share": f"{limits.CONVERGENT_LIMIT_PERCENT:g} %",
        "predicted-dome": f"{limits.DOME_LIMIT_PERCENT:g} % H",
        "focal-sigma": limits.percent(limits.FOCAL_SIGMA_PERCENT),
        "cross-validation": f"{limits.SPLIT_LIMIT:g} sigma",
        "model-sensitivity": f"{limits.FOCAL_LIMIT_PERCENT:g} %",
        "coverage": f"{limits.COVERAGE_LIMIT_PERCENT:g} %",
        "alignment": f"{limits.ALIGNED_LIMIT_PERCENT:g} %",
    }
    text = _text("docs/check.md")
    assert f"saved only if f is known to {REFERENCE_SIGMA_PERCENT:g} %" in text
    assert f"residual over {limits.RMS_LIMIT_PX:g} px" in text
    assert f"second block of {limits.SECOND_COMPONENT_PERCENT:g} %" in text
    assert f"Flagged above {limits.FOCAL_LIMIT_PERCENT:g} %" in text
    assert f"{limits.FOCAL_SIGMA_ALONE_PERCENT:g} %" in text


@pytest.mark.parametrize("row", _rows("docs/method.md", "| name | value | what |"), ids=lambda row: row[0])
def test_constants(row: list[str]) -> None:
    module, _, name = row[0].rpartition(".")
    assert getattr(importlib.import_module(module), name) == pytest.approx(float(row[1]))


def test_report_json_example_has_the_schema() -> None:
    ((_, example),) = [block for block in _blocks("json") if "fieldcal.check/1" in block[1]]
    CheckReport.model_validate(json.loads(example))


def test_plan_json_example_has_the_fields() -> None:
    ((_, example),) = [block for block in _blocks("json") if "fieldcal.plan/1" in block[1]]
    shown = json.loads(example)
    with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding="utf-8")) as out:
        circle = "54.77,-1.58,20"
        words = ["plan", "fan", "--area", circle, "--camera", "dji-phantom-3-professional", "--height", "60"]
        assert cli.run([*words, "--json", "-"]) == 0
        out.seek(0)
        printed = json.loads(out.read())

    def fields(value: object) -> object:
        if isinstance(value, dict):
            return {key: fields(item) for key, item in value.items()}
        return [fields(value[0])] if isinstance(value, list) and value else None

    assert fields(shown | {"notes": []}) == fields(printed | {"notes": []})


def test_patterns_and_limits_are_all_listed() -> None:
    patterns = _rows("docs/planning.md", "| pattern | what it flies |")
    assert [row[0] for row in patterns] == list(DESCRIPTIONS)
    rules = _rows("docs/planning.md", "| rule | hard | what must hold | option |")
    assert len(rules) == len({row[0] for row in rules}) == 12


def test_site_file_example_is_valid() -> None:
    ((_, example),) = _blocks("toml")
    keys = SiteFile.model_validate(tomllib.loads(example))
    text = _text("docs/planning.md")
    for model in (keys, keys.vehicle, keys.wind, keys.fence[0], keys.structure[0], keys.wall, keys.pattern):
        for key in type(model).model_fields:
            assert key in text, key


def test_formats_and_exports_are_all_listed() -> None:
    header = "| format | file | holds | pitfalls that are taken care of |"
    listed = {name for row in _rows("docs/cameras.md", header) for name in re.findall(r"[a-z0-9-]+", row[0])}
    assert listed == {*FORMATS, "fieldcal"}
    exports = {row[0]: row[1] for row in _rows("docs/files.md", "| export | file | use |")}
    assert exports == {
        **{name: f"exports/{file}" for name, (_, file) in CALIBRATIONS.items()},
        "odm_geo": f"exports/{GEO}",
        "metashape_reference": f"exports/{METASHAPE_REFERENCE}",
        "colmap": "exports/colmap",
        "not_written": f"exports/{NOT_WRITTEN}",
    }


def test_keys_of_truth_are_all_listed() -> None:
    assert cli.run(["sim", "survey", "orbit", "--photos", "4", "--size", "160x120", "--out", "x"]) == 0
    written = json.loads(Path("x/truth.json").read_text(encoding="utf-8"))
    rows = _rows("docs/simulator.md", "| key | what |")
    assert {key for row in rows for key in re.findall(r"[a-z0-9_]+", row[0])} == set(written) - {"schema"}
    assert set(written["camera"]) == {field.name for field in dataclasses.fields(BrownCamera)}


# --- Links and places ----------------------------------------------------------------------------


def _anchors(text: str) -> set[str]:
    """Anchors of the headings as code hosts make them."""
    headings = re.findall(r"^#+ (.*)$", _FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _links() -> Iterator[tuple[str, str]]:
    for name in NAMES:
        for target in re.findall(r"\]\(([^)\s]+)\)", _FENCE.sub("", _text(name))):
            yield name, target


@pytest.mark.parametrize(("name", "target"), list(_links()))
def test_links_resolve(name: str, target: str) -> None:
    assert "://" not in target
    path, _, anchor = target.partition("#")
    linked = (ROOT / name).parent / path if path else ROOT / name
    assert linked.is_file()
    if anchor:
        assert anchor in _anchors(linked.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "name", [*NAMES, "requirements.lock", "pyproject.toml", "Makefile", ".ci/run", "LICENSE"]
)
def test_names_no_machine_and_no_index(name: str) -> None:
    text = _text(name)
    assert re.findall(r"(?<![\w./])/(?:work|root|home|tmp|mnt|srv)/\S*", text) == []
    assert re.findall(r"https?://\S+", text) == []
    assert (
        re.findall(r"(?im)^\s*(?:-i|--index-url|--extra-index-url|--find-links|--trusted-host)\b.*", text)
        == []
    )


def test_every_page_is_reached_from_the_readme() -> None:
    linked = {target.partition("#")[0] for name, target in _links() if name == "README.md"}
    assert {name for name in NAMES if name != "README.md"} <= linked


def test_picture_is_small() -> None:
    assert 10_000 < (ROOT / "docs" / "report.png").stat().st_size < 200_000
