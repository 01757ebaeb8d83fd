"""Recommended passes, remembered until their photos come: beside the check, and in the user's store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from calib.errors import FieldcalError, InputError, OutputError, PhotoError
from calib.extra_pass import ExtraPass
from calib.files import output_errors, write_text_atomic
from calib.flown_file import SurveyPhoto
from calib.photos import Photo
from calib.photos.radiometric import with_levels
from calib.photos.read import read_photo
from calib.references import store_folder
from mission.refly_record import PASS_FILE, PassRecord, pass_record, read_record, record_text

if TYPE_CHECKING:
    from mission.refly import Refly
    from mission.refly_taken import Taken

#: Of a flight's own folder: where its pass is written.
FLIGHT_FOLDER = "refly"
FOLDER = "passes"
#: So many passes are kept in the store, the newest.
KEPT = 20


def remember(found: Refly, folder: Path) -> str | None:
    """Keep a pass that was handed out; what stands against it, in a sentence (None: nothing)."""
    record = pass_record(found, datetime.now(UTC))
    if record is None:
        return None
    store, text = store_folder() / FOLDER, record_text(record)
    try:
        write_text_atomic(folder / PASS_FILE, text)
        with output_errors(store):
            store.mkdir(parents=True, exist_ok=True)
        write_text_atomic(store / f"{record.made:%Y%m%dT%H%M%S%f}.json", text)
        with output_errors(store):
            for old in sorted(store.glob("*.json"))[:-KEPT]:
                old.unlink(missing_ok=True)
    except OutputError as error:
        return f"The photos of this pass will not be known again by themselves: {error}"
    return None


@dataclass
class PassFinder:
    """Finds the photos of a pass among those of a check, and the survey's where only the pass is there.

    ``folder``: results that the pass is of, named by the user. ``out``: where results go, and perhaps are.
    ``alone``: nothing is added.
    """

    folder: Path | None
    out: Path
    alone: bool = False
    found: Taken | None = None
    notes: list[str] = field(default_factory=list)

    def check_folder(self) -> None:
        """Refuse a folder without a pass before the work.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        if self.folder is not None:
            self._named(self.folder)

    def complete(self, photos: Sequence[Photo]) -> Sequence[Photo]:
        """The photos, pass and survey marked as one flight; the survey's are added where there are none."""
        records = self._records() if self.folder is None else [self._named(self.folder)]
        if not records:
            return photos
        # Loaded when it is wanted: a daemon that was killed is to be back soon.
        from mission.refly_taken import taken

        named = self.folder is not None
        self.found = _last([t for record in records if (t := taken(record, photos, named)) is not None])
        if self.found is None:
            return photos
        added: list[Photo] = []
        if not self.found.survey and not self.alone:
            added = self._survey(self.found.record.survey)
        stood = {p.path for p in self.found.photos if p is not None}
        one = stood | {p.path for p in (*self.found.survey, *added)}
        return [
            replace(p, joined=True, standing=p.path in stood) if p.path in one else p
            for p in with_levels([*photos, *added])
        ]

    @property
    def extra_pass(self) -> ExtraPass | None:
        """What was found, for the result."""
        if self.found is None:
            return None
        paths = tuple(None if photo is None else photo.path for photo in self.found.photos)
        return ExtraPass(paths, self.found.record.knowledge, self.found.flown.knowledge)

    @staticmethod
    def _named(folder: Path) -> PassRecord:
        if not (folder / PASS_FILE).is_file():
            raise InputError(
                f"There is no {PASS_FILE} in {folder}: --with takes the folder of a check for which "
                "fieldcal refly has written a pass."
            )
        return read_record(folder / PASS_FILE)

    def _records(self) -> list[PassRecord]:
        """All passes that are remembered; what cannot be read is none."""
        found: dict[datetime, PassRecord] = {}
        for path in (self.out / PASS_FILE, *sorted((store_folder() / FOLDER).glob("*.json"))):
            if not path.is_file():
                continue
            try:
                record = read_record(path)
            except FieldcalError:
                continue
            found[record.made] = record
        return list(found.values())

    def _survey(self, files: Sequence[SurveyPhoto]) -> list[Photo]:
        """The survey's photos, from where they were when it was checked."""
        there, gone = [], 0
        for file in files:
            try:
                photo = read_photo(Path(file.path))
            except PhotoError:
                gone += 1
                continue
            if photo.fingerprint == file.fingerprint and photo.time == file.time:
                there.append(photo)
            else:
                gone += 1
        if there:
            self.notes.append(
                f"The {len(there)} photos of the survey that the pass completes were taken along from "
                f"{_folders(there)}."
            )
        if gone:
            self.notes.append(
                f"{gone} of the {len(files)} photos of the survey that the pass completes are not where they "
                "were: give them along with those of the pass."
            )
        return there


def _last(found: Sequence[Taken]) -> Taken | None:
    """The pass most of which is there; not one whose photos a later pass counts to its survey."""
    known = {id(t): {p.path for p in t.survey} for t in found}
    open_ones = [
        t
        for t in found
        if not any(p is not None and p.path in known[id(o)] for o in found if o is not t for p in t.photos)
    ]
    return max(open_ones, key=lambda t: (t.count, len(t.survey), t.record.made), default=None)


def _folders(photos: Sequence[Photo]) -> str:
    folders = sorted({str(photo.path.parent) for photo in photos})
    return folders[0] if len(folders) == 1 else f"{folders[0]} and {len(folders) - 1} more folders"
