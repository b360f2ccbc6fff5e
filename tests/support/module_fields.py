"""Closed-form fields as modules, and a map of one, for tests that move maps to another device."""

from __future__ import annotations

import functools
from typing import Any, cast

import torch
from torch import Tensor, nn

import baked
from bidnerf.scenes import GaussianBlobs, orbit
from bidnerf_core.devices import move_to
from bidnerf_core.fields import FieldValues, RaySampler, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.mapping import SurfaceMap, bake


class AsModule(nn.Module):
    """A closed-form field, a dataclass of tensors, as a module that moves with its tensors."""

    def __init__(self, closed_form: Any) -> None:
        super().__init__()
        self.closed_form = closed_form
        self.register_buffer("place", torch.zeros(()))

    @property
    def sampler(self) -> RaySampler:
        return cast(RaySampler, self.closed_form.sampler)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return cast(FieldValues, self.closed_form.query(positions, directions))

    def _apply(self, *args: Any, **options: Any) -> AsModule:
        super()._apply(*args, **options)
        self.closed_form = move_to(self.closed_form, self.place.device)
        return self


@functools.cache
def field() -> AsModule:
    return AsModule(GaussianBlobs.random(samples=32, density=1000.0))


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
