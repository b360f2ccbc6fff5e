"""Another camera with which far more matches agree: that of a cropped image, say, or of one resized to another shape.

Matches in one part of the scene, on a single wall say, agree with a wrong pose and wrong intrinsics as well as with the right
ones. The other matches decide: far more of them agree if the camera is an unknown of the fit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.search.ransac import focal_consensus
from bidnerf_core.mapping.geometry.calibration import ANY, UNSTRETCHED, Calibration, Stretch
from bidnerf_core.mapping.geometry.observations import ObservedPoints

UNSUSPECTED = 0.8
"""Least share of agreeing matches at which a pose is not suspected."""
SUSPECTED, FAR = 0.5, 0.1
"""Share of agreeing matches below which a pose may be far off, and shift of the principal points tried then, as a share of the
focal length.
"""
LEAST_STRETCH = math.log(1.03)
"""Smallest stretch, as a logarithm, that is distinguished from the errors of lenses and landmarks."""
SUPPORT_RATIO, LEAST_EXTRA_INLIERS = 1.1, 5
"""Factor by which, and number of exact matches by which, the support of another camera has to exceed that of the one found."""
DEVIATIONS = np.array([ANY.log_focal, ANY.shift, ANY.shift, ANY.log_focal])
"""Standard deviations of the logarithm of the focal length, of the principal point and of the logarithm of the stretch."""
FIT_SCALES = (4.0, 1.0)
"""Residuals at which outliers begin in the successive fits, in units of the inlier threshold."""
MOST_EVALUATIONS, ROUGH_EVALUATIONS = 30, 8
"""Largest number of steps of a fit, and of the fits that choose among starts."""
FEW_DRAWS = 500
"""Largest number of minimal samples: enough for two inliers in five matches."""
LARGEST_RESIDUAL = 1e4
"""Residual (pixels) of points behind the camera, and upper limit of all others: fits need finite numbers."""
LARGEST_CHANGE = 5.0
"""Largest logarithm of a focal length's change that is tried."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """The pose and the camera with which most matches agree."""

    T_world_rig: SE3
    stretch: Stretch  # of the given intrinsics
    calibration: Calibration  # of the stretched ones
    inliers: Bool[Tensor, "m"]  # matches that agree

    @property
    def agreeing(self) -> int:
        """The number of matches that agree."""
        return int(self.inliers.sum())

    @property
    def sentence(self) -> str:
        """What differs from the given camera, in words."""
        return self.stretch.sentence(self.calibration)


def better_camera(
    data: ObservedPoints,
    T_world_rig: SE3,
    calibration: Calibration,
    limit: float,
    unsuspected: float = UNSUSPECTED,
) -> CameraFit | None:
    """Return a camera with which far more matches agree than with the one that was found; None if there is none.

    ``data`` are matches by descriptors alone; a match agrees if its residual is within ``limit`` (pixels). The camera that was
    found is the given one corrected by ``calibration``; if at least a share ``unsuspected`` of the matches agree with it, no
    other is sought.
    """
    here = _Projection(data, T_world_rig, calibration.radial)
    start = _unknowns(calibration)
    before, enough = (
        here.agreeing(start, limit),
        SUPPORT_RATIO * here.support(start, limit) + LEAST_EXTRA_INLIERS,
    )
    if not 0 < before < unsuspected * len(data):
        return None
    fits = [_fitted(here, start, limit)]
    if fits[0][1] < enough and (sampled := _from_sample(data, limit)) is not None:
        fits.append(sampled)
    if before < SUSPECTED * len(data) and max(support for _, support in fits) < enough:
        fits.append(_from_far(data, T_world_rig, calibration, limit))
    found, best = max(fits, key=lambda fit: fit[1])
    return found if best >= enough else None


def _unknowns(calibration: Calibration) -> Float[np.ndarray, "10"]:
    """Return the unknowns of a fit at its start."""
    return np.array([0.0] * 6 + [calibration.log_focal, calibration.shift_u, calibration.shift_v, 0.0])


def _fitted(
    project: _Projection, start: Float[np.ndarray, "10"], limit: float, scales: Sequence[float] = FIT_SCALES
) -> tuple[CameraFit, float]:
    """Return the fit that a start leads to, and its support."""
    found = start
    for scale in scales:
        found = project.descended(found, scale * limit, MOST_EVALUATIONS)
    focal, u, v, log_stretch = found[6:].tolist()
    stretch, log_focal = split_stretch(log_stretch, focal)
    corrected = Calibration(log_focal, u / stretch.across, v / stretch.down, project.radial)
    within = torch.from_numpy(project.distances(found) <= limit)
    return CameraFit(project.pose(found), stretch, corrected, within), project.support(found, limit)


def _from_sample(data: ObservedPoints, limit: float) -> tuple[CameraFit, float] | None:
    """Return the fit from the best minimal sample of the matches, whose focal length is free.

    Returns None if there is no sample, and for several views, whose matches are not those of one pinhole camera.
    """
    parts = (data.translation, data.rotation, data.focal)
    if not all(bool((part == part[0]).all()) for part in parts):
        return None
    sampled = focal_consensus(data, limit, seed=0, most_draws=FEW_DRAWS)
    if sampled is None:
        return None
    project = _Projection(data, sampled.T_world_rig, 0.0)
    return _fitted(project, _unknowns(sampled.calibration), limit, FIT_SCALES[-1:])


def _from_far(
    data: ObservedPoints, T_world_rig: SE3, calibration: Calibration, limit: float
) -> tuple[CameraFit, float]:
    """Return the best of the fits that start from principal points far from the middle."""
    rough = []
    for u, v in itertools.product((-FAR, FAR), repeat=2):
        # The principal point and this turn move the image by opposite amounts.
        turn = torch.tensor([0.0, 0.0, 0.0, v, -u, 0.0], dtype=torch.float64)
        project = _Projection(data, T_world_rig.retract(turn), calibration.radial)
        start = _unknowns(replace(calibration, shift_u=u, shift_v=v))
        found = project.descended(start, FIT_SCALES[0] * limit, ROUGH_EVALUATIONS)
        rough.append((project.support(found, limit), project, found))
    _, project, found = max(rough, key=lambda fit: fit[0])
    return _fitted(project, found, limit)


def split_stretch(log_stretch: float, log_focal: float) -> tuple[Stretch, float]:
    """Return the stretch, if it is more than the errors of lenses, and what remains of the change of the focal length."""
    if abs(log_stretch) <= LEAST_STRETCH:
        return UNSTRETCHED, log_focal
    return least_change(log_stretch, log_focal)


def least_change(log_stretch: float, log_focal: float) -> tuple[Stretch, float]:
    """Return the stretch, and the change of the focal length that remains (logarithm).

    An image that was resized in one direction keeps its focal length in the other, so the least change is the most probable.
    """
    across = min((0.5, 0.0, 1.0), key=lambda share: abs(log_focal + (0.5 - share) * log_stretch))
    stretch = Stretch(math.exp(across * log_stretch), math.exp((across - 1) * log_stretch))
    return stretch, log_focal + (0.5 - across) * log_stretch


class _Projection:
    """Residuals of matches as functions of ten unknowns.

    These are a right update of the pose, the logarithm of the focal length, the shift of the principal point as a share of the
    focal length, and the logarithm of the stretch.
    """

    def __init__(self, data: ObservedPoints, T_world_rig: SE3, radial: float) -> None:
        self._points, self._image = data.points.numpy(), data.image.numpy()
        self._focal = data.focal.numpy()[:, None]
        self._rotation, self._translation = data.rotation.numpy(), data.translation.numpy()
        self._R_world_rig = T_world_rig.rotation.numpy()
        self._rig = T_world_rig.translation.numpy()
        self.radial = radial

    def pose(self, unknowns: Float[np.ndarray, "10"]) -> SE3:
        """Return the pose of the rig."""
        rotation, position = self._moved(unknowns)
        return SE3(torch.from_numpy(rotation), torch.from_numpy(position))

    def distances(self, unknowns: Float[np.ndarray, "10"]) -> Float[np.ndarray, "m"]:
        """Return the distance of each projection from its observation, pixels."""
        distances: Float[np.ndarray, "m"] = np.linalg.norm(self.residuals(unknowns), axis=1)
        return distances

    def agreeing(self, unknowns: Float[np.ndarray, "10"], limit: float) -> int:
        """Return how many matches agree."""
        return int((self.distances(unknowns) <= limit).sum())

    def support(self, unknowns: Float[np.ndarray, "10"], limit: float) -> float:
        """Return how many matches agree, where each counts the less the farther off it is (MSAC: Torr and Zisserman 2000)."""
        return float((1 - (self.distances(unknowns) / limit) ** 2).clip(min=0).sum())

    def descended(self, start: Float[np.ndarray, "10"], scale: float, steps: int) -> Float[np.ndarray, "10"]:
        """Return the unknowns to which minimizing the robust loss of this ``scale`` leads from a start."""
        found: Float[np.ndarray, "10"] = least_squares(
            self._whitened, start, args=(scale,), loss="cauchy", max_nfev=steps
        ).x
        return found

    def residuals(self, unknowns: Float[np.ndarray, "10"]) -> Float[np.ndarray, "m 2"]:
        """Return projection minus observation, pixels."""
        turned, position = self._moved(unknowns)
        rig = (self._points - position) @ turned
        local = np.einsum("mij,mj->mi", self._rotation, rig) + self._translation
        z = local[:, 2:]
        change = unknowns[6] + np.array([0.5, -0.5]) * unknowns[9]
        factors = np.exp(change.clip(-LARGEST_CHANGE, LARGEST_CHANGE))
        flat = local[:, :2] / np.where(z > 0, z, 1)
        bent = flat * (1 + self.radial * (flat**2).sum(1, keepdims=True))
        projected = bent * factors + unknowns[7:9]
        off = np.where(z > 0, (projected - self._image) * self._focal, LARGEST_RESIDUAL)
        return off.clip(-LARGEST_RESIDUAL, LARGEST_RESIDUAL)

    def _whitened(self, unknowns: Float[np.ndarray, "10"], scale: float) -> Float[np.ndarray, "n"]:
        """Return all residuals in units of ``scale``, and those of the prior."""
        return np.append(self.residuals(unknowns).ravel() / scale, unknowns[6:] / DEVIATIONS)

    def _moved(
        self, unknowns: Float[np.ndarray, "10"]
    ) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Return the rig's orientation and position."""
        turn = Rotation.from_rotvec(unknowns[3:6]).as_matrix()
        return self._R_world_rig @ turn, self._rig + self._R_world_rig @ unknowns[:3]
