"""Depth that no pixel measured: a lidar's, or a few points; and files of such points."""

from __future__ import annotations

from dataclasses import replace

import torch

from bidnerf_core.fields import Observations, render
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import (
    ColourSettings,
    DepthSettings,
    DescentSettings,
    Problem,
    ReachSettings,
    SampledLoss,
    objective_of,
    window,
)
from blob_images import BOUNDS, CAMERA, FIELD, FRAME, TRUTH, photograph
from problems import localize, single
from refusals import refused
from tiny import depth_rays_of

OBJECTIVE = objective_of(ColourSettings(), DepthSettings(depth_scale=0.1))
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


def depth_loss(problem: Problem, T: SE3, count: int = 10**6) -> float:
    """The part of the loss that the depth rays add."""
    values = []
    for own in (count, 0):
        generator = torch.Generator().manual_seed(0)
        loss = SampledLoss(problem, OBJECTIVE, own, DescentSettings(rays=16), ReachSettings(), generator)
        values.append(float(loss(T)))
    return values[0] - values[1]


def test_points_come_back() -> None:
    points = scan()
    rays = lidar()
    met = points.isfinite().all(-1)
    assert 100 < len(rays) == int(met.sum())
    torch.testing.assert_close(rays.points, T_CAMERA_LIDAR.apply(points[met]))
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones_like(rays.distance))
    torch.testing.assert_close(rays.origins, T_CAMERA_LIDAR.translation.expand(len(rays), 3))


def test_no_residual_at_the_truth_and_some_elsewhere() -> None:
    problem = single(FIELD, BOUNDS, photograph(depth=False), TRUTH, lidar())
    assert abs(depth_loss(problem, TRUTH)) < 1e-8
    assert depth_loss(problem, perturb(TRUTH, 0.2, 5.0, seed=0)) > 1e-4


def test_a_lidar_alone_tells_how_far_the_scene_is() -> None:
    """All black to the eye: no pixel has a gradient that is of use, but the distance comes right."""
    dark = replace(FRAME, rgb=torch.zeros(40, 48, 3), depth=None)
    start = TRUTH.retract(torch.tensor([0, 0, -0.2, 0, 0, 0], dtype=torch.float64))
    config = {
        "rays": 1,
        "depth_rays": 200,
        "max_steps": 60,
        "learning_rate": 0.03,
        "level": None,
        "depth_weight": 1e3,
        "pivot": "camera",
    }
    found = localize(single(FIELD, BOUNDS, dark, start, lidar()), "bid", config)
    backward = TRUTH.inverse().apply(found.T_world_camera.translation)[2]
    assert abs(float(backward)) < 0.03


def test_weight_zero_leaves_depth_rays_out() -> None:
    start = perturb(TRUTH, 0.3, 6.0, seed=3)
    few = {"rays": 32, "max_steps": 3, "depth_weight": 0.0, "level": None, "pivot": "camera"}
    with_rays, without = (
        localize(single(FIELD, BOUNDS, photograph(depth=False), start, rays), "bid", few) for rays in (lidar(), None)
    )
    assert torch.equal(with_rays.poses.matrix(), without.poses.matrix())


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


def test_a_window_is_the_last_items() -> None:
    items = list("abcdefgh")
    assert window(items, 4, 3) == ("c", "d", "e")
    assert window(items, 7, 3, stride=2) == ("d", "f", "h")
    assert window(items, 1, 3) == ("a", "b")
    assert window(items, 0, 1) == ("a",)
    for wrong, found in (
        ((8, 1), "at item 8 of 8"),
        ((-1, 1), "at item -1 of 8"),
        ((0, 0), "size 0 and stride 1"),
    ):
        with refused(found=found):
            window(items, *wrong)
    assert len(window(items, 7, 100)) == 8
