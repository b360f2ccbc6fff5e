"""Resampling of images from non-pinhole lenses to pinhole images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from bidnerf_core.camera import Lens


@dataclass(frozen=True, eq=False)
class Images:
    """The upright images of a frame, all of the same size."""

    rgb: Shaped[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"] | None = None  # planar z
    alpha: Float[Tensor, "h w"] | None = None
    hidden: Bool[Tensor, "h w"] | None = None

    def as_pinhole(self, lens: Lens) -> Images:
        """Return the images that the pinhole camera of ``lens`` would have taken.

        Colours are interpolated between pixels, and depth is that of the nearest one. Pixels that the lens
        did not see are hidden.
        """
        depth, alpha, hidden = (
            None if part is None else torch.from_numpy(lens.resampled(part.numpy(), nearest))
            for part, nearest in (
                (self.depth, True), (self.alpha, False), (None if self.hidden is None else self.hidden.byte(), True),
            )
        )  # fmt: skip
        unseen = torch.from_numpy(lens.unseen())
        unseen = unseen if hidden is None else unseen | (hidden > 0)
        rgb = torch.from_numpy(lens.resampled(self.rgb.numpy()))
        return Images(rgb, depth, alpha, unseen if bool(unseen.any()) else None)
