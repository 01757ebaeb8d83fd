"""The command line: one typer app, and the only place that turns errors into exit codes.

0 done (or TRUST), 3 REFLY, 4 CANNOT TELL, 2 unusable input or usage, 1 a defect of ours;
128 and the signal's number where one ended the program (130 Ctrl-C, 141 reader gone, 143 terminated).
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Annotated

import platformdirs
import typer
from typer.exceptions import Abort, TyperException

from calib.errors import FieldcalError

DEFECT = 1
INTERRUPTED = 128 + signal.SIGINT
READER_GONE = 128 + signal.SIGPIPE
#: What writing to a terminal, pipe or redirection may fail with; none of it is a defect.
_OUTPUT_FAULTS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF})

#: Commands in the order of the help: module and what to take from it, a function or a group of commands.
_COMMANDS = {
    "check": ("daemon.cli_check", "check"),
    "run": ("daemon.cli_run", "run_command"),
    "plan": ("daemon.cli_plan", "plan"),
    "refly": ("daemon.cli_refly", "refly_command"),
    "upload": ("daemon.cli_upload", "upload"),
    "status": ("daemon.cli_status", "status"),
    "sessions": ("daemon.cli_sessions", "app"),
    "doctor": ("daemon.cli_doctor", "doctor"),
    "calibrate": ("daemon.cli_calibrate", "app"),
    "cameras": ("daemon.cli_cameras", "app"),
    "assess": ("daemon.cli_assess", "assess_command"),
    "correct": ("daemon.cli_correct", "correct_command"),
    "adjust-k": ("daemon.cli_adjust_k", "adjust_k"),
    "equifinal": ("daemon.cli_equifinal", "equifinal"),
    "perturb": ("daemon.cli_perturb", "perturb_command"),
    "sim": ("daemon.cli_sim", "app"),
}


def _app(arguments: Sequence[str]) -> typer.Typer:
    # The commands bring the numerical libraries, a second or two: loaded in here, so that Ctrl-C
    # is answered with one line from the start, and only those of the command that is asked for.
    asked = [name for name in arguments[:1] if name in _COMMANDS]
    app = typer.Typer(
        name="fieldcal",
        invoke_without_command=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_root)
    for name in asked or _COMMANDS:
        module, attribute = _COMMANDS[name]
        found = getattr(importlib.import_module(module), attribute)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            app.command(name)(found)
    return app


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"fieldcal {version('fieldcal')}")
        raise typer.Exit


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
        given = list(sys.argv[1:] if arguments is None else arguments)
        result = _app(given)(args=given, standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()  # What cannot be written is to be said here, not by the interpreter's end.
    except FieldcalError as error:
        _say(str(error))
        return error.exit_code
    except TyperException as error:
        _say(f"{error.format_message()} `fieldcal COMMAND --help` shows what is possible.")
        return FieldcalError.exit_code
    except (Abort, KeyboardInterrupt):
        result = INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output has enough (`| head`); that is no news to the user.
        _discard_stdout()
        return READER_GONE
    except Exception as error:  # noqa: BLE001 the top of the program: anything unforeseen is a defect
        if isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT_FAULTS:
            _discard_stdout()
            _say(f"The output cannot be written: {(error.strerror or str(error)).lower()}.")
            return FieldcalError.exit_code
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
    # Before numpy is loaded, which no module here does: threads for small matrices gain nothing, and waiting
    # for each other beside a flight's other work they take minutes for what is done in seconds.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _ended)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # Terminals without Unicode.
    sys.exit(run())


def _ended(number: int, frame: FrameType | None) -> None:
    """Leave as after Ctrl-C: the child process ended, nothing half-written left behind."""
    del frame
    sys.exit(128 + number)


def _say(text: str) -> None:
    """One line on stderr, whatever a file's name has put into ``text``."""
    line = "".join(c if c.isprintable() else "\ufffd" for c in " ".join(text.split()))
    with contextlib.suppress(OSError):
        print(f"fieldcal: {line}", file=sys.stderr, flush=True)


def _discard_stdout() -> None:
    """Send what is still buffered nowhere, or the interpreter stumbles over it at its end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


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
