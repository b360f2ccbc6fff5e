"""Small and smoothed versions of images, and whether an image shows anything."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, grid_sample, interpolate, pad

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import constant
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.frames.pixels import inpaint
from bidnerf_core.geometry import SE3


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A view resampled to a small camera without distortion."""

    camera: Intrinsics
    T_last_camera: SE3
    rgb: Float[Tensor, "3 h w"]  # smoothed
    flat: Float[Tensor, "n 3"]  # the pixels' points on the plane z = 1 of the camera frame, row by row
    slopes: Float[Tensor, "3 n 2"]  # of the colours, per unit on that plane

    @staticmethod
    def of(view: View, width: int) -> Thumbnail:
        """Return ``view`` undistorted, smoothed and reduced to at most ``width`` pixels on its longer side; on the CPU."""
        camera = view.frame.intrinsics
        small = replace(camera.scaled(min(1.0, width / max(camera.width, camera.height))), distortion=())
        # Averaged first, so that every pixel of the image contributes.
        rgb = inpaint(view.frame).cpu().float().permute(2, 0, 1)[None]
        rgb = interpolate(rgb, (small.height, small.width), mode="area")
        flat = small.unproject(small.pixel_centres())
        if camera.distortion:
            seen = 2 * camera.project(flat) / torch.tensor([camera.width, camera.height]) - 1
            rgb = grid_sample(rgb, seen[None], padding_mode="border", align_corners=False)
        rgb, T = smooth(rgb[0]), view.T_ref_camera.to("cpu", torch.float64)
        return Thumbnail(small, T, rgb, flat.reshape(-1, 3), slopes(rgb, small))


def smooth(image: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Convolve an image with a 5x5 binomial kernel, approximately a Gaussian of one pixel; the border is replicated."""
    kernel = constant((1.0, 4.0, 6.0, 4.0, 1.0), image) / 16
    flat = image.reshape(-1, 1, *image.shape[-2:])
    flat = conv2d(pad(flat, (2, 2, 0, 0), mode="replicate"), kernel.view(1, 1, 1, 5))
    flat = conv2d(pad(flat, (0, 0, 2, 2), mode="replicate"), kernel.view(1, 1, 5, 1))
    return flat.view(image.shape)


def slopes(image: Float[Tensor, "*b h w"], camera: Intrinsics) -> Float[Tensor, "*b n 2"]:
    """Return the image's central differences to the right and down, per unit on the plane z = 1."""
    flat = image.reshape(-1, 1, *image.shape[-2:])
    wide = pad(flat, (1, 1, 1, 1), mode="replicate")
    across = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) * (camera.fx / 2)
    down = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) * (camera.fy / 2)
    return torch.stack([across, down], -1).reshape(*image.shape[:-2], -1, 2)


def averaged(frame: Frame, size: int) -> Float[Tensor, "h w 3"]:
    """Return the colours averaged over squares of ``size`` pixels and interpolated between them; hidden pixels are filled in."""
    height, width = frame.rgb_bytes.shape[:2]
    size = min(size, height, width)
    rgb = inpaint(frame).cpu().float().permute(2, 0, 1)[None]
    small = avg_pool2d(rgb, size, ceil_mode=True, count_include_pad=False)
    # Enlarged to whole squares, then cropped to the image, so that squares stay in place.
    covered = (small.shape[2] * size, small.shape[3] * size)
    smooth = interpolate(small, covered, mode="bilinear", align_corners=False)[..., :height, :width]
    return smooth[0].permute(1, 2, 0)


def is_blank(frame: Frame) -> bool:
    """Return whether the image has a single colour, as if the lens were covered, or the frame has no colours at all."""
    # Of an image of many megapixels, some 100,000 pixels suffice.
    step = 1 + math.isqrt(frame.intrinsics.width * frame.intrinsics.height // 100_000)
    rgb = frame.rgb_bytes[::step, ::step].float() / 255
    shown = rgb.flatten(0, 1) if frame.hidden is None else rgb[~frame.hidden[::step, ::step]]
    # A gain and an offset can fit any view to an image whose colours, in [0, 1], deviate by less.
    return not frame.has_colour or float(shown.std(0, correction=0).max()) < 0.02
