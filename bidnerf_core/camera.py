"""Pinhole cameras with lens distortion.

Camera axes are OpenCV's: x right, y down, z forward. Pixel (column u, row v) of an image has its centre at
(u + 0.5, v + 0.5); intrinsics are given for that convention.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor

from bidnerf_core.errors import InputError


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths, principal point and size in pixels; distortion as OpenCV orders it (k1, k2, p1, p2[, k3 ...])."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"focal length {name} is {value}, expected a positive number of pixels")
        if self.width < 1 or self.height < 1:
            raise InputError(f"image size is {self.width}x{self.height}, expected at least 1x1")
        if not all(math.isfinite(x) for x in (self.cx, self.cy, *self.distortion)):
            raise InputError("principal point or distortion is not finite")
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            raise InputError(
                f"distortion has {len(self.distortion)} coefficients, expected 0, 4, 5, 8, 12 or 14"
            )

    def matrix(self, dtype: torch.dtype = torch.float64) -> Float[Tensor, "3 3"]:
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=dtype)

    def unproject(self, pixels: Float[Tensor, "*p 2"]) -> Float[Tensor, "*p 3"]:
        """Points on the plane z = 1 that are seen at ``pixels`` (u, v); not unit vectors."""
        if self.distortion:
            flat = undistort_points(
                pixels.reshape(-1, 2).double(), self.matrix(), self._coefficients(), num_iters=20
            )
            pixels = flat.to(pixels.dtype).reshape(pixels.shape)
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)

    def project(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 2"]:
        """Where points of the camera frame are seen; those at or behind the camera come out not finite."""
        z = torch.where(points[..., 2] > 0, points[..., 2], torch.nan)
        u = points[..., 0] / z * self.fx + self.cx
        v = points[..., 1] / z * self.fy + self.cy
        pixels = torch.stack([u, v], dim=-1)
        if self.distortion:
            flat = distort_points(pixels.reshape(-1, 2).double(), self.matrix(), self._coefficients())
            pixels = flat.to(pixels.dtype).reshape(pixels.shape)
        return pixels

    def pixel_centres(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "h w 2"]:
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=dtype) + 0.5,
            torch.arange(self.width, dtype=dtype) + 0.5,
            indexing="ij",
        )
        return torch.stack([u, v], dim=-1)

    def scaled(self, factor: float) -> Intrinsics:
        """The same camera with an image ``factor`` times as large."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        x, y = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y, width=width, height=height
        )

    def _coefficients(self) -> Tensor:
        return torch.tensor(self.distortion, dtype=torch.float64)
