"""All faults by name."""

from __future__ import annotations

import math

import torch

from bidnerf_core.errors import unknown_name
from bidnerf_core.evaluation.faults import camera, colour, depth, scene, whole_image
from bidnerf_core.evaluation.faults.fault import SHARE, SWITCH, Fault, WholeNumbers
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.settings import Above, Range

FACTOR = Above(0.0, 100.0)
LARGEST_SHIFT = 10_000.0
"""Maximum shift of anything, in pixels."""
LARGER_THAN_IMAGES = 1_000_000
"""Size, in pixels, of a window that holds any image."""
HALF_TURN = SE3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, math.pi], dtype=torch.float64))
"""A turn by 180 degrees about the optical axis."""


def find_fault(name: str) -> Fault:
    """Return a fault by name. Raises ``InputError`` for an unknown name."""
    if name not in FAULTS:
        raise unknown_name("fault", name, FAULTS)
    return FAULTS[name]


FAULTS: dict[str, Fault] = {
    "depth-scale": Fault(
        "depth multiplied by a factor", "factor", FACTOR, 1.0, (0.95, 0.98, 1.02, 1.05), depth.scaled, True
    ),
    "depth-offset": Fault(
        "a constant added to the depth", "metres", Range(-1000.0, 1000.0), 0.0, (-0.05, 0.05), depth.offset, True
    ),
    "depth-noise": Fault(
        "Gaussian noise proportional to the depth", "standard deviation over depth", SHARE, 0.0, (0.01, 0.02, 0.05),
        depth.proportional_noise, True,
    ),
    "depth-noise-squared": Fault(
        "Gaussian noise proportional to the depth's square", "standard deviation at 1 m, metres", SHARE, 0.0,
        (0.0015, 0.005, 0.015), depth.quadratic_noise, True,
    ),
    "depth-steps": Fault(
        "depth rounded to multiples of a step", "metres", Range(0.0, 1000.0), 0.0, (0.01, 0.05), depth.quantised, True
    ),
    "depth-holes": Fault(
        "depth missing at random pixels", "share of the pixels", SHARE, 0.0, (0.25, 0.5, 0.75, 0.95),
        depth.random_holes, True,
    ),
    "depth-hole": Fault(
        "depth missing on one side, in one piece", "share of the measured pixels", SHARE, 0.0, (0.5, 0.75, 0.9),
        depth.one_hole, True,
    ),
    "depth-shift": Fault(
        "depth moved relative to colour, in a random direction", "pixels", Range(0.0, LARGEST_SHIFT), 0.0, (2.0, 5.0),
        depth.misregistered, True,
    ),
    "depth-window": Fault(
        "depth in a random square only", "pixels a side", WholeNumbers(1, LARGER_THAN_IMAGES), LARGER_THAN_IMAGES,
        (25.0, 50.0, 100.0), depth.square_window, True,
    ),
    "depth-rows": Fault(
        "depth in neighbouring rows only", "rows", WholeNumbers(1, LARGER_THAN_IMAGES), LARGER_THAN_IMAGES,
        (1.0, 10.0), depth.few_rows, True,
    ),
    "depth-wall": Fault(
        "depth on the largest plane only", "1: on, 0: off", SWITCH, 0.0, (1.0,), depth.one_wall, True
    ),
    "focal": Fault(
        "stated focal lengths multiplied by a factor", "factor", FACTOR, 1.0, (0.9, 0.95, 0.98, 1.02, 1.05, 1.1),
        camera.focal_scaled,
    ),
    "nominal": Fault(
        "only the focal length stated, and as approximate, as of a photo without a calibration", "1: on, 0: off", SWITCH, 0.0,
        (1.0,), camera.nominal,
    ),
    "stretch": Fault(
        "stated focal length across multiplied by a factor, as of an image that was resized to another shape", "factor",
        FACTOR, 1.0, (0.75, 0.9, 1.1, 1.33), camera.stretched,
    ),
    "crop": Fault(
        "rows and columns cut off at a corner, which the stated principal point does not allow for",
        "share of width and height", Range(0.0, 0.9), 0.0, (0.1, 0.25), camera.cropped,
    ),
    "principal-point": Fault(
        "stated principal point moved in a random direction", "pixels", Range(0.0, LARGEST_SHIFT), 0.0, (2.0, 5.0, 10.0),
        camera.principal_point_moved,
    ),
    "distortion": Fault(
        "radial distortion that the intrinsics do not state", "k1", Range(-1.0, 1.0), 0.0, (-0.1, 0.1, 0.3),
        camera.distorted,
    ),
    "rolling-shutter": Fault(
        "rows exposed one after the other while the camera turns", "degrees during the exposure of all rows",
        Range(0.0, 30.0), 0.0, (0.5, 2.0), camera.rolling_shutter,
    ),
    "exposure": Fault(
        "all values multiplied by a factor", "factor", FACTOR, 1.0, (0.5, 0.7, 1.3, 2.0), colour.exposure
    ),
    "white-balance": Fault(
        "red multiplied and blue divided by a factor", "factor", FACTOR, 1.0, (0.8, 1.25), colour.white_balance
    ),
    "blur": Fault(
        "colours blurred by a Gaussian", "standard deviation, pixels", Range(0.0, 1000.0), 0.0, (1.0, 3.0, 5.0),
        colour.blur,
    ),
    "jpeg": Fault("colours compressed as JPEG", "quality", WholeNumbers(1, 100), None, (50.0, 20.0, 5.0), colour.jpeg),
    "grey": Fault("saturation removed", "share of it", SHARE, 0.0, (1.0,), colour.grey),
    "vignetting": Fault(
        "corners darkened", "share of the light lost in the corners", SHARE, 0.0, (0.3, 0.6), colour.vignetting
    ),
    "occluder": Fault(
        "something in front, with its depth", "share of the image", SHARE, 0.0, (0.1, 0.25, 0.5), scene.occluder
    ),
    "occluder-unmeasured": Fault(
        "something in front, without depth", "share of the image", SHARE, 0.0, (0.1, 0.25, 0.5),
        scene.unmeasured_occluder,
    ),
    "moved": Fault(
        "a piece of the scene moved to another place", "share of the image", SHARE, 0.0, (0.1, 0.25), scene.moved_thing
    ),
    "added": Fault(
        "a thing on the surface that the map lacks", "share of the measured surface", SHARE, 0.0, (0.2,),
        scene.added_thing, True,
    ),
    "vanished": Fault(
        "a piece of the surface gone", "share of the measured surface", SHARE, 0.0, (0.2,), scene.vanished_thing, True
    ),
    "mirror": Fault("left and right swapped", "1: on, 0: off", SWITCH, 0.0, (1.0,), whole_image.mirrored),
    "flip": Fault("top and bottom swapped", "1: on, 0: off", SWITCH, 0.0, (1.0,), whole_image.flipped),
    "upside-down": Fault(
        "the camera held upside down", "1: on, 0: off", SWITCH, 0.0, (1.0,), whole_image.upside_down,
        T_true_faulty=HALF_TURN,
    ),
    "covered": Fault(
        "one colour everywhere and no depth", "1: on, 0: off", SWITCH, 0.0, (1.0,), whole_image.covered_lens
    ),
}  # fmt: skip
"""All faults by name."""
