"""Depth sensors: their accuracy as known beforehand, and as estimated from one depth image.

All assumptions about the accuracy of measured depth are stated here. Standard deviations are one sigma. An
error in the scale or the offset is the same in all pixels of an image and shifts the whole pose; noise is
independent between pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import unknown_name
from bidnerf_core.geometry import MAD_TO_SIGMA
from bidnerf_core.settings import NotNegative, Settings

Depth = TypeVar("Depth", float, Tensor)


@dataclass(frozen=True)
class DepthNoise(Settings):
    """The standard deviation of a pixel's depth as a polynomial in the depth."""

    constant: NotNegative = 0.0  # metres
    linear: NotNegative = 0.0  # metres per metre, hence independent of the unit of length
    quadratic: NotNegative = 0.0  # metres per square metre; sensors that measure disparity have this kind of noise

    def deviation(self, depth: Depth) -> Depth:
        """Return the standard deviation (metres) of measured depths (metres)."""
        return self.constant + (self.linear + self.quadratic * depth) * depth


@dataclass(frozen=True)
class DepthSensorModel(Settings):
    """The errors of one kind of depth sensor, as standard deviations.

    Only named sensors have errors in metres. For an unknown sensor, all errors are relative, since a scene may
    have any unit of length.
    """

    scale: NotNegative  # relative error of the factor shared by all depths of the sensor
    noise: DepthNoise
    offset: NotNegative = 0.0  # metres, error of the constant shared by all depths of the sensor


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
"""Sensor models by the names that users give; more may be added."""


def find_depth_sensor(name: str) -> DepthSensorModel:
    """Return the model of the sensor called ``name``. Raises ``InputError``, which lists the known names, for any other name."""
    if name not in DEPTH_SENSORS:
        raise unknown_name("depth sensor", name, DEPTH_SENSORS)
    return DEPTH_SENSORS[name]


WINDOW_SIDE = 8
"""Side, in pixels, of the square windows to which planes are fitted."""
LEAST_WINDOWS = 20
"""Minimum number of windows in a range of depths for estimating the noise in that range."""
LEAST_VALUES = 8
"""Minimum number of distinct rows and columns in a resampled depth image, and of distinct values in an image stored in steps."""


def estimate_depth_noise(depth: Float[Tensor, "h w"], intrinsics: Intrinsics) -> DepthNoise | None:
    """Return the noise of a depth image (planar z, metres, 0: not measured), as a function of the depth.

    The relative noise is ``linear + quadratic * z``, constant or growing; it is fitted to the larger of the
    robust residuals of local planes and the rounding of stored values. Returns None if too few windows
    are measured without gaps. Errors shared by neighbouring pixels go unnoticed, such as those of a warped
    image, or of a lidar whose measurements were interpolated. If hardly any window is planar, the relief of
    the scene counts as noise.
    """
    if min(depth.shape) < WINDOW_SIDE:
        return None
    depth = depth.detach().cpu()
    # If the sensor's resolution is lower than the image's, depth was resampled by nearest neighbour: rows and columns that repeat
    # the preceding one are no separate measurements. All count if few repeat another, such as empty ones along a border, and if
    # hardly any would be left, as in an exact image of a wall.
    first = torch.ones(1, dtype=torch.bool)
    rows, columns = (torch.cat([first, (x[1:] != x[:-1]).any(-1)]) for x in (depth, depth.T))
    if not all(LEAST_VALUES <= int(new.sum()) <= 0.8 * len(new) for new in (rows, columns)):
        rows[:], columns[:] = True, True
    image = intrinsics.unproject(intrinsics.pixel_centres(torch.float64)[rows][:, columns])[..., :2]
    depth = depth[rows][:, columns].double()
    # Adjacent windows, one per row; left-over rows and columns of the image are not used.
    parts = (part.unfold(0, WINDOW_SIDE, WINDOW_SIDE).unfold(1, WINDOW_SIDE, WINDOW_SIDE) for part in (depth, image))
    z, x = (part.flatten(0, 1).flatten(-2) for part in parts)
    whole = ((z > 0) & z.isfinite()).all(-1)
    z, x = z[whole], x[whole].mT
    if len(z) < LEAST_WINDOWS:
        return None
    # The inverse depth of a plane is linear in the image coordinates, whatever its slant. A deviation e of 1/z is a relative
    # deviation z e of z.
    x = x - x.mean(1, keepdim=True)
    residual = 1 / z - (1 / z).mean(-1, keepdim=True)
    residual = residual - (x @ torch.linalg.solve(x.mT @ x, x.mT @ residual[..., None]))[..., 0]
    middle, spare = z.median(-1).values, z.shape[-1] / (z.shape[-1] - 3)
    # A quarter of the windows is assumed to be planar (the others may show edges, curved surfaces and relief): the noise is that
    # quantile of their residuals, times the ratio of the two if all windows are planar and all pixels independent.
    noise = 1.11 * MAD_TO_SIGMA * spare**0.5 * middle * residual.abs().median(-1).values
    ranges = middle.argsort().tensor_split(min(8, len(z) // LEAST_WINDOWS))
    at = torch.stack([middle[some].median() for some in ranges]).numpy()
    deviation = torch.stack([noise[some].quantile(0.25) for some in ranges]).numpy()
    # The noise is at least the rounding to the usual step of the values, unless they are continuous or few.
    measured = depth[(depth > 0) & depth.isfinite()]
    values = measured.unique()
    if len(values) >= LEAST_VALUES and len(measured) >= 4 * len(values):
        deviation = np.maximum(deviation, float(values.diff().median()) / math.sqrt(12) / at)
    if at.max() < 1.5 * at.min():  # too small a range to estimate how the noise grows with depth
        return DepthNoise(linear=float(np.median(deviation)))
    from scipy.optimize import nnls  # imported here, since it takes as long as the rest of scipy

    (linear, quadratic), _ = nnls(np.stack([np.ones_like(at), at], axis=-1), deviation)
    return DepthNoise(linear=float(linear), quadratic=float(quadratic))


def describe_depth_noise(depth: Float[Tensor, "h w"], intrinsics: Intrinsics, sensor: str) -> str | None:
    """Return one line if the noise estimated from a depth image (metres) is not that of ``sensor`` within a factor of two.

    Returns None if it is, and if the noise cannot be estimated from the image.
    """
    noise = estimate_depth_noise(depth, intrinsics)
    if noise is None:
        return None
    z = float(depth[depth > 0].median())
    estimated, expected = noise.deviation(z) / z, find_depth_sensor(sensor).noise.deviation(z) / z
    if 0.5 * expected <= estimated <= 2 * expected:
        return None
    return (
        f"the depth scatters by about {estimated:.2%} of the distance at {z:.3g} m, that of a {sensor!r} usually by"
        f" {expected:.2%}; `depth_sensor` states what measured it"
    )
