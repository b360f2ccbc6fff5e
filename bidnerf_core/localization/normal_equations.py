"""From residuals and their Jacobian to the 6x6 system of a step and the covariance of the answer; float64."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.localization.exposure import Exposure, fit_exposure
from bidnerf_core.localization.linearization import Linearization
from bidnerf_core.localization.ray_batch import RayBatch
from bidnerf_core.localization.solvers.levenberg_marquardt import System
from bidnerf_core.robust import Robust


@dataclass(frozen=True)
class Losses:
    """Robust losses of colour (its scale in differences of colour) and of depth (in metres)."""

    colour: Robust
    depth: Robust

    def __call__(self, residual: Float[Tensor, "*r 4"]) -> Float[Tensor, "*r 4"]:
        return torch.cat([self.colour(residual[..., :3]), self.depth(residual[..., 3:])], -1)

    def weight(self, residual: Float[Tensor, "*r 4"]) -> Float[Tensor, "*r 4"]:
        """``rho'(r) / r``."""
        parts = (self.colour.weight(residual[..., :3]), self.depth.weight(residual[..., 3:]))
        return torch.cat(parts, -1)


@dataclass(frozen=True, eq=False)
class Residuals:
    """What is seen less what was measured by each of n rays from each of h poses: red, green, blue, metres."""

    value: Float[Tensor, "h n 4"]
    jacobian: Float[Tensor, "h n 4 6"]
    share: Float[Tensor, "n 4"]  # of each in the objective; 0 where nothing was measured
    firm: Float[Tensor, "h n 4"]  # 1, or less where a residual is too steep to be trusted
    losses: Losses

    @property
    def _pull(self) -> Float[Tensor, "h n 4"]:
        """Weight of each square in a step."""
        return self.share * self.firm**2 * self.losses.weight(self.firm * self.value)

    def system(self) -> System:
        """``cost = 2 sum share rho(r)``, so that it is the plain sum of squares where residuals are small.

        How firm residuals are steers a step, but a step is judged without: steep places would be sought for being so.
        """
        pull = self._pull
        return System(
            2 * (self.share * self.losses(self.value)).sum((-1, -2)).cpu(),
            torch.einsum("hnc,hnci->hi", pull * self.value, self.jacobian).cpu(),
            torch.einsum("hnc,hnci,hncj->hij", pull, self.jacobian, self.jacobian).cpu(),
        )

    def covariance(self) -> Float[Tensor, "h 6 6"]:
        """Of the update that is left, ``H^-1 (sum_r s_r s_r^T) H^-1`` with the score ``s_r`` of each ray (Huber 1967).

        The residuals say how noisy each kind of measurement is, and the channels of one ray may err together. Infinite
        where the rays do not determine the pose.
        """
        score = torch.einsum("hnc,hnci->hni", self._pull * self.value, self.jacobian).cpu()
        score = score - score.mean(1, keepdim=True)  # what is not yet descended is no noise
        heard = int((score != 0).any(-1).any(0).sum())
        hessian = self.system().hessian
        if heard <= 6:
            return torch.full_like(hessian, torch.inf)
        unit = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
        scaled = unit[..., None] * hessian * unit[..., None, :]
        spread, axes = torch.linalg.eigh(scaled)
        inverse = axes @ torch.diag_embed(1 / spread.clamp(min=1e-300)) @ axes.mT
        inverse = unit[..., None] * inverse * unit[..., None, :]
        found = inverse @ (score.mT @ score) @ inverse * (heard / (heard - 6))
        sound = (spread[..., 0] > 1e-10) & found.isfinite().all(-1).all(-1)
        return torch.where(sound[:, None, None], (found + found.mT) / 2, torch.inf)

    def inliers(self) -> Float[Tensor, "h"]:
        """Share of the rays of which no measurement is farther off than three times where its outliers begin."""
        limits = [self.losses.colour.scale] * 3 + [self.losses.depth.scale]
        off = (self.value.abs() > 3 * self.value.new_tensor(limits)) & (self.share > 0)
        met: Bool[Tensor, "h n"] = ~off.any(-1)
        return met.double().mean(-1).cpu()


def residuals(
    found: Linearization, batch: RayBatch, losses: Losses, exposure: bool, play: float = 0.0
) -> Residuals:
    """``exposure``: render as bright as the image was taken, by a gain and a bias that are fitted at each pose.

    ``play``: metres that surfaces may be off. They let a residual vary by its steepness times that, beside its own scale,
    and it counts for so much less.
    """
    seen, jacobian, share = found.seen.double(), found.jacobian.double(), batch.share.double()
    target = torch.cat([batch.measured[:, :3], torch.zeros_like(batch.measured[:, 3:])], -1).double()
    if exposure:
        fitted = fit_exposure(seen[..., :3], target[:, :3], share[:, :3], losses.colour)
        seen, jacobian = _exposed(seen, jacobian, share, fitted)
    scale = seen.new_tensor([losses.colour.scale] * 3 + [losses.depth.scale])
    firm = (1 + (play / scale * found.steepness.double()) ** 2).rsqrt()
    return Residuals(torch.where(share > 0, seen - target, 0), jacobian, share, firm, losses)


def _exposed(
    seen: Float[Tensor, "h n 4"], jacobian: Float[Tensor, "h n 4 6"], share: Float[Tensor, "n 4"], fitted: Exposure
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Brightened; of the derivative, less what a change of gain and bias could do as well (variable projection)."""
    colour, by_pose = seen[..., :3], fitted.gain[:, None, :, None] * jacobian[..., :3, :]
    weights = share[:, :3] / share[:, :3].sum(0).clamp(min=torch.finfo(share.dtype).tiny)
    basis = colour - (weights * colour).sum(1, keepdim=True)
    basis = basis * (weights * basis**2).sum(1, keepdim=True).clamp(min=1e-12).rsqrt()
    by_pose = by_pose - torch.einsum("nc,hnci->hci", weights, by_pose)[:, None]
    by_pose = by_pose - basis[..., None] * torch.einsum("nc,hnc,hnci->hci", weights, basis, by_pose)[:, None]
    brightened = torch.cat([fitted.applied(colour), seen[..., 3:]], -1)
    return brightened, torch.cat([by_pose, jacobian[..., 3:, :]], -2)
