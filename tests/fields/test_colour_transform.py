"""The colour transform of images: identity at first, learned where images differ."""

from dataclasses import replace

import pytest
import torch

import tiny
from bidnerf.scenes import demo_object
from bidnerf_core.training import ColourTransforms, RayBank, Supervision, SupervisionConfig


def colours(count: int = 500) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(2))


def test_a_new_transform_changes_nothing_and_costs_nothing() -> None:
    transforms = ColourTransforms(4)
    rgb = colours()
    assert torch.equal(transforms(rgb, torch.arange(500) % 4), rgb)
    assert float(transforms.penalty().detach()) == 0


def test_the_gains_and_offsets_of_all_images_have_mean_zero() -> None:
    """A gain that all images share is the field's own colour."""
    transforms = ColourTransforms(3)
    with torch.no_grad():
        transforms.log_gain.add_(0.7)
        transforms.offset.add_(-0.2)
    rgb = colours()
    torch.testing.assert_close(transforms(rgb, torch.arange(500) % 3), rgb)


def test_exposures_are_found_from_colours_alone() -> None:
    true = ColourTransforms(3)
    with torch.no_grad():
        true.log_gain.copy_(torch.tensor([[0.5, 0.4, 0.3], [-0.3, -0.3, 0.0], [-0.2, -0.1, -0.3]]))
    rgb, image = colours(3000), torch.arange(3000) % 3
    photo = true(rgb, image).detach()
    learned = ColourTransforms(3)
    optimizer = torch.optim.Adam(learned.parameters(), lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        (learned(rgb, image) - photo).square().mean().backward()
        optimizer.step()
    torch.testing.assert_close(learned(rgb, image), photo, rtol=0, atol=2e-3)


def test_the_derivative_is_the_numerical_one() -> None:
    transforms = ColourTransforms(2).double()
    rgb, image = colours(6).double().requires_grad_(), torch.arange(6) % 2
    assert torch.autograd.gradcheck(
        lambda g, o, c: torch.func.functional_call(transforms, {"log_gain": g, "offset": o}, (c, image)),
        (torch.randn(2, 3).double().requires_grad_(), torch.randn(2, 3).double().requires_grad_(), rgb),
    )


@pytest.mark.parametrize("alpha", [True, False])
def test_images_with_a_background_have_no_exposure_to_learn(alpha: bool) -> None:
    views = tiny.views()
    if not alpha:
        views = [replace(view, frame=replace(view.frame, alpha=None)) for view in views]
    supervision = Supervision(views, demo_object().bounds, SupervisionConfig())
    assert (supervision.colours is None) == alpha
    assert isinstance(supervision.bank, RayBank)
    assert Supervision(views, demo_object().bounds, replace(SupervisionConfig(), exposure=False)).colours is None
