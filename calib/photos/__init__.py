"""Photo files and what they say about themselves."""

from calib.photos.blur import blurred, sharpness
from calib.photos.collect import collect
from calib.photos.photo import (
    AltitudeDatum,
    CameraIdentity,
    GimbalAngles,
    LeftOut,
    Photo,
    Position,
    Processing,
)
from calib.photos.read import read_photo, read_photos
from calib.photos.sort import Sorted, require_block, sort_photos

__all__ = [
    "AltitudeDatum",
    "CameraIdentity",
    "GimbalAngles",
    "LeftOut",
    "Photo",
    "Position",
    "Processing",
    "Sorted",
    "blurred",
    "collect",
    "read_photo",
    "read_photos",
    "require_block",
    "sharpness",
    "sort_photos",
]
