"""A sparse model as COLMAP's text files, moved as a cloud is: points and cameras alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import InputError
from calib.export_colmap import COLMAP_FILES
from calib.files import output_folder, write_text_atomic
from calib.similarity import Similarity


def move_sparse(folder: Path, out: Path, moved: Similarity) -> None:
    """Write the model of ``folder`` to ``out`` (another folder), moved.

    With X' = s R X + t a camera's pose R_cam X + t_cam becomes R_cam R^T and s t_cam - R_cam R^T t.

    Raises:
        InputError: not a COLMAP text model. OutputError: ``out`` cannot be written.
    """
    texts = []
    for name in COLMAP_FILES:
        try:
            texts.append((folder / name).read_text(encoding="utf-8", errors="surrogateescape"))
        except OSError as error:
            raise InputError(f"{folder} is no COLMAP text model: {name} cannot be read.") from error
    cameras, images, points = texts
    if folder.resolve() == out.resolve():
        raise InputError(f"{out} is the model itself; give another folder.")
    try:
        images, points = _images(images, moved), _points(points, moved)
    except (ValueError, IndexError) as error:
        raise InputError(f"{folder} is no COLMAP text model that can be read.") from error
    with output_folder(out):
        for name, text in zip(COLMAP_FILES, (cameras, images, points), strict=True):
            write_text_atomic(out / name, text)


def _images(text: str, moved: Similarity) -> str:
    lines = text.splitlines()
    pose = True
    for i, line in enumerate(lines):
        if line.startswith("#"):
            continue
        if pose:
            words = line.split(maxsplit=8)
            w, x, y, z, *t = (float(word) for word in words[1:8])
            turned = Rotation.from_quat([x, y, z, w]).as_matrix() @ moved.rotation.T
            place = moved.scale * np.array(t) - turned @ moved.shift
            x, y, z, w = Rotation.from_matrix(turned).as_quat()
            numbers = " ".join(f"{value:.17g}" for value in (w, x, y, z, *place))
            lines[i] = f"{words[0]} {numbers} {words[8]}"
        pose = not pose
    return "\n".join(lines) + "\n"


def _points(text: str, moved: Similarity) -> str:
    lines = text.splitlines()
    for i, line in enumerate(lines):
        if line.strip() and not line.startswith("#"):
            words = line.split(maxsplit=4)
            place = moved.apply(np.array([float(word) for word in words[1:4]]))
            lines[i] = " ".join([words[0], *(f"{value:.12g}" for value in place), *words[4:]])
    return "\n".join(lines) + "\n"
