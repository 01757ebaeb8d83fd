"""Why a file on another machine did not come: for good, or for now."""

from __future__ import annotations

from calib.errors import InputError

#: No photo is larger; whoever offers more is not believed.
MOST_BYTES = 256 * 2**20


class RefusedError(InputError):
    """The other side has no such file, or not one that is taken."""


class CutError(InputError):
    """Nobody answers now; what has come stays, and trying again makes sense."""
