"""Selection of pixels, and their conversion to measured rays.

A ``PixelDrawer`` picks pixels of a frame; ``observe`` turns them into rays in the view's reference frame with
the colour and distance measured there. This is the only place where planar depth becomes distance along the
ray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Generator, Tensor

from bidnerf_core.camera import exposure_times, poses_of_rows
from bidnerf_core.fields import Observations
from bidnerf_core.frames.frame import Frame, View


@runtime_checkable
class PixelDrawer(Protocol):
    """Draws ``count`` pixels (column, row) of a frame, as a tensor on the device of ``generator``."""

    def __call__(self, frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]: ...


def uniform(frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]:
    """Draw uniformly among the pixels that are not hidden, with replacement."""
    if frame.hidden is not None:
        return among_visible(frame, count, generator)
    size, where = frame.intrinsics, generator.device
    columns = torch.randint(size.width, (count,), generator=generator, device=where)
    rows = torch.randint(size.height, (count,), generator=generator, device=where)
    return torch.stack([columns, rows], dim=-1)


def all_pixels(frame: Frame) -> Int[Tensor, "n 2"]:
    """Return all pixels (column, row) of a frame, row by row."""
    return frame.intrinsics.pixel_centres().long().reshape(-1, 2)


def observe(
    view: View,
    pixels: Int[Tensor, "n 2"],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Observations:
    """Return the measurements of ``view`` at ``pixels`` (column, row), as rays in the view's reference frame.

    The measurements are on ``device``, by default the image's device. Nothing is copied if the image, the pose and
    ``pixels`` are already there.
    """
    frame = view.frame
    columns, rows = pixels.unbind(-1)
    ray, length = frame.intrinsics.rays(pixels.double() + 0.5)
    depth = (
        torch.zeros_like(length)
        if frame.depth is None
        else frame.depth[rows.to(frame.depth.device), columns.to(frame.depth.device)].to(length)
    )
    T = view.T_ref_camera.to(length)
    if view.motion is not None and bool(view.motion.any()):
        T = T @ poses_of_rows(exposure_times(pixels.to(ray) + 0.5, frame.intrinsics), view.motion)
    directions = T.rotate(ray)
    origins = T.translation.expand_as(directions)
    there = frame.rgb_bytes.device if device is None else device
    coloured = torch.full((len(length),), frame.has_colour, device=length.device)
    return Observations(origins, directions, frame.colours_at(rows, columns), depth * length, coloured).to(there, dtype)


def draw(
    views: Sequence[View],
    count: int,
    drawer: PixelDrawer,
    generator: Generator,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Observations:
    """Draw about ``count`` pixels, the same number from each view; every tensor has leading axes (views, pixels per view).

    Images may be on any device; the result is on ``device``, by default that of the images.
    """
    share = max(1, count // len(views))
    return Observations.joined(
        [observe(view, drawer(view.frame, share, generator), dtype, device)[None] for view in views]
    )


def visible_at(frame: Frame, pixels: Float[Tensor, "n 2"]) -> Bool[Tensor, "n"]:
    """Return a mask of those ``pixels`` (u, v, inside the image) that are not hidden."""
    if frame.hidden is None:
        return torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
    columns, rows = pixels.to(frame.hidden.device).long().unbind(-1)
    height, width = frame.hidden.shape
    return ~frame.hidden[rows.clamp(0, height - 1), columns.clamp(0, width - 1)].to(pixels.device)


def inpaint(frame: Frame) -> Float[Tensor, "h w 3"]:
    """Return the colours of a frame with hidden pixels filled in from the nearest visible ones."""
    if frame.hidden is None:
        return frame.rgb
    _, nearest = distance_transform_edt(frame.hidden.cpu().numpy(), return_indices=True)
    return frame.colours_at(*torch.from_numpy(nearest).long())


def among(choose: Callable[[Frame], Int[Tensor, "n 2"]]) -> PixelDrawer:
    """Return a drawer that draws uniformly among the visible pixels that ``choose`` finds in a frame, with replacement.

    These pixels are found once per frame and cached with it. If there are none, as in the image of a blank wall,
    pixels are drawn uniformly: they still carry depth, and evidence of where there are no edges.
    """

    def draw(frame: Frame, count: int, generator: Generator) -> Int[Tensor, "n 2"]:
        candidates: Tensor | None = frame.__dict__.get(choose.__name__)
        if candidates is None or candidates.device != generator.device:
            candidates = choose(frame)
            candidates = candidates[visible_at(frame, candidates)].to(generator.device)
            frame.__dict__[choose.__name__] = candidates
        if len(candidates) == 0:
            return uniform(frame, count, generator)
        return candidates[torch.randint(len(candidates), (count,), generator=generator, device=candidates.device)]

    return draw


among_visible = among(all_pixels)
