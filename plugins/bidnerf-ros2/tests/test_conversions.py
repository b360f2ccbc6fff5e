"""The conversions agree with the formulae of tf2 and GTSAM, with scipy, and with sampled motions."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf import SE3
from bidnerf_core.geometry import covariance_in
from bidnerf_ros2.conversions import (
    R_BODY_OPTICAL,
    body_pose,
    covariance_elsewhere,
    fill,
    seconds,
    transform_of,
)


def rotations(count: int = 200) -> np.ndarray:
    """Return random rotations, half turns about many axes, and the identity."""
    drawn = np.random.default_rng(0)
    axes = drawn.normal(size=(50, 3))
    turns = np.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    turns = np.concatenate([turns, np.pi * np.eye(3), np.zeros((1, 3)), 1e-9 * axes])
    return np.concatenate([Rotation.random(count, rng=drawn).as_matrix(), Rotation.from_rotvec(turns).as_matrix()])


def poses(seed: int = 0) -> SE3:
    return SE3.exp(torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))


def test_quaternions_are_those_of_scipy_in_the_order_of_ros() -> None:
    for matrix in rotations():
        message = SimpleNamespace(translation=SimpleNamespace(), rotation=SimpleNamespace())
        fill(message, SE3(torch.from_numpy(matrix), torch.zeros(3, dtype=torch.float64)))
        found = message.rotation
        assert Rotation.from_quat([found.x, found.y, found.z, found.w]).as_matrix() == pytest.approx(matrix, abs=1e-9)
        assert transform_of(message).rotation.numpy() == pytest.approx(matrix, abs=1e-9)


def test_optical_axes_are_those_of_rep_103() -> None:
    """REP 103's turn from body to optical, as static_transform_publisher has it: roll -90, pitch 0, yaw -90 degrees."""
    expected = Rotation.from_euler("ZYX", [-90, 0, -90], degrees=True).as_matrix()
    assert R_BODY_OPTICAL.numpy() == pytest.approx(expected, abs=1e-12)
    pose = poses()
    forward = body_pose(pose).rotate(torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert torch.allclose(forward, pose.rotate(torch.tensor([0, 0, 1.0], dtype=torch.float64)))
    assert torch.equal(body_pose(pose).translation, pose.translation)


def samples(count: int = 200_000) -> tuple[SE3, torch.Tensor, torch.Tensor]:
    """Return a pose, a small covariance, and draws of its tangent."""
    g = torch.Generator().manual_seed(1)
    root = 1e-3 * torch.randn((6, 6), dtype=torch.float64, generator=g)
    return poses(2), root @ root.mT, torch.randn((count, 6), dtype=torch.float64, generator=g) @ root.mT


def close(found: torch.Tensor, expected: torch.Tensor) -> bool:
    scale = expected.diagonal().sqrt()
    return bool(((found - expected).abs() <= 0.02 * scale[:, None] * scale).all())


def test_covariance_about_fixed_axes_is_that_of_sampled_poses() -> None:
    """tf2::transformCovariance and GTSAM's Pose3 adjoint reduce to this where only the axes change."""
    pose, covariance, drawn = samples()
    moved = pose.retract(drawn)
    places = moved.translation - pose.translation
    turned = SE3(moved.rotation @ pose.rotation.mT, torch.zeros_like(places)).log()[:, 3:]  # about fixed axes
    assert close(torch.cov(torch.cat([places, turned], dim=1).mT), covariance_in(covariance, pose, "ros"))


def test_covariance_at_a_base_is_that_of_sampled_poses() -> None:
    pose, covariance, drawn = samples()
    T_camera_base = poses(3)
    base = pose @ T_camera_base
    tangents = (base.inverse() @ (pose.retract(drawn) @ T_camera_base)).log()
    assert close(torch.cov(tangents.mT), covariance_elsewhere(covariance, T_camera_base))


def test_transforms_survive_messages() -> None:
    pose = poses(4)
    for names in (("translation", "rotation"), ("position", "orientation")):
        message = SimpleNamespace(**{name: SimpleNamespace() for name in names})
        fill(message, pose)
        assert torch.allclose(transform_of(message).matrix(), pose.matrix(), atol=1e-12)
    assert seconds(SimpleNamespace(sec=3, nanosec=250_000_000)) == 3.25
