"""From the light on the sensor to the levels of a photo: optics, motion, exposure, noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calib.camera import FloatArray
from sim.texture import ByteImage, Image32


@dataclass(frozen=True)
class RenderOptions:
    """``blur_px``: Gaussian sigma of the optics. ``noise_levels``: sensor noise, standard deviation in
    grey levels of 255. ``vignetting``: loss of light in the corners (0..1). ``readout_s``: rolling
    shutter, first row to last; the pose is the middle row's. ``exposure_s``: time during which a row is
    exposed, around its own moment: what moves meanwhile is smeared along its way. ``gain``: exposure,
    1 as the scene is; ``white_balance``: factors of red, green and blue. ``contrast`` around middle grey,
    before noise. ``monochrome``: the three channels alike."""

    blur_px: float = 0.5
    noise_levels: float = 2.0
    vignetting: float = 0.2
    readout_s: float = 0.0
    exposure_s: float = 0.0
    gain: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    contrast: float = 1.0
    monochrome: bool = False


#: A thermal camera of 640 x 512 px: soft, low in contrast, grey; slow bolometers smear.
THERMAL = RenderOptions(
    blur_px=1.1,
    noise_levels=2.5,
    vignetting=0.08,
    exposure_s=0.008,
    contrast=0.45,
    monochrome=True,
)


def exposed(image: Image32, options: RenderOptions, motion_px: FloatArray | None, seed: int) -> ByteImage:
    """The photo (h, w, 3) of the light ``image`` (h, w, 3), which is used up.

    motion_px: (a, b, 2) way of the image during the exposure at nodes spread evenly from the first
    pixel to the last.
    """
    height, width = image.shape[:2]
    if motion_px is not None:
        image = smeared(image, motion_px)
    if options.blur_px > 0:
        cv2.GaussianBlur(image, (0, 0), options.blur_px, dst=image)
    if options.monochrome:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        image = np.asarray(cv2.merge([grey, grey, grey]), np.float32)
    factor = np.float32(options.contrast * options.gain) * np.asarray(options.white_balance, np.float32)
    if (factor != 1).any():
        image *= factor
    if options.contrast != 1:
        image += np.float32(128 * (1 - options.contrast)) * factor / np.float32(options.contrast)
    if options.vignetting > 0:
        u = (np.arange(width, dtype=np.float32) + 0.5) / width - 0.5
        v = (np.arange(height, dtype=np.float32) + 0.5) / height - 0.5
        radius2 = (u * u * width**2 + (v * v * height**2)[:, None]) * 4 / (width**2 + height**2)
        image *= (1 - np.float32(options.vignetting) * radius2 * radius2)[..., None]
    if options.noise_levels > 0:
        rng = np.random.default_rng([seed, 6])
        # One draw for all three channels: what matters is the noise of the brightness.
        image += np.float32(options.noise_levels) * rng.standard_normal((height, width, 1), dtype=np.float32)
    image += np.float32(0.5)
    photo: ByteImage = np.clip(image, 0, 255, out=image).astype(np.uint8)
    return photo


def smeared(image: Image32, motion_px: FloatArray) -> Image32:
    """The mean of the image along the way of every pixel, half of it before and half after."""
    longest = float(np.linalg.norm(motion_px, axis=-1).max())
    if longest < 0.02:
        return image
    height, width = image.shape[:2]
    samples = int(np.ceil(longest / 0.5)) + 1
    # cv2.resize would put its nodes at pixel centres of the small map; this puts them on the borders.
    place = np.stack(
        np.meshgrid(
            np.linspace(0, motion_px.shape[1] - 1, width, dtype=np.float32),
            np.linspace(0, motion_px.shape[0] - 1, height, dtype=np.float32),
        )
    )
    way = cv2.remap(motion_px.astype(np.float32), place[0], place[1], cv2.INTER_LINEAR)
    columns = np.arange(width, dtype=np.float32)
    rows = np.arange(height, dtype=np.float32)[:, None]
    total = np.zeros_like(image)
    for i in range(samples):
        time = np.float32((i + 0.5) / samples - 0.5)
        total += cv2.remap(
            image,
            columns + time * way[..., 0],
            rows + time * way[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
    total /= np.float32(samples)
    return total
