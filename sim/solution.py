"""A simulated survey handed over as an alignment of its photos would hand it over.

From here on the field check cannot tell it from photos: the same network, dome, evidence and
judge take it.
"""

from __future__ import annotations

from pathlib import Path

from calib.align.child import Outcome, measured
from calib.align.georeference import place, read_tags
from calib.align.selfcal import Calibrated
from calib.frames import LocalFrame
from calib.photos.photo import CameraIdentity, Photo, Position, Processing
from calib.reference import Reference
from calib.solution import BoolArray, Solution
from sim.network import SimBlock
from sim.photo_writer import level_gimbal
from sim.solve import calibrate_block

#: Where simulated surveys lie; heights are above the ground.
FRAME = LocalFrame(50.831, -0.142)
#: Receivers better than this state their accuracy in the file, others do not.
_STATED_BELOW_M = 1.0


def identity_of(
    block: SimBlock, make: str = "DJI", model: str = "FC300X", serial: str = "SIM"
) -> CameraIdentity:
    """The camera that a simulated survey was taken with; its files are raw."""
    brown = block.lens.brown
    return CameraIdentity(make, model, serial, brown.width, brown.height, Processing.RAW)


def photos_of(block: SimBlock, camera: CameraIdentity) -> tuple[Photo, ...]:
    """The k photos of a block with the positions and gimbal angles that the vehicle measured."""
    geodetic = FRAME.geodetic(block.gps_m)
    photos = []
    for i, (latitude, longitude, altitude) in enumerate(geodetic.tolist()):
        east, _, up = block.gps_sigma_m[i].tolist()
        stated = max(east, up) < _STATED_BELOW_M
        position = Position(
            latitude,
            longitude,
            altitude,
            sigma_horizontal_m=east if stated else None,
            sigma_vertical_m=up if stated else None,
        )
        gimbal = level_gimbal(block.gimbal_cam_from_world[i])
        photos.append(Photo(Path(f"SIM_{i:04d}.JPG"), camera, position, gimbal))
    return tuple(photos)


def solution_of(block: SimBlock, calibrated: Calibrated, camera: CameraIdentity | None = None) -> Solution:
    """The solution that an alignment of the photos would give.

    Where the geotags stand is measured on the calibrated block; an alignment looks a step earlier.
    """
    state = calibrated.adjusted.state
    photos = photos_of(block, camera or identity_of(block))
    placement = place(state.rotations, state.centres_m, state.points_m, read_tags(photos))
    return calibrated.solution(photos, placement.georeference, (len(photos),))


def outcome_of(
    block: SimBlock,
    nominal_f_px: float,
    seed: int,
    reference: Reference | None,
    camera: CameraIdentity | None = None,
    standing: BoolArray | None = None,
) -> tuple[Outcome, Calibrated]:
    """Self-calibrate a simulated survey and measure all that the verdict rests on.

    Args:
        nominal_f_px: focal length that the files state.
        seed: of the start.
        reference: to hold the dome against; for the images' size.
        standing: (k,) photos that are known to be taken standing; None: none.

    Raises:
        AlignmentError: too few observations survive.
    """
    calibrated = calibrate_block(block, nominal_f_px, seed, standing)
    solution = solution_of(block, calibrated, camera)
    if reference is None:
        return measured(solution, calibrated, None), calibrated
    return measured(solution, calibrated, reference.lens, reference.lens_covariance), calibrated
