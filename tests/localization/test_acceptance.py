"""Verdicts: from the measures of a pose to its outcome and reason.

The methods' own tests have right and wrong answers as a whole; the verdicts are needed here for the threshold of each measure.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch
from torch import Generator

import baked
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Outcome, PointCloud, Support, SurfaceDiagnostics, Verdict

# Inside: the threshold of each measure, of which an outcome shows only the decisive one
from bidnerf_core.localization.acceptance import (
    descent_verdict,
    free_space_violations,
    rendered_verdict,
    surface_diagnostics,
)
from bidnerf_core.localization.refinement import RefinementResult
from bidnerf_core.localization.search.by_points import PointSearch
from bidnerf_core.localization.settings import RenderedThresholds


def rejection(T: SE3, cloud: PointCloud, margin: float = math.inf) -> Verdict | None:
    return surface_diagnostics(PointSearch(baked.toy(), cloud).judge(), T, margin).rejection()


def outcome(T: SE3, cloud: PointCloud, margin: float = math.inf) -> Outcome:
    return surface_diagnostics(PointSearch(baked.toy(), cloud).judge(), T, margin).verdict().outcome


def test_wrong_poses_are_rejected(generator: Generator) -> None:
    view = baked.unseen()[0]
    cloud = baked.cloud(view)
    for shift in (torch.tensor([0.0, 0, 0, 0, 0, math.pi / 2]), torch.tensor([0.4, 0, 0, 0, 0, 0])):
        assert rejection(cloud.pivot.moved(view.T_ref_camera, shift.double()), cloud) is not None
    assert outcome(view.T_ref_camera, cloud, margin=0.01) is Outcome.AMBIGUOUS


SOUND = SurfaceDiagnostics(
    on_surface=1.0, colour_inliers=1.0, free_space_violations=0.0, runner_up_margin=1.0
)


@pytest.mark.parametrize(
    ("changed", "expected", "words"),
    [
        ({}, Outcome.CONVERGED, "100% of the measured points match the surface in position and colour"),
        ({"on_surface": 0.8}, Outcome.OFF_SURFACE, "only 80% of the measured points lie on the surface"),
        (
            {"colour_inliers": 0.3},
            Outcome.COLOUR_MISMATCH,
            "only 30% of the measured points have the surface's colour",
        ),
        (
            {"free_space_violations": 0.2},
            Outcome.FREE_SPACE_VIOLATED,
            "20% of the lines of sight pass through",
        ),
        ({"runner_up_margin": 0.1}, Outcome.AMBIGUOUS, "another pose fits about as well"),
        ({"rendered_inliers": 0.5}, Outcome.RENDERING_MISMATCH, "only 50% of the rendered rays agree"),
        ({"rendered_inliers": math.nan}, Outcome.RENDERING_MISMATCH, "of the rendered rays agree"),
        ({"runner_up_margin": 0.1, "on_surface": 0.5}, Outcome.OFF_SURFACE, "only 50%"),
    ],
)
def test_diagnostics_of_points_lead_to_an_outcome(
    changed: dict[str, float], expected: Outcome, words: str
) -> None:
    verdict = replace(SOUND, **changed).verdict()
    assert verdict.outcome is expected
    assert words in verdict.reason
    assert verdict.accepted == (expected is Outcome.CONVERGED)


SUPPORTED = Support(explained=1.0, plain=10.0, displaced=10.0, other=10.0)


def refined(
    inliers: float = 1.0, step: float = 0.0, covariance: float = 1.0, support: Support = SUPPORTED
) -> RefinementResult:
    T = SE3.identity()
    losses = torch.zeros(0, dtype=torch.float64)
    found = RefinementResult(
        T, 0.0, inliers, covariance * torch.eye(6, dtype=torch.float64), step, T[None], losses, fresh=None, rivals=None
    )  # fmt: skip
    vars(found)["support"] = support  # instead of rays that are rendered for it
    return found


@pytest.mark.parametrize(
    ("found", "expected", "words"),
    [
        (refined(), Outcome.CONVERGED, "100% of newly drawn rays agree"),
        (refined(inliers=0.93, step=0.02), Outcome.CONVERGED, "93%"),
        (refined(inliers=0.9), Outcome.RENDERING_MISMATCH, "90% of newly drawn rays agree .*, expected 93%"),
        (refined(inliers=math.nan), Outcome.RENDERING_MISMATCH, "expected 93%"),
        (refined(step=0.03), Outcome.NOT_SETTLED, "a further step of 0.03, expected 0.02 at most"),
        (refined(step=math.nan), Outcome.NOT_SETTLED, "expected 0.02 at most"),
        (refined(covariance=math.inf), Outcome.UNDETERMINED, "do not determine the pose"),
        (refined(support=replace(SUPPORTED, plain=0.5)), Outcome.UNDETERMINED, "a single-colour image"),
        (refined(support=replace(SUPPORTED, displaced=0.5)), Outcome.UNDETERMINED, "displaced by 10%"),
        (
            refined(support=replace(SUPPORTED, other=0.5)),
            Outcome.AMBIGUOUS,
            "another pose fits about as well",
        ),
        (
            refined(support=replace(SUPPORTED, explained=0.4)),
            Outcome.RENDERING_MISMATCH,
            "only 40% of the contrast",
        ),
        (
            refined(support=replace(SUPPORTED, explained=math.nan)),
            Outcome.RENDERING_MISMATCH,
            "of the contrast",
        ),
        (refined(support=Support(0.0, 0.0, 0.0, 0.0)), Outcome.UNDETERMINED, "fits about as well"),
    ],
)
def test_fresh_rays_lead_to_an_outcome(found: RefinementResult, expected: Outcome, words: str) -> None:
    verdict = rendered_verdict(found, RenderedThresholds())
    assert verdict.outcome is expected
    assert re.search(words, verdict.reason)


@pytest.mark.parametrize(
    ("loss", "finite", "expected"),
    [
        (0.01, True, Outcome.CONVERGED),
        (0.02, True, Outcome.HIGH_LOSS),
        (0.01, False, Outcome.DIVERGED),
        (math.nan, True, Outcome.DIVERGED),
        (math.inf, True, Outcome.DIVERGED),
    ],
)
def test_the_loss_of_a_descent_leads_to_an_outcome(loss: float, finite: bool, expected: Outcome) -> None:
    verdict = descent_verdict(loss, 0.02, finite, "reached 5 steps", SUPPORTED, 0.5)
    why = "" if expected is Outcome.DIVERGED else f"; mean loss {loss:.3g}, must be below 0.02"
    confidence = SUPPORTED.confidence if expected is Outcome.CONVERGED else None
    assert verdict == Verdict(expected, f"reached 5 steps{why}", confidence)


@pytest.mark.parametrize(("least", "expected"), [(0.4, Outcome.CONVERGED), (0.6, Outcome.RENDERING_MISMATCH)])
def test_a_descent_has_to_explain_more_than_a_single_colour_does(least: float, expected: Outcome) -> None:
    found = replace(SUPPORTED, explained=0.5)
    verdict = descent_verdict(0.01, 0.02, True, "reached 5 steps", found, least)
    assert verdict.outcome is expected
    assert ("explains only" in verdict.reason) is not verdict.accepted


def test_lines_of_sight_run_through_the_surface_from_behind() -> None:
    view = baked.unseen()[0]
    cloud, truth = baked.cloud(view), view.T_ref_camera
    assert free_space_violations(PointSearch(baked.toy(), cloud).judge(), truth) < 0.15
    # The same points as if seen from the other side.
    through = baked.points(cloud.points, cloud.rgb, cloud.origins + 2 * cloud.middle)
    assert free_space_violations(PointSearch(baked.toy(), through).judge(), truth) > 0.5


def test_only_points_with_a_colour_tell_of_colours() -> None:
    """Half of the points are those of a lidar; the colours of the others are wrong."""
    view = baked.unseen()[0]
    seen = baked.cloud(view)
    coloured = torch.arange(len(seen)) % 2 == 0
    inverted = baked.points(seen.points, 1 - seen.rgb, seen.origins, coloured)
    assert outcome(view.T_ref_camera, inverted) is Outcome.COLOUR_MISMATCH
    bare = baked.points(seen.points, 1 - seen.rgb, seen.origins, torch.zeros_like(coloured))
    assert outcome(view.T_ref_camera, bare) is Outcome.CONVERGED
