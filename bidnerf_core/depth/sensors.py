"""Models of depth sensors: their accuracy as known beforehand.

All assumptions about the accuracy of measured depth are stated here. Standard deviations are one sigma. An
error of the scale or the offset is the same in all pixels of an image and shifts the whole pose; noise is
independent between pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import overload

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError, unknown_name


@dataclass(frozen=True)
class DepthNoise:
    """The standard deviation of a pixel's depth, a polynomial in the depth."""

    constant: float = 0.0  # metres
    linear: float = 0.0  # metres per metre, hence independent of the unit of length
    quadratic: float = 0.0  # metres per square metre; sensors that measure disparity have this kind of noise

    def __post_init__(self) -> None:
        if not all(0 <= value < math.inf for value in (self.constant, self.linear, self.quadratic)):
            raise InputError(f"the depth noise is {self}", expected="finite coefficients of 0 or more")

    @overload
    def deviation(self, depth: float) -> float: ...
    @overload
    def deviation(self, depth: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]: ...
    def deviation(self, depth: float | Float[Tensor, "*p"]) -> float | Float[Tensor, "*p"]:
        """Return the standard deviation (metres) of measured depths (metres)."""
        return self.constant + (self.linear + self.quadratic * depth) * depth


@dataclass(frozen=True)
class DepthSensorModel:
    """The errors of one kind of depth sensor, as standard deviations.

    Lengths in metres are stated only for named sensors. For an unknown sensor everything is relative, since a
    scene may have any unit of length.
    """

    scale: float  # relative error of the factor shared by all depths of the sensor
    noise: DepthNoise
    offset: float = 0.0  # metres, error of the constant shared by all depths of the sensor

    def __post_init__(self) -> None:
        if not all(0 <= value < math.inf for value in (self.scale, self.offset)):
            raise InputError(
                f"the depth sensor has scale {self.scale} and offset {self.offset}",
                expected="finite numbers of 0 or more",
            )


UNKNOWN = DepthSensorModel(scale=0.01, noise=DepthNoise(linear=0.01))
"""An unspecified sensor: 1 % each for scale and noise, a round figure for consumer sensors at a few metres."""

UNKNOWN_SENSOR = "unknown"
"""The name of an unspecified sensor."""

DEPTH_SENSORS: dict[str, DepthSensorModel] = {
    UNKNOWN_SENSOR: UNKNOWN,
    # Microsoft's first Kinect, and other sensors by PrimeSense, with factory calibration. The noise follows from half a pixel
    # of disparity: 1.4 mm at 1 m, 36 mm at 5 m (Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for
    # Indoor Mapping Applications", Sensors 12, 2012). The scale is the root mean square of the corrections of 3.5 %, 3.1 % and
    # 0 % that the TUM RGB-D benchmark publishes for its three Kinects (Sturm et al., "A Benchmark for the Evaluation of RGB-D
    # SLAM Systems", IROS 2012). They are scale factors only, without an offset.
    "kinect": DepthSensorModel(scale=0.027, noise=DepthNoise(quadratic=0.001425)),
    # Intel's RealSense D4xx, stereo cameras with a projector. The noise was fitted to a D435 (Ahn et al., "Analysis and Noise
    # Modeling of the Intel RealSense D435 for Mobile Robots", UR 2019). It agrees with Intel's formula for the root mean square
    # error, 0.08 px z^2 / (focal length x baseline) = 0.0038 z^2 at 848x480; that of a D415 is 0.0015 z^2 at 1280x720, so this
    # model is cautious there. The data sheet of the D400 series limits the error of the distance to 2 % within 2 m, which is
    # taken as two standard deviations.
    "realsense": DepthSensorModel(
        scale=0.01, noise=DepthNoise(constant=0.001063, linear=0.0007278, quadratic=0.003949)
    ),
    # The lidar of Apple's phones and tablets, as ARKit returns it: few measured points, interpolated along image edges.
    # Luetzenburg, Kroon and Bjørk, "Evaluation of the Apple iPhone 12 Pro LiDAR for an Application in Geosciences", Scientific
    # Reports 11, 2021, found an accuracy of 1 cm on objects with sides of more than 10 cm, which is taken as the offset and, at
    # 2 m, as the noise. The scale is that of an unknown sensor.
    "lidar": DepthSensorModel(scale=0.01, offset=0.01, noise=DepthNoise(constant=0.005, linear=0.0025)),
    # Depth computed from a model of the scene: exact up to rounding, such as to the whole millimetres of a PNG from 1 m on.
    "rendered": DepthSensorModel(scale=0.0, noise=DepthNoise(linear=0.001)),
}
"""Sensors by the names that users give; others may be added."""


def find_depth_sensor(name: str) -> DepthSensorModel:
    """Return the model of a sensor. Raises ``InputError``, which lists the known names, for an unknown one."""
    if name not in DEPTH_SENSORS:
        raise unknown_name("depth sensor", name, DEPTH_SENSORS)
    return DEPTH_SENSORS[name]
