"""What the papers print, with where: the "theirs" of every table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Flight3:
    """A row of [C&D] Table 3: f px, K1 e-8, K2 e-15, K3 e-23, K2 error e-15 (pixel units)."""

    f_px: float
    k1_e8: float
    k2_e15: float
    k3_e23: float
    k2_error_e15: float


#: [C&D] Table 3.
TABLE_3 = {
    "A1": Flight3(2539, -2.48, 3.86, -9.48, 1.69),
    "A2": Flight3(1974, -2.50, 3.83, -9.97, 3.89),
    "A3": Flight3(2317, -2.52, 3.84, -9.69, 0.04),
    "A4": Flight3(2320, -2.52, 3.86, -10.6, 0.06),
    "B1": Flight3(2304, -2.45, 4.11, -11.9, 0.45),
    "B2": Flight3(2229, -2.58, 4.12, -13.0, 0.02),
    "B3": Flight3(2323, -2.59, 4.13, -13.2, 0.18),
    "B4": Flight3(2323, -2.58, 4.10, -12.2, 0.16),
}


@dataclass(frozen=True)
class Flight4:
    """A row of [C&D] Table 4: Tx Ty Tz m, Rphi Rtheta Rpsi degrees, S %, eta_p m."""

    seven: tuple[float, float, float, float, float, float, float]
    eta_p_m: float


#: [C&D] Table 4.
TABLE_4 = {
    "A1": Flight4((4.02, 1.32, -2.48, -0.93, -0.38, 0.40, 99.7), 0.46),
    "A2": Flight4((3.31, -1.79, 8.88, -0.60, -1.42, -0.34, 100.9), 0.36),
    "A3": Flight4((0.65, 0.35, 3.49, -1.34, -0.44, -0.02, 99.5), 0.55),
    "A4": Flight4((3.04, 1.63, 0.36, -0.62, -0.78, -0.18, 100.4), 0.32),
    "B1": Flight4((0.82, 6.38, -5.73, 0.86, -1.20, 1.11, 98.4), 0.12),
    "B2": Flight4((-0.46, 4.20, 5.19, 0.09, 0.33, -0.06, 95.8), 0.24),
    "B3": Flight4((0.79, 5.85, 1.17, -0.08, -1.05, 0.66, 94.9), 0.15),
    "B4": Flight4((-3.31, 2.43, -0.49, 0.68, 0.23, 0.02, 104.6), 0.06),
}
#: Residuals of the registration, mean and standard deviation in m ([C&D] Table 4).
REGISTRATION = {"A": (0.05, 0.23), "B": (0.00, 0.03)}

#: R2 of the quadrics: mean, 5th percentile, median; of all and of those on the line ([C&D] results).
R2_ALL = {"Phantom 3": (0.94, 0.75, 0.98), "Inspire 1": (0.99, 0.99, 0.99)}
R2_LINE = {"Phantom 3": (0.97, 0.94, 0.98), "Inspire 1": (0.99, 0.99, 0.99)}
#: Adjustments of the perturbation experiment ([C&D] methods), and a grid of as many.
ADJUSTMENTS, GRID = 6232, (82, 76)
INSPIRE_1_F_PX = 2326.07

#: [C&D] Table 5: the library's name of each of the eleven cameras.
TABLE_5 = (
    "canon-eos-rebel-t2i",
    "canon-powershot-a3300-is",
    "canon-powershot-a4400-is",
    "canon-powershot-s110",
    "canon-powershot-sd1000",
    "canon-powershot-sx170-is",
    "lg-nexus-5",
    "microdrone-2-hd",
    "nikon-d1x-35mm",
    "nikon-d5200-18mm",
    "sony-nex-7-20mm",
)


@dataclass(frozen=True)
class OrbitSet:
    """A row of [SEN] Table 1: images, observations, targets (in its text), RMS px, sigma0 (VMS only)."""

    images: int
    observations: int
    targets: int
    rms_px: float
    sigma0: float


#: [SEN] Table 1, VMS rows; targets from the results section.
SENN = {
    "thermal subset": OrbitSet(12, 317, 51, 0.48, 1.00),
    "thermal add6": OrbitSet(17, 404, 58, 0.53, 1.00),
    "RGB subset": OrbitSet(15, 609, 91, 0.88, 1.36),
    "RGB add6": OrbitSet(21, 752, 105, 1.02, 1.23),
}
#: All images taken ([SEN] 2.1).
CAMPAIGN = {"thermal": 158, "RGB": 101}
#: The same sets in Metashape: RMS px of control and of check points ([SEN] Table 1).
SENN_METASHAPE = {
    "thermal subset": (0.81, 0.54),
    "thermal add6": (0.88, 0.73),
    "RGB subset": (0.92, 0.71),
    "RGB add6": (1.19, 1.31),
}
#: [SEN] Table 2: c, xp, yp in mm, K1 K2 K3 in mm^-2 mm^-4 mm^-6, P1 P2 in mm^-1; xp to the right, yp up.
TABLE_2 = {
    ("thermal", "VMS", "subset"): (13.10, -1.25e-1, -1.63e-1, 5.34e-4, -3.76e-5, 8.90e-7, -5.36e-5, -6.47e-4),
    ("thermal", "VMS", "add6"): (13.09, -1.02e-1, -3.15e-2, 2.35e-4, -1.11e-5, 3.26e-7, -8.64e-5, -2.56e-4),
    ("thermal", "Metashape", "subset"): (
        13.12,
        -1.09e-1,
        -7.55e-2,
        -1.11e-4,
        1.19e-5,
        -4.12e-7,
        2.52e-5,
        3.67e-4,
    ),
    ("thermal", "Metashape", "add6"): (13.13, -9.76e-2, 6.32e-2, -2.98e-5, 3.69e-6, -2.41e-7, 0.0, 2.18e-5),
    ("RGB", "VMS", "subset"): (8.84, 1.82e-2, -3.20e-3, 1.80e-4, -1.15e-5, 1.96e-7, 3.01e-5, 1.85e-5),
    ("RGB", "VMS", "add6"): (8.84, 2.04e-2, -7.60e-3, 2.04e-4, -1.25e-5, 2.11e-7, 3.46e-5, 4.15e-6),
    ("RGB", "Metashape", "subset"): (8.85, 1.64e-2, -6.30e-3, -1.30e-4, 8.24e-6, -1.43e-7, -1.43e-5, 5.39e-6),
    ("RGB", "Metashape", "add6"): (8.85, 1.97e-2, -1.29e-2, -1.18e-4, 7.16e-6, -1.20e-7, -1.60e-5, 2.16e-5),
}
#: Width and height in px and pixel size in mm of the sensors ([SEN] 2.1).
SENSORS = {"thermal": (640, 512, 0.017), "RGB": (5472, 3648, 0.00241)}
#: Correlation of K3 and K4, RGB add6 in Metashape ([SEN] 2.3).
K3_K4_CORRELATION = 0.99
