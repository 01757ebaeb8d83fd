"""Coded targets found in photos: AprilTag and ArUco tags by number, corners of a ChArUco board.

Detection and decoding are OpenCV's. Pixels count from the corner of the first pixel, as everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.align.features import photo_gray
from calib.camera import FloatArray
from calib.control_files import ControlPoint, Mark
from calib.errors import InputError, PhotoError
from calib.photos.photo import Photo

#: Precision of a corner that was detected, px, and of the corners of a printed board, m.
DETECTED_SIGMA_PX = 0.1
BOARD_SIGMA_M = 0.0002
_BOARD = re.compile(r"(\d{1,3})x(\d{1,3}),([\d.]+),([\d.]+)(?:,(\w+))?", re.ASCII)
_DEFAULT_BOARD_TAGS = "5X5_100"
_MIDDLE = ((0, 2), (1, 3))

Detector = Callable[[NDArray[np.uint8]], list[tuple[str, float, float]]]


@dataclass(frozen=True)
class Board:
    """A ChArUco board of columns x rows squares, side and tags in m, tags of a dictionary."""

    columns: int
    rows: int
    square_m: float
    tag_m: float
    dictionary: str


def dictionaries() -> dict[str, int]:
    """OpenCV's dictionaries of tags by their short names, 4X4_50 to APRILTAG_36h11."""
    names = (name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    return {name.removeprefix("DICT_"): int(getattr(cv2.aruco, name)) for name in names}


def parse_board(text: str) -> Board:
    """``COLUMNSxROWS,SQUARE_MM,TAG_MM[,DICTIONARY]``, counted in squares.

    Raises:
        InputError: it does not make sense; one sentence.
    """
    found = _BOARD.fullmatch(text.strip())
    if found is None:
        raise InputError(
            f"{text} is no board: write columns and rows of squares, then the sides of a square and of a tag "
            "in mm, as 7x5,40,30."
        )
    columns, rows, square, tag = int(found[1]), int(found[2]), float(found[3]), float(found[4])
    if columns < 3 or rows < 3 or not 0 < tag < square:
        raise InputError(
            f"{text} is no board: it needs three squares or more each way, and tags smaller than the squares."
        )
    return Board(columns, rows, square / 1000, tag / 1000, _known(found[5] or _DEFAULT_BOARD_TAGS))


def board_points(board: Board) -> tuple[ControlPoint, ...]:
    """Inner corners of the board, x along its columns, y along its rows, z into it; metres."""
    corners = np.asarray(_opencv_board(board).getChessboardCorners(), float)
    sigma = (BOARD_SIGMA_M,) * 3
    return tuple(
        ControlPoint(_corner(i), (float(x), float(y), float(z)), sigma) for i, (x, y, z) in enumerate(corners)
    )


def board_detector(board: Board) -> Detector:
    """Finds the inner corners of a board, named as :func:`board_points` does."""
    detector = cv2.aruco.CharucoDetector(_opencv_board(board))

    def detect(gray: NDArray[np.uint8]) -> list[tuple[str, float, float]]:
        pixels, numbers, _, _ = detector.detectBoard(gray)
        if pixels is None or numbers is None:
            return []
        return [
            (_corner(int(number)), float(u) + 0.5, float(v) + 0.5)
            for number, (u, v) in zip(np.ravel(numbers), np.reshape(pixels, (-1, 2)), strict=True)
        ]

    return detect


def tag_detector(dictionary: str, names: Collection[str] = ()) -> Detector:
    """Finds tags; the middle of tag 7 (where its diagonals cross) is named 7, its corners 7.1 to 7.4.

    Corners go clockwise from the upper left one of the upright tag; they are given where ``names`` has them.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(_opencv_tags(_known(dictionary)), parameters)

    def detect(gray: NDArray[np.uint8]) -> list[tuple[str, float, float]]:
        found, numbers, _ = detector.detectMarkers(gray)
        marks: list[tuple[str, float, float]] = []
        if numbers is None:
            return marks
        for number, four in zip(np.ravel(numbers), found, strict=True):
            corners = np.reshape(four, (4, 2)).astype(float) + 0.5
            u, v = _crossing(corners)
            marks.append((f"{number}", u, v))
            marks += [
                (f"{number}.{i}", float(c[0]), float(c[1]))
                for i, c in enumerate(corners, 1)
                if f"{number}.{i}" in names
            ]
        return marks

    return detect


def find_targets(
    photos: Sequence[Photo], detect: Detector, progress: Callable[[int], None] | None = None
) -> tuple[Mark, ...]:
    """Marks of all targets in all photos; a name that stands twice in a photo is left out of it.

    Raises:
        InputError: nothing was found at all.
    """
    marks: list[Mark] = []
    for done, photo in enumerate(photos):
        try:
            gray, _ = photo_gray(photo, None)
        except PhotoError:
            continue
        found = detect(gray)
        names = [name for name, _, _ in found]
        marks += [Mark(photo.path.name, name, u, v) for name, u, v in found if names.count(name) == 1]
        if progress is not None:
            progress(done + 1)
    if not marks:
        raise InputError(
            f"No target was found in {len(photos)} photos; check the dictionary, and whether the targets are "
            "sharp and at least 30 px wide."
        )
    return tuple(marks)


def _known(dictionary: str) -> str:
    names = {name.lower(): name for name in dictionaries()}
    wanted = dictionary.lower().removeprefix("dict_")
    if wanted not in names:
        raise InputError(
            f"{dictionary} is no dictionary of tags; known are {', '.join(sorted(names.values()))}."
        )
    return names[wanted]


def _opencv_tags(dictionary: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(dictionaries()[dictionary])


def _opencv_board(board: Board) -> cv2.aruco.CharucoBoard:
    tags = _opencv_tags(board.dictionary)
    needed, there = (board.columns * board.rows) // 2, len(tags.bytesList)
    if needed > there:
        raise InputError(
            f"A board of {board.columns} x {board.rows} squares needs {needed} tags; {board.dictionary} has "
            f"{there}."
        )
    return cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.tag_m, tags)


def _corner(number: int) -> str:
    return f"corner-{number:03d}"


def _crossing(corners: FloatArray) -> tuple[float, float]:
    """Where the diagonals of a quadrangle (4, 2) cross: the middle of a flat square in perspective."""
    (a, c), (b, d) = ((corners[i], corners[j]) for i, j in _MIDDLE)
    along = np.linalg.lstsq(np.stack([c - a, b - d], axis=1), b - a, rcond=None)[0][0]
    u, v = a + along * (c - a)
    return float(u), float(v)
