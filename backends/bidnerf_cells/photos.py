"""What photos show of a cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from bidnerf_cells.field import CellGrid, CellsField
from bidnerf_core.backend import View, render_image
from bidnerf_core.fields import intersect_box
from bidnerf_core.frames import SeenLandmarks, all_pixels, observe

SMALL = 64
"""Pixels along the longer side of the images in which the overview shows depth."""


def of_mean_exposure(views: Sequence[View], exposure: Mapping[str, Tensor]) -> list[View]:
    """Return photos as they were with the mean exposure, given what training has learned (the state of ``ColourTransforms``)."""
    if not exposure:
        return list(views)
    gain, offset = exposure["log_gain"].cpu(), exposure["offset"].cpu()
    gain, offset = (gain - gain.mean(0)).exp(), offset - offset.mean(0)
    return [
        replace(view, frame=replace(view.frame, rgb=((view.frame.rgb - offset[number]) / gain[number]).clamp(0, 1)))
        for number, view in enumerate(views)
    ]


def surface_depth(view: View, field: CellsField) -> Float[Tensor, "h w"]:
    """Return the depth (planar z, metres) that was measured or, elsewhere, what the overview shows; 0 where there is no surface."""
    camera, frame = view.frame.intrinsics, view.frame
    measured = torch.zeros(camera.height, camera.width) if frame.depth is None else frame.depth
    if bool((measured > 0).all()):
        return measured
    small = render_image(field.overview, camera.at_most(SMALL), view.T_ref_camera, field.bounds).depth
    shown = interpolate(small[None, None], measured.shape)[0, 0]
    return torch.where(measured > 0, measured, shown if frame.alpha is None else torch.where(frame.alpha > 0, shown, 0))


def view_of_cell(view: View, depth: Float[Tensor, "h w"], grid: CellGrid, number: int) -> View | None:
    """Return a view, whose surface is at a ``depth``, as it shows one cell; None if it shows nothing of it.

    Pixels whose rays end before the cell are hidden. If there is nothing behind the box of the scene, those whose rays leave the cell
    again are transparent; else the field of the cell shows what is behind it, too.
    """
    frame, rays = view.frame, observe(view, all_pixels(view.frame))
    lower, upper = map(depth.new_tensor, grid.box(number, grid.overlap / 2, endless=True))
    enter, leave = (limit.view_as(depth) for limit in intersect_box(rays.origins, rays.directions, lower, upper))
    forward = (rays.directions @ view.T_ref_camera.rotation[:, 2].to(rays.directions)).view_as(depth)
    distance = torch.where(depth > 0, depth / forward, torch.inf)
    visible = (leave > enter.clamp(min=0)) & (distance >= enter)
    through = visible & ((distance > leave) | distance.isinf())
    if frame.hidden is not None:
        visible &= ~frame.hidden
    if not bool(visible.any()):
        return None
    changes: dict[str, Any] = {"hidden": ~visible}
    if not grid.bounds.contracted:
        background = (frame.rgb.new_tensor(grid.bounds.background) * 255).round().byte()
        alpha = torch.ones_like(depth) if frame.alpha is None else frame.alpha
        changes["rgb"] = torch.where(through[..., None], background, frame.rgb_bytes)
        changes["alpha"] = torch.where(through, 0, alpha)
        changes["depth"] = None if frame.depth is None else torch.where(through, 0, frame.depth)
        visible = visible & ~through
    landmarks = view.landmarks
    if landmarks is not None:
        columns, rows = landmarks.pixels.long().unbind(-1)
        shown = visible[rows.clamp(0, len(visible) - 1), columns.clamp(0, visible.shape[1] - 1)]
        landmarks = SeenLandmarks(landmarks.pixels[shown], landmarks.distance[shown], landmarks.deviation[shown])
    return replace(view, frame=frame.replace(**changes), landmarks=landmarks)
