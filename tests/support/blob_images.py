"""A closed-form field and perfect RGB-D images of it, for tests of methods."""

from __future__ import annotations

import torch

from bidnerf.scenes import GaussianBlobs, orbit
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import Observations, SceneBounds, render
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0, (1.0, 1.0, 1.0))
CAMERA = Intrinsics(50.0, 50.0, 24.0, 20.0, 48, 40)
POSES = orbit(4.0, 3, seed=1)
TRUTH = POSES[1]
FIELD = GaussianBlobs.random(samples=32, density=60.0)


def photograph(T: SE3 = TRUTH, depth: bool = True, field: GaussianBlobs = FIELD) -> Frame:
    """Return what a perfect RGB-D camera sees: the rendering's own colour and, where it is opaque, distance."""
    ray = CAMERA.unproject(CAMERA.pixel_centres(torch.float64))
    length = torch.linalg.vector_norm(ray, dim=-1)
    directions = T.rotate(ray / length[..., None])
    seen = render(field, BOUNDS.rays(T.translation.expand_as(directions), directions), BOUNDS.background)
    opaque = seen.opacity > 0.95
    measured = torch.where(opaque, seen.distance / seen.opacity.clamp(min=0.9) / length, 0)
    return Frame("frame", seen.rgb.float(), CAMERA, measured.float() if depth else None)


FRAME = photograph()
T_CAMERA_LIDAR = SE3.exp(torch.tensor([0.3, -0.4, 0.1, 0.2, 1.5, -0.4], dtype=torch.float64))


def scan() -> torch.Tensor:
    """Points (n 3) of the lidar's frame, measured in a wide cone at rays that are no pixels; NaN where no return."""
    ahead = torch.randn((2000, 3), generator=torch.Generator().manual_seed(5), dtype=torch.float64) * 0.3
    ahead[:, 2] += 1.0
    directions = T_CAMERA_LIDAR.inverse().rotate(torch.nn.functional.normalize(ahead, dim=-1))
    T = TRUTH @ T_CAMERA_LIDAR
    with torch.no_grad():
        turned = T.rotate(directions)
        found = render(FIELD, BOUNDS.rays(T.translation.expand_as(turned), turned))
    return torch.where((found.opacity > 0.9)[:, None], found.distance[:, None] * directions, torch.nan)


def lidar() -> Observations:
    return Observations.from_points(scan(), T_CAMERA_LIDAR)
