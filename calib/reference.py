"""A reference calibration: the thing a survey's self-calibration is held against."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.field import LENS_NAMES, Lens
from calib.photos.photo import Processing


@dataclass(frozen=True)
class EquifinalLine:
    """A published or computed line K2 = slope K1 + intercept (pixel units) and its domain in K1.

    ``band_k2_px`` is the half width of the band in K2 at fixed K1 (None: not published).
    """

    slope: float
    intercept: float
    k1_min: float
    k1_max: float
    k2_min: float
    k2_max: float
    band_k2_px: float | None
    source: str


@dataclass(frozen=True)
class PublishedRow:
    """One row of a published table, as printed: ``values`` by the names of the table's columns."""

    label: str
    values: dict[str, float]
    #: Whether the reference's calibration was made from this row.
    chosen: bool = False


@dataclass(frozen=True)
class Reference:
    """One calibration of one camera, with what is known about where it came from.

    ``brown`` is None for cameras of which only the line was published. ``sigma`` holds standard
    deviations by the names of ``BROWN_NAMES``; ``covariance`` is (35, 35) over ``LENS_NAMES`` or
    None. ``field_px`` (24,) is the residual field, where the reference was made by fieldcal.
    """

    name: str
    make: str
    model: str
    width: int
    height: int
    processing: Processing
    source: str
    brown: BrownCamera | None = None
    field_px: FloatArray | None = None
    sigma: dict[str, float] = field(default_factory=dict)
    covariance: FloatArray | None = None
    serial: str | None = None
    date: str | None = None
    temperature_c: float | None = None
    provenance: str = ""
    line: EquifinalLine | None = None
    #: EXIF model names under which this camera signs its photos (FC300X, ...).
    exif_models: tuple[str, ...] = ()
    #: Focal length in mm at which a zoom lens was calibrated (None: fixed lens or unknown).
    focal_mm: float | None = None
    #: Focal length where it is known without the rest of the calibration.
    focal_px: float | None = None
    #: K1-K3 in pixel units derived from published lines, where no calibration was published.
    implied_radial_px: tuple[float, float, float] | None = None
    #: Brown fitted to the total mapping and its covariance (11, 11), where ``brown`` is only the
    #: Brown part of a lens with a residual field.
    fitted_brown: BrownCamera | None = None
    fitted_covariance: FloatArray | None = None
    published: tuple[PublishedRow, ...] = ()

    @property
    def comparable_brown(self) -> BrownCamera | None:
        """The Brown parameters that another calibration's may be compared with."""
        return self.brown if self.fitted_brown is None else self.fitted_brown

    @property
    def f_px(self) -> float | None:
        """Focal length in px, None when unknown."""
        brown = self.comparable_brown
        return self.focal_px if brown is None else brown.f_px

    @property
    def lens(self) -> Lens | None:
        """Total mapping of the reference (None when only its line is known)."""
        if self.brown is None:
            return None
        return Lens(self.brown) if self.field_px is None else Lens(self.brown, self.field_px)

    @property
    def lens_covariance(self) -> FloatArray:
        """(35, 35) of the total mapping; where only sigmas are known, as if they were independent."""
        if self.covariance is not None:
            return self.covariance
        return np.diag([self.sigma.get(name, 0.0) ** 2 for name in LENS_NAMES])
