"""What widens the reach of first-order steps, and the presets with the paper's settings.

``Blurred`` is needed here for a convolution in closed form.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import FieldValues, RaySampler, SceneBounds
from bidnerf_core.fields.rendering import render_image
from bidnerf_core.fields.sampling import Stratified
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import (
    METHODS,
    ColourSettings,
    DepthSettings,
    DescentSettings,
    Localizer,
    Problem,
    RayCounts,
    ReachSettings,
    SampledLoss,
    objective_of,
    rig,
    settings_of,
)
from bidnerf_core.localization.costs.sampled import Blurred
from bidnerf_core.settings import to_flat
from bidnerf_core.testing.scene import CAMERA
from problems import FieldMap, localize

BACK = (0.0, 0.0, 0.0)
BOX = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 8.0, BACK)


class Ball:
    """A yellow ball of radius 0.4 about the origin, opaque within a few centimetres."""

    sampler: RaySampler = Stratified(64, BOX)

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        inside = torch.sigmoid(40 * (0.4 - torch.linalg.vector_norm(positions, dim=-1)))
        return FieldValues(60 * inside, torch.ones_like(positions) * positions.new_tensor([0.9, 0.8, 0.1]))


FIELD = Ball()
TRUTH = SE3(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, -3.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def frame() -> Frame:
    image = render_image(FIELD, CAMERA, TRUTH, BOX)
    return Frame("ball", image.rgb, CAMERA, image.depth)


def problem_at(frame: Frame, shift: float) -> Problem:
    """Return the problem whose start lies ``shift`` metres to the right of the truth."""
    start = SE3(TRUTH.rotation, TRUTH.translation + torch.tensor([shift, 0, 0], dtype=torch.float64))
    return rig(FieldMap(FIELD, BOX), [View(frame, SE3.identity())], start)


def loss_of(problem: Problem, **reach: float) -> SampledLoss:
    return SampledLoss(
        problem, objective_of(ColourSettings(), DepthSettings()), RayCounts(64), DescentSettings(),
        ReachSettings(**reach), torch.Generator().manual_seed(0),
    )  # fmt: skip


def gradient(loss: SampledLoss, problem: Problem) -> torch.Tensor:
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    value = loss(problem.start_for("bid").retract(xi))
    return torch.autograd.grad(value, xi)[0] if value.requires_grad else torch.zeros(6)


def test_a_start_from_which_nothing_is_met_has_a_gradient_towards_the_box_only_by_its_term(
    frame: Frame,
) -> None:
    problem = problem_at(frame, 3.0)
    assert float(gradient(loss_of(problem), problem).abs().max()) == 0
    found = gradient(loss_of(problem, box_weight=1.0), problem)
    assert float(found[0]) > 1e-3  # a step against it leads back to the left
    near = problem_at(frame, 0.1)
    plain, boxed = (gradient(loss_of(near, box_weight=w), near) for w in (0.0, 1.0))
    torch.testing.assert_close(plain, boxed)  # all measured points lie in the box


def test_points_beyond_the_box_are_right_where_the_scene_goes_on_there(frame: Frame) -> None:
    away = problem_at(frame, 3.0)
    problem = replace(away, bounds=replace(BOX, contracted=True))
    assert float(gradient(loss_of(problem, box_weight=1.0), problem).abs().max()) < 1e-9


def test_a_blurred_field_is_the_field_convolved_with_a_gaussian() -> None:
    """The convolution of a plane wave ``cos(k x)`` is ``exp(-k^2 sigma^2 / 2) cos(k x)``."""

    class Wave(Ball):
        def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
            return FieldValues(1 + torch.cos(5 * positions[..., 0]), torch.zeros_like(positions))

    blurred = Blurred(Wave(), 0.2, torch.Generator().manual_seed(0))
    at = torch.tensor([0.1, 0.0, 0.0]).expand(20000, 3)
    found = float(blurred.query(at, at).density.mean())
    exact = 1 + float(torch.exp(torch.tensor(-0.5)) * torch.cos(torch.tensor(0.5)))
    assert found == pytest.approx(exact, abs=0.02)
    assert blurred.sampler is Wave.sampler


def test_the_papers_settings_are_presets() -> None:
    paper, ours = (to_flat(METHODS["bid"].settings(name)) for name in ("paper", "paper-scene"))
    assert (paper["rays"], paper["max_steps"], paper["level"], paper["depth_weight"]) == (2048, 1000, 0, 1.0)
    assert (paper["pivot"], ours["pivot"]) == ("camera", "scene")
    assert {name for name in paper if paper[name] != ours[name]} == {"pivot"}
    assert (paper["candidates"], paper["box_weight"]) == (1, 0.0)  # nothing is added to the paper's objective
    inerf = to_flat(METHODS["inerf"].settings("paper"))
    assert (inerf["rays"], inerf["max_steps"], inerf["learning_rate"]) == (2048, 1000, 0.01)


def test_bid_finds_the_ball_where_the_papers_objective_does_not(frame: Frame) -> None:
    """The pose is free to turn about the ball, so that the loss tells whether it is seen as it was."""
    losses = [
        float(localize(problem_at(frame, 1.5), "bid", {"rays": 64, "max_steps": 100} | reach).losses[-1])
        for reach in ({}, {"candidates": 1, "box_weight": 0.0})
    ]
    assert losses[0] < 0.05
    assert losses[1] > 0.2
    usual = METHODS["bid"].settings().reach
    assert (usual.candidates, usual.box_weight) == (3, 1.0)


def test_depth_that_has_no_weight_is_not_used(frame: Frame) -> None:
    problem = problem_at(frame, 3.0)
    loss = replace(
        loss_of(problem, box_weight=1.0),
        objective=objective_of(ColourSettings(), DepthSettings(depth_weight=0.0)),
    )
    assert float(gradient(loss, problem).abs().max()) < 1e-9


def test_a_preset_can_be_changed_and_is_checked() -> None:
    changed = settings_of("bid", {"rays": 64}, preset="paper")
    assert to_flat(changed) == to_flat(METHODS["bid"].settings("paper")) | {"rays": 64}
    with pytest.raises(InputError, match="preset 'papers' is unknown, this method offers paper, paper-scene"):
        settings_of("bid", {}, preset="papers")
    with pytest.raises(InputError, match="offers none"):
        METHODS["auto"].settings("paper")
    world = FieldMap(FIELD, BOX)
    assert Localizer(world, "bid", preset="paper", warm_up=False).config == METHODS["bid"].settings("paper")
    with pytest.raises(InputError, match="preset 'paper' and a BidConfig, expected one"):
        Localizer(world, "bid", METHODS["bid"].settings(), preset="paper")
