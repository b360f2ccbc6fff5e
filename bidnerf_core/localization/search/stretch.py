"""Whether an image was stretched: resized to another shape, while its intrinsics are those of square pixels.

Matches in a part of the scene, on one wall say, then still agree with a wrong pose as well as with the right one of an image that
was not stretched. The other matches tell: far more agree if the stretch is an unknown of the fit.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.se3 import SE3

UNSUSPECTED = 0.8
"""Share of the matches from which on a pose is not suspected."""
LEAST_STRETCH = math.log(1.03)
"""Smallest stretch that is told from the errors of lenses and landmarks."""
MORE, FURTHER = 1.1, 5
"""Factor by which, and number of matches by which, more have to agree if the image is stretched."""
FOCAL_DEVIATION = 0.2
"""Standard deviation of the logarithm of the focal length in these fits: a stretch in width alone changes it too."""
SCALES = (4.0, 1.0)
"""Residuals at which outliers begin in the fits one after the other, in limits of an inlier."""
MOST_EVALUATIONS = 30
"""Largest number of steps of a fit."""
LARGEST_RESIDUAL = 1e4
"""Residual, pixels, of points behind the camera and of those that are farther off: fits need finite numbers."""
LARGEST_CHANGE = 5.0
"""Largest logarithm of a focal length's change that is tried."""


def stretch_of(data: ObservedPoints, T_world_rig: SE3, limit: float, agreeing: int) -> float:
    """Return the factor by which images are wider than their intrinsics say, relative to their height; 1 where nothing tells.

    ``data`` are matches by descriptors alone, of which ``agreeing`` have residuals within ``limit`` (pixels) at the pose.
    """
    if not 0 < agreeing < UNSUSPECTED * len(data):
        return 1.0
    project = _Projection(data, T_world_rig)
    found = np.zeros(8)
    for scale in SCALES:
        found = least_squares(
            project.whitened, found, args=(scale * limit,), loss="cauchy", max_nfev=MOST_EVALUATIONS
        ).x
    within = int((np.linalg.norm(project.residuals(found), axis=1) <= limit).sum())
    more = within >= MORE * agreeing + FURTHER
    return math.exp(found[7]) if more and abs(found[7]) > LEAST_STRETCH else 1.0


class _Projection:
    """Residuals of matches from eight unknowns: a right update of the pose, and logarithms of focal length and stretch."""

    def __init__(self, data: ObservedPoints, T_world_rig: SE3) -> None:
        self._points, self._image = data.points.numpy(), data.image.numpy()
        self._focal = data.focal.numpy()[:, None]
        self._rotation, self._translation = data.rotation.numpy(), data.translation.numpy()
        self._R_world_rig = T_world_rig.rotation.numpy()
        self._rig = T_world_rig.translation.numpy()

    def residuals(self, unknowns: Float[np.ndarray, "8"]) -> Float[np.ndarray, "m 2"]:
        """Return projection minus observation, pixels."""
        turned = self._R_world_rig @ Rotation.from_rotvec(unknowns[3:6]).as_matrix()
        rig = (self._points - self._rig - self._R_world_rig @ unknowns[:3]) @ turned
        local = np.einsum("mij,mj->mi", self._rotation, rig) + self._translation
        z = local[:, 2:]
        change = unknowns[6] + np.array([0.5, -0.5]) * unknowns[7]
        factors = np.exp(change.clip(-LARGEST_CHANGE, LARGEST_CHANGE))
        projected = local[:, :2] / np.where(z > 0, z, 1) * factors
        off = np.where(z > 0, (projected - self._image) * self._focal, LARGEST_RESIDUAL)
        return off.clip(-LARGEST_RESIDUAL, LARGEST_RESIDUAL)

    def whitened(self, unknowns: Float[np.ndarray, "8"], scale: float) -> Float[np.ndarray, "n"]:
        """Return all residuals in units of ``scale``, and those of the prior."""
        return np.append(self.residuals(unknowns).ravel() / scale, unknowns[6:] / FOCAL_DEVIATION)
