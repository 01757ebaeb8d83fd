"""The command line: one typer app, and the only place that turns errors into exit codes.

0 done (or TRUST), 3 REFLY, 4 CANNOT TELL, 2 unusable input or usage, 130 interrupted,
1 a defect of ours.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import platformdirs
import typer
from typer.exceptions import Abort, TyperException

from calib.errors import FieldcalError
from daemon.cli_cameras import app as cameras_app
from daemon.cli_check import check
from daemon.cli_equifinal import equifinal

app = typer.Typer(
    name="fieldcal",
    help="Know, before you leave the field, whether your drone survey's camera calibration can be trusted.",
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("check")(check)
app.add_typer(cameras_app, name="cameras")
app.command("equifinal")(equifinal)

DEFECT = 1
INTERRUPTED = 130


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"fieldcal {version('fieldcal')}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave."),
    ] = False,
) -> None:
    """Know, before you leave the field, whether your drone survey's calibration can be trusted."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(FieldcalError.exit_code)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with ``arguments`` (the process's own by default): the exit code."""
    try:
        result = app(args=None if arguments is None else list(arguments), standalone_mode=False)
    except FieldcalError as error:
        _say(str(error))
        return error.exit_code
    except TyperException as error:
        _say(f"{error.format_message()} `fieldcal COMMAND --help` shows what is possible.")
        return FieldcalError.exit_code
    except (Abort, KeyboardInterrupt):
        result = INTERRUPTED
    except Exception as error:  # noqa: BLE001 the top of the program: anything unforeseen is a defect
        _say(
            f"Something went wrong inside fieldcal ({type(error).__name__}); this is a defect of the program."
        )
        where = _write_details(error)
        if where is not None:
            _say(f"Details for a bug report: {where}")
        return DEFECT
    # typer returns 130 for an interrupt, the code of a typer.Exit, or what the command returned.
    code = result if isinstance(result, int) else 0
    if code == INTERRUPTED:
        _say("Interrupted.")
    return code


def main() -> None:
    """Entry point of the ``fieldcal`` command."""
    sys.exit(run())


def _say(text: str) -> None:
    with contextlib.suppress(OSError):
        print(f"fieldcal: {text}", file=sys.stderr, flush=True)


def _write_details(error: Exception) -> Path | None:
    """Write the traceback where the user can find it; None where nothing can be written."""
    text = f"fieldcal {version('fieldcal')}\n{' '.join(sys.argv)}\n" + "".join(
        traceback.format_exception(error)
    )
    name = time.strftime("defect-%Y%m%d-%H%M%S.txt")
    for folder in (platformdirs.user_state_path("fieldcal"), Path(tempfile.gettempdir())):
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
            return folder / name
    return None


if __name__ == "__main__":
    main()
