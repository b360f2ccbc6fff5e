"""Laws of rigid transforms: at the identity, near it, far from it, and against scipy's matrix exponential."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from bidnerf_core.geometry import SE3, skew

# Inside: the Jacobians of the exponential map are compared with its series and differences
from refusals import refused

SIZES = [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.0099, 0.0101, 0.5, 2.0, math.pi - 1e-3, math.pi - 1e-6]


def tangent(size: float, seed: int = 0, reach: float = 3.0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return torch.tensor(np.concatenate([reach * rng.normal(size=3), size * axis / np.linalg.norm(axis)]))


def generator_matrix(xi: torch.Tensor) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = skew(xi[3:]).numpy(), xi[:3].numpy()
    return matrix


tangents = st.builds(tangent, st.floats(0, math.pi - 1e-4), st.integers(0, 10**6), st.floats(0, 1e4))


def test_exp_is_the_matrix_exponential_and_log_inverts_it() -> None:
    xi = torch.stack([tangent(size, seed) for size in SIZES for seed in (0, 1)])
    expected = np.stack([expm(generator_matrix(x)) for x in xi])
    np.testing.assert_allclose(SE3.exp(xi).matrix().numpy(), expected, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(SE3.exp(xi).log(), xi, atol=1e-8, rtol=1e-8)


@given(tangents)
def test_exp_inverts_log(xi: torch.Tensor) -> None:
    T = SE3.exp(xi)
    torch.testing.assert_close(SE3.exp(T.log()).matrix(), T.matrix(), atol=1e-6, rtol=1e-9)


@given(tangents, tangents, tangents)
def test_group_laws(a: torch.Tensor, b: torch.Tensor, c: torch.Tensor) -> None:
    A, B, C = SE3.exp(a), SE3.exp(b), SE3.exp(c)
    scale = 1 + float(torch.stack([a, b, c]).abs().max())
    close = {"atol": 1e-11 * scale, "rtol": 1e-9}
    torch.testing.assert_close(((A @ B) @ C).matrix(), (A @ (B @ C)).matrix(), **close)
    torch.testing.assert_close((A @ A.inverse()).matrix(), torch.eye(4, dtype=torch.float64), **close)
    torch.testing.assert_close((A @ B).inverse().matrix(), (B.inverse() @ A.inverse()).matrix(), **close)
    torch.testing.assert_close((A @ B).matrix(), A.matrix() @ B.matrix(), **close)
    point = c[:3]
    torch.testing.assert_close((A @ B).apply(point), A.apply(B.apply(point)), **close)
    torch.testing.assert_close(A.rotate(point), A.apply(point) - A.apply(torch.zeros_like(point)), **close)


@given(tangents, tangents)
def test_adjoint_moves_a_tangent_to_the_other_side(a: torch.Tensor, b: torch.Tensor) -> None:
    A, small = SE3.exp(a), b / (1 + b.norm())
    left = A @ SE3.exp(small)
    right = SE3.exp(A.adjoint() @ small) @ A
    torch.testing.assert_close(left.matrix(), right.matrix(), atol=1e-9 * (1 + float(a.abs().max())), rtol=1e-8)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 1.0, 3.0])
def test_derivative_of_exp(size: float) -> None:
    point = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)
    xi = tangent(size).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: SE3.exp(x).apply(point), xi, atol=1e-6)


@pytest.mark.parametrize("size", [1e-4, 0.0099, 0.0101, 1.3, 3.0])
def test_derivative_of_log(size: float) -> None:
    T, zero = SE3.exp(tangent(size)), torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: T.retract(d).log(), zero, atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5, 0.1, 1.0])
def test_an_update_leads_to_the_other_transform(size: float) -> None:
    generator = torch.Generator().manual_seed(0)
    start, xi = (torch.randn((50, 6), generator=generator, dtype=torch.float64) for _ in range(2))
    T = SE3.exp(start)
    xi = size * xi / xi[:, 3:].norm(dim=-1, keepdim=True)
    torch.testing.assert_close(T.update_to(T.retract(xi)), xi, rtol=1e-8, atol=1e-14)


def test_batches_broadcast_against_leading_axes() -> None:
    T = SE3.exp(torch.stack([tangent(s) for s in (0.1, 1.0, 2.0)]))
    points = torch.randn(5, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.stack([T[i].apply(points[:, i]) for i in range(3)], dim=1)
    torch.testing.assert_close(T.apply(points), expected)
    empty = SE3.exp(torch.zeros(0, 6, dtype=torch.float64))
    assert empty.matrix().shape == (0, 4, 4)
    assert empty.log().shape == (0, 6)


def test_normalized_is_the_nearest_rigid_transform() -> None:
    T = SE3.exp(tangent(1.0))
    noisy = SE3(T.rotation + 1e-4 * torch.randn(3, 3, dtype=torch.float64), T.translation)
    assert not bool(noisy.is_rigid(1e-6))
    assert bool(noisy.normalized().is_rigid(1e-12))
    assert float((noisy.normalized().rotation - T.rotation).abs().max()) < 1e-3


def test_what_is_not_finite_mirrored_or_scaled_is_not_rigid() -> None:
    T = SE3.exp(tangent(1.0))
    for change in ([math.nan] * 3, [1.0, 1.0, -1.0], [1.1] * 3):
        assert not bool(SE3(T.rotation * torch.tensor(change).double(), T.translation).is_rigid())
    assert not bool(SE3(T.rotation, torch.tensor([0.0, math.inf, 0.0], dtype=torch.float64)).is_rigid())


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("matrix", [np.eye(4), [[1.0]], torch.eye(3), torch.eye(4)[0]])
def test_what_is_no_tensor_of_matrices_is_refused(matrix: Any) -> None:
    found = f"has shape {tuple(matrix.shape)}" if isinstance(matrix, torch.Tensor) else type(matrix).__name__
    with refused(found=found, expected="a tensor" if found[:3] != "has" else "(..., 4, 4)"):
        SE3.from_matrix(matrix)
