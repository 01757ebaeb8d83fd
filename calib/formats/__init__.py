"""Foreign calibration files, one module per format, each with ``read(text)`` and ``write(camera)``.

A file's format is known by its content. Writers read their own text back and refuse where the mapping
ray -> pixel would change by more than ``WriteOptions.tolerance_px`` anywhere in the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calib.camera import BrownCamera
from calib.errors import FormatError, OutputError
from calib.formats import australis, colmap, metashape, micmac, odm, opencv, pix4d, plain, vms
from calib.formats.common import TOLERANCE_PX, ReadOptions, WriteOptions

__all__ = [
    "FORMATS",
    "MAX_BYTES",
    "TOLERANCE_PX",
    "Format",
    "ReadOptions",
    "WriteOptions",
    "detect_format",
    "format_named",
    "read_calibration",
    "write_calibration",
]

#: No calibration is larger; whole projects, photos and films are.
MAX_BYTES = 16 * 2**20


@dataclass(frozen=True)
class Format:
    """A foreign format; ``suffix`` is what its files are usually called."""

    name: str
    title: str
    suffix: str
    detect: Callable[[str], bool]
    read: Callable[[str, ReadOptions | None], BrownCamera]
    write: Callable[[BrownCamera, WriteOptions | None], str]


#: Every format, in the order in which contents are tried.
FORMATS: dict[str, Format] = {
    f.name: f
    for f in (
        Format("json", "fieldcal JSON", ".json", plain.detect, plain.read, plain.write),
        Format("odm", "OpenDroneMap cameras.json", ".json", odm.detect, odm.read, odm.write),
        Format("opencv-xml", "OpenCV XML", ".xml", opencv.detect_xml, opencv.read, opencv.write_xml),
        Format("metashape", "Metashape XML", ".xml", metashape.detect, metashape.read, metashape.write),
        Format("micmac", "MicMac AutoCal", ".xml", micmac.detect, micmac.read, micmac.write),
        Format("opencv-yaml", "OpenCV YAML", ".yml", opencv.detect_yaml, opencv.read, opencv.write_yaml),
        Format("pix4d", "Pix4D camera", ".cam", pix4d.detect, pix4d.read, pix4d.write),
        Format("vms", "VMS and Australis", ".txt", vms.detect, vms.read, vms.write),
        Format(
            "australis", "Australis by Metashape", ".txt", australis.detect, australis.read, australis.write
        ),
        Format("colmap", "COLMAP cameras.txt", ".txt", colmap.detect, colmap.read, colmap.write),
    )
}


def format_named(name: str) -> Format:
    """The format of that name ("opencv" means its YAML).

    Raises:
        FormatError: there is none.
    """
    found = FORMATS.get("opencv-yaml" if name == "opencv" else name)
    if found is None:
        raise FormatError(f"There is no calibration format {name[:40]!r}; there are {', '.join(FORMATS)}.")
    return found


def detect_format(text: str) -> Format:
    """The format of a file's text.

    Raises:
        FormatError: none of those known.
    """
    for candidate in FORMATS.values():
        if candidate.detect(text):
            return candidate
    titles = ", ".join(f.title for f in FORMATS.values())
    raise FormatError(f"The file is no camera calibration that fieldcal knows ({titles}).")


def read_calibration(
    path: Path, options: ReadOptions | None = None, format_name: str | None = None
) -> tuple[str, BrownCamera]:
    """The format's name and the camera of a calibration file; the format is told by its content.

    Raises:
        FormatError: the file cannot be read, is no calibration, or is damaged.
    """
    text = read_text(path)
    try:
        found = detect_format(text) if format_name is None else format_named(format_name)
        return found.name, found.read(text, options)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from error


def read_text(path: Path) -> str:
    """A calibration file's text, at most ``MAX_BYTES`` of it read.

    Raises:
        FormatError: no regular file, too large, not readable, or not text.
    """
    try:
        if not path.is_file():
            raise FormatError(f"{path}: there is no such file.")
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror or error}.") from error
    if len(data) > MAX_BYTES:
        raise FormatError(f"{path} is larger than {MAX_BYTES // 2**20} MB, so it is no camera calibration.")
    if b"\0" in data:
        raise FormatError(f"{path} is not a text file, so it is no camera calibration.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Australis and VMS are older than UTF-8; every byte is a letter in Latin-1, and numbers are ASCII.
        return data.decode("latin-1")


def write_calibration(
    camera: BrownCamera, format_name: str, path: Path, options: WriteOptions | None = None
) -> None:
    """Write ``camera`` to ``path``.

    Raises:
        FormatError: no such format, or one that cannot hold this lens.
        OutputError: the file cannot be written.
    """
    text = format_named(format_name).write(camera, options)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error
