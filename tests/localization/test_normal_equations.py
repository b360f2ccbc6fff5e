"""Normal equations: their solution, sums and choices, and what happens where they cannot be solved."""

from __future__ import annotations

import pytest
import torch
from torch import Generator

from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Cost, NormalEquations, Scaled, Sum


def random(count: int, generator: Generator) -> NormalEquations:
    """Return well-conditioned equations."""
    rows = torch.randn((count, 20, 6), generator=generator, dtype=torch.float64)
    gradient = torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return NormalEquations(torch.arange(count, dtype=torch.float64), gradient, rows.mT @ rows)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_the_step_solves_the_damped_equations(damping: float, generator: Generator) -> None:
    equations = random(4, generator)
    step = equations.solve(torch.full((4,), damping, dtype=torch.float64))
    damped = equations.hessian + damping * torch.diag_embed(equations.hessian.diagonal(dim1=-2, dim2=-1))
    expected = -torch.linalg.solve(damped, equations.gradient)
    torch.testing.assert_close(step, expected, rtol=1e-6, atol=1e-9)


def test_there_is_no_step_along_what_the_cost_is_blind_to(generator: Generator) -> None:
    """No information on three of the six directions, as where a plain wall is all that is seen."""
    seen = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    full = random(2, generator)
    blind = NormalEquations(full.cost, full.gradient * seen, full.hessian * seen * seen[:, None])
    step = blind.solve(torch.full((2,), 1e-3, dtype=torch.float64))
    assert torch.equal(step[:, 3:], torch.zeros((2, 3), dtype=torch.float64))
    inner = full.hessian[:, :3, :3]
    expected = -torch.linalg.solve(
        inner + 1e-3 * torch.diag_embed(inner.diagonal(dim1=-2, dim2=-1)), full.gradient[:, :3]
    )
    torch.testing.assert_close(step[:, :3], expected, rtol=1e-5, atol=1e-9)


def test_equations_that_cannot_be_solved_have_no_step_and_harm_no_other(generator: Generator) -> None:
    good = random(5, generator)
    hessian, gradient = good.hessian.clone(), good.gradient.clone()
    hessian[0] = -hessian[0]
    hessian[1] = torch.inf
    gradient[2] = torch.nan
    hessian[3] = torch.nan
    none = torch.zeros(5, dtype=torch.float64)
    step = NormalEquations(good.cost, gradient, hessian).solve(none)
    assert not bool(step[:4].any())
    assert torch.equal(step[4], good.solve(none)[4])


def test_a_sum_of_costs_is_a_cost(generator: Generator) -> None:
    parts = [random(3, generator) for _ in range(3)]
    whole = Sum((lambda T: parts[0], lambda T: parts[1], lambda T: parts[2]))
    assert isinstance(whole, Cost)
    found = whole(SE3.identity()[None])
    for name in ("cost", "gradient", "hessian"):
        expected = sum(getattr(part, name) for part in parts)
        torch.testing.assert_close(getattr(found, name), expected, rtol=0, atol=0)
    assert Sum((lambda T: parts[0],))(SE3.identity()[None]) is parts[0]


@pytest.mark.parametrize("factor", [0.25, 1.0, 1000.0])
def test_a_scaled_cost_takes_the_same_steps_and_weighs_more_in_a_sum(
    factor: float, generator: Generator
) -> None:
    parts, here = random(3, generator), SE3.identity()[None]
    scaled = Scaled(lambda T: parts, factor)
    assert isinstance(scaled, Cost)
    found, damping = scaled(here), torch.full((3,), 1e-3, dtype=torch.float64)
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(found, name), factor * getattr(parts, name))
    torch.testing.assert_close(found.solve(damping), parts.solve(damping), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(Sum((scaled, lambda T: parts))(here).cost, (factor + 1) * parts.cost)


def test_equations_are_chosen_pose_by_pose(generator: Generator) -> None:
    one, other = random(3, generator), random(3, generator)
    found = one.chosen(torch.tensor([True, False, True]), other)
    for name in ("cost", "gradient", "hessian"):
        values = getattr(found, name)
        assert torch.equal(values[[0, 2]], getattr(one, name)[[0, 2]])
        assert torch.equal(values[1], getattr(other, name)[1])


def wide(generator: Generator) -> NormalEquations:
    """Return two sets of well-conditioned equations of seven unknowns."""
    rows = torch.randn((2, 20, 7), generator=generator, dtype=torch.float64)
    gradient = torch.randn((2, 7), generator=generator, dtype=torch.float64)
    return NormalEquations(torch.tensor([3.0, 5.0], dtype=torch.float64), gradient, rows.mT @ rows)


def model(equations: NormalEquations, unknowns: torch.Tensor) -> torch.Tensor:
    linear = 2 * (equations.gradient * unknowns).sum(-1)
    return equations.cost + linear + torch.einsum("hi,hij,hj->h", unknowns, equations.hessian, unknowns)


def test_equations_of_other_unknowns_have_the_value_of_what_they_map_to(generator: Generator) -> None:
    whole = wide(generator)
    updates = torch.randn((7, 3), generator=generator, dtype=torch.float64)
    others = torch.randn((2, 3), generator=generator, dtype=torch.float64)
    torch.testing.assert_close(model(whole.of_others(updates), others), model(whole, others @ updates.mT))
