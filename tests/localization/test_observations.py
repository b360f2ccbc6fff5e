"""Depth that no pixel measured: a lidar's, or a few points."""

from __future__ import annotations

from dataclasses import replace

import torch

from bidnerf_core.fields import Observations
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from blob_images import CAMERA, FRAME, T_CAMERA_LIDAR, lidar, scan
from refusals import refused
from tiny import depth_rays_of


def test_points_come_back() -> None:
    points = scan()
    rays = lidar()
    met = points.isfinite().all(-1)
    assert 100 < len(rays) == int(met.sum())
    torch.testing.assert_close(rays.points, T_CAMERA_LIDAR.apply(points[met]))
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones_like(rays.distance))
    torch.testing.assert_close(rays.origins, T_CAMERA_LIDAR.translation.expand(len(rays), 3))


def test_rays_are_drawn_from_the_generator_or_all_taken() -> None:
    rays = lidar()
    one, same, other = (rays.drawn(50, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert len(one) == 50
    assert torch.equal(one.distance, same.distance)
    assert not torch.equal(one.distance, other.distance)
    assert one.distance.dtype == torch.float32
    assert len(rays.drawn(10**6, torch.Generator())) == len(rays)


def test_sparse_depth_images_become_rays() -> None:
    """Twenty pixels of a depth image, as structure from motion leaves them: every one is looked at."""
    dense = FRAME
    assert dense.depth is not None
    kept = dense.depth > 0
    index = kept.reshape(-1).nonzero()[::17, 0]
    depth = torch.zeros(40 * 48)
    depth[index] = dense.depth.reshape(-1)[index]
    frame = replace(dense, depth=depth.reshape(40, 48))
    T = SE3.exp(torch.tensor([0.1, 0.2, 0.3, 0.1, 0.0, -0.2], dtype=torch.float64))
    rays = depth_rays_of([View(frame, T)])
    assert len(rays) == len(index)
    seen = T.inverse().apply(rays.points)
    torch.testing.assert_close(seen[:, 2].float(), depth[index])
    rows, columns = index // 48, index % 48
    torch.testing.assert_close(CAMERA.project(seen), torch.stack([columns, rows], -1).double() + 0.5, atol=1e-6, rtol=0)


def test_nothing_measured_is_told() -> None:
    for points in (torch.zeros(3, 3), torch.full((2, 3), torch.nan), torch.zeros(0, 3)):
        with refused(where="depth rays", found="nothing was measured", expected="one finite point in front"):
            Observations.from_points(points, SE3.identity())
