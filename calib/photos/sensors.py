"""Sensors by EXIF make and model, for cameras whose files do not give their pixel size.

Pixel pitch and full pixel array from the makers' data sheets. Only cameras whose pitch together
with the EXIF focal length agrees with known calibrations or with the 35 mm equivalent.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sensor:
    """Pixel pitch in micrometres and the full image in px."""

    pitch_um: float
    width: int
    height: int

    def scale(self, width: int, height: int) -> float:
        """How much smaller an image's pixels are laid out than the sensor's (1: full size or a crop).

        A crop keeps at least one side whole (5472 x 3648, 4864 x 3648 and 5472 x 3078 are all the
        same camera at scale 1); a reduced image keeps neither. Rotated images count alike.
        """
        long, short = max(width, height), min(width, height)
        return max(long / max(self.width, self.height), short / min(self.width, self.height))


_ONE_INCH = Sensor(2.41, 5472, 3648)
#: [C&D] Phantom 3 and Inspire 1, and the Phantom 4's like sensor: 6.25 mm across 4000 px.
_DJI_ONE_2_3 = Sensor(1.5625, 4000, 3000)
_HALF_INCH_48MP = Sensor(0.8, 8000, 6000)

_SENSORS: dict[str, dict[str, Sensor]] = {
    "dji": {
        "fc300c": _DJI_ONE_2_3,
        "fc300s": _DJI_ONE_2_3,
        "fc300x": _DJI_ONE_2_3,
        "fc330": _DJI_ONE_2_3,
        "fc350": _DJI_ONE_2_3,
        "fc550": Sensor(3.75, 4608, 3456),
        "fc6310": _ONE_INCH,
        "fc6310r": _ONE_INCH,
        "fc6310s": _ONE_INCH,
        "fc6360": Sensor(3.0, 1600, 1300),
        "fc6520": Sensor(3.28, 5280, 3956),
        "fc3170": _HALF_INCH_48MP,
        "l1d-20c": _ONE_INCH,
        "l2d-20c": Sensor(3.3, 5280, 3956),
        "m3e": Sensor(3.3, 5280, 3956),
        "m3m": Sensor(3.3, 5280, 3956),
        "zenmusep1": Sensor(4.39, 8192, 5460),
    },
    "autel": {"xt701": _HALF_INCH_48MP, "xt705": _ONE_INCH},
    "skydio": {
        "2": Sensor(1.55, 4056, 3040),
        "x2": Sensor(1.55, 4056, 3040),
        "vt300-l_93": Sensor(1.6, 8192, 6144),
        "v100-l_93": Sensor(1.6, 8192, 6144),
        "vt300-l_50": Sensor(0.8, 9248, 6944),
        "vt300-z_50": Sensor(0.8, 9248, 6944),
        "v100-l_50": Sensor(0.8, 9248, 6944),
        "vt300-z_13": Sensor(0.8, 8000, 6000),
    },
    "parrot": {
        "anafi": Sensor(1.12, 5344, 4016),
        "anafi thermal": Sensor(1.12, 5344, 4016),
        "anafi usa": Sensor(1.12, 5344, 4016),
        "sequoia": Sensor(3.75, 1280, 960),
    },
    "sensefly": {"s.o.d.a.": Sensor(2.33, 5472, 3648)},
    "canon": {
        "powershot s100": Sensor(1.86, 4000, 3000),
        "powershot s110": Sensor(1.86, 4000, 3000),
        "powershot sx260 hs": Sensor(1.549, 4000, 3000),
        "powershot elph 110 hs": Sensor(1.34, 4608, 3456),
        "powershot g9 x": _ONE_INCH,
    },
    "sony": {
        "dsc-rx100m2": _ONE_INCH,
        "dsc-rx1rm2": Sensor(4.51, 7952, 5304),
        "dsc-rx0": Sensor(2.75, 4800, 3200),
        "dsc-wx220": Sensor(1.26, 4896, 3672),
        "dsc-qx1": Sensor(4.25, 5456, 3632),
        "ilce-5100": Sensor(3.92, 6000, 4000),
        "ilce-6000": Sensor(3.92, 6000, 4000),
        "ilce-6100": Sensor(3.92, 6000, 4000),
        "ilce-6300": Sensor(3.92, 6000, 4000),
        "ilce-7r": Sensor(4.88, 7360, 4912),
        "ilce-7rm2": Sensor(4.51, 7952, 5304),
        "ilce-7rm4": Sensor(3.76, 9504, 6336),
        "nex-5t": Sensor(4.78, 4912, 3264),
    },
    "gopro": {
        "hero3+ black edition": Sensor(1.55, 4000, 3000),
        "hero4 black": Sensor(1.55, 4000, 3000),
        "hero4 silver": Sensor(1.55, 4000, 3000),
    },
}


def find_sensor(make: str, model: str) -> Sensor | None:
    """Sensor of a camera by its EXIF names, however they are cased (None: not in the table)."""
    maker = next((m for m in _SENSORS if make.lower().startswith(m)), None)
    if maker is None and make.lower() == "hasselblad":
        maker = "dji"  # Mavic 2 Pro and Mavic 3 sign with their lens maker's name.
    if maker is None:
        return None
    name = model.lower().strip()
    return _SENSORS[maker].get(name.removeprefix(maker).strip())
