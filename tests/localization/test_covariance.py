"""Covariances of poses: symmetric, positive definite, growing with the noise, large where nothing is determined; refinement on rays.

The covariances of costs are needed here for closed forms and repeated trials.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Generator

import baked
from bidnerf_core.depth import EXACT
from bidnerf_core.geometry import SE3, USUAL, independent
from bidnerf_core.localization import (
    ColourSettings,
    DepthSettings,
    PointCloud,
    PointScales,
    RefinementSettings,
    RefinementStage,
    RenderedCostSettings,
    SurfaceCost,
)

# Inside: the closed forms are compared with repeated trials and integrals
from bidnerf_core.localization.covariance import (
    finest_cost,
    position_deviation,
    sandwich_covariance,
    surface_covariance,
)
from bidnerf_core.localization.refinement import refine, take_few_steps
from bidnerf_core.localization.search.by_points import PointSearch
from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.results import pose_error
from blob_images import BOUNDS, FIELD, FRAME, TRUTH
from problems import single


def seen_patch(noise: float) -> PointCloud:
    generator = torch.Generator().manual_seed(0)
    surface = baked.patch()
    points = surface.surfels.positions + noise * torch.randn((100, 3), generator=generator)
    return baked.points(points, surface.surfels.rgb)


@pytest.mark.parametrize("number", range(3))
def test_the_surface_covariance_is_symmetric_and_positive_definite(number: int) -> None:
    view = baked.unseen()[number]
    cost = PointSearch(baked.toy(), baked.cloud(view)).judge()
    found = surface_covariance(cost, view.T_ref_camera)
    assert torch.equal(found, found.mT)
    assert torch.linalg.eigvalsh(found).min() > 0
    assert found.diagonal()[:3].sum().sqrt() < 0.2
    exact, rigged = (surface_covariance(cost, view.T_ref_camera, views, sensor=EXACT) for views in (1, 4))
    assert torch.allclose(rigged, exact / 4, rtol=0.05, atol=1e-7)


def test_an_uncertain_scale_of_the_depth_makes_the_way_to_the_scene_uncertain() -> None:
    view = baked.unseen()[0]
    cost = PointSearch(baked.toy(), baked.cloud(view)).judge()
    exact, uncertain = (
        surface_covariance(cost, view.T_ref_camera, sensor=s) for s in (EXACT, replace(EXACT, scale=0.02))
    )
    added = (uncertain - exact)[:3, :3]
    expected = 0.02 * cost.cloud.middle.double()
    torch.testing.assert_close(added, expected[:, None] * expected, rtol=1e-6, atol=1e-12)
    assert (uncertain - exact)[3:].abs().max() < 1e-12


def test_an_uncertain_offset_of_the_depth_makes_the_way_along_the_line_of_sight_uncertain() -> None:
    cloud = seen_patch(0.0)
    cost = SurfaceCost(baked.patch(), cloud, PointScales(0.1))
    sensors = (EXACT, replace(EXACT, offset=0.02))
    exact, uncertain = (surface_covariance(cost, SE3.identity(), sensor=sensor) for sensor in sensors)
    sight = (cloud.points - cloud.origins).double()
    mean = (sight / sight.norm(dim=-1, keepdim=True)).mean(0)
    added = (uncertain - exact)[:3, :3]
    torch.testing.assert_close(added, 0.02**2 * mean[:, None] * mean, rtol=1e-6, atol=1e-12)


def test_the_surface_covariance_grows_with_the_square_of_noise() -> None:
    surface = baked.patch()
    little, more = (
        surface_covariance(PointSearch(surface, seen_patch(noise)).judge(), SE3.identity(), sensor=EXACT)[
            2, 2
        ]
        for noise in (0.002, 0.004)
    )
    assert float(more / little) == pytest.approx(4, rel=0.1)


def test_what_a_wall_does_not_determine_has_the_size_of_the_scene() -> None:
    """A wall of one colour determines its distance and two turns, but not the way along it."""
    surface = baked.patch()
    grey = baked.of_points(surface.surfels.positions, torch.full((100, 3), 0.5), (0.0, 0.0, 1.0))
    middle = (grey.surfels.positions[:, :2].abs() < 0.3).all(-1)
    cloud = baked.points(grey.surfels.positions[middle], grey.surfels.rgb[middle])
    deviation = surface_covariance(PointSearch(grey, cloud).judge(), SE3.identity()).diagonal().sqrt()
    assert deviation[2] < 0.01
    assert (deviation[:2] > 0.5 * grey.extent).all()
    assert (deviation[3:5] < 0.1).all()
    assert deviation[5] > 1


def test_the_surface_covariance_of_a_plane_is_that_of_a_few_independent_distances() -> None:
    """Noise sigma of n independent distances leaves ``sigma / sqrt(n)``; the right colour counts as much as the place."""
    noise, surface = 0.003, baked.patch()
    bare = torch.zeros(100, dtype=torch.bool)
    cloud = baked.points(seen_patch(noise).points, torch.zeros((100, 3)), coloured=bare)
    found = surface_covariance(PointSearch(surface, cloud).judge(), SE3.identity(), sensor=EXACT)
    assert float(found[2, 2].sqrt()) == pytest.approx(noise / (2 * USUAL.points) ** 0.5, rel=0.15)


def test_the_sandwich_of_independent_noise_is_the_inverse_of_the_information(generator: Generator) -> None:
    """The scores of residuals of unit variance vary as the Hessian, so that both reduce to its inverse."""
    jacobian = torch.randn((1, 20000, 6), generator=generator, dtype=torch.float64)
    noise = torch.randn((1, 20000, 1), generator=generator, dtype=torch.float64)
    hessian = jacobian.mT @ jacobian
    found = sandwich_covariance(jacobian * noise, hessian)
    expected = torch.linalg.inv(hessian)
    torch.testing.assert_close(
        found, expected, rtol=0, atol=0.05 * float(expected.diagonal(dim1=1, dim2=2).mean())
    )


def test_too_few_rays_or_a_blind_direction_make_the_sandwich_infinite(generator: Generator) -> None:
    scores = torch.randn((2, 6, 6), generator=generator, dtype=torch.float64)
    eye = torch.eye(6, dtype=torch.float64).expand(2, 6, 6)
    assert bool(sandwich_covariance(scores, eye).isinf().all())
    many = torch.randn((2, 50, 6), generator=generator, dtype=torch.float64)
    blind = torch.diag_embed(torch.tensor([[1.0] * 6, [1.0] * 5 + [0.0]], dtype=torch.float64))
    found = sandwich_covariance(many, blind)
    assert bool(found[0].isfinite().all())
    assert bool(found[1].isinf().all())


def test_the_deviation_of_a_position_is_that_of_its_least_certain_direction() -> None:
    covariance = torch.diag(torch.tensor([1.0, 9.0, 4.0, 100.0, 1.0, 1.0], dtype=torch.float64))
    assert position_deviation(covariance) == pytest.approx(3.0)
    for unknown in (math.inf, math.nan):
        covariance[0, 0] = unknown
        assert position_deviation(covariance) == math.inf


def test_slopes_that_overflow_determine_no_pose() -> None:
    """A field of absurd weights must give an answer without a covariance, not an error of linear algebra."""
    scores = torch.randn((2, 40, 6), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    hessian = scores.mT @ scores
    expected = sandwich_covariance(scores, hessian)
    hessian[0, 2, 3] = torch.nan
    found = sandwich_covariance(scores, hessian)
    assert bool(found[0].isinf().all())
    assert torch.equal(found[1], expected[1])


def rendered(**refinement: Any) -> RenderedCostSettings:
    return RenderedCostSettings(ColourSettings(), DepthSettings(), RefinementSettings(**refinement))


@pytest.mark.slow
def test_the_covariance_is_that_of_many_trials() -> None:
    """Noise of known size on colour and depth: squared errors in units of the covariance average to 6."""
    settings = rendered(least_weight=0)
    stage = RefinementStage(3, 128, level=None, colour_scale=0.5)
    at = SE3(TRUTH.rotation[None], TRUTH.translation[None])
    squared, trials = [], 30
    for seed in range(trials):
        generator = torch.Generator().manual_seed(seed)
        colour = FRAME.rgb + 0.02 * torch.randn(FRAME.rgb.shape, generator=generator)
        assert FRAME.depth is not None
        depth = FRAME.depth + 0.01 * (FRAME.depth > 0) * torch.randn(FRAME.depth.shape, generator=generator)
        problem = single(FIELD, BOUNDS, replace(FRAME, rgb=colour, depth=depth), TRUTH)
        found = refine(problem, at, (stage,), settings, generator)
        xi = (found.T.inverse() @ TRUTH).log()
        squared.append(float(xi @ torch.linalg.solve(found.covariance, xi)))
    # The mean of n chi-square variables with 6 degrees of freedom varies by sqrt(12 / n).
    assert sum(squared) / trials == pytest.approx(6, abs=4 * (12 / trials) ** 0.5)


def test_the_covariance_is_the_cameras_whatever_the_pivot() -> None:
    problem = single(FIELD, BOUNDS, FRAME, TRUTH)
    at = SE3(TRUTH.rotation[None], TRUTH.translation[None])
    names: tuple[PivotName, ...] = ("camera", "scene", "world")
    found = [
        refine(
            problem,
            at,
            (RefinementStage(8, 256),),
            rendered(pivot=name),
            Generator().manual_seed(0),
        )
        for name in names
    ]
    for other in found[1:]:
        torch.testing.assert_close(other.T.matrix(), found[0].T.matrix(), rtol=0, atol=1e-3)
        torch.testing.assert_close(
            other.covariance.diagonal(), found[0].covariance.diagonal(), rtol=0.1, atol=0
        )


def test_at_the_truth_no_step_leads_away() -> None:
    stage, settings = (
        RefinementStage(3, 256),
        RenderedCostSettings(ColourSettings(), None, RefinementSettings()),
    )
    problem = single(FIELD, BOUNDS, FRAME, None)
    steps = take_few_steps(problem, TRUTH, stage, settings, Generator().manual_seed(0))
    assert float(pose_error(steps.poses, TRUTH).translation.max()) < 1e-3


def test_a_field_that_shows_something_else_leads_no_pose_off_a_surface_that_determines_it() -> None:
    view = baked.unseen()[0]
    search, problem = PointSearch(baked.toy(), baked.cloud(view)), baked.problem(view)
    stage, finest = RefinementStage(3, 256), finest_cost(search.surface, search.cloud)
    together, alone = (
        take_few_steps(problem, view.T_ref_camera, stage, rendered(), Generator().manual_seed(0), surface)
        for surface in (finest, None)
    )
    fused, misled = (pose_error(steps.poses, view.T_ref_camera).translation for steps in (together, alone))
    assert float(fused[-1]) < search.surface.cell
    assert float(misled[-1]) > 10 * search.surface.cell
    assert together.inliers < 0.9  # what it renders is rejected nevertheless


@pytest.mark.parametrize("most", [3.0, 100.0])
def test_many_measurements_count_as_the_most_and_one_as_one(most: float) -> None:
    assert independent(1, most) == 1
    assert independent(1e9, most) == pytest.approx(most)
    assert independent(50, 1e9) == pytest.approx(50)
