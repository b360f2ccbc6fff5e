"""What is seen from a camera, quickly on the surface or in full by the field, as long as it is wanted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.fields.rendering import render_image
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.costs.images import SurfaceRenderer
from bidnerf_core.localization.problem import SceneMap

PIXELS_AT_A_TIME = 4096
"""Pixels after which a rendering looks whether it is still wanted."""


def field_image(
    scene: SceneMap, camera: Intrinsics, T_world_camera: SE3, cancelled: Callable[[], bool]
) -> Float[Tensor, "h w 3"] | None:
    """Return what the field shows from a camera without distortion; None once it is ``cancelled``."""
    rows, parts = max(1, PIXELS_AT_A_TIME // camera.width), list[Tensor]()
    for top in range(0, camera.height, rows):
        if cancelled():
            return None
        strip = replace(camera, cy=camera.cy - top, height=min(rows, camera.height - top))
        parts.append(render_image(scene.field, strip, T_world_camera, scene.bounds).rgb)
    return torch.cat(parts)


@torch.no_grad()
def quick_image(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Return the colours of the surface as a camera sees them, in a twentieth of the time of the field.

    A map without a surface is rendered by its field.
    """
    if scene.surface is None:
        return render_image(scene.field, camera, T_world_camera, scene.bounds).rgb
    surface = scene.surface
    rays, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    T = T_world_camera.to(dtype=torch.float32, device=surface.device)
    directions = T.rotate(rays.to(surface.device))
    origins = T.translation.expand_as(directions).contiguous()
    seen = SurfaceRenderer(surface, scene.bounds.background)(origins, directions)
    return seen.rgb.cpu().clamp(0, 1).reshape(camera.height, camera.width, 3)
