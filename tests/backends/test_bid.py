"""First-order methods: what updates turn about, when descents stop, where pixels are drawn, and what widens their reach; presets.

``AdamSteps`` is needed here for what no answer shows: steps beside torch's Adam.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf.scenes import GaussianBlobs
from bidnerf_bid import (
    AdamSettings,
    AdamSteps,
    DepthSettings,
    DescentSettings,
    InerfConfig,
    Pivot,
    ReachSettings,
    SampledLoss,
    objective_of,
    pivot,
)
from bidnerf_bid.adam import RATE, WINDOW
from bidnerf_bid.pivot import retract_linearly
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import FieldValues, RaySampler, SceneBounds, Stratified, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import METHODS, ColourSettings, Outcome, Problem, Support, rig, settings_of
from bidnerf_core.settings import to_flat
from blob_images import BOUNDS, CAMERA, TRUTH
from optional import require
from problems import FieldMap, localize, single
from refusals import refused

FIELD = GaussianBlobs.random()
XI = torch.tensor([0.02, -0.01, 0.03, 0.05, -0.07, 0.04], dtype=torch.float64)


def photograph(T_world_camera: SE3 = TRUTH) -> Frame:
    image = render_image(FIELD, CAMERA, T_world_camera, BOUNDS)
    return Frame("frame", image.rgb, CAMERA, image.depth)


@pytest.fixture(autouse=True)
def judged_on_fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judging a descent takes longer than most of these descents."""
    monkeypatch.setattr("bidnerf_bid.methods.RAYS", 256)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return single(FIELD, BOUNDS, photograph(), perturb(TRUTH, 0.2, 4.0, seed=3))


def test_pixels_are_drawn_where_the_config_says(problem: Problem) -> None:
    """Alone at its few corners this soft scene says too little of the pose; that they are looked at can be seen."""
    losses = [
        localize(problem, "inerf", {"rays": 64, "max_steps": 1, "pixels": name}).loss
        for name in ("uniform", "interest-points", "interest-regions")
    ]
    assert len(set(losses)) == 3


def test_colours_have_to_be_explained_better_than_by_a_single_one(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_bid.methods.RAYS", 1024)
    found = localize(problem, "inerf", {"rays": 128, "max_steps": 100}, seed=0)
    assert found.outcome is Outcome.CONVERGED
    assert isinstance(found.diagnostics, Support)
    strict = replace(found.diagnostics, limits=found.diagnostics.limits | {"explained": 1 - 1e-6})
    assert strict.verdict("").outcome is Outcome.RENDERING_MISMATCH


def test_the_loss_of_depth_is_not_compared_with_that_of_a_colour(problem: Problem) -> None:
    found = localize(problem, "bid", {"rays": 64, "max_steps": 20, "converged_loss": 10.0})
    assert isinstance(found.diagnostics, Support)
    assert "plain" not in found.diagnostics.measures
    assert "contrast" not in found.reason


def test_the_learning_rate_is_inerfs(problem: Problem) -> None:
    """Adam's first step is as long as the learning rate, in each entry of the tangent vector (Kingma and Ba 2015, section 2.1)."""
    found = localize(problem, "inerf", {"rays": 64, "max_steps": 1})
    xi = (found.poses[1] @ found.poses[0].inverse()).log()  # a left update
    torch.testing.assert_close(xi.abs(), torch.full((6,), 0.01, dtype=torch.float64), rtol=1e-3, atol=0)
    config = InerfConfig().adam
    assert require(config.learning_rate) * config.decay ** (200 / config.decay_steps) == pytest.approx(0.01 * 0.8**2)


def test_bid_is_inerf_with_other_settings(problem: Problem) -> None:
    few = {"rays": 64, "max_steps": 4, "pixels": "interest-regions"}
    same = {
        **few,
        "learning_rate": 0.01,
        "decay": 0.8,
        "decay_steps": 100,
        "colour_loss": "l2",
        "pivot": "world",
        "level": None,
        "depth_weight": 0.0,
        "candidates": 1,
    }
    one, other = localize(problem, "inerf", few), localize(problem, "bid", same)
    assert torch.equal(one.poses.matrix(), other.poses.matrix())


def test_updates_are_written_where_the_pivot_is(problem: Problem) -> None:
    torch.testing.assert_close(pivot("camera", problem).move(TRUTH, XI).matrix(), TRUTH.retract(XI).matrix())
    torch.testing.assert_close(pivot("world", problem).move(TRUTH, XI).matrix(), (SE3.exp(XI) @ TRUTH).matrix())
    about = pivot("scene", problem)
    middle = require(about.T_camera_pivot).translation
    assert abs(float(middle.norm()) - 4) < 1  # the blobs are about the origin, four metres away
    turn = torch.cat([torch.zeros(3, dtype=torch.float64), XI[3:]])
    torch.testing.assert_close(about.move(TRUTH, turn).apply(middle), TRUTH.apply(middle))  # it stays


def test_a_linear_update_has_the_value_and_the_derivative_of_the_exact_one() -> None:
    T = SE3.exp(torch.tensor([0.3, -1.0, 2.0, 0.4, -0.7, 0.2], dtype=torch.float64))
    zero = torch.zeros(6, dtype=torch.float64)
    parts = (lambda x: T.retract(x).matrix(), lambda x: retract_linearly(T, x).matrix())
    torch.testing.assert_close(parts[1](zero), parts[0](zero))
    exact, linear = (torch.autograd.functional.jacobian(part, zero) for part in parts)
    torch.testing.assert_close(linear, exact)


def test_a_turn_moves_the_camera_as_far_as_a_shift(problem: Problem) -> None:
    assert pivot("camera", problem).lever_arm == 1
    assert pivot("world", problem).lever_arm == 1
    about = pivot("scene", problem)
    usual = AdamSettings()
    assert usual.learning_rate is None
    first = AdamSteps(lambda T: T.translation.sum(), about, usual, TRUTH)._rate
    torch.testing.assert_close(first[0], torch.tensor(RATE * about.lever_arm).double())
    torch.testing.assert_close(first[3], torch.tensor(RATE).double())
    turn = torch.tensor([0, 0, 0, 1e-4, 0, 0], dtype=torch.float64)
    shift = float((about.move(TRUTH, turn).translation - TRUTH.translation).norm())
    assert shift == pytest.approx(1e-4 * about.lever_arm, rel=0.05)


def test_descents_stop_on_the_loss_or_at_the_end(problem: Problem) -> None:
    few = {"rays": 64, "max_steps": WINDOW + 5, "level": None}
    assert localize(problem, "bid", few).reason.startswith(f"reached {WINDOW + 5} steps; mean loss")
    loss = localize(problem, "bid", {**few, "stop_loss": 10.0})
    assert loss.steps == WINDOW
    assert loss.reason.startswith(f"mean loss of {WINDOW} steps fell below 10; mean loss")


def test_updates_are_those_of_torch() -> None:
    """Steps on a quadratic loss of the translation, beside torch's own Adam on the same gradients."""
    goal = torch.tensor([0.5, -2.0, 1.0], dtype=torch.float64)
    config = AdamSettings(learning_rate=0.1, decay=0.5, decay_steps=10)
    steps = AdamSteps(lambda T: (T.translation - goal).square().sum(), Pivot(SE3.identity()), config, SE3.identity())
    place = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([place])
    for number in range(2 * WINDOW):
        optimizer.param_groups[0]["lr"] = 0.1 * 0.5 ** (number / 10)
        optimizer.zero_grad()
        (place - goal).square().sum().backward()
        optimizer.step()
        steps()
        torch.testing.assert_close(steps.T.translation, place.detach())


def test_each_step_of_a_descent_follows_from_the_one_before(problem: Problem) -> None:
    """No step is longer than Adam allows, also from one block of steps to the next."""
    settings = {"rays": 64, "max_steps": 2 * WINDOW, "learning_rate": 0.01, "decay": 1.0}
    found = localize(problem, "bid", settings)
    steps = (found.poses[:-1].inverse() @ found.poses[1:]).log()
    assert float(steps[:, 3:].norm(dim=-1).max()) < 0.05
    assert float(steps[:, :3].norm(dim=-1).max()) < 0.3
    assert len(torch.unique(found.poses.translation, dim=0)) == 2 * WINDOW + 1


def test_a_step_that_is_not_finite_leaves_the_pose() -> None:
    steps = AdamSteps(lambda T: T.translation.sum() / 0, Pivot(SE3.identity()), AdamSettings(), SE3.identity())
    steps()
    _, _, finite = steps.block()
    assert torch.equal(steps.T.matrix(), SE3.identity().matrix())
    assert not finite[0]


BACK = (0.0, 0.0, 0.0)
BOX = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 8.0, BACK)


class Ball:
    """A yellow ball of radius 0.4 about the origin, opaque within a few centimetres."""

    sampler: RaySampler = Stratified(64, BOX)

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        inside = torch.sigmoid(40 * (0.4 - torch.linalg.vector_norm(positions, dim=-1)))
        return FieldValues(60 * inside, torch.ones_like(positions) * positions.new_tensor([0.9, 0.8, 0.1]))


BALL = Ball()
SMALL_CAMERA = Intrinsics(32.0, 32.0, 12.0, 12.0, 24, 24)
AHEAD = SE3(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, -3.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def frame() -> Frame:
    image = render_image(BALL, SMALL_CAMERA, AHEAD, BOX)
    return Frame("ball", image.rgb, SMALL_CAMERA, image.depth)


def problem_at(frame: Frame, shift: float) -> Problem:
    """Return the problem whose start lies ``shift`` metres to the right of the truth."""
    start = SE3(AHEAD.rotation, AHEAD.translation + torch.tensor([shift, 0, 0], dtype=torch.float64))
    return rig(FieldMap(BALL, BOX), [View(frame, SE3.identity())], start)


def loss_of(problem: Problem, **reach: float) -> SampledLoss:
    return SampledLoss(
        problem,
        objective_of(ColourSettings(), DepthSettings(depth_scale=0.1)),
        0,
        DescentSettings(rays=64),
        ReachSettings(**reach),
        torch.Generator().manual_seed(0),
    )


def gradient(loss: SampledLoss, problem: Problem) -> torch.Tensor:
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    value = loss(require(problem.start).retract(xi))
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


def test_the_papers_settings_are_presets() -> None:
    paper, ours = (to_flat(METHODS["bid"].settings(name)) for name in ("paper", "paper-scene"))
    assert (paper["rays"], paper["max_steps"], paper["level"], paper["depth_weight"]) == (2048, 1000, 0, 1.0)
    assert (paper["pivot"], ours["pivot"]) == ("camera", "scene")
    assert (paper["learning_rate"], paper["depth_scale"]) == (0.02, 0.1)  # metres
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
        objective=objective_of(ColourSettings(), DepthSettings(depth_weight=0.0, depth_scale=0.1)),
    )
    assert float(gradient(loss, problem).abs().max()) < 1e-9


def test_a_preset_can_be_changed_and_is_checked() -> None:
    changed = settings_of("bid", {"rays": 64}, preset="paper")
    assert to_flat(changed) == to_flat(METHODS["bid"].settings("paper")) | {"rays": 64}
    with refused(found="preset 'papers' is unknown, this method offers paper, paper-scene"):
        settings_of("bid", {}, preset="papers")
    with refused(found="preset 'paper' is unknown, this method offers none"):
        METHODS["auto"].settings("paper")
