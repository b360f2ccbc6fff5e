"""Another camera that far more of the matches agree with: a part of an image, say, or one that was resized to another shape.

Matches in a part of the scene, on one wall say, agree with a wrong pose and wrong intrinsics as well as with the right ones. The
other matches tell: far more agree if the camera is an unknown of the fit.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.localization.search.ransac import focal_consensus
from bidnerf_core.mapping.calibration import ANY, UNSTRETCHED, Calibration, Stretch
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.se3 import SE3

UNSUSPECTED = 0.8
"""Share of the matches from which on a pose is not suspected."""
FEW, FAR = 0.5, 0.1
"""Share of the matches below which a pose may be far from right, and principal points tried then, as shares of the focal length."""
LEAST_STRETCH = math.log(1.03)
"""Smallest stretch that is told from the errors of lenses and landmarks."""
MORE, FURTHER = 1.1, 5
"""Factor by which, and number of matches by which, more have to agree with another camera."""
DEVIATIONS = np.array([ANY.log_focal, ANY.shift, ANY.shift, ANY.log_focal])
"""Standard deviations of the logarithm of the focal length, of the principal point and of the logarithm of the stretch."""
SCALES = (4.0, 1.0)
"""Residuals at which outliers begin in the fits one after the other, in limits of an inlier."""
MOST_EVALUATIONS = 30
"""Largest number of steps of a fit."""
LARGEST_RESIDUAL = 1e4
"""Residual, pixels, of points behind the camera and of those that are farther off: fits need finite numbers."""
LARGEST_CHANGE = 5.0
"""Largest logarithm of a focal length's change that is tried."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """The pose and the camera that most matches agree with."""

    T_world_rig: SE3
    stretch: Stretch  # of the given intrinsics
    calibration: Calibration  # of the stretched ones
    inliers: Bool[Tensor, "m"]  # matches that agree

    def camera(self, given: Intrinsics) -> Intrinsics:
        """Return the intrinsics of the fit."""
        return self.calibration.applied(self.stretch.applied(given))

    @property
    def agreeing(self) -> int:
        """The number of matches that agree."""
        return int(self.inliers.sum())

    @property
    def sentence(self) -> str:
        """What differs from the given camera, in words."""
        return self.stretch.sentence(self.calibration)


def better_camera(
    data: ObservedPoints, T_world_rig: SE3, calibration: Calibration, limit: float, agreeing: int
) -> CameraFit | None:
    """Return the camera with which far more matches agree than with one that was found; None if there is none.

    ``data`` are matches by descriptors alone, of which ``agreeing`` have residuals within ``limit`` (pixels) at that pose and with
    the given intrinsics corrected by ``calibration``.
    """
    if not 0 < agreeing < UNSUSPECTED * len(data):
        return None
    enough = MORE * agreeing + FURTHER
    found = _from_near(data, T_world_rig, calibration, limit)
    if agreeing < FEW * len(data) and found.agreeing < enough:
        fits = [found, *_from_far(data, T_world_rig, calibration, limit)]
        found = max(fits, key=lambda fit: fit.agreeing)
    return found if found.agreeing >= enough else None


def _from_near(data: ObservedPoints, T_world_rig: SE3, calibration: Calibration, limit: float) -> CameraFit:
    """Return the fit that a pose and a camera lead to."""
    project = _Projection(data, T_world_rig, calibration.radial)
    found = np.array([0.0] * 6 + [calibration.log_focal, calibration.shift_u, calibration.shift_v, 0.0])
    for scale in SCALES:
        found = least_squares(
            project.whitened, found, args=(scale * limit,), loss="cauchy", max_nfev=MOST_EVALUATIONS
        ).x
    within = np.linalg.norm(project.residuals(found), axis=1) <= limit
    focal, u, v, log_stretch = found[6:].tolist()
    stretch, log_focal = _told_apart(log_stretch, focal)
    corrected = Calibration(log_focal, u / stretch.across, v / stretch.down, calibration.radial)
    return CameraFit(project.pose(found), stretch, corrected, torch.from_numpy(within))


def _from_far(
    data: ObservedPoints, T_world_rig: SE3, calibration: Calibration, limit: float
) -> list[CameraFit]:
    """Return the fits from principal points far off, and that of minimal samples of the matches, whose focal length is free."""
    fits = []
    for u, v in itertools.product((-FAR, FAR), repeat=2):
        # The principal point and this turn move the image by opposite amounts.
        turn = torch.tensor([0.0, 0.0, 0.0, v, -u, 0.0], dtype=torch.float64)
        moved = replace(calibration, shift_u=u, shift_v=v)
        fits.append(_from_near(data, T_world_rig.retract(turn), moved, limit))
    one_camera = bool((data.translation == data.translation[0]).all())
    sampled = focal_consensus(data, limit, seed=0) if one_camera else None
    if sampled is not None:
        fits.append(CameraFit(sampled.T_world_rig, UNSTRETCHED, sampled.calibration, sampled.inliers))
    return fits


def _told_apart(log_stretch: float, log_focal: float) -> tuple[Stretch, float]:
    """Return the stretch, and what remains of the change of the focal length.

    An image that was resized in one direction keeps its focal length in the other, so that the least change is the most probable.
    """
    if abs(log_stretch) <= LEAST_STRETCH:
        return UNSTRETCHED, log_focal
    parts = min((0.5, 0.0, 1.0), key=lambda across: abs(log_focal + (0.5 - across) * log_stretch))
    stretch = Stretch(math.exp(parts * log_stretch), math.exp((parts - 1) * log_stretch))
    return stretch, log_focal + (0.5 - parts) * log_stretch


class _Projection:
    """Residuals of matches from ten unknowns.

    These are a right update of the pose, the logarithm of the focal length, the shift of the principal point as a share of the
    focal length, and the logarithm of the stretch.
    """

    def __init__(self, data: ObservedPoints, T_world_rig: SE3, radial: float) -> None:
        self._points, self._image = data.points.numpy(), data.image.numpy()
        self._focal = data.focal.numpy()[:, None]
        self._rotation, self._translation = data.rotation.numpy(), data.translation.numpy()
        self._R_world_rig = T_world_rig.rotation.numpy()
        self._rig = T_world_rig.translation.numpy()
        self._radial = radial

    def pose(self, unknowns: Float[np.ndarray, "10"]) -> SE3:
        """Return the pose of the rig."""
        rotation, position = self._moved(unknowns)
        return SE3(torch.from_numpy(rotation), torch.from_numpy(position))

    def residuals(self, unknowns: Float[np.ndarray, "10"]) -> Float[np.ndarray, "m 2"]:
        """Return projection minus observation, pixels."""
        turned, position = self._moved(unknowns)
        rig = (self._points - position) @ turned
        local = np.einsum("mij,mj->mi", self._rotation, rig) + self._translation
        z = local[:, 2:]
        change = unknowns[6] + np.array([0.5, -0.5]) * unknowns[9]
        factors = np.exp(change.clip(-LARGEST_CHANGE, LARGEST_CHANGE))
        flat = local[:, :2] / np.where(z > 0, z, 1)
        bent = flat * (1 + self._radial * (flat**2).sum(1, keepdims=True))
        projected = bent * factors + unknowns[7:9]
        off = np.where(z > 0, (projected - self._image) * self._focal, LARGEST_RESIDUAL)
        return off.clip(-LARGEST_RESIDUAL, LARGEST_RESIDUAL)

    def whitened(self, unknowns: Float[np.ndarray, "10"], scale: float) -> Float[np.ndarray, "n"]:
        """Return all residuals in units of ``scale``, and those of the prior."""
        return np.append(self.residuals(unknowns).ravel() / scale, unknowns[6:] / DEVIATIONS)

    def _moved(
        self, unknowns: Float[np.ndarray, "10"]
    ) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Return the rig's orientation and position."""
        turn = Rotation.from_rotvec(unknowns[3:6]).as_matrix()
        return self._R_world_rig @ turn, self._rig + self._R_world_rig @ unknowns[:3]
