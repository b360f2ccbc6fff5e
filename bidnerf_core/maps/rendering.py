"""How well a rendered image matches a photo."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.metrics import psnr
from torch import Tensor

from bidnerf_core.fields import RenderedImage
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import LengthUnit, symbol


@dataclass(frozen=True, eq=False)
class RenderingScores:
    """The quality of a rendered image, compared with the photo from the same pose."""

    psnr: float  # dB
    depth_errors: Float[Tensor, "n"]  # absolute errors of planar z, at the pixels with measured depth
    unit: LengthUnit  # of the depth

    @property
    def depth_error(self) -> float | None:
        """The median absolute depth error; None without measured depth."""
        return float(self.depth_errors.median()) if len(self.depth_errors) else None

    def __str__(self) -> str:
        error = "-" if self.depth_error is None else f"{self.depth_error:.4f}"
        return f"PSNR {self.psnr:.2f} dB  depth error {error} {symbol(self.unit)}"


def rendering_scores(image: RenderedImage, frame: Frame, unit: LengthUnit = "units") -> RenderingScores:
    """Compare a rendered image with the visible colours and measured depth of the frame from the same pose.

    ``unit`` is the map's, for printing the depth error.
    """
    errors = torch.zeros(0)
    if frame.depth is not None and frame.has_depth:
        errors = (image.depth - frame.depth).abs()[frame.depth > 0]
    shown, seen = image.rgb, frame.rgb
    if frame.hidden is not None:
        shown, seen = shown[~frame.hidden], seen[~frame.hidden]
    return RenderingScores(float(psnr(shown, seen, 1.0)), errors, unit)
