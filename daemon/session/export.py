"""A flight as a folder or a zip file to take away: database, plans, report, exports and a MANIFEST."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
import zipfile
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path, PurePosixPath

from calib.errors import InputError
from calib.files import output_errors
from calib.output import EXPORTS, REPORT_HTML, REPORT_JSON
from daemon.session.database import DATABASE
from daemon.session.reader import SessionReader

MANIFEST, VERDICT, PLANS = "MANIFEST", "verdict.json", "plans"
#: First line of a MANIFEST; `sha256sum -c` passes over it.
_HEADER = "# fieldcal.session/1 "
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Exported:
    """What was written: files with their bytes in all, and whether an earlier export went for it."""

    target: Path
    files: int
    size_bytes: int
    replaced: bool


def export_session(session: SessionReader, target: Path, replace: bool = False) -> Exported:
    """Write the flight to the folder ``target``, or to a zip file if it ends in .zip.

    A flight that is being recorded gives one consistent state. Everything is made beside ``target``
    and moved there at the end. Photos are listed in the database and not copied.

    Args:
        replace: an earlier export at ``target`` may go; anything else there is never touched.

    Raises:
        InputError: something is at ``target``; the record is damaged. OutputError: not writable, disk full.
    """
    zipped = target.suffix.lower() == ".zip"
    replaced = _check_free(target, zipped, replace)
    if target.absolute().is_relative_to(session.folder.absolute()):
        raise InputError(f"{target} lies inside the flight itself; choose another place.")
    with output_errors(target):
        stage = Path(tempfile.mkdtemp(prefix=".fieldcal-", dir=target.absolute().parent))
        try:
            made = stage / "out"
            made.mkdir()
            created = _collect(session, made)
            size = sum(path.stat().st_size for path in _files(made))
            count = len(_files(made))
            if zipped:
                made = _zip(made, stage / "out.zip", session.folder.name, created)
            _settle(made)
            old = stage / "old"
            if replaced:
                target.rename(old)
            try:
                made.rename(target)
            except OSError:
                if replaced:
                    old.rename(target)
                raise
            _sync(target.absolute().parent)
        finally:
            shutil.rmtree(stage, ignore_errors=True)
    return Exported(target, count, size, replaced)


def _check_free(target: Path, zipped: bool, replace: bool) -> bool:
    """Whether there is an export of ours to replace; raises where something must stay."""
    with output_errors(target):
        if not target.exists() and not target.is_symlink():
            return False
        if zipped:
            ours = target.is_file() and not target.is_symlink() and _is_our_zip(target)
        else:
            ours = target.is_dir() and not target.is_symlink() and _is_our_folder(target)
    if not ours:
        raise InputError(
            f"There is something at {target} that is no export of a flight; choose another place."
        )
    if not replace:
        raise InputError(f"There is an export at {target} already; add --replace or choose another place.")
    return True


def _is_our_folder(folder: Path) -> bool:
    """An export with nothing of the user's beside it."""
    try:
        lines = (folder / MANIFEST).read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except FileNotFoundError:
        return False
    listed = {line.partition("  ")[2] for line in lines[1:]} | {MANIFEST}
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    return bool(lines) and lines[0].startswith(_HEADER) and there <= listed


def _is_our_zip(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            manifests = [name for name in archive.namelist() if PurePosixPath(name).name == MANIFEST]
            return any(archive.read(name).startswith(_HEADER.encode()) for name in manifests)
    except (zipfile.BadZipFile, NotImplementedError):
        return False


def _collect(session: SessionReader, place: Path) -> datetime:
    """Fill ``place``; the time at which the flight was begun."""
    session.backup(place / DATABASE)
    # From the copy, so that all files tell of the same instant.
    with SessionReader.open(place) as copy:
        created = copy.flight().created
        verdict = copy.latest_verdict()
        if verdict is not None:
            text = json.dumps(dict(verdict.value.report), indent=2, ensure_ascii=False) + "\n"
            (place / VERDICT).write_text(text, encoding="utf-8", errors="replace")
        for plan in copy.plans():
            (place / PLANS).mkdir(exist_ok=True)
            (place / PLANS / f"{plan.seq:03d}-{_file_name(plan.value.name)}").write_bytes(plan.value.content)
    for leftover in ("-wal", "-shm"):
        (place / f"{DATABASE}{leftover}").unlink(missing_ok=True)
    for name in (REPORT_HTML, REPORT_JSON):
        if _is_plain_file(session.folder / name):
            shutil.copyfile(session.folder / name, place / name)
    for path in _files(session.folder / EXPORTS):
        copy_to = place / path.relative_to(session.folder)
        copy_to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy_to)
    lines = [f"{_sha256(path)}  {path.relative_to(place).as_posix()}\n" for path in _files(place)]
    text = f"{_HEADER}{session.folder.name}\n" + "".join(lines)
    (place / MANIFEST).write_text(text, encoding="utf-8", errors="surrogateescape")
    return created


def _zip(folder: Path, target: Path, name: str, created: datetime) -> Path:
    """Pack ``folder`` as one folder ``name``; all files bear the flight's time (UTC), not this one."""
    moment = max(created, datetime(1980, 1, 1, tzinfo=created.tzinfo)).timetuple()[:6]
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in _files(folder):
            entry = zipfile.ZipInfo(f"{name}/{path.relative_to(folder).as_posix()}", moment)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            with path.open("rb") as source, archive.open(entry, "w", force_zip64=True) as packed:
                shutil.copyfileobj(source, packed, _BLOCK)
    return target


def _files(folder: Path) -> list[Path]:
    """Plain files below ``folder``, sorted; links are not followed out of it."""
    return sorted(path for path in folder.rglob("*") if _is_plain_file(path))


def _is_plain_file(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", PurePosixPath(text).name).strip("-.") or "plan"


def _settle(made: Path) -> None:
    """Have the bytes on the disk before the rename."""
    for path in [made] if made.is_file() else [*_files(made), made]:
        _sync(path)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF):  # Some file systems cannot sync a folder.
            raise
    finally:
        os.close(descriptor)
