"""A Gaussian prior on a pose, from landmarks, a previous frame or another sensor, as a cost."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3, se3_right_jacobian
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.solvers.pivots import Pivot


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """The squared Mahalanobis distance of poses from a mean; updates are expressed about ``pivot``."""

    mean: SE3  # T_world_camera
    covariance: Float[Tensor, "6 6"]  # of a right update of the mean (metres, radians); float64
    pivot: Pivot

    @property
    def at_pivot(self) -> Float[Tensor, "6 6"]:
        """The covariance of an update of the mean about the pivot."""
        back = torch.linalg.inv(self.pivot.update_at_camera(self.mean))
        return back @ self.covariance @ back.mT

    def __call__(self, T: SE3) -> NormalEquations:
        inverse = self.mean.inverse()
        off = (SE3(inverse.rotation[None], inverse.translation[None]) @ T).log()
        # log(exp(off) exp(d)) = off + J_r(off)^-1 d to first order (Sola et al. 2018, eq. 76).
        off_by_update = torch.linalg.inv(se3_right_jacobian(off)) @ self.pivot.update_at_camera(T)
        information = torch.linalg.inv(self.covariance)
        pulled = information @ off_by_update
        return NormalEquations(
            torch.einsum("hi,ij,hj->h", off, information, off),
            torch.einsum("hi,hij->hj", off, pulled),
            off_by_update.mT @ pulled,
        )
