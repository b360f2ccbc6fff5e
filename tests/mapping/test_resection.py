"""Resection: exact poses from exact sightings, errors as large as the covariance says, and evidence of motions."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from bidnerf import SE3, Intrinsics
from bidnerf_core.camera import AT_REST, STILL, MotionPrior, exposure_times
from bidnerf_core.mapping import (
    CAMERA,
    MOTION,
    Normal,
    Sightings,
    Sights,
    States,
    log_evidence,
    project,
    resections,
    true_intrinsics,
)

# Inside: the size of the batches, on which nothing may depend
from bidnerf_core.mapping.resection.reprojection import BATCH

TRUE = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3], dtype=torch.float64))
OFF = torch.full((6,), 0.03, dtype=torch.float64)
FOCAL, HEIGHT = 400.0, 480.0
MOVED = torch.tensor([0.01, -0.02, 0.005, 0.01, 0.005, -0.015], dtype=torch.float64)
OPEN = MotionPrior(move=0.05, turn=0.02)


def seen(
    images: int, count: int = 200, noise: float = 0.0, motion: Tensor = AT_REST, off: Tensor = 0 * OFF
) -> tuple[Sightings, Tensor]:
    """Return what images with one true pose see of points two to six metres away, and the points.

    The given poses are ``off`` by an update. The pose at each row is the exponential of the ``motion`` so far.
    """
    random = torch.Generator().manual_seed(count)
    flat = (torch.rand((count, 2), generator=random, dtype=torch.float64) - 0.5) * 1.2
    z = 2 + 4 * torch.rand((count, 1), generator=random, dtype=torch.float64)
    local, times = torch.cat([flat * z, z], -1), flat[:, 1] * FOCAL / HEIGHT
    for _ in range(20):  # the row on which a point appears depends on the pose at that row
        there = SE3.exp(-times[:, None] * motion).apply(local)
        flat = there[:, :2] / there[:, 2:]
        times = flat[:, 1] * FOCAL / HEIGHT
    m, given = images * count, TRUE.retract(off)
    image = flat.repeat(images, 1) + noise / FOCAL * torch.randn((m, 2), generator=random, dtype=torch.float64)
    found = Sightings(
        torch.arange(count).repeat(images),
        torch.arange(images).repeat_interleave(count),
        given.rotation.mT.expand(m, 3, 3),
        given.translation.expand(m, 3),
        image,
        torch.full((m,), FOCAL, dtype=torch.float64),
        times.repeat(images),
    )
    return found, TRUE.apply(local)


def resected(
    sightings: Sightings,
    points: Tensor,
    correlation: float = 1.0,
    motions: tuple[MotionPrior, ...] = (STILL,),
) -> tuple[States, Normal]:
    """Return the states of all images, which must fit into one batch."""
    images = torch.bincount(sightings.view).nonzero()[:, 0]
    ((_, states, normal),) = resections(sightings, points, images, correlation, motions)
    return states, normal


def chi_squared(states: States, normal: Normal) -> Tensor:
    """Return the squared Mahalanobis distances of the estimated updates from zero."""
    update = states.T.log()
    covariance = torch.linalg.inv(normal.hessian)[:, :6, :6]
    return (update * torch.linalg.solve(covariance, update)).sum(-1)


def test_exact_sightings_give_exact_poses() -> None:
    states, _ = resected(*seen(3, off=OFF))
    assert float((TRUE.retract(OFF) @ states.T).translation.sub(TRUE.translation).norm(dim=-1).max()) < 1e-6
    assert float((states.T.log() - (TRUE.retract(OFF).inverse() @ TRUE).log()).abs().max()) < 1e-6


@pytest.mark.parametrize(
    ("count", "motion", "mean", "inside"),
    [(20, STILL, 9.0, 0.8), (40, STILL, 7.0, 0.9), (200, STILL, 7.0, 0.9), (200, OPEN, 7.0, 0.9)],
)
def test_poses_are_off_by_as_much_as_the_covariance_says(
    count: int, motion: MotionPrior, mean: float, inside: float
) -> None:
    """Poses fit 20 points so closely that their noise is underestimated."""
    data = seen(4 * BATCH, count, 0.5, AT_REST if motion == STILL else MOVED)
    found = resections(*data, torch.arange(4 * BATCH), motions=(motion,))
    squared = torch.cat([chi_squared(states, normal) for _, states, normal in found])
    assert 5 < float(squared.mean()) < mean  # of six degrees of freedom: 6
    assert inside < float((squared < chi2.ppf(0.95, 6)).double().mean()) <= 0.98


def test_correlated_sightings_count_less() -> None:
    data = seen(1, noise=0.5)
    one, four = (torch.linalg.inv(resected(*data, c)[1].hessian[0, :6, :6]) for c in (1.0, 4.0))
    torch.testing.assert_close(four, 4 * one, rtol=0.01, atol=1e-9)


def test_outliers_do_not_move_the_pose() -> None:
    sightings, points = seen(1, noise=0.2, off=OFF)
    sightings.image[::4] += 0.1  # 40 pixels
    update = (TRUE.inverse() @ TRUE.retract(OFF) @ resected(sightings, points)[0].T).log()
    assert float(update.norm()) < 2e-3


def test_an_image_is_resected_alike_alone_and_among_others() -> None:
    sightings, points = seen(BATCH + 5, noise=0.5, off=OFF)
    sightings = sightings[(sightings.view != 2) & ((sightings.point < 50) | (sightings.view % 3 > 0))]
    images = torch.bincount(sightings.view).nonzero()[:, 0]
    together = {
        int(image): states.T[i]
        for numbers, states, _ in resections(sightings, points, images)
        for i, image in enumerate(numbers)
    }
    assert sorted(together) == images.tolist()
    for image in (0, 1, BATCH + 4):
        alone, normal = resected(sightings[sightings.view == image], points)
        update = (alone.T[0].inverse() @ together[image]).log()
        assert float(update @ normal.hessian[0, :6, :6] @ update) < 0.01


def test_a_motion_between_rows_is_found_and_no_longer_shifts_the_pose() -> None:
    states, _ = resected(*seen(1, motion=MOVED, off=OFF), motions=(STILL, OPEN))
    error = (TRUE.inverse() @ TRUE.retract(OFF) @ states.T).log().norm(dim=-1)
    assert float(error[1]) < 3e-4
    assert float(error[0]) > 10 * float(error[1])
    torch.testing.assert_close(states.nuisances[1, MOTION], MOVED, atol=3e-4, rtol=0)
    assert not states.nuisances[0].any()


@pytest.mark.parametrize("count", [40, 200])
@pytest.mark.parametrize(("motion", "moved"), [(MOVED, True), (AT_REST, False)], ids=["moving", "still"])
def test_a_motion_is_evident_where_there_was_one(motion: Tensor, moved: bool, count: int) -> None:
    states, normal = resected(*seen(BATCH, count, 0.5, motion), motions=(STILL, OPEN))
    still, moving = log_evidence(states, normal).view(2, -1)
    assert float(((moving > still) == moved).double().mean()) > 0.9


def test_true_intrinsics_project_as_the_states_do() -> None:
    stated = Intrinsics(FOCAL, FOCAL, 320.0, 240.0, 640, 480)
    states = States.known(SE3.identity(), torch.tensor([0.05, 0.01, -0.02, 0.03, 0.04, 0.0], dtype=torch.float64))
    points = torch.tensor([[0.3, -0.2, 1.0], [-1.0, 0.8, 2.0]], dtype=torch.float64)
    rotation, zero = torch.eye(3, dtype=torch.float64).expand(2, 3, 3), torch.zeros_like(points)
    flat = project(states, points, Sights(points[:, :2], zero[:, 0], rotation, zero)).image[0]
    expected = flat * FOCAL + torch.tensor([320.0, 240.0])
    torch.testing.assert_close(true_intrinsics(stated, states.nuisances[0, CAMERA]).project(points), expected)


def test_rows_of_upright_images_are_their_columns() -> None:
    pixels = torch.tensor([[0.0, 0.0], [320.0, 120.0], [640.0, 480.0]])
    wide = Intrinsics(400.0, 400.0, 320.0, 240.0, 640, 480)
    upright = Intrinsics(400.0, 400.0, 240.0, 320.0, 480, 640)
    assert exposure_times(pixels, wide).tolist() == [-0.5, -0.25, 0.5]
    assert exposure_times(pixels.flip(-1), upright).tolist() == [-0.5, -0.25, 0.5]
