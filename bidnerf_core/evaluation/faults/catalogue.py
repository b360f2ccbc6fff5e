"""The bundled faults. Each is registered in pyproject.toml under its name."""

from __future__ import annotations

import math

import torch

from bidnerf_core.evaluation.faults import camera, colour, depth, scene
from bidnerf_core.evaluation.faults.fault import SHARE, SWITCH, Fault
from bidnerf_core.geometry import SE3
from bidnerf_core.settings import Above, Range, WholeNumbers

FACTOR = Above(0.0, 100.0)
LARGEST_SHIFT = 10_000.0
"""Maximum shift of anything, in pixels."""
LARGER_THAN_IMAGES = 1_000_000
"""Size, in pixels, of a window that contains any image."""
HALF_TURN = SE3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, math.pi], dtype=torch.float64))
"""A turn by 180 degrees about the optical axis."""

depth_scale = Fault(
    "factor", FACTOR, 1.0, (0.95, 0.98, 1.02, 1.05), depth.scaled, True,
    summary="depth multiplied by a factor",
)  # fmt: skip

depth_offset = Fault(
    "metres", Range(-1000.0, 1000.0), 0.0, (-0.05, 0.05), depth.offset, True,
    summary="a constant added to the depth",
)  # fmt: skip

depth_noise = Fault(
    "standard deviation over depth", SHARE, 0.0, (0.01, 0.02, 0.05), depth.proportional_noise, True,
    summary="Gaussian noise proportional to the depth",
)  # fmt: skip

depth_noise_squared = Fault(
    "standard deviation at 1 m, metres", SHARE, 0.0, (0.0015, 0.005, 0.015), depth.quadratic_noise, True,
    summary="Gaussian noise proportional to the depth's square",
)  # fmt: skip

depth_steps = Fault(
    "metres", Range(0.0, 1000.0), 0.0, (0.01, 0.05), depth.quantised, True,
    summary="depth rounded to multiples of a step",
)  # fmt: skip

depth_holes = Fault(
    "share of the pixels", SHARE, 0.0, (0.25, 0.5, 0.75, 0.95), depth.random_holes, True,
    summary="depth missing at random pixels",
)  # fmt: skip

depth_hole = Fault(
    "share of the measured pixels", SHARE, 0.0, (0.5, 0.75, 0.9), depth.one_hole, True,
    summary="depth missing on one side, in one piece",
)  # fmt: skip

depth_shift = Fault(
    "pixels", Range(0.0, LARGEST_SHIFT), 0.0, (2.0, 5.0), depth.misregistered, True,
    summary="depth moved relative to colour, in a random direction",
)  # fmt: skip

depth_window = Fault(
    "pixels a side", WholeNumbers(1, LARGER_THAN_IMAGES), LARGER_THAN_IMAGES, (25.0, 50.0, 100.0), depth.square_window, True,
    summary="depth in a random square only",
)  # fmt: skip

depth_rows = Fault(
    "rows", WholeNumbers(1, LARGER_THAN_IMAGES), LARGER_THAN_IMAGES, (1.0, 10.0), depth.few_rows, True,
    summary="depth in neighbouring rows only",
)  # fmt: skip

depth_wall = Fault(
    "1: on, 0: off", SWITCH, 0.0, (1.0,), depth.one_wall, True,
    summary="depth on the largest plane only",
)  # fmt: skip

focal = Fault(
    "factor", FACTOR, 1.0, (0.9, 0.95, 0.98, 1.02, 1.05, 1.1), camera.focal_scaled,
    summary="stated focal lengths multiplied by a factor",
)  # fmt: skip

nominal = Fault(
    "1: on, 0: off", SWITCH, 0.0, (1.0,), camera.nominal,
    summary="only the focal length stated, and as approximate, as for an uncalibrated photo",
)  # fmt: skip

stretch = Fault(
    "factor", FACTOR, 1.0, (0.75, 0.9, 1.1, 1.33), camera.stretched,
    summary="stated horizontal focal length multiplied by a factor, as if the image's aspect ratio had"
            " changed",
)  # fmt: skip

crop = Fault(
    "share of width and height", Range(0.0, 0.9), 0.0, (0.1, 0.25), camera.cropped,
    summary="rows and columns cropped at a corner, not reflected in the stated principal point",
)  # fmt: skip

principal_point = Fault(
    "pixels", Range(0.0, LARGEST_SHIFT), 0.0, (2.0, 5.0, 10.0), camera.principal_point_moved,
    summary="stated principal point moved in a random direction",
)  # fmt: skip

distortion = Fault(
    "k1", Range(-1.0, 1.0), 0.0, (-0.1, 0.1, 0.3), camera.distorted,
    summary="radial distortion that the intrinsics do not state",
)  # fmt: skip

rolling_shutter = Fault(
    "degrees during the exposure of all rows", Range(0.0, 30.0), 0.0, (0.5, 2.0), camera.rolling_shutter,
    summary="rolling shutter while the camera rotates",
)  # fmt: skip

exposure = Fault(
    "factor", FACTOR, 1.0, (0.5, 0.7, 1.3, 2.0), colour.exposure,
    summary="all values multiplied by a factor",
)  # fmt: skip

white_balance = Fault(
    "factor", FACTOR, 1.0, (0.8, 1.25), colour.white_balance,
    summary="red multiplied and blue divided by a factor",
)  # fmt: skip

blur = Fault(
    "standard deviation, pixels", Range(0.0, 1000.0), 0.0, (1.0, 3.0, 5.0), colour.blur,
    summary="colours blurred by a Gaussian",
)  # fmt: skip

jpeg = Fault(
    "quality", WholeNumbers(1, 100), None, (50.0, 20.0, 5.0), colour.jpeg,
    summary="colours compressed as JPEG",
)  # fmt: skip

grey = Fault(
    "share of it", SHARE, 0.0, (1.0,), colour.grey,
    summary="saturation removed",
)  # fmt: skip

vignetting = Fault(
    "share of the light lost in the corners", SHARE, 0.0, (0.3, 0.6), colour.vignetting,
    summary="corners darkened",
)  # fmt: skip

occluder = Fault(
    "share of the image", SHARE, 0.0, (0.1, 0.25, 0.5), scene.occluder,
    summary="something in front, with its depth",
)  # fmt: skip

occluder_unmeasured = Fault(
    "share of the image", SHARE, 0.0, (0.1, 0.25, 0.5), scene.unmeasured_occluder,
    summary="something in front, without depth",
)  # fmt: skip

moved = Fault(
    "share of the image", SHARE, 0.0, (0.1, 0.25), scene.moved_thing,
    summary="a piece of the scene moved to another place",
)  # fmt: skip

added = Fault(
    "share of the measured surface", SHARE, 0.0, (0.2,), scene.added_thing, True,
    summary="an object on the surface that the map lacks",
)  # fmt: skip

vanished = Fault(
    "share of the measured surface", SHARE, 0.0, (0.2,), scene.vanished_thing, True,
    summary="a piece of the surface missing",
)  # fmt: skip

mirror = Fault(
    "1: on, 0: off", SWITCH, 0.0, (1.0,), camera.mirrored,
    summary="left and right swapped",
)  # fmt: skip

flip = Fault(
    "1: on, 0: off", SWITCH, 0.0, (1.0,), camera.flipped,
    summary="top and bottom swapped",
)  # fmt: skip

upside_down = Fault(
    "1: on, 0: off", SWITCH, 0.0, (1.0,), camera.upside_down, T_true_faulty=HALF_TURN,
    summary="the camera held upside down",
)  # fmt: skip

covered = Fault(
    "1: on, 0: off", SWITCH, 0.0, (1.0,), camera.covered_lens,
    summary="one colour everywhere and no depth",
)  # fmt: skip
