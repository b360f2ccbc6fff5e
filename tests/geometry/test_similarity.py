"""Similarities between point sets: what comes back, what does not, and scipy's rotation as a witness."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.geometry import SE3, Similarity, fit_most, fit_similarity, spread
from refusals import refused

GENERATOR = torch.Generator().manual_seed(0)
CLOUD = torch.randn((20, 3), generator=GENERATOR, dtype=torch.float64)
TRUTH = Similarity(0.37, SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.4, -1.1, 2.7], dtype=torch.float64)))


@pytest.mark.parametrize("count", [3, 4, 20])
@pytest.mark.parametrize("flat", [False, True])
def test_an_exact_one_comes_back(count: int, flat: bool) -> None:
    points = CLOUD[:count] * torch.tensor([1.0, 1.0, 0.0 if flat else 1.0])
    found = fit_similarity(points, TRUTH.apply(points))
    assert found.scale == pytest.approx(TRUTH.scale, rel=1e-9)
    torch.testing.assert_close(found.T_target_source.matrix(), TRUTH.T_target_source.matrix())


def test_of_points_on_a_line_the_scale_is_known() -> None:
    line = CLOUD[:1] * torch.linspace(-2, 5, 6)[:, None]
    for points in (line, line[:2]):
        found = fit_similarity(points, TRUTH.apply(points))
        assert found.scale == pytest.approx(TRUTH.scale, rel=1e-9)
        assert bool(found.T_target_source.is_rigid())
        torch.testing.assert_close(found.apply(points), TRUTH.apply(points))


def test_a_mirror_image_is_answered_with_a_rotation() -> None:
    found = fit_similarity(CLOUD, CLOUD * torch.tensor([1.0, 1.0, -1.0]))
    assert float(torch.linalg.det(found.T_target_source.rotation)) == pytest.approx(1)


def test_the_rotation_is_scipys_and_the_scale_the_least_squares_one() -> None:
    noisy = TRUTH.apply(CLOUD) + 0.1 * torch.randn(CLOUD.shape, generator=GENERATOR, dtype=torch.float64)
    found = fit_similarity(CLOUD, noisy)
    a, b = CLOUD - CLOUD.mean(0), noisy - noisy.mean(0)
    rotation, _ = Rotation.align_vectors(b.numpy(), a.numpy())
    torch.testing.assert_close(found.T_target_source.rotation, torch.from_numpy(rotation.as_matrix()))
    turned = found.T_target_source.rotate(a)
    assert found.scale == pytest.approx(float((turned * b).sum() / (a * a).sum()))  # d/ds |b - s R a|^2 = 0


@pytest.mark.parametrize(("count", "wrong"), [(2, 0), (12, 4), (80, 30)])
def test_wrong_pairs_leave_the_similarity_of_most_as_it_is(count: int, wrong: int, generator: torch.Generator) -> None:
    source = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    target = TRUTH.apply(source) + 0.002 * torch.randn(count, 3, generator=generator)
    target[:wrong] += 10 * torch.randn(wrong, 3, generator=generator)
    fit, distances, fits = fit_most(source, target)
    assert fits.tolist() == [False] * wrong + [True] * (count - wrong)
    torch.testing.assert_close(distances, torch.linalg.vector_norm(fit.apply(source) - target, dim=-1))
    if wrong:
        assert fit.scale == pytest.approx(TRUTH.scale, rel=0.03)
        assert fit_similarity(source, target).scale != pytest.approx(TRUTH.scale, rel=0.2)
    alone = fit_similarity(source[fits], target[fits])
    assert fit_similarity(source, target, fits.double()).scale == pytest.approx(alone.scale)


def test_points_that_tell_nothing_are_refused() -> None:
    same = torch.full((4, 3), 0.1, dtype=torch.float64)
    some = CLOUD[:4]
    for source, target in ((some[:1], some[:1]), (same, some), (some, same), (some[:0], some[:0])):
        with refused(found=f"{len(source)} pairs of points", expected="2 or more distinct ones"):
            fit_similarity(source, target)
    assert spread(same) == 0
