"""Test inputs of the contract: views of a tiny closed-form scene, and edge cases of rays and points."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.scenes import demo_object, orbit
from bidnerf.scenes import views as seen_from
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import Rays, widen
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3

FIELD_CAMERA = Intrinsics(32.0, 32.0, 12.0, 12.0, 24, 24)
SCENE_BOUNDS = demo_object().bounds
SIDE = max(SCENE_BOUNDS.size)  # metres
DIMMED = 0.6
"""Brightness of the views of ``exposed_views`` and of the background behind them, so that no exposure saturates."""
DIMMED_BOUNDS = replace(SCENE_BOUNDS, background=(DIMMED,) * 3)  # the toy's own background is white


@cache
def rgbd_views(coverage: bool = True) -> tuple[View, ...]:
    """Return six views of the toy scene with exact depth.

    With ``coverage``, the views have an alpha channel; otherwise, they show the toy in front of white, as a
    sensor would see it.
    """
    seen = seen_from(demo_object(), FIELD_CAMERA, orbit(3.5, 6))
    return tuple(v if coverage else replace(v, frame=v.frame.replace(alpha=None)) for v in seen)


@cache
def rgb_views() -> tuple[View, ...]:
    """Return six views of the toy in front of white, without depth or alpha."""
    return tuple(replace(v, frame=v.frame.replace(depth=None)) for v in rgbd_views(coverage=False))


def exposed_views(log_gain: float) -> tuple[View, ...]:
    """Return the RGB views, dimmed and then made alternately brighter and darker by the factor ``exp(log_gain)``."""
    gains = [DIMMED * math.exp(log_gain * (-1) ** number) for number in range(len(rgb_views()))]
    return tuple(
        replace(v, frame=replace(v.frame, rgb=g * v.frame.rgb)) for v, g in zip(rgb_views(), gains, strict=True)
    )


def camera_rays(T_world_camera: SE3) -> Rays:
    """Return the rays through all pixels from a pose, in its precision and differentiable with respect to it."""
    pixels = FIELD_CAMERA.unproject(FIELD_CAMERA.pixel_centres()).reshape(-1, 3).to(T_world_camera.translation)
    directions = T_world_camera.rotate(torch.nn.functional.normalize(pixels, dim=-1))
    return SCENE_BOUNDS.rays(T_world_camera.translation.expand_as(directions), directions)


def points(count: int, seed: int = 0) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return random positions (metres) in the scene's box, and random unit directions."""
    generator = torch.Generator().manual_seed(seed)
    lower, size = torch.tensor(SCENE_BOUNDS.lower), torch.tensor(SCENE_BOUNDS.size)
    positions = lower + size * torch.rand((count, 3), generator=generator)
    return positions, torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=-1)


def awkward_points() -> dict[str, Float[Tensor, "n 3"]]:
    """Return positions (metres), by description, at which a careless field may index out of range or overflow."""
    lower, upper = torch.tensor(SCENE_BOUNDS.lower), torch.tensor(SCENE_BOUNDS.upper)
    share = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    middle, corners = (lower + upper) / 2, lower + share * (upper - lower)
    return {
        "points within the box": points(256)[0],
        "corners of the box": corners,
        "points just outside the box": middle + (corners - middle) * (1 + 1e-6),
        "points far outside the box": middle + (corners - middle) * 1e3 + SIDE,
    }


def awkward_rays() -> dict[str, Rays]:
    """Return rays of the kinds that occur in localization, by description."""
    middle = (torch.tensor(SCENE_BOUNDS.lower) + torch.tensor(SCENE_BOUNDS.upper)) / 2
    inside, away = points(24)
    outside = middle - 2 * SIDE * away
    across = torch.nn.functional.normalize(away + 0.3 * away.roll(1, 0), dim=-1)
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    return {
        "rays from outside": SCENE_BOUNDS.rays(outside, across),
        "rays from within the box": SCENE_BOUNDS.rays(inside, away),
        "rays along the axes": SCENE_BOUNDS.rays(middle - 2 * SIDE * axes + 0.1 * SIDE * axes.roll(1, -1), axes),
        "rays that are sampled twice as far": widen(SCENE_BOUNDS.rays(outside, away), 2.0),
        "rays that miss the scene": SCENE_BOUNDS.rays(outside, -away),
    }
