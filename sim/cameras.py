"""The cameras that surveys are simulated with: published lenses, and how their files sign."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from calib.camera import BrownCamera
from calib.errors import InputError
from calib.photos.photo import Processing
from sim.flights import phantom3
from sim.sensor import THERMAL, RenderOptions

LEAST_WIDTH = 160
_SIZE = re.compile(r"([0-9]{1,6})[xX×]([0-9]{1,6})")


@dataclass(frozen=True)
class CameraModel:
    """``lens``: the published calibration at full size, of files with ``processing``.

    ``default_width`` of simulated photos (px). ``dji_tags``: signs with DJI's XMP; otherwise plain
    EXIF. ``rendering``: how its photos look.
    """

    name: str
    make: str
    model: str
    lens: Callable[[], BrownCamera]
    processing: Processing
    focal_mm: float
    focal_35mm: int
    default_width: int
    dji_tags: bool = True
    rendering: RenderOptions = field(default_factory=RenderOptions)

    def at(self, width: int, height: int) -> BrownCamera:
        """The lens with the images resampled to a size."""
        full = self.lens()
        return full if (full.width, full.height) == (width, height) else full.scaled(width, height)

    @property
    def default_size(self) -> tuple[int, int]:
        full = self.lens()
        return self.default_width, round(self.default_width * full.height / full.width)

    def size_of(self, text: str | None) -> tuple[int, int]:
        """``WxH`` or ``full`` as people write it; None is the default size.

        Raises:
            InputError: no size, or one that this camera's photos cannot be brought to; one sentence.
        """
        if text is None:
            return self.default_size
        if text == "full":
            return self.lens().width, self.lens().height
        found = _SIZE.fullmatch(text.strip())
        if found is None:
            example = "{}x{}".format(*self.default_size)
            raise InputError(
                f"{text!r} is no size of photos: give width and height, such as {example}, or full."
            )
        width, height = int(found[1]), int(found[2])
        self.check_size(width, height)
        return width, height

    def check_size(self, width: int, height: int) -> None:
        """Refuse sizes that this camera's photos cannot be brought to.

        Raises:
            InputError: too small, larger than the sensor, or of another shape; one sentence.
        """
        full = self.lens()
        example = "{}x{}".format(*self.default_size)
        if width < LEAST_WIDTH or width > full.width:
            raise InputError(
                f"Photos of {width}x{height} px are not possible: the {self.name} takes {full.width}x"
                f"{full.height} px, and below {LEAST_WIDTH} px width nothing is left; try {example}."
            )
        if abs(height - width * full.height / full.width) > 1:
            raise InputError(
                f"Photos of {width}x{height} px have another shape than those of the {self.name} "
                f"({full.width}x{full.height} px); try {example}."
            )


def _inspire1() -> BrownCamera:
    """[C&D] Inspire 1: f and the lines (6) and (8) were published, K1-K3 were not.

    Line (6) holds for models without K3, so K3 is zero here; K1 lies in the middle of the line's
    domain and K2 on the line.
    """
    f_px, k1_px = 2326.07, -2.355e-8
    k2_px = -2.7335e-7 * k1_px - 3.5858e-15
    return BrownCamera(4000, 3000, f_px, 2000.0, 1500.0, k1=k1_px * f_px**2, k2=k2_px * f_px**4)


def _phantom4pro() -> BrownCamera:
    """[SEN] Table 2, RGB, row "Metashape subset", as in the bundled reference: corrected files."""
    return _from_mm(5472, 3648, 2.41e-3, 8.85, (0.0164, -0.0063), (-1.3e-4, 8.24e-6, -1.43e-7))


def _wiris() -> BrownCamera:
    """[SEN] Table 2, thermal, row "Metashape subset", as in the bundled reference."""
    return _from_mm(640, 512, 17e-3, 13.12, (-0.109, -0.0755), (-1.11e-4, 1.19e-5, -4.12e-7))


def _from_mm(
    width: int,
    height: int,
    pixel_mm: float,
    c_mm: float,
    middle_mm: tuple[float, float],
    radial_mm: tuple[float, float, float],
) -> BrownCamera:
    """A row of [SEN] Table 2: principal point to the right and up from the centre, K in mm units."""
    k1, k2, k3 = (k * c_mm**power for k, power in zip(radial_mm, (2, 4, 6), strict=True))
    return BrownCamera(
        width,
        height,
        c_mm / pixel_mm,
        width / 2 + middle_mm[0] / pixel_mm,
        height / 2 - middle_mm[1] / pixel_mm,
        k1=k1,
        k2=k2,
        k3=k3,
    )


PHANTOM_3 = CameraModel(
    "Phantom 3 Professional", "DJI", "FC300X", phantom3, Processing.RAW, 3.61, 20, default_width=1000
)
INSPIRE_1 = CameraModel("Inspire 1", "DJI", "FC350", _inspire1, Processing.RAW, 3.61, 20, default_width=1000)
PHANTOM_4_PRO = CameraModel(
    "Phantom 4 Pro",
    "DJI",
    "FC6310",
    _phantom4pro,
    Processing.LENS_CORRECTED,
    8.8,
    24,
    default_width=1368,
)
WIRIS_PRO = CameraModel(
    "WIRIS Pro",
    "Workswell",
    "WIRIS Pro",
    _wiris,
    Processing.UNKNOWN,
    13.0,
    40,
    default_width=640,
    dji_tags=False,
    rendering=THERMAL,
)

#: By the names that options take.
CAMERAS: dict[str, CameraModel] = {
    "phantom-3": PHANTOM_3,
    "inspire-1": INSPIRE_1,
    "phantom-4-pro": PHANTOM_4_PRO,
    "wiris-pro": WIRIS_PRO,
}


def find_camera(name: str) -> CameraModel:
    """A camera by its name.

    Raises:
        InputError: there is none; the sentence names them all.
    """
    if name not in CAMERAS:
        raise InputError(f"There is no camera named {name} to simulate: choose one of {', '.join(CAMERAS)}.")
    return CAMERAS[name]
