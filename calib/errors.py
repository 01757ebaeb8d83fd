"""The one error tree of fieldcal.

FieldcalError                exit code 2 unless said otherwise
├── InputError               what the user gave cannot be used (no photos, wrong file, bad option)
│   ├── PhotoError           one photo cannot be read
│   └── FormatError          a calibration file cannot be read or written
├── OutputError              a result cannot be written (permissions, disk full)
└── AlignmentError           the photos cannot be joined to a block at all

A bad calibration is a result, not an error.
"""

from __future__ import annotations


class FieldcalError(Exception):
    """Base of all errors meant for the user: one sentence saying what, where and what to do."""

    exit_code = 2


class InputError(FieldcalError):
    """What the user gave cannot be used."""


class PhotoError(InputError):
    """One photo cannot be read or used."""


class FormatError(InputError):
    """A calibration file cannot be read, or a calibration cannot be written in that format."""


class OutputError(FieldcalError):
    """A result cannot be written."""


class AlignmentError(FieldcalError):
    """The photos cannot be joined to a block."""
