"""Poses with other axes or inverse matrices: which are recognised, and what is never mistaken for them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bidnerf_core import SE3
from bidnerf_core.captures.pose_conventions import Y_AND_Z_REVERSED, OtherConvention, other_convention
from bidnerf_core.mapping import PosedKeypoints, tracked_views
from landmark_scene import Points, looking_in, ring

REVERSED = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
CYCLED = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)


def images(points: Points, poses: list[SE3]) -> list[PosedKeypoints]:
    """The keypoints of a ring of cameras, with other ``poses`` than the true ones."""
    views = ring(points, len(poses))
    return list(tracked_views(views, points).at(SE3.stack(poses)).observations.images)


def true_poses(count: int = 14) -> list[SE3]:
    return [view.T_ref_camera for view in ring(Points(), count)]


def with_axes(T: SE3, axes: Tensor) -> SE3:
    return SE3(T.rotation @ axes, T.translation)


def judged(poses: list[SE3], noise: float = 0.4, outliers: float = 0.2) -> OtherConvention | None:
    return other_convention(images(Points(noise=noise, outliers=outliers), poses))


def test_right_poses_are_in_the_expected_convention() -> None:
    assert judged(true_poses()) is None


def test_axes_of_opengl_are_recognised() -> None:
    found = judged([with_axes(T, REVERSED) for T in true_poses()])
    assert found is not None
    assert (found.axes, found.inverted) == (Y_AND_Z_REVERSED, False)
    assert found.agreeing == found.pairs
    assert found.agreeing_as_given < 0.3 * found.pairs
    assert "diag(1, -1, -1, 1)" in found.sentence


@pytest.mark.parametrize("axes", [torch.eye(3, dtype=torch.float64), REVERSED])
def test_inverse_matrices_are_recognised(axes: Tensor) -> None:
    found = judged([with_axes(T, axes).inverse() for T in true_poses()])
    assert found is not None
    assert found.inverted
    assert "inverses" in found.sentence


def test_permuted_axes_are_named() -> None:
    found = judged([with_axes(T, CYCLED) for T in true_poses()])
    assert found is not None
    assert not found.inverted
    # The given camera looks along the true one's x axis, so the true one's right is its forward.
    assert "right, down and forward are the given ones' forward, right and down" in found.sentence
    axes = torch.tensor(found.axes, dtype=torch.float64)
    assert torch.equal(CYCLED @ axes, torch.eye(3, dtype=torch.float64))


def test_a_moved_world_changes_nothing() -> None:
    T = SE3.exp(torch.tensor([1.0, -2.0, 0.5, 0.7, -1.1, 2.0], dtype=torch.float64))
    assert judged([T @ pose for pose in true_poses()]) is None
    found = judged([T @ with_axes(pose, REVERSED) for pose in true_poses()])
    assert found is not None
    assert found.axes == Y_AND_Z_REVERSED


def test_a_few_wrong_poses_and_random_ones_are_no_convention() -> None:
    generator = torch.Generator().manual_seed(0)
    some = true_poses()
    some[3], some[8] = with_axes(some[3], REVERSED), with_axes(some[8], CYCLED)
    assert judged(some) is None
    tangents = 2 * torch.randn(14, 6, dtype=torch.float64, generator=generator)
    assert judged([SE3.exp(tangent) for tangent in tangents]) is None


def test_few_images_tell_nothing() -> None:
    assert judged([with_axes(T, REVERSED) for T in true_poses(4)]) is None


def looking_at(centre: list[float], target: list[float]) -> SE3:
    """A camera with a level x axis, where y points down."""
    place, aim = torch.tensor(centre, dtype=torch.float64), torch.tensor(target, dtype=torch.float64)
    z = (aim - place) / (aim - place).norm()
    x = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), z)
    x = x / x.norm()
    return SE3(torch.stack([x, torch.linalg.cross(z, x), z], dim=-1), place)


@pytest.mark.parametrize("seed", range(3))
def test_right_poses_before_a_wall_are_not_refused(seed: int) -> None:
    """Two rotations fit the images of a plane, so rotations alone would contradict right poses."""
    points = Points(count=600, noise=0.4, outliers=0.1)
    points.positions[:, 2] = 0
    places = [-2 + 0.3 * i for i in range(14)]
    poses = [looking_at([x, -0.3, -3.0], [0.5 * x + 1, 0.0, 0.0]) for x in places]
    views = [points.view(T, seed=14 * seed + i) for i, T in enumerate(poses)]
    tracked = tracked_views(views, points)
    assert other_convention(tracked.observations.images) is None
    flipped = SE3.stack([with_axes(T, REVERSED) for T in poses])
    found = other_convention(tracked.at(flipped).observations.images)
    assert found is None or (found.axes, found.inverted) == (Y_AND_Z_REVERSED, False)


@pytest.mark.parametrize("axes", [torch.eye(3, dtype=torch.float64), REVERSED])
def test_inverse_matrices_of_cameras_on_one_level_are_not_called_axes(axes: Tensor) -> None:
    """Cameras that turn about one axis only: other axes explain their rotations as well as the inverses do."""
    points = Points(noise=0.4)
    poses = [looking_in(0.105 * i, 0.0) for i in range(14)]
    views = [points.view(T, seed=i) for i, T in enumerate(poses)]
    inverse = SE3.stack([with_axes(T, axes).inverse() for T in poses])
    found = other_convention(tracked_views(views, points).at(inverse).observations.images)
    assert found is not None
    assert found.inverted


def test_pure_rotation_and_pure_translation_are_not_refused() -> None:
    points = Points(noise=0.4)
    start = looking_in(0.0)
    for step in ([0, 0, 0, 0, 0.02, 0], [0.05, 0, 0, 0, 0, 0], [0, 0, 0.05, 0, 0, 0]):
        poses = [start @ SE3.exp(i * torch.tensor(step, dtype=torch.float64)) for i in range(14)]
        views = [points.view(T, seed=i) for i, T in enumerate(poses)]
        assert other_convention(tracked_views(views, points).observations.images) is None


def test_images_that_share_nothing_tell_nothing() -> None:
    found = images(Points(), [with_axes(T, REVERSED) for T in true_poses()])
    generator = torch.Generator().manual_seed(0)
    blind = [
        replace(
            image,
            keypoints=replace(
                image.keypoints,
                descriptors=torch.randint(
                    0, 256, image.keypoints.descriptors.shape, generator=generator, dtype=torch.uint8
                ),
            ),
        )
        for image in found
    ]
    assert other_convention(blind) is None
    assert other_convention([]) is None
