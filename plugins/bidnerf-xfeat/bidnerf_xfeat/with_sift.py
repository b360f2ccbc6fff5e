"""XFeat and SIFT as one detector, so that a map has landmarks of both and a pose is supported by both together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from bidnerf_core.mapping import SIFT, Keypoints, Sift
from bidnerf_xfeat.detector import XFeat

ZERO = 128
"""The byte that stands for 0."""


@dataclass(frozen=True)
class WithSift:
    """Keypoints of XFeat and SIFT in alternation.

    Descriptors have the channels of both, with zeros for the other detector, so that descriptors of different
    detectors are farther apart than unrelated ones of the same detector. SIFT's are scaled to half their
    usual length, which is that of XFeat's.
    """

    xfeat: XFeat = XFeat()
    sift: Sift = SIFT

    def at_most(self, count: int) -> WithSift:
        half = max(1, count // 2)
        return WithSift(self.xfeat.at_most(half), self.sift.at_most(half))

    def __call__(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints:
        learned, classic = self.xfeat(rgb), self.sift(rgb)
        halved = (classic.descriptors.float() / 2 + ZERO).round().to(torch.uint8)
        parts = (
            replace(learned, descriptors=torch.cat([learned.descriptors, _zeros(learned, classic)], dim=1)),
            replace(classic, descriptors=torch.cat([_zeros(classic, learned), halved], dim=1)),
        )
        ranks = torch.cat([torch.arange(len(part)) for part in parts])
        order = ranks.argsort(stable=True)
        return Keypoints(
            *(torch.cat([getattr(part, name) for part in parts])[order] for name in ("pixels", "sizes", "descriptors"))
        )


def _zeros(rows: Keypoints, columns: Keypoints) -> UInt8[Tensor, "n d"]:
    """Return zeros for as many keypoints as ``rows`` has, with as many channels as ``columns``'s descriptors."""
    return torch.full((len(rows), columns.descriptors.shape[1]), ZERO, dtype=torch.uint8)


detector = WithSift()
