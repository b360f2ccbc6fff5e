"""Landmarks: points of the scene that are recognised by their look, and where they are."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Points of the world frame (metres) with descriptors, on the CPU."""

    positions: Float[Tensor, "n 3"]
    deviations: Float[Tensor, "n 2"]  # metres: standard deviation of a position across and along ``directions``
    descriptors: UInt8[Tensor, "n d"]  # mean over the views; see ``mapping.features``
    directions: Float[Tensor, "n 3"]  # unit, from the landmark towards the middle of the cameras that saw it
    cones: Float[Tensor, "n"]  # radians: greatest angle between ``directions`` and such a camera
    sizes: Float[Tensor, "n"]  # metres: diameter of the keypoint, measured at its distance
    views: Int[Tensor, "n"]  # how many images saw it, int32
    noise: float  # pixels: standard deviation of a keypoint along each axis, in the images the map was made of

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Tensor) -> LandmarkMap:
        parts = [getattr(self, field.name) for field in fields(self)]
        return LandmarkMap(*(part[index] if isinstance(part, Tensor) else part for part in parts))

    @property
    def megabytes(self) -> float:
        """Size of the tensors, 10^6 bytes."""
        parts = (getattr(self, field.name) for field in fields(self))
        return sum(part.numel() * part.element_size() for part in parts if isinstance(part, Tensor)) / 1e6


def concatenated(maps: list[LandmarkMap]) -> LandmarkMap:
    """All landmarks of ``maps``, which have descriptors of one length; the first one's noise is kept."""
    names = [field.name for field in fields(LandmarkMap) if field.name != "noise"]
    return LandmarkMap(*(torch.cat([getattr(m, name) for m in maps]) for name in names), noise=maps[0].noise)
