"""The hash encoding against a slow reference, its gradients, and what it promises about borders and levels."""

from __future__ import annotations

import itertools
import os
from functools import partial
from typing import Literal
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import Tensor

from bidnerf_hashgrid import encoding as encoding_module
from bidnerf_hashgrid.encoding import HashEncoding, HashEncodingConfig
from bidnerf_hashgrid.threads import concurrently
from optional import require

Interpolation = Literal["linear", "smooth"]
both_interpolations = pytest.mark.parametrize("interpolation", ["linear", "smooth"])
PRIMES = (1, 2654435761, 805459861)


def make(features: int = 2, interpolation: Interpolation = "linear", log2_table_size: int = 7) -> HashEncoding:
    """A small encoding with a dense level (5^3 vertices in 2^7 entries) and three hashed ones, all of order one."""
    config = HashEncodingConfig(4, features, log2_table_size, 4, 32, interpolation)
    encoding = HashEncoding(config).double()
    with torch.no_grad():
        for table in encoding.tables:
            table.normal_()
    return encoding


def inner_points(encoding: HashEncoding, count: int = 12) -> Tensor:
    """Random positions that are not close to a border of any level's cells."""
    points = torch.rand(400, 3, dtype=torch.float64)
    scaled = points[:, None] * torch.tensor([level.resolution for level in encoding.levels])[:, None]
    distance = (scaled - scaled.round()).abs().flatten(1).amin(dim=1)
    return points[distance > 1e-2][:count].clone()


def reference(encoding: HashEncoding, positions: Tensor) -> np.ndarray:
    """Equations 1 to 4 of the paper, point by point and corner by corner."""
    config = encoding.config
    growth = (config.finest_resolution / config.base_resolution) ** (1 / (config.levels - 1))
    table_size = 2**config.log2_table_size
    out = np.zeros((len(positions), config.levels, config.features))
    for n, position in enumerate(positions.tolist()):
        for level, table in enumerate(encoding.tables):
            resolution = int(np.floor(config.base_resolution * growth**level + 1e-6))
            cell = [min(int(np.floor(p * resolution)), resolution - 1) for p in position]
            t = np.array(position) * resolution - cell
            if config.interpolation == "smooth":
                t = 3 * t**2 - 2 * t**3
            for corner in itertools.product((0, 1), repeat=3):
                x, y, z = (c + d for c, d in zip(cell, corner, strict=True))
                if (resolution + 1) ** 3 <= table_size:
                    index = x + (resolution + 1) * (y + (resolution + 1) * z)
                else:
                    index = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % table_size
                weight = np.prod([w if d else 1 - w for w, d in zip(t, corner, strict=True)])
                out[n, level] += weight * table[index].detach().numpy()
    return out.reshape(len(positions), -1)


def position_gradient(encoding: HashEncoding, positions: Tensor) -> Tensor:
    positions = positions.clone().requires_grad_()
    encoding(positions).sum().backward()
    return require(positions.grad)


@pytest.mark.parametrize(
    "wrong",
    [
        {"levels": 0},
        {"features": 0},
        {"log2_table_size": 31},
        {"base_resolution": 64, "finest_resolution": 32},
    ],
)
def test_refuses_a_wrong_configuration(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        HashEncoding(HashEncodingConfig(**wrong))  # type: ignore[arg-type]


@both_interpolations
@pytest.mark.parametrize("features", [1, 2, 3, 4])
@pytest.mark.parametrize("log2_table_size", [4, 7, 16])  # all levels hashed, one dense, all dense
def test_agrees_with_the_reference(features: int, interpolation: Interpolation, log2_table_size: int) -> None:
    encoding = make(features, interpolation, log2_table_size)
    special = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.25, 0.5, 1.0], [1.0, 0.3, 0.0]])
    positions = torch.cat((torch.rand(20, 3), special)).double()
    expected = reference(encoding, positions)
    np.testing.assert_allclose(encoding(positions).detach(), expected, rtol=1e-10, atol=1e-10)
    # The path that also keeps derivatives computes the value in another way.
    with_slopes = encoding(positions.clone().requires_grad_()).detach()
    np.testing.assert_allclose(with_slopes, expected, rtol=1e-10, atol=1e-10)


@both_interpolations
@pytest.mark.parametrize("features", [1, 2, 4])
def test_gradients(features: int, interpolation: Interpolation) -> None:
    encoding = make(features, interpolation)
    positions = inner_points(encoding, 4)
    # Thousands of table entries: random combinations of them instead of one by one.
    assert torch.autograd.gradcheck(lambda *_: encoding(positions), tuple(encoding.tables), fast_mode=True)
    encoding.requires_grad_(False)
    assert torch.autograd.gradcheck(encoding, (positions.requires_grad_(),))


@both_interpolations
def test_float32_gradients_are_those_of_float64(interpolation: Interpolation) -> None:
    encoding = make(interpolation=interpolation)
    positions = inner_points(encoding, 100).float()
    exact = position_gradient(encoding, positions.double())
    exact_tables = [table.grad for table in encoding.tables]
    single = make(interpolation=interpolation).float()
    single.load_state_dict(encoding.state_dict())
    torch.testing.assert_close(position_gradient(single, positions), exact.float(), rtol=1e-3, atol=1e-3)
    for table, expected in zip(single.tables, exact_tables, strict=True):
        torch.testing.assert_close(table.grad, require(expected).float(), rtol=1e-3, atol=1e-4)


def test_gives_gradients_only_where_they_are_required() -> None:
    encoding = make()
    positions = inner_points(encoding)
    encoding(positions).sum().backward()
    assert all(table.grad is not None for table in encoding.tables)
    encoding.zero_grad()
    encoding.requires_grad_(False)
    assert not encoding(positions).requires_grad
    assert position_gradient(encoding, positions).abs().min() > 0
    assert all(table.grad is None for table in encoding.tables)


def test_refuses_double_backward() -> None:
    encoding = make()
    positions = inner_points(encoding).requires_grad_()
    (gradient,) = torch.autograd.grad(encoding(positions).square().sum(), positions, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_derivative_of_smooth_interpolation_is_continuous_across_cells() -> None:
    step = torch.tensor([0, 1e-9, 0], dtype=torch.float64)
    jumps = []
    for interpolation in ("smooth", "linear"):
        encoding = make(interpolation=interpolation)
        border = inner_points(encoding)
        border[:, 1] = 0.25
        below, above = position_gradient(encoding, border - step), position_gradient(encoding, border + step)
        jumps.append(float((above - below).abs().max()))
    smooth, linear = jumps
    assert smooth < 1e-4
    assert linear > 1


@pytest.mark.parametrize("active", [0, 1, 3, 4, 9])
def test_inactive_levels_are_zero_and_get_no_gradient(active: int) -> None:
    encoding = make()
    positions = inner_points(encoding).requires_grad_()
    encoded = encoding(positions, active_levels=active)
    assert torch.equal(encoded[:, : 2 * active], encoding(positions)[:, : 2 * active])
    assert not encoded[:, 2 * active :].any()
    if active:
        encoded.sum().backward()
    assert [table.grad is not None for table in encoding.tables] == [k < active for k in range(4)]


@pytest.mark.parametrize("features", [1, 2, 4])
def test_no_points(features: int) -> None:
    encoding = make(features)
    positions = torch.zeros(0, 3, dtype=torch.float64, requires_grad=True)
    encoded = encoding(positions)
    assert encoded.shape == (0, encoding.width)
    encoded.sum().backward()
    assert require(positions.grad).shape == (0, 3)
    assert all(table.grad is not None and not table.grad.any() for table in encoding.tables)


def test_clamps_positions_to_the_cube() -> None:
    encoding = make()
    outside = torch.tensor([[-0.2, 0.37, 1.7], [0.41, 3.0, 0.53]], dtype=torch.float64)
    assert torch.equal(encoding(outside), encoding(outside.clamp(0, 1)))
    gradient = position_gradient(encoding, outside)
    assert torch.equal(gradient == 0, (outside < 0) | (outside > 1))


@both_interpolations
def test_chunks_do_not_change_the_result(interpolation: Interpolation, monkeypatch: pytest.MonkeyPatch) -> None:
    encoding = make(interpolation=interpolation)
    positions = inner_points(encoding, 50)

    def run() -> list[Tensor]:
        encoding.zero_grad()
        gradient = position_gradient(encoding, positions)
        tables = [table.grad for table in encoding.tables if table.grad is not None]
        return [encoding(positions), gradient, *tables]

    whole = run()
    monkeypatch.setattr(encoding_module, "CHUNK", 7)
    for part, expected in zip(run(), whole, strict=True):
        torch.testing.assert_close(part, expected)


@pytest.mark.parametrize("inference", [False, True])
def test_the_number_of_threads_does_not_change_the_result(monkeypatch: pytest.MonkeyPatch, inference: bool) -> None:
    encoding, points, usual = make(), torch.rand(50, 3, dtype=torch.float64), torch.get_num_threads()
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(encoding_module, "threads_for", lambda *_, threads=threads: threads)
        with torch.inference_mode(inference):
            encoded = encoding(points.clone().requires_grad_(not inference))
        if inference:
            results.append([encoded])
        else:
            results.append([encoded, *torch.autograd.grad(encoded.square().sum(), list(encoding.tables))])
    for one, three in zip(*results, strict=True):
        assert torch.equal(one, three)
    assert torch.get_num_threads() == usual


def test_an_error_in_a_thread_is_raised() -> None:
    with pytest.raises(ValueError, match="of a task"):
        concurrently([Mock(side_effect=ValueError("of a task"))] * 2, threads=2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_has_threads_of_its_own() -> None:
    done = []
    concurrently([partial(done.append, 1)] * 2, threads=2)
    child = os.fork()
    if child == 0:
        concurrently([partial(done.append, 1)] * 2, threads=2)
        os._exit(0 if len(done) == 4 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
