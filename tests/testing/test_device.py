"""Device discipline: what the simulated device forbids, and that steps with planted faults fail the contract."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from bidnerf.testing import SCENE_BOUNDS as BOUNDS
from bidnerf_core.devices import may_wait, without_waiting
from bidnerf_core.fields import FieldValues, RaySampler, Stratified
from bidnerf_core.geometry import SE3
from simulated_device import DEVICE, DeviceFault, Elsewhere, check_steps

FORBIDDEN: dict[str, Callable[[Tensor], object]] = {
    "cpu": lambda x: x.cpu(),
    "to": lambda x: x.to("cpu"),
    "numpy": lambda x: x.numpy(),
    "tolist": lambda x: x.tolist(),
    "item": lambda x: x.sum().item(),
    "float": lambda x: float(x.sum()),
    "bool": lambda x: bool((x > 0).all()),
    "int": lambda x: int(x.argmax()),
    "mask": lambda x: x[x > 0],
    "write by mask": lambda x: x.clone().index_put_((x > 0,), torch.zeros((), device=x.device)),
    "nonzero": lambda x: x.nonzero(),
    "where": lambda x: torch.where(x > 0),
    "unique": lambda x: x.unique(),
    "masked_select": lambda x: x.masked_select(x > 0),
    "svd": lambda x: torch.linalg.svd(x),
    "mixed": lambda x: x + torch.ones(3),
    "upload": lambda x: torch.ones(3).to(x.device),
    "new_tensor": lambda x: x.new_tensor([1.0, 2.0, 3.0]) + x,
    "tensor": lambda x: torch.tensor([1.0, 2.0, 3.0], device=x.device) + x,
    "equal": lambda x: torch.equal(x, x),
}


@pytest.mark.parametrize("name", FORBIDDEN)
def test_what_makes_the_host_wait_is_a_fault(name: str) -> None:
    with Elsewhere() as mode:
        x = torch.randn((4, 3), generator=torch.Generator().manual_seed(0)).to(DEVICE)
        with mode.strict(), pytest.raises(DeviceFault):
            FORBIDDEN[name](x)


def test_arithmetic_elsewhere_is_that_of_the_cpu() -> None:
    here = torch.randn((5, 3), generator=torch.Generator().manual_seed(0))
    layer = nn.Linear(3, 2)
    leaf = here.clone().requires_grad_()
    expected = torch.autograd.grad(layer(leaf).relu().square().sum(), leaf)[0]
    with Elsewhere() as mode:
        leaf = here.to(DEVICE).requires_grad_()
        moved = layer.to(DEVICE)
        with mode.strict():
            found = torch.autograd.grad(moved(leaf).relu().square().sum(), leaf)[0]
            written = torch.zeros(3, device=DEVICE)
            written[0] = 2.0
            written += 1
        torch.testing.assert_close(found.cpu(), expected)
        assert written.tolist() == [3.0, 1.0, 1.0]


def test_waiting_is_forbidden_for_other_devices_only() -> None:
    with without_waiting():
        assert may_wait(torch.device("cpu"))
        assert not may_wait(DEVICE)
    assert may_wait(DEVICE)


class Ball(nn.Module):
    """A soft ball, whose query may do something on the way."""

    def __init__(self, fault: Callable[[Tensor], Tensor] = lambda density: density) -> None:
        super().__init__()
        self.strength = nn.Parameter(torch.tensor(8.0))
        self.fault = fault

    @property
    def sampler(self) -> RaySampler:
        return Stratified(24, BOUNDS)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        distance = torch.linalg.vector_norm(positions, dim=-1)
        density = self.strength * torch.sigmoid(8 * (0.6 - distance))
        return FieldValues(self.fault(density), positions.sigmoid())


def by_mask(density: Tensor) -> Tensor:
    density = density.clone()
    density[density < 1e-3] = 0.0
    return density


PLANTED: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "a copy": (lambda density: density.cpu().to(density.device), "copied between devices"),
    "a number": (lambda density: density / max(1.0, float(density.detach().amax())), "reads a number"),
    "a mask": (by_mask, "mask"),
}


def test_a_field_without_faults_passes() -> None:
    check_steps(Ball())


@pytest.mark.parametrize("name", PLANTED)
def test_a_fault_that_is_put_into_a_step_fails(name: str) -> None:
    fault, message = PLANTED[name]
    with pytest.raises(AssertionError, match=message):
        check_steps(Ball(fault))


class Unmoved(Ball):
    """A field one of whose tensors ``.to(device)`` does not find."""

    def __init__(self) -> None:
        super().__init__()
        self.colour = torch.full((3,), 0.5)  # neither a parameter nor a buffer

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return FieldValues(super().query(positions, directions).density, self.colour + 0 * positions)


def test_state_that_does_not_move_fails() -> None:
    with pytest.raises(AssertionError, match="mixes devices"):
        check_steps(Unmoved())


def test_a_newton_schulz_step_removes_rounding() -> None:
    exact = SE3.exp(torch.tensor([0.1, 0.2, 0.3, 0.4, -0.5, 0.6], dtype=torch.float64))
    rough = SE3(exact.rotation * (1 + 1e-6) + 1e-7, exact.translation)
    polished = rough.polished().rotation
    eye = torch.eye(3, dtype=torch.float64)
    assert float((polished.mT @ polished - eye).abs().max()) < 1e-11
    torch.testing.assert_close(polished, rough.normalized().rotation, rtol=0, atol=1e-11)
