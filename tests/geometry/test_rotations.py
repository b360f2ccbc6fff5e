"""Rotations of single poses against SciPy, and the Jacobian against the exponential of batches."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.geometry import SE3

# Inside: the rotation vector and its Jacobian are compared with SciPy's
from bidnerf_core.geometry.rotations import left_jacobian, rotation_matrix, rotation_vector

ANGLES = [0.0, 1e-9, 9e-5, 1.1e-4, 1e-2, 1.0, 2.49, 2.51, 3.1, math.pi - 1e-7]


def vector(angle: float) -> np.ndarray:
    axis = np.random.default_rng(int(1e6 * angle)).normal(size=3)
    return angle * axis / np.linalg.norm(axis)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_are_scipys(angle: float) -> None:
    phi = vector(angle)
    expected = Rotation.from_rotvec(phi).as_matrix()
    np.testing.assert_allclose(rotation_matrix(phi), expected, atol=1e-15)
    np.testing.assert_allclose(rotation_vector(expected), phi, atol=1e-8 if angle > 3 else 1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_jacobian_is_that_of_the_exponential(angle: float) -> None:
    phi, rho = vector(angle), np.array([0.3, -2.0, 0.7])
    expected = SE3.exp(torch.from_numpy(np.concatenate([rho, phi]))).translation
    np.testing.assert_allclose(left_jacobian(phi) @ rho, expected, atol=1e-9)
