"""Support of a pose: a plain wall looks the same from anywhere, so that no pose before it is accepted.

``support`` and ``log_odds`` are needed here for the odds themselves, which no answer shows.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import FieldValues, RaySampler, SceneBounds, Stratified, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, look_at
from bidnerf_core.localization import (
    SUPPORT_BOUNDS,
    AutoConfig,
    Bound,
    Localization,
    Outcome,
    Problem,
    Support,
    rig,
)

# Inside: the odds themselves, far from the values at which they decide
from bidnerf_core.localization.accept import log_odds, same_pose, support
from bidnerf_core.mapping import BakeConfig, SurfaceMap, bake
from optional import require
from problems import FieldMap, localize

CAMERA = Intrinsics(70.0, 70.0, 40.0, 30.0, 80, 60)
BOUNDS = SceneBounds((-2.0, -2.0, -0.2), (2.0, 2.0, 0.2), 0.1, 8.0)
POSES = [look_at((x, y, 1.8), (x, y + 0.1, 0.0)) for x in (-0.8, -0.3, 0.3, 0.8) for y in (-0.6, 0.0, 0.5)]
FEW_STEPS = {"rays": 256, "max_steps": 20}
CONFIGS: dict[str, Any] = {"auto": AutoConfig(hypotheses=24, rounds=1), "bid": FEW_STEPS, "inerf": FEW_STEPS}
"""Settings where the default ones take long, by method."""
MIDDLE = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)


@dataclass(frozen=True)
class Wall:
    """A wall of one colour, all but a little unevenness, or with a texture all over; below z = 0."""

    texture: float
    sampler: RaySampler = field(default_factory=lambda: Stratified(48))

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        x, y, z = positions.unbind(-1)
        waves = torch.stack([(5 * x + 2 * y).sin() * (3 * y).cos(), (4 * y - x).sin(), (3 * x + 4 * y).cos()], -1)
        uneven = 0.004 * (2.2 * x + 1.3 * y).sin()[..., None]
        return FieldValues(150 * torch.sigmoid(-z / 0.01), 0.7 + uneven + self.texture * waves)


@functools.cache
def wall(texture: float) -> tuple[Wall, SurfaceMap]:
    seen = Wall(texture)
    return seen, bake(seen, BOUNDS, [(CAMERA, T) for T in POSES], config=BakeConfig(cells=50_000))


def photograph(T: SE3, texture: float, depth: bool = False) -> View:
    seen = render_image(Wall(texture), CAMERA, T, BOUNDS)
    noise = 0.01 * torch.randn(seen.rgb.shape, generator=Generator().manual_seed(1))
    rgb = (seen.rgb + noise).clamp(0, 1)
    return View(Frame("frame", rgb, CAMERA, torch.where(seen.opacity > 0.9, seen.depth, 0) if depth else None), T)


def found(view: View, texture: float, method: str = "auto") -> Localization:
    scene, surface = wall(texture)
    start = None if method == "auto" else view.T_ref_camera
    problem: Problem = rig(FieldMap(scene, BOUNDS, surface), [View(view.frame, SE3.identity())], start)
    return localize(problem, method, CONFIGS.get(method))


QUERY = look_at((0.1, -0.2, 1.6), (0.3, 0.2, 0.0))


@pytest.mark.parametrize("kind", ["cable", "gradient"])
def test_no_image_of_another_bare_wall_is_accepted(kind: str) -> None:
    rgb = torch.full((CAMERA.height, CAMERA.width, 3), 0.7)
    if kind == "cable":
        rgb[:, 30:32] = 0.1
    if kind == "gradient":
        rgb += 0.05 * torch.linspace(-1, 1, CAMERA.width)[None, :, None]
    rgb += 0.01 * torch.randn(rgb.shape, generator=Generator().manual_seed(2))
    assert not found(View(Frame(kind, rgb, CAMERA), QUERY), 0.0).converged


@pytest.mark.parametrize("depth", [False, True], ids=["RGB", "RGB-D"])
def test_no_pose_before_a_bare_wall_is_accepted(depth: bool) -> None:
    answer = found(photograph(QUERY, 0.0, depth), 0.0)
    assert not answer.converged, answer.reason


@pytest.mark.slow
@pytest.mark.parametrize("method", ["bid", "inerf"])
def test_no_method_accepts_a_start_before_a_bare_wall(method: str) -> None:
    answer = found(photograph(QUERY, 0.0), 0.0, method)
    assert answer.outcome is Outcome.UNDETERMINED, answer.reason


def test_a_textured_wall_determines_the_pose() -> None:
    answer = found(photograph(QUERY, 0.1), 0.1)
    assert answer.converged, answer.reason
    assert float((answer.T_world_camera.translation - QUERY.translation).norm()) < 0.05
    assert require(answer.confidence) > 0.8


@pytest.mark.parametrize(
    ("eye", "aim"), [((0.1, -0.32, 1.7), (0.2, 0.05, 0.0)), ((-0.05, -0.08, 1.6), (0.1, 0.2, 0.0))]
)
def test_the_noise_of_newly_drawn_rays_does_not_reject_a_right_pose(
    eye: tuple[float, float, float], aim: tuple[float, float, float]
) -> None:
    """They give further steps of 0.017 and 0.018."""
    query = look_at(eye, aim)
    answer = found(photograph(query, 0.1), 0.1)
    assert answer.converged, answer.reason
    assert float((answer.T_world_camera.translation - query.translation).norm()) < 0.05


def costs_about(best: SE3, noise: float, slope: tuple[float, ...]) -> object:
    """Costs that grow with the square of an update, by ``slope`` along each axis, and noise of 400 measurements."""
    generator = Generator().manual_seed(0)
    each = noise * torch.randn(400, generator=generator, dtype=torch.float64)

    def costs(T: SE3) -> Tensor:
        count = len(T.translation)
        back = SE3(best.inverse().rotation.expand(count, 3, 3), best.inverse().translation.expand(count, 3))
        moved = (back @ T).log()
        fresh = noise * torch.randn((count, 400), generator=generator, dtype=torch.float64)
        return (moved**2 * torch.tensor(slope, dtype=torch.float64)).sum(-1)[:, None] + each + fresh

    return costs


def test_a_pose_is_determined_if_all_directions_are() -> None:
    T = SE3.identity()
    for slope, is_determined in (((1.0,) * 3 + (20.0,) * 3, True), ((0.0, 1.0, 1.0, 0.0, 0.0, 20.0), False)):
        measures = support(costs_about(T, 0.05, slope), T, MIDDLE)  # type: ignore[arg-type]
        verdict = Support(measures).verdict("")
        assert verdict.outcome is (Outcome.CONVERGED if is_determined else Outcome.UNDETERMINED)
        assert verdict.confidence is not None
        assert verdict.confidence > 0.99 if is_determined else verdict.confidence < 0.8


def test_only_poses_farther_away_than_the_displacement_are_rivals() -> None:
    T, costs = SE3.identity(), costs_about(SE3.identity(), 0.05, (1.0,) * 6)
    near, far = (torch.tensor([x, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64) for x in (0.1, 1.0))
    alone = support(costs, T, MIDDLE, others=T[None].retract(near[None]))  # type: ignore[arg-type]
    assert "other" not in alone
    both = support(costs, T, MIDDLE, others=T[None].retract(torch.stack([near, far])))  # type: ignore[arg-type]
    assert math.isfinite(require(both["other"]))


def test_odds_are_antisymmetric_and_grow_with_the_number_of_measurements(generator: Generator) -> None:
    one, other = torch.rand((2, 4000), generator=generator, dtype=torch.float64) + torch.tensor([[0.0], [0.1]])
    assert float(log_odds(other[None], one)) == pytest.approx(-float(log_odds(one[None], other)))
    assert float(log_odds(other[None], one)) > 1.5 * float(log_odds(other[None, :1000], one[:1000]))
    assert float(log_odds(one[None], one)) == 0


def test_confidence_is_that_of_the_pose_among_its_rivals() -> None:
    """A pose that fits no better than three rivals is one of four; the rival that fits best is named."""
    T = SE3.identity()

    def even(poses: SE3) -> Tensor:
        return torch.arange(400.0).double().expand(len(poses.translation), 400)

    alike = support(even, T, MIDDLE, even(T[None])[0], T[None].retract(torch.full((1, 6), 9.0).double()))
    assert alike["confidence"] == pytest.approx(0.25)
    other = Support({"plain": 20.0, "displaced": 20.0, "other": 0.0, "confidence": 0.5}).verdict("")
    assert (other.outcome, other.confidence) == (Outcome.AMBIGUOUS, 0.5)
    assert Support({}).verdict("").confidence is None


@pytest.mark.parametrize("bound", SUPPORT_BOUNDS, ids=lambda bound: bound.measure)
def test_each_bound_alone_rejects_and_a_method_may_have_its_own_limit(bound: Bound) -> None:
    step = 1e-3 if bound.is_least else -1e-3
    measures = {"displaced": 0.0, bound.measure: bound.limit + step}
    assert Support(measures).verdict("").accepted
    assert Support(measures, {bound.measure: bound.limit + 2 * step}).verdict("").outcome is bound.outcome
    for value in (bound.limit - step, math.nan):
        found = Support(measures | {bound.measure: value}).verdict("")
        assert found.outcome is bound.outcome


def test_poses_are_the_same_by_where_they_put_the_middle_and_by_their_angle() -> None:
    """In any world frame and unit of length; a turn about the middle moves it nowhere, and counts by its angle."""
    xi = torch.zeros((4, 6), dtype=torch.float64)
    xi[0, 0], xi[1, 0], xi[2, 4], xi[3, 4] = 0.19, 0.21, 0.09, 0.11
    T = look_at((0.1, -0.2, 1.6), (0.3, 0.2, 0.0))
    others = SE3(T.rotation.expand(4, 3, 3), T.translation.expand(4, 3)).retract_about(MIDDLE, xi)
    expected = [True, False, True, False]
    assert same_pose(T, others, MIDDLE).tolist() == expected
    elsewhere = SE3.exp(torch.tensor([5.0, -3.0, 2.0, 0.4, 0.5, -1.0], dtype=torch.float64))
    assert same_pose(elsewhere @ T, elsewhere @ others, MIDDLE).tolist() == expected
    small, fewer = (SE3(x.rotation, 1e-3 * x.translation) for x in (T, others))
    assert same_pose(small, fewer, 1e-3 * MIDDLE).tolist() == expected
