"""Sharpness of synthetic ground and which photos of a set are called blurred."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.photos import blurred, sharpness


def ground(seed: int, contrast: float = 40.0) -> np.ndarray:
    """Texture with the 1/f amplitudes of natural scenes, as a 1000 x 750 image."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(750)[:, None], np.fft.fftfreq(1000)[None])
    frequency[0, 0] = 1
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((750, 1000))) / frequency).real
    return np.clip(128 + contrast * field / field.std(), 0, 255).astype(np.uint8)


def smeared(image: np.ndarray, length: int, vertical: bool) -> np.ndarray:
    kernel = np.full((length, 1) if vertical else (1, length), 1 / length)
    return cv2.filter2D(image, -1, kernel)


def test_sharp_photos_of_any_contrast_measure_alike():
    values = [sharpness(ground(seed, contrast)) for seed in range(3) for contrast in (10.0, 25.0, 45.0)]
    assert min(values) > 0.3
    assert max(values) < 1.0
    assert max(values) / min(values) < 1.3


@pytest.mark.parametrize("vertical", [False, True])
def test_motion_blur_in_any_direction_lowers_it(vertical):
    image = ground(1)
    sharp = sharpness(image)
    assert 0.3 * sharp < sharpness(smeared(image, 3, vertical)) < 0.9 * sharp
    # Longer smears also take the coarse differences, so the measure levels off.
    assert all(sharpness(smeared(image, n, vertical)) < 0.45 * sharp for n in (5, 9, 15))


def test_nothing_is_said_of_an_image_without_contrast():
    assert np.isnan(sharpness(np.full((300, 400), 77, np.uint8)))
    assert np.isnan(sharpness(np.zeros((16, 400), np.uint8)))


def test_only_the_blurred_photo_of_a_set_is_flagged():
    values = [sharpness(ground(seed)) for seed in range(7)]
    values.insert(3, sharpness(smeared(ground(9), 8, vertical=False)))
    values.append(float("nan"))
    assert np.flatnonzero(blurred(values)).tolist() == [3]


def test_a_set_that_varies_or_is_soft_throughout_loses_nothing():
    assert not blurred([0.30, 0.55, 0.42, 0.61, 0.35, 0.48, 0.29]).any()
    assert not blurred([0.16, 0.15, 0.17, 0.16, 0.14]).any()
    assert not blurred([0.9, 0.88, 0.91, 0.9, 0.45]).any()  # far behind, but sharp in absolute terms
    assert not blurred([0.5, 0.1]).any()
    assert blurred([]).shape == (0,)
