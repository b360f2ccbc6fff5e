"""Rays of pixels of many cameras at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from kornia.geometry.calibration import undistort_points
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics


@dataclass(frozen=True, eq=False)
class CameraBatch:
    """The intrinsics of several cameras as tensors."""

    matrices: Float[Tensor, "c 3 3"]  # float64, pixels
    distortion: Float[Tensor, "c d"]  # float64, in OpenCV's order; has no columns if no lens is distorted

    @staticmethod
    def of(cameras: Sequence[Intrinsics]) -> CameraBatch:
        """Build a batch from ``cameras``; shorter coefficient lists are padded with zeros."""
        longest = max((len(camera.distortion) for camera in cameras), default=0)
        rows = [[*camera.distortion, *[0.0] * (longest - len(camera.distortion))] for camera in cameras]
        return CameraBatch(
            torch.stack([camera.matrix() for camera in cameras]), torch.tensor(rows, dtype=torch.float64)
        )

    def unproject(self, pixels: Float[Tensor, "p 2"], camera: Int[Tensor, "p"]) -> Float[Tensor, "p 3"]:
        """Return the points on the plane z = 1 that appear at ``pixels`` (u, v); ``camera`` is the index of
        each pixel's camera.
        """
        matrix, exact = self.matrices[camera], pixels.double()
        if self.distortion.shape[1]:
            exact = undistort_points(exact[:, None], matrix, self.distortion[camera], num_iters=20)[:, 0]
        focal, middle = matrix.diagonal(dim1=1, dim2=2)[:, :2], matrix[:, :2, 2]
        return torch.cat([(exact - middle) / focal, torch.ones_like(exact[:, :1])], dim=-1).to(pixels.dtype)
