"""A closed-form field as a module, and a map of what it shows, for tests that move maps to another device."""

from __future__ import annotations

import functools

import torch
from torch import Tensor, nn

import baked
from bidnerf_core.field import FieldValues, RaySampler
from bidnerf_core.frames import Frame, View
from bidnerf_core.mapping import SurfaceMap, bake
from bidnerf_core.rendering import render_image
from bidnerf_core.scenes.fields import GaussianBlobs
from bidnerf_core.scenes.trajectories import orbit
from bidnerf_core.se3 import SE3

NAMES = ("centres", "widths", "densities", "waves")


class BlobField(nn.Module):
    """Gaussian blobs whose tensors are buffers."""

    def __init__(self, blobs: GaussianBlobs) -> None:
        super().__init__()
        self.blobs_sampler = blobs.sampler
        for name in NAMES:
            self.register_buffer(name, getattr(blobs, name).float())

    @property
    def sampler(self) -> RaySampler:
        return self.blobs_sampler

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        tensors = [getattr(self, name) for name in NAMES]
        here = SE3.identity(positions.dtype, positions.device)
        return GaussianBlobs(*tensors, here, self.blobs_sampler).query(positions, directions)


@functools.cache
def field() -> BlobField:
    return BlobField(GaussianBlobs.random(density=1000.0))


@functools.cache
def surface() -> SurfaceMap:
    return bake(field(), baked.BOUNDS, [], list(shown(12, seed=0)), baked.CONFIG)


@functools.cache
def shown(count: int, seed: int) -> tuple[View, ...]:
    """Return images of the blobs, with depth where they are opaque."""
    views = []
    for place, T in enumerate(orbit(3.5, count, elevation=(-10.0, 60.0), seed=seed)):
        image = render_image(field(), baked.CAMERA, T, baked.BOUNDS)
        depth = torch.where(image.opacity > 0.95, image.depth, 0)
        views.append(View(Frame(f"{place:04d}", image.rgb, baked.CAMERA, depth), T))
    return tuple(views)
