"""Second-order refinement on rendered rays: where it leads and what its covariance means."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Generator

import baked
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    RenderedCostSettings,
)
from bidnerf_core.localization.covariance import finest_cost
from bidnerf_core.localization.refinement import refine, take_few_steps
from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.results.errors import pose_error
from blob_images import BOUNDS, FIELD, FRAME, TRUTH
from problems import single


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
    search, problem = baked.point_search(view), baked.problem(view)
    stage, finest = RefinementStage(3, 256), finest_cost(search.surface, search.cloud)
    together, alone = (
        take_few_steps(problem, view.T_ref_camera, stage, rendered(), Generator().manual_seed(0), surface)
        for surface in (finest, None)
    )
    fused, misled = (pose_error(steps.poses, view.T_ref_camera).translation for steps in (together, alone))
    assert float(fused[-1]) < search.surface.cell
    assert float(misled[-1]) > 10 * search.surface.cell
    assert together.inliers < 0.9  # what it renders is rejected nevertheless
