"""Thumbnails: small, smooth images, which renderings of a map from many poses are compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, interpolate, pad

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.devices import constant
from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3

KERNEL_REACH = 3.0
"""Radius of a blurring kernel in standard deviations."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A view resampled to a small camera without distortion. All that is derived from it lies on the device of ``rgb``."""

    camera: Intrinsics
    T_last_camera: SE3
    rgb: Float[Tensor, "3 h w"]  # smoothed

    @cached_property
    def flat(self) -> Float[Tensor, "n 3"]:
        """The pixels' points on the plane z = 1 of the camera frame, row by row."""
        return self.camera.unproject(self.camera.pixel_centres()).reshape(-1, 3).to(self.rgb.device)

    @cached_property
    def directions(self) -> Float[Tensor, "n 3"]:
        """The pixels' unit directions, in the last camera's frame."""
        return self.T_last_camera.to(self.flat).rotate(torch.nn.functional.normalize(self.flat, dim=-1))

    @cached_property
    def directness(self) -> Float[Tensor, "n"]:
        """Ratio of depth (planar z) to distance along each ray."""
        return 1 / torch.linalg.vector_norm(self.flat, dim=-1)

    @cached_property
    def origin(self) -> Float[Tensor, "3"]:
        return self.T_last_camera.translation.to(self.flat)

    @cached_property
    def rotation(self) -> Float[Tensor, "3 3"]:
        """Rotation that takes the axes of the camera to those of the last camera."""
        return self.T_last_camera.rotation.to(self.flat)

    @cached_property
    def slopes(self) -> Float[Tensor, "3 n 2"]:
        return slopes(self.rgb, self.camera)


def thumbnail(view: View, width: int) -> Thumbnail:
    """Return ``view`` reduced to at most ``width`` pixels on its longer side, without distortion, smoothed; on the CPU."""
    camera = view.frame.intrinsics
    small = replace(camera.scaled(min(1.0, width / max(camera.width, camera.height))), distortion=())
    rgb = view.frame.rgb.cpu().float().permute(2, 0, 1)[None]
    # Averaged first, so that every pixel of the image contributes.
    rgb = interpolate(rgb, (small.height, small.width), mode="area")
    if camera.distortion:
        seen = camera.project(small.unproject(small.pixel_centres())) / torch.tensor(
            [camera.width, camera.height]
        )
        rgb = grid_sample(rgb, 2 * seen[None] - 1, padding_mode="border", align_corners=False)
    return Thumbnail(small, view.T_ref_camera.to("cpu", torch.float64), smooth(rgb[0]))


def smooth(image: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Convolve with a binomial kernel of 5x5 pixels, about a Gaussian of one pixel; the border is repeated."""
    kernel = constant((1.0, 4.0, 6.0, 4.0, 1.0), image) / 16
    flat = image.reshape(-1, 1, *image.shape[-2:])
    flat = conv2d(pad(flat, (2, 2, 0, 0), mode="replicate"), kernel.view(1, 1, 1, 5))
    flat = conv2d(pad(flat, (0, 0, 2, 2), mode="replicate"), kernel.view(1, 1, 5, 1))
    return flat.view(image.shape)


def gaussian_blurred(image: Float[Tensor, "b c h w"], pixels: float) -> Float[Tensor, "b c h w"]:
    """Convolve with a Gaussian of standard deviation ``pixels``; the border is repeated."""
    size = 2 * math.ceil(KERNEL_REACH * pixels) + 1
    return gaussian_blur2d(image, (size, size), (pixels, pixels), "replicate")


def slopes(image: Float[Tensor, "*b h w"], camera: Intrinsics) -> Float[Tensor, "*b n 2"]:
    """Return central differences to the right and down, per unit on the plane z = 1."""
    flat = image.reshape(-1, 1, *image.shape[-2:])
    wide = pad(flat, (1, 1, 1, 1), mode="replicate")
    across = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) * (camera.fx / 2)
    down = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) * (camera.fy / 2)
    return torch.stack([across, down], -1).reshape(*image.shape[:-2], -1, 2)
