"""Options of a command from a TOML file: ``--config FILE``. The command line goes first.

Keys are the long options without dashes in front; numbers, texts, true and false, and lists where an option
may be given several times. What is in the file is held against the command's options before anything begins.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from calib.errors import FormatError, InputError


def read_options(path: Path, parameters: Sequence[Any]) -> dict[str, Any]:
    """The file's values by the parameters' own names, as click's ``default_map`` takes them.

    Raises:
        InputError: there is no such file, or it cannot be read. FormatError: not TOML, or a key or value
            that the command does not have.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"The configuration {path} cannot be read: {reason}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FormatError(f"The configuration {path} is not TOML: {error}.") from error
    known = {name: parameter for parameter in parameters for name in _names(parameter)}
    found = {}
    for key, value in content.items():
        parameter = known.get(key)
        if parameter is None:
            close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
            hint = f"did you mean {close[0]}?" if close else f"it knows {', '.join(sorted(known))}."
            raise FormatError(f"{path}: there is no setting named {key}; {hint}")
        if not _fits(parameter, value):
            raise FormatError(f"{path}: {key} has to be {_kind(parameter)[1]}, not {value!r}.")
        found[str(parameter.name)] = value
    return found


def _names(parameter: Any) -> list[str]:
    """Not in the file: the file itself."""
    return [name.removeprefix("--") for name in parameter.opts if name != "--config"]


def _kind(parameter: Any) -> tuple[tuple[type, ...], str]:
    """What TOML may hold for an option, and how that is called. Paths and choices are texts."""
    annotation = parameter.type_descriptor.annotation
    if parameter.multiple:
        return (list,), "a list of texts"
    return _KINDS.get(annotation, ((str,), "a text"))


_KINDS: dict[object, tuple[tuple[type, ...], str]] = {
    bool: ((bool,), "true or false"),
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
}


def _fits(parameter: Any, value: object) -> bool:
    kinds, _ = _kind(parameter)
    if isinstance(value, list):
        return list in kinds and all(isinstance(one, str) for one in value)
    # For Python true is a number.
    return isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))


def _configure(context: typer.Context, path: Path | None) -> Path | None:
    """Runs before the other options are looked at."""
    if path is not None:
        context.default_map = read_options(path, context.command.params)
    return path


ConfigFileOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="Options from this file (TOML); those given here go first.",
        readable=False,
        is_eager=True,
        callback=_configure,
    ),
]
