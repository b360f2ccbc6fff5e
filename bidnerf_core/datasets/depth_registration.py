"""Registration of depth to colour: a depth image as the colour camera beside the depth camera would see it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.se3 import SE3


def register_depth(
    depth: Float[Tensor, "dh dw"], depth_camera: Intrinsics, colour_camera: Intrinsics, T_colour_depth: SE3
) -> Float[Tensor, "h w"]:
    """Return planar z (metres) in the colour camera, 0 where no measurement falls.

    Each measurement is moved to the colour camera and written to the pixel that it falls into. Where several do, the nearest
    is kept, which hides what the colour camera cannot see.
    """
    measured = depth > 0
    rays = depth_camera.unproject(depth_camera.pixel_centres(torch.float64)[measured])
    points = T_colour_depth.apply(rays * depth[measured].double()[:, None])
    column, row = colour_camera.project(points).nan_to_num(-1.0, -1.0, -1.0).floor().unbind(-1)
    width, height = colour_camera.width, colour_camera.height
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = (row * width + column)[inside].long()
    empty = torch.full((height * width,), torch.inf)
    nearest = empty.scatter_reduce(0, place, points[inside, 2].float(), "amin")
    return torch.where(nearest.isfinite(), nearest, 0).reshape(height, width)
