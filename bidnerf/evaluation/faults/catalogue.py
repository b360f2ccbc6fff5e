"""The bundled faults: one table, which an entry point registers as a whole."""

from __future__ import annotations

import math
from functools import partial

import torch

from bidnerf.evaluation.faults import changes
from bidnerf.evaluation.faults.fault import SHARE, SWITCH, Fault, depth_of
from bidnerf_core.geometry import SE3
from bidnerf_core.settings import Above, Range, WholeNumbers

FACTOR, SHIFT = Above(0.0, 100.0), Range(0.0, 10_000.0)
PIXELS = WholeNumbers(1, 1_000_000)
"""The allowed sizes of a window; the largest contains any image."""

CATALOGUE: dict[str, Fault] = {
    "depth-scale": Fault(
        "factor",
        FACTOR,
        1.0,
        (0.95, 0.98, 1.02, 1.05),
        lambda frame, factor, _: frame.replace(depth=depth_of(frame) * factor),
        True,
        summary="depth multiplied by a factor",
    ),
    "depth-offset": Fault(
        "metres",
        Range(-1000.0, 1000.0),
        0.0,
        (-0.05, 0.05),
        lambda frame, metres, _: changes.replace_depth(frame, depth_of(frame) + metres),
        True,
        summary="a constant added to the depth",
    ),
    "depth-noise": Fault(
        "standard deviation over depth",
        SHARE,
        0.0,
        (0.01, 0.02, 0.05),
        changes.add_noise,
        True,
        summary="Gaussian noise proportional to the depth",
    ),
    "depth-noise-squared": Fault(
        "standard deviation at 1 m, metres",
        SHARE,
        0.0,
        (0.0015, 0.005, 0.015),
        partial(changes.add_noise, power=2),
        True,
        summary="Gaussian noise proportional to the depth's square",
    ),
    "depth-steps": Fault(
        "metres",
        Range(0.0, 1000.0),
        0.0,
        (0.01, 0.05),
        lambda frame, step, _: changes.replace_depth(frame, (depth_of(frame) / step).round() * step),
        True,
        summary="depth rounded to multiples of a step",
    ),
    "depth-holes": Fault(
        "share of the pixels",
        SHARE,
        0.0,
        (0.25, 0.5, 0.75, 0.95),
        changes.remove_random_depth,
        True,
        summary="depth missing at random pixels",
    ),
    "depth-hole": Fault(
        "share of the measured pixels",
        SHARE,
        0.0,
        (0.5, 0.75, 0.9),
        changes.remove_depth_on_one_side,
        True,
        summary="depth missing on one side, in one piece",
    ),
    "depth-shift": Fault(
        "pixels",
        SHIFT,
        0.0,
        (2.0, 5.0),
        changes.misregister,
        True,
        summary="depth moved relative to colour, in a random direction",
    ),
    "depth-window": Fault(
        "pixels a side",
        PIXELS,
        PIXELS.most,
        (25.0, 50.0, 100.0),
        changes.keep_window,
        True,
        summary="depth in a random square only",
    ),
    "depth-rows": Fault(
        "rows",
        PIXELS,
        PIXELS.most,
        (1.0, 10.0),
        partial(changes.keep_window, whole_rows=True),
        True,
        summary="depth in neighbouring rows only",
    ),
    "depth-wall": Fault(
        "1: on, 0: off",
        SWITCH,
        0.0,
        (1.0,),
        changes.keep_largest_plane,
        True,
        summary="depth on the largest plane only",
    ),
    "focal": Fault(
        "factor",
        FACTOR,
        1.0,
        (0.9, 0.95, 0.98, 1.02, 1.05, 1.1),
        lambda frame, factor, _: changes.restate_camera(
            frame, fx=frame.intrinsics.fx * factor, fy=frame.intrinsics.fy * factor
        ),
        summary="stated focal lengths multiplied by a factor",
    ),
    "nominal": Fault(
        "1: on, 0: off",
        SWITCH,
        0.0,
        (1.0,),
        changes.state_focal_alone,
        summary="only the focal length stated, and as approximate, as for an uncalibrated photo",
    ),
    "stretch": Fault(
        "factor",
        FACTOR,
        1.0,
        (0.75, 0.9, 1.1, 1.33),
        lambda frame, factor, _: changes.restate_camera(frame, fx=frame.intrinsics.fx * factor),
        summary="stated horizontal focal length multiplied by a factor, as if the image's aspect ratio had changed",
    ),
    "crop": Fault(
        "share of width and height",
        Range(0.0, 0.9),
        0.0,
        (0.1, 0.25),
        changes.crop,
        summary="rows and columns cropped at a corner, not reflected in the stated principal point",
    ),
    "principal-point": Fault(
        "pixels",
        SHIFT,
        0.0,
        (2.0, 5.0, 10.0),
        changes.move_principal_point,
        summary="stated principal point moved in a random direction",
    ),
    "distortion": Fault(
        "k1",
        Range(-1.0, 1.0),
        0.0,
        (-0.1, 0.1, 0.3),
        changes.distort,
        summary="radial distortion that the intrinsics do not state",
    ),
    "rolling-shutter": Fault(
        "degrees during the exposure of all rows",
        Range(0.0, 30.0),
        0.0,
        (0.5, 2.0),
        changes.rolling_shutter,
        summary="rolling shutter while the camera rotates",
    ),
    "exposure": Fault(
        "factor",
        FACTOR,
        1.0,
        (0.5, 0.7, 1.3, 2.0),
        lambda frame, factor, _: changes.recolour(frame, frame.rgb * factor),
        summary="all values multiplied by a factor",
    ),
    "white-balance": Fault(
        "factor",
        FACTOR,
        1.0,
        (0.8, 1.25),
        lambda frame, factor, _: changes.recolour(frame, frame.rgb * frame.rgb.new_tensor([factor, 1.0, 1 / factor])),
        summary="red multiplied and blue divided by a factor",
    ),
    "blur": Fault(
        "standard deviation, pixels",
        Range(0.0, 1000.0),
        0.0,
        (1.0, 3.0, 5.0),
        changes.blur,
        summary="colours blurred by a Gaussian",
    ),
    "jpeg": Fault(
        "quality", WholeNumbers(1, 100), None, (50.0, 20.0, 5.0), changes.compress, summary="colours compressed as JPEG"
    ),
    "grey": Fault("share of it", SHARE, 0.0, (1.0,), changes.desaturate, summary="saturation removed"),
    "vignetting": Fault(
        "share of the light lost in the corners",
        SHARE,
        0.0,
        (0.3, 0.6),
        changes.darken_corners,
        summary="corners darkened",
    ),
    "occluder": Fault(
        "share of the image",
        SHARE,
        0.0,
        (0.1, 0.25, 0.5),
        changes.add_occluder,
        summary="something in front, with its depth",
    ),
    "occluder-unmeasured": Fault(
        "share of the image",
        SHARE,
        0.0,
        (0.1, 0.25, 0.5),
        partial(changes.add_occluder, is_measured=False),
        summary="something in front, without depth",
    ),
    "moved": Fault(
        "share of the image",
        SHARE,
        0.0,
        (0.1, 0.25),
        changes.move_piece,
        summary="a piece of the scene moved to another place",
    ),
    "added": Fault(
        "share of the measured surface",
        SHARE,
        0.0,
        (0.2,),
        changes.add_object,
        True,
        summary="an object on the surface that the map lacks",
    ),
    "vanished": Fault(
        "share of the measured surface",
        SHARE,
        0.0,
        (0.2,),
        changes.remove_piece,
        True,
        summary="a piece of the surface missing",
    ),
    "mirror": Fault(
        "1: on, 0: off", SWITCH, 0.0, (1.0,), partial(changes.flip, columns=True), summary="left and right swapped"
    ),
    "flip": Fault(
        "1: on, 0: off", SWITCH, 0.0, (1.0,), partial(changes.flip, rows=True), summary="top and bottom swapped"
    ),
    "upside-down": Fault(
        "1: on, 0: off",
        SWITCH,
        0.0,
        (1.0,),
        partial(changes.flip, columns=True, rows=True),
        T_true_faulty=SE3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, math.pi], dtype=torch.float64)),
        summary="the camera held upside down",
    ),
    "covered": Fault(
        "1: on, 0: off", SWITCH, 0.0, (1.0,), changes.cover_lens, summary="one colour everywhere and no depth"
    ),
}
"""All bundled faults, by name."""
