"""Derivatives by the pose, all the way from the tangent space to the loss, and what they are good for."""

from __future__ import annotations

import pytest
import torch

from bidnerf.results import pose_error
from bidnerf.scenes import GaussianBlobs, MovedField, orbit
from bidnerf_bid import Objective
from bidnerf_bid.residuals import colour_term, depth_term
from bidnerf_core.fields import Observations, SceneBounds, render, widen
from bidnerf_core.frames import View, draw, uniform
from bidnerf_core.geometry import SE3, Robust, perturb
from bidnerf_core.localization import rig
from blob_images import BOUNDS, photograph
from problems import FieldMap, localize, single

HUBER = Robust("huber", 0.1)
PAPERS = Objective((colour_term(HUBER), depth_term(HUBER, 1.0)))


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("wide", [1.0, 2.0])
def test_gradient_by_the_pose_is_the_numerical_one(views: int, wide: float) -> None:
    field = GaussianBlobs.random()
    poses = orbit(4.0, views + 3, seed=1)[:views]
    seen = [View(photograph(T, field=field), T) for T in poses]
    problem = rig(FieldMap(field, BOUNDS), seen, perturb(poses[-1], 0.3, 8.0, seed=0))
    pixels = draw(problem.views, 60, uniform, torch.Generator().manual_seed(7), torch.float64)

    def by_tangent(xi: torch.Tensor) -> torch.Tensor:
        # The interval on each ray says the part that is sampled, without a derivative: hold it, as autograd does.
        here = widen(pixels.rays(problem.start, problem.bounds), wide)
        moved = pixels.rays(problem.start.retract(xi), problem.bounds)
        rays = type(here)(moved.origins, moved.directions, here.near, here.far)
        return PAPERS.loss(render(field, rays, BOUNDS.background), pixels)

    zero = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    rays = widen(pixels.rays(problem.start.retract(zero), problem.bounds), wide)
    loss = PAPERS.loss(render(problem.field, rays, problem.bounds.background), pixels)
    (found,) = torch.autograd.grad(loss, zero)
    numerical = []
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-5
        numerical.append(float(by_tangent(step) - by_tangent(-step)) / 2e-5)
    assert float(found.norm()) > 1e-3
    torch.testing.assert_close(found, torch.tensor(numerical, dtype=torch.float64), atol=1e-8, rtol=1e-5)


def test_a_moved_world_gives_a_moved_answer() -> None:
    """Map, start and truth moved together: the same steps, moved. The scene's box cannot turn, so it is made larger."""
    motion = SE3.exp(torch.tensor([0.2, -0.1, 0.3, 0.5, -0.7, 1.1], dtype=torch.float64))
    roomy = SceneBounds((-30.0,) * 3, (30.0,) * 3, 2.0, 6.5, BOUNDS.background)
    field = GaussianBlobs.random()
    truth = orbit(4.0, 3, seed=1)[2]
    start = perturb(truth, 0.25, 5.0, seed=3)
    frame = photograph(truth, field=field)
    few = {"rays": 256, "max_steps": 25, "level": None}
    here = localize(single(field, roomy, frame, start), "bid", few, seed=0)
    there = localize(single(MovedField(field, motion), roomy, frame, motion @ start), "bid", few, seed=0)
    expected = motion @ here.T_world_camera
    torch.testing.assert_close(there.T_world_camera.matrix(), expected.matrix(), atol=2e-4, rtol=0)
    assert float(pose_error(here.T_world_camera, start).translation) > 0.05


def test_rays_are_shared_out_equally_and_lie_in_the_last_cameras_frame() -> None:
    field = GaussianBlobs.random()
    poses = orbit(4.0, 6, seed=1)[:3]
    problem = rig(
        FieldMap(field, BOUNDS),
        [View(photograph(T, field=field), T) for T in poses],
        poses[-1],
    )
    pixels: Observations = draw(problem.views, 99, uniform, torch.Generator().manual_seed(0))
    assert pixels.rgb.shape == (3, 33, 3)
    world = pixels.rays(poses[-1], BOUNDS)
    for i, T in enumerate(poses):
        torch.testing.assert_close(world.origins[i], T.translation.float().expand(33, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(world.directions.norm(dim=-1), torch.ones(3, 33), atol=1e-5, rtol=0)
    assert bool(problem.views[-1].T_ref_camera.matrix().allclose(torch.eye(4, dtype=torch.float64)))
