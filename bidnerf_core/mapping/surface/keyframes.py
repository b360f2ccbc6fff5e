"""Keyframes: images that a field renders from known poses, and how well it reproduces its training images."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.fields.contract import RadianceField, SceneBounds, device_of
from bidnerf_core.fields.rendering import render, render_image
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.frames.pixels import draw, uniform
from bidnerf_core.geometry.se3 import SE3

Camera = tuple[Intrinsics, SE3]
"""Intrinsics and T_world_camera."""

KEYFRAME_SIDE = 400
"""Largest number of pixels along the longer side of a rendered keyframe."""
MOST = 100
"""Largest number of keyframes that are rendered, from cameras at regular intervals."""
NOISE_RAYS = 4096
"""Rays on which the colour noise is measured."""


def rendered_views(field: RadianceField, bounds: SceneBounds, cameras: Sequence[Camera]) -> list[View]:
    """Return images with depth that ``field`` renders from ``cameras``, for a map that came without photos."""
    every = max(1, math.ceil(len(cameras) / MOST))
    views = []
    for number, (intrinsics, T) in enumerate(cameras[::every]):
        small = intrinsics.scaled(min(1.0, KEYFRAME_SIDE / max(intrinsics.width, intrinsics.height)))
        image = render_image(field, small, T, bounds)
        views.append(View(Frame(f"{number:04d}", image.rgb, small, image.depth), T))
    return views


@torch.no_grad()
def colour_noise(field: RadianceField, bounds: SceneBounds, views: Sequence[View]) -> float:
    """Return the root mean square difference between rendered and photographed colours, over pixels of all views."""
    count, generator = max(NOISE_RAYS, len(views)), torch.Generator().manual_seed(0)
    pixels = draw(views, count, uniform, generator, device=device_of(field)).flattened()
    seen = render(field, bounds.rays(pixels.origins, pixels.directions), bounds.background)
    return float((seen.rgb - pixels.rgb).square().mean().sqrt())
