"""Renderings of a map from a camera: of the field, or quickly of the surface."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import has_field, render_image
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import SceneMap, surface_renderer


def field_image(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Render the colours of the field, in [0, 1], from a camera, which may be farther away or nearer than those of the images.

    A map without a field shows its landmarks as dots.
    """
    bounds = scene.bounds
    place = T_world_camera.translation.detach().cpu().double()
    if scene.surface is not None and len(scene.surface.surfels):
        away = (scene.surface.surfels.positions.cpu().double() - place).norm(dim=-1).min()
        bounds = replace(bounds, near=min(bounds.near, float(away) / 2))  # the nearest matter is seen
    distance = float((place - torch.tensor(bounds.centre, dtype=torch.float64)).norm())
    # Farther from the centre than this, there is no more matter.
    beyond = bounds.far if bounds.contracted else math.hypot(*bounds.size) / 2
    bounds = replace(bounds, far=max(bounds.far, distance + beyond))
    if not has_field(scene.field):
        image = torch.ones((camera.height, camera.width, 3))
        if scene.landmarks is not None:
            points = scene.landmarks.positions.cpu().double()
            rows, columns, inside = camera.cells(
                T_world_camera.to("cpu", torch.float64).inverse().apply(points)
            )
            image[rows[inside], columns[inside]] = torch.tensor((0.0, 0.75, 0.43))  # green dots
        return image
    # After each 4,096 pixels, it is checked whether the rendering is still wanted, see ``job_context``.
    return render_image(scene.field, camera, T_world_camera, bounds, 4096).rgb


@torch.no_grad()
def quick_image(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Render the colours of the surface, in [0, 1], from a camera, twenty times as fast as the field.

    For a map without a surface, the field is rendered.
    """
    if scene.surface is None:
        return field_image(scene, camera, T_world_camera)
    surface = scene.surface
    rays, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    T = T_world_camera.to(dtype=torch.float32, device=surface.device)
    directions = T.rotate(rays.to(surface.device))
    origins = T.translation.expand_as(directions).contiguous()
    rgb, _, _ = surface_renderer(surface, scene.bounds.background)(origins, directions)
    return rgb.cpu().clamp(0, 1).reshape(camera.height, camera.width, 3)
