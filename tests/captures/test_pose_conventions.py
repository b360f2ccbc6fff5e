"""Poses that contradict their images: which mistakes are recognised, and what is never mistaken for one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from torch import Tensor

from bidnerf import SE3, register
from bidnerf_core.captures import pose_contradiction, prepare_views

# Inside: every reading of poses is applied and taken back, also those that no message proposes
from bidnerf_core.captures.pose_conventions import Y_AND_Z_REVERSED as REVERSED
from bidnerf_core.captures.pose_conventions import PoseContradiction, readings
from bidnerf_core.geometry import look_at
from bidnerf_core.mapping import ImageKeypoints, detect_keypoints
from landmark_scene import Points, looking_in, ring
from optional import require
from refusals import refused

COUNT = 150  # points: as many as tell all readings apart
IMAGES = 13  # enough for another order as text
CYCLED = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)


def seen_from(points: Points, truth: Sequence[SE3], given: Sequence[SE3]) -> list[ImageKeypoints]:
    """Return the keypoints of images from true poses, with ``given`` ones."""
    found = detect_keypoints([points.view(T, seed=i) for i, T in enumerate(truth)], points)
    return [replace(image, T_ref_camera=T) for image, T in zip(found, given, strict=True)]


def true_poses(count: int = IMAGES) -> list[SE3]:
    return [view.T_ref_camera for view in ring(Points(), count)]


def with_axes(T: SE3, axes: Tensor) -> SE3:
    return SE3(T.rotation @ axes, T.translation)


def judged(poses: list[SE3], noise: float = 0.4, outliers: float = 0.2) -> PoseContradiction | None:
    return pose_contradiction(seen_from(Points(COUNT, noise, outliers), true_poses(len(poses)), poses))


def test_right_poses_are_in_the_expected_convention_in_any_world() -> None:
    T_world = SE3.exp(torch.tensor([1.0, -2.0, 0.5, 0.7, -1.1, 2.0], dtype=torch.float64))
    assert judged([T_world @ pose for pose in true_poses()]) is None


@pytest.mark.parametrize(("axes", "height"), [(torch.eye(3, dtype=torch.float64), 0.0), (REVERSED, 0.3)])
def test_inverse_matrices_are_recognised(axes: Tensor, height: float) -> None:
    """Also of cameras that turn about one axis only: other axes explain their rotations as well as the inverses do."""
    truth = [looking_in(0.105 * i, height * (i % 3)) for i in range(IMAGES)]
    given = [with_axes(T, axes).inverse() for T in truth]
    found = require(pose_contradiction(seen_from(Points(COUNT, 0.4, 0.2), truth, given)))
    assert "inverses" in found.sentence


def test_a_few_wrong_poses_are_accepted_and_random_ones_refused_without_a_reading() -> None:
    generator = torch.Generator().manual_seed(0)
    some = true_poses()
    some[3], some[8] = with_axes(some[3], REVERSED), with_axes(some[8], CYCLED)
    assert judged(some) is None
    tangents = 2 * torch.randn(IMAGES, 6, dtype=torch.float64, generator=generator)
    found = require(judged([SE3.exp(tangent) for tangent in tangents]))
    assert found.reading is None
    assert f"agree with the keypoints of {found.agreeing_as_given} of {found.pairs}" in found.sentence


def test_few_images_tell_nothing() -> None:
    assert judged([with_axes(T, REVERSED) for T in true_poses(4)]) is None


def test_right_poses_before_a_wall_are_not_refused() -> None:
    """Two rotations fit the images of a plane, so rotations alone would contradict right poses."""
    points = Points(2 * COUNT, 0.4, 0.1)
    points.positions[:, 2] = 0
    places = [-2 + 0.3 * i for i in range(IMAGES)]
    poses = [look_at([x, -0.3, -3.0], [0.5 * x + 1, 0.0, 0.0], (0.0, -1.0, 0.0)) for x in places]
    assert pose_contradiction(seen_from(points, poses, poses)) is None
    given = [with_axes(T, REVERSED) for T in poses]
    found = pose_contradiction(seen_from(points, poses, given))
    reading = None if found is None else found.reading
    if reading is not None:
        assert torch.allclose(reading.understand(SE3.stack(given)).matrix(), SE3.stack(poses).matrix())


def test_pure_rotation_and_pure_translation_are_not_refused() -> None:
    points = Points(COUNT, 0.4)
    start = looking_in(0.0)
    for step in ([0, 0, 0, 0, 0.02, 0], [0.05, 0, 0, 0, 0, 0], [0, 0, 0.05, 0, 0, 0]):
        poses = [start @ SE3.exp(i * torch.tensor(step, dtype=torch.float64)) for i in range(IMAGES)]
        assert pose_contradiction(seen_from(points, poses, poses)) is None


def test_images_that_share_nothing_tell_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    found = seen_from(Points(COUNT), true_poses(), [with_axes(T, REVERSED) for T in true_poses()])
    for image in found:
        image.keypoints.descriptors.random_(0, 256, generator=generator)
    assert pose_contradiction(found) is None
    assert pose_contradiction([]) is None


def opengl(change: Callable[[SE3], SE3]) -> Callable[[SE3], SE3]:
    """A change of matrices in a file whose y and z axes a reader reverses."""
    return lambda T: with_axes(change(with_axes(T, REVERSED)), REVERSED)


def reordered(T: SE3, order: list[int]) -> SE3:
    quaternion = rotation_matrix_to_quaternion(T.rotation.contiguous())
    return SE3(quaternion_to_rotation_matrix(quaternion[:, order]), T.translation)


def mirrored(T: SE3, signs: list[float]) -> SE3:
    S = torch.diag(torch.tensor(signs, dtype=torch.float64))
    return SE3(S @ T.rotation @ S, T.translation @ S)


def positions(T: SE3, *factors: float) -> SE3:
    return SE3(T.rotation, T.translation * torch.tensor(factors, dtype=torch.float64))


WRONG: dict[str, tuple[Callable[[SE3], SE3], str]] = {
    "OpenCV's axes": (lambda T: with_axes(T, REVERSED), "diag(1, -1, -1, 1)"),
    # The given camera looks along the true one's x axis, so the true one's right is its forward.
    "other axes": (
        lambda T: with_axes(T, CYCLED),
        "right, down and forward are the given ones' forward, right and down",
    ),
    "transposed": (opengl(lambda T: SE3(T.rotation.mT, T.translation)), "transpose the upper left 3x3"),
    "half an inverse": (opengl(lambda T: SE3(T.rotation, T.inverse().translation)), "-R t"),
    "no minus": (opengl(lambda T: SE3(T.rotation.mT, -T.inverse().translation)), "lack the minus"),
    "negated": (lambda T: positions(T, -1, -1, -1), "by -1"),
    "x reversed": (lambda T: positions(T, -1, 1, 1), "the given ones' -x, y, z"),
    "swapped": (lambda T: SE3(T.rotation, T.translation[:, [0, 2, 1]]), "the given ones' x, z, y"),
    "quaternions": (lambda T: reordered(T, [1, 2, 3, 0]), "x y z w, but w x y z"),
    "quaternions of COLMAP": (lambda T: reordered(T.inverse(), [1, 2, 3, 0]).inverse(), "quaternions"),
    "Unity": (opengl(lambda T: mirrored(T, [1, 1, -1])), "left-handed"),
    "next image": (lambda T: T[[*range(1, IMAGES), IMAGES - 1]], "that of the next image"),
    "text order": (lambda T: T[sorted(range(IMAGES), key=str)], "text order"),
    "reverse": (lambda T: T[list(range(IMAGES))[::-1]], "reverse order"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_mistakes_are_refused_with_the_remedy_that_works(mistake: str) -> None:
    change, words = WRONG[mistake]
    truth = SE3.stack(irregular_poses())
    given = change(truth)
    found = require(pose_contradiction(seen_from(Points(COUNT, 0.4, 0.1), [*truth], [*given])))
    assert words in found.sentence
    assert found.agreeing >= 0.9 * found.pairs
    assert found.agreeing_as_given < 0.3 * found.pairs
    corrected = require(found.reading).understand(given)
    known = corrected.translation.isfinite().all(-1)
    corrected, expected = corrected[known], truth[known]
    relative = [(T[0].inverse() @ T).matrix() for T in (corrected, expected)]  # in whatever world
    torch.testing.assert_close(*relative)


def irregular_poses(count: int = IMAGES) -> list[SE3]:
    """Cameras that look at the points from places on no ring, so that no two mistakes look alike."""
    shifts = 0.25 * torch.randn(count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    shifts[:, 3:] *= 0.3
    return [looking_in(0.12 * i, 0.15 * (-1) ** i) @ SE3.exp(shifts[i]) for i in range(count)]


def test_positions_that_are_scaled_along_one_axis_are_refused() -> None:
    truth = irregular_poses()
    given = [*positions(SE3.stack(truth), 1, 1, 2)]
    assert pose_contradiction(seen_from(Points(COUNT, 0.4, 0.1), truth, given)) is not None


def test_images_in_no_order_are_judged_as_well() -> None:
    """Neither order nor wrong poses propose pairs that show the same; the images do."""
    points = Points(COUNT, 0.4, 0.1)
    poses = [view.T_ref_camera for view in ring(points, 40)]
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1)).tolist()
    found = detect_keypoints([points.view(poses[i], seed=i) for i in order], points)
    assert pose_contradiction(found) is None
    mixed = [replace(image, T_ref_camera=found[(7 * i) % 40].T_ref_camera) for i, image in enumerate(found)]
    contradiction = require(pose_contradiction(mixed))
    assert contradiction.agreeing_as_given < 0.5 * contradiction.pairs


def test_every_reading_has_words_and_keeps_the_number_of_poses() -> None:
    T = SE3.stack(irregular_poses())
    for reading in readings(IMAGES):
        assert reading.clause
        assert reading.remedy
        assert reading.understand(T).rotation.shape == (IMAGES, 3, 3)


def test_training_refuses_contradicting_poses_unless_they_are_trusted() -> None:
    points = Points(COUNT, 0.4)
    views = ring(points, 14)
    register("features", "points", points)
    wrong = [replace(view, T_ref_camera=view.T_ref_camera.inverse()) for view in views]
    with refused(found="the poses contradict the photos") as caught:
        prepare_views(wrong, features="points")
    assert "if they are inverses" in caught.error.found
    assert "trust_poses" in caught.error.found
    assert prepare_views(wrong, "never", features="points", trust_poses=True).cameras
