"""The remark that commands print on the depth of an image whose sensor was named."""

from __future__ import annotations

from typing import Any

from bidnerf_core.depth.noise import estimated_depth_noise
from bidnerf_core.depth.sensors import find_depth_sensor
from bidnerf_core.depth.steps import depth_steps
from bidnerf_core.frames.frame import Frame
from bidnerf_core.localization import AutoConfig


def depth_remark(frame: Frame, settings: Any) -> str | None:
    """Return one line that compares the noise estimated from a depth image with that of its sensor.

    Returns None where the settings name no sensor, and where the noise cannot be estimated from the image.
    """
    sensor = settings.depth_sensor if isinstance(settings, AutoConfig) else AutoConfig.depth_sensor
    if sensor == AutoConfig.depth_sensor or frame.depth is None or not frame.has_depth:
        return None
    found = estimated_depth_noise(frame.depth, frame.intrinsics)
    if found is None:
        return None
    z = float(frame.depth[frame.depth > 0].median())
    estimated, expected = found.deviation(z) / z, find_depth_sensor(sensor).noise.deviation(z) / z
    steps = depth_steps(frame.depth)
    of_disparity = (
        "; its steps grow with the square of the distance" if steps is not None and steps.of_disparity else ""
    )
    return f"depth noise at {z:.3g} m is about {estimated:.2%}; that of {sensor!r} is usually {expected:.2%}{of_disparity}"
