"""Which pixels are looked at, and what they say.

A ``PixelDrawer`` picks pixels of a frame; ``observe`` turns them into rays of the view's reference frame with the colour
and distance that were measured there. This is where planar depth becomes distance along the ray, once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from bidnerf_core.field import Rays, SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class Pixels:
    """Measurements along half-lines of a reference frame."""

    origins: Float[Tensor, "*p 3"]  # metres, reference frame
    directions: Float[Tensor, "*p 3"]  # unit, reference frame
    rgb: Float[Tensor, "*p 3"]
    distance: Float[Tensor, "*p"]  # metres along the ray; 0 where nothing was measured

    def rays(self, T_world_ref: SE3, bounds: SceneBounds) -> Rays:
        """The half-lines where ``T_world_ref`` puts them, limited to the scene; differentiable in the transform."""
        T = T_world_ref.to(self.origins)
        return bounds.rays(T.apply(self.origins), T.rotate(self.directions))


@runtime_checkable
class PixelDrawer(Protocol):
    """Picks ``count`` pixels (column, row) of a frame; ``generator`` is on the CPU, and so is the answer."""

    def __call__(self, frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]: ...


def uniform(frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]:
    """Every pixel as likely as any other."""
    columns = torch.randint(frame.intrinsics.width, (count,), generator=generator)
    rows = torch.randint(frame.intrinsics.height, (count,), generator=generator)
    return torch.stack([columns, rows], dim=-1)


def all_pixels(frame: Frame) -> Int[Tensor, "n 2"]:
    """Row by row. Centres lie at +0.5, so that truncation gives the index."""
    return frame.intrinsics.pixel_centres().long().reshape(-1, 2)


def observe(
    view: View,
    pixels: Int[Tensor, "n 2"],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Pixels:
    """What ``view`` measured at ``pixels``, as half-lines of its reference frame, on ``device`` (default: the image's)."""
    frame = view.frame
    pixels = pixels.cpu()  # few, and a camera computes there
    columns, rows = pixels.to(frame.rgb.device).unbind(-1)
    ray = frame.intrinsics.unproject(pixels.double() + 0.5)  # z = 1
    length = torch.linalg.vector_norm(ray, dim=-1)
    depth = torch.zeros_like(length)
    if frame.depth is not None:
        depth = frame.depth[rows.to(frame.depth.device), columns.to(frame.depth.device)].to(length)
    T = view.T_ref_camera.to(length)
    directions = T.rotate(ray / length[:, None])
    origins = T.translation.expand_as(directions)
    there = frame.rgb.device if device is None else device
    parts = (origins, directions, frame.rgb[rows, columns], depth * length)
    return Pixels(*(part.to(device=there, dtype=dtype) for part in parts))


def draw(
    views: Sequence[View],
    count: int,
    drawer: PixelDrawer,
    generator: Generator,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Pixels:
    """``count`` pixels shared out equally among the views; every tensor has leading axes (views, pixels a view).

    Images may lie anywhere; what was drawn lies on ``device``, by default where the images are.
    """
    share = max(1, count // len(views))
    parts = [observe(view, drawer(view.frame, share, generator), dtype, device) for view in views]
    return Pixels(
        torch.stack([p.origins for p in parts]),
        torch.stack([p.directions for p in parts]),
        torch.stack([p.rgb for p in parts]),
        torch.stack([p.distance for p in parts]),
    )


def measured_middle(views: Sequence[View], stride: int = 4) -> Float[Tensor, "3"] | None:
    """The median by axis of the points that ``views`` measured, in their reference frame; None where there are none."""
    points = []
    for view in views:
        pixels = observe(view, all_pixels(view.frame)[::stride], torch.float64, "cpu")
        measured = pixels.distance > 0
        points.append((pixels.origins + pixels.distance[:, None] * pixels.directions)[measured])
    together = torch.cat(points)
    return together.median(0).values if len(together) else None
