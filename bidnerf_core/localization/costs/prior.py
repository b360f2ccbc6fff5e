"""Gaussian knowledge of a pose as a cost: what landmarks, a previous frame or another sensor say."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """The squared Mahalanobis distance of poses from a mean; updates turn about ``pivot``."""

    mean: SE3  # T_world_camera
    covariance: Float[
        Tensor, "6 6"
    ]  # of a right update of the mean: translation (metres), rotation (radians)
    pivot: Pivot

    def __call__(self, T: SE3) -> NormalEquations:
        inverse = self.mean.inverse()
        off = (SE3(inverse.rotation[None], inverse.translation[None]) @ T).log()
        information = torch.linalg.inv(self.covariance)
        # To first order in the distance from the mean an update at the pivot is Ad(T_camera_pivot) times it at the camera.
        T_camera_pivot = self.pivot.T_camera_pivot
        by_update = (self.mean.inverse() if T_camera_pivot is None else T_camera_pivot).adjoint()
        pulled = information @ by_update
        return NormalEquations(
            torch.einsum("hi,ij,hj->h", off, information, off),
            off @ pulled,
            (by_update.mT @ pulled).expand(len(off), 6, 6),
        )
