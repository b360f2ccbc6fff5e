"""The second pose of a plane: refinement that began at the wrong one of two minima is led to the other.

The table of ``test_answers`` has what ``auto`` makes of a poster; the geometry is tested here, at ``second_pose``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

import conditions
from bidnerf_core import Localizer, Outcome
from bidnerf_core.geometry import SE3

# Inside: the geometry of the two minima, of which an answer keeps the deeper one
from bidnerf_core.localization.landmarks.twins import second_pose, tilted_to_the_other_side
from bidnerf_core.mapping import ObservedPoints, resect
from bidnerf_core.registry import registered
from bidnerf_core.scenes import look_at
from conditions import NOT_RENDERED, point_landmarks, point_view, with_landmarks
from landmark_scene import looking_in
from localizations import assert_near

FOCAL, NOISE = 400.0, 0.3  # pixels
TILT = 0.5  # radians


def points(relief: float) -> Tensor:
    """Points on a square of a metre, up to half of ``relief`` (metres) off its plane."""
    unit = torch.rand((60, 3), generator=Generator().manual_seed(0), dtype=torch.float64) - 0.5
    return unit * torch.tensor([1.0, 1.0, relief], dtype=torch.float64)


def pose(distance: float) -> SE3:
    return look_at(
        (distance * math.sin(TILT), 0.1, distance * math.cos(TILT)), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    )


def observed(T: SE3, places: Tensor) -> ObservedPoints:
    local, count = T.inverse().apply(places), len(places)
    off = torch.randn((count, 2), generator=Generator().manual_seed(1), dtype=torch.float64)
    nothing, eye = torch.zeros(count, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    return ObservedPoints(
        points=places,
        deviations=torch.full((count, 2), 1e-3, dtype=torch.float64),
        directions=torch.nn.functional.normalize(T.translation - places, dim=-1),
        image=local[:, :2] / local[:, 2:] + NOISE / FOCAL * off,
        focal=torch.full((count,), FOCAL, dtype=torch.float64),
        depth=nothing,
        rotation=eye.expand(count, 3, 3),
        translation=torch.zeros((count, 3), dtype=torch.float64),
        exposure_times=nothing,
    )


def degrees(one: SE3, other: SE3) -> float:
    return math.degrees(float(torch.linalg.vector_norm((one.inverse() @ other).log()[3:])))


def test_from_the_other_side_a_plane_looks_the_same_and_twice_it_is_the_same() -> None:
    T, plane = pose(60.0), points(0.0)
    there = tilted_to_the_other_side(plane, T)
    seen = [where.inverse().apply(plane) for where in (T, there)]
    pixels = [FOCAL * local[:, :2] / local[:, 2:] for local in seen]
    torch.testing.assert_close(pixels[0], pixels[1], atol=0.05, rtol=0)
    assert degrees(T, there) == pytest.approx(2 * math.degrees(TILT), rel=0.05)
    torch.testing.assert_close(tilted_to_the_other_side(plane, there).matrix(), T.matrix(), atol=1e-9, rtol=0)
    assert float(torch.linalg.det(there.rotation)) == pytest.approx(1)


def test_a_pose_at_the_wrong_minimum_is_led_to_the_right_one() -> None:
    T, plane = pose(6.0), points(0.0)
    data = observed(T, plane)
    wrong = resect(data, tilted_to_the_other_side(plane, T), NOISE)
    assert degrees(wrong.T_world_rig, T) > 20  # it is a minimum
    found = second_pose(data, wrong)
    assert found is not None
    assert found.log_odds < -3
    assert degrees(found.fit.T_world_rig, T) < 2
    back = second_pose(data, found.fit)
    assert back is not None
    assert back.log_odds == pytest.approx(-found.log_odds, rel=1e-3)


def test_points_off_the_plane_leave_no_second_pose_that_fits() -> None:
    T, solid = pose(6.0), points(0.5)
    data = observed(T, solid)
    found = second_pose(data, resect(data, T, NOISE))
    assert found is None or found.log_odds > 10


@pytest.mark.parametrize("given", ["nothing", "start", "depth"])
def test_a_start_or_depth_tells_the_two_poses_of_a_poster_apart(
    given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without either, its image from afar is ambiguous."""
    seen, T = conditions.points(flat=True), looking_in(0.5, 0.3, 8.0)
    monkeypatch.setitem(registered, ("features", "points"), seen)
    scene = with_landmarks(replace(point_landmarks(flat=True), features="points"))
    view = point_view(seen, T, depth=1.0 if given == "depth" else None, seed=100)
    localize = Localizer(scene, config=NOT_RENDERED, warm_up=False)
    found = localize([view], T if given == "start" else None)
    assert (found.outcome is Outcome.AMBIGUOUS) is (given == "nothing")
    assert_near(found.T_world_camera, T, 0.3, 2)
