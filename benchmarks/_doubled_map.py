"""Maps of scenes that stand twice, in which no image shows which of the two it is of.

A map is doubled: its field and its landmarks are repeated far away. Each copy's descriptors get noise of their own, as if each had
been built from its own photos. The doubled map has no surface. No pose should be accepted in it, from images alone or with measured
depth, unless a start is near one copy.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Generator, Tensor, nn

from bidnerf import Map
from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues, RadianceField, Rays, RaySamples, SceneBounds
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import LandmarkMap, concatenate

DESCRIPTOR_NOISE = 5.0
"""Standard deviation of the noise in each channel of a descriptor, whose values range from 0 to 255."""


class DoubledField(nn.Module):
    """A field and its copy; points and rays belong to the nearer one."""

    def __init__(self, field: RadianceField, bounds: SceneBounds, T_world_copy: SE3) -> None:
        super().__init__()
        self.field, self._bounds, self._T = field, bounds, T_world_copy.to("cpu", torch.float32)

    @property
    def sampler(self) -> DoubledField:
        return self

    def forward(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        origins, directions = self._home(rays.origins, rays.directions)
        return self.field.sampler(self._bounds.rays(origins, directions), jitter)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return self.field.query(*self._home(positions, directions.expand_as(positions)))

    def _home(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and directions in the frame of the copy to which they belong."""
        centre = positions.new_tensor(self._bounds.centre)
        there = (positions - self._T.apply(centre)).norm(dim=-1) < (positions - centre).norm(dim=-1)
        back = self._T.inverse()
        return (
            torch.where(there[..., None], back.apply(positions), positions),
            torch.where(there[..., None], back.rotate(directions), directions),
        )


def double(map: Map, T_world_copy: SE3) -> Map:
    """Return a map with its field and landmarks doubled, without its surface."""
    if map.landmarks is None:
        raise InputError("a map without landmarks, expected one that was baked")
    bounds = map.bounds
    copy = T_world_copy.translation
    lower, upper = torch.tensor(bounds.lower), torch.tensor(bounds.upper)
    reach = (upper - lower).norm()
    wide = replace(
        bounds,
        lower=tuple((torch.minimum(lower, lower + copy) - reach).tolist()),
        upper=tuple((torch.maximum(upper, upper + copy) + reach).tolist()),
    )
    field = DoubledField(map.field, bounds, T_world_copy).eval()
    info = replace(map.info, bounds=wide)
    return replace(map, info=info, field=field, surface=None, landmarks=twice(map.landmarks, T_world_copy))


def twice(landmarks: LandmarkMap, T_world_copy: SE3) -> LandmarkMap:
    """Return landmarks that are repeated elsewhere, seen by other images; the descriptors of all get noise."""
    T, generator = T_world_copy.to("cpu", torch.float32), Generator().manual_seed(0)
    copy = replace(landmarks, positions=T.apply(landmarks.positions), directions=T.rotate(landmarks.directions))
    if (tracks := landmarks.tracks) is not None:
        copy = replace(copy, tracks=replace(tracks, image=tracks.image + int(tracks.image.max()) + 1))
    both = concatenate([landmarks, copy])
    noise = DESCRIPTOR_NOISE * torch.randn(both.descriptors.shape, generator=generator)
    descriptors = (both.descriptors + noise).round().clamp(0, 255).to(both.descriptors.dtype)
    return replace(both, descriptors=descriptors, descriptor_cells=None).indexed()


def far_away(bounds: SceneBounds) -> SE3:
    """Return the pose of the copy of a map, so far away that neither is within the space that the other models."""
    away = torch.tensor([4 * max(bounds.far, bounds.side), 0.0, 0.0], dtype=torch.float64)
    return SE3(torch.eye(3, dtype=torch.float64), away)
