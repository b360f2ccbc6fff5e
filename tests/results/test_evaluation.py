"""Pose errors, success and starts: laws, extremes, and scipy as a second opinion."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest, chi2, kstest

from bidnerf.evaluation import bid_start
from bidnerf.results import (
    CRITERIA,
    PoseError,
    Reduced,
    normalized_error_squared,
    pose_error,
    steps_to_success,
    success_rate,
    success_rate_by_frame,
    within,
)

# Inside: the angles of rotations near zero and pi, and criteria with other bars
from bidnerf.results.errors import Within, rotation_angle
from bidnerf_core.geometry import SE3, perturb, random_units
from refusals import refused

tangents = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(lambda x: torch.tensor(x, dtype=torch.float64))


def trace(translation: list[float], rotation_deg: list[float] | None = None) -> PoseError:
    far = torch.tensor(translation, dtype=torch.float64)
    return PoseError(far, torch.zeros_like(far) if rotation_deg is None else far.new_tensor(rotation_deg))


def test_the_median_of_an_even_number_of_errors_is_between_the_middle_ones() -> None:
    assert str(trace([1.0, 2.0, 4.0, 9.0])) == "median 3 units and median 0 deg"


@given(tangents, tangents)
def test_error_agrees_with_scipy(a: torch.Tensor, b: torch.Tensor) -> None:
    one, two = SE3.exp(a), SE3.exp(b)
    error = pose_error(one, two)
    expected = (
        Rotation.from_matrix(one.rotation.numpy()).inv() * Rotation.from_matrix(two.rotation.numpy())
    ).magnitude()
    assert float(error.rotation_deg) == pytest.approx(math.degrees(expected), abs=1e-6)
    assert float(error.translation) == pytest.approx(np.linalg.norm(one.translation - two.translation), abs=1e-12)


def test_normalized_errors_of_an_honest_covariance_are_chi_squared() -> None:
    generator = torch.Generator().manual_seed(0)
    spread = 0.05 * torch.randn((6, 6), generator=generator, dtype=torch.float64)
    covariance = spread @ spread.mT
    true = SE3.exp(torch.randn(6, generator=generator, dtype=torch.float64))
    drawn = torch.randn((4000, 6), generator=generator, dtype=torch.float64) @ spread.mT
    found = true @ SE3.exp(drawn).inverse()
    values = normalized_error_squared(found, true, covariance)
    assert kstest(values.numpy(), chi2(6).cdf).pvalue > 0.01
    assert float(within(found, true, covariance).double().mean()) == pytest.approx(0.95, abs=0.02)
    expected = np.einsum("bi,ij,bj->b", drawn.numpy(), np.linalg.inv(covariance.numpy()), drawn.numpy())
    assert values.numpy() == pytest.approx(expected, rel=1e-6)


def test_normalized_error_without_an_inverse_is_no_finite_number() -> None:
    nothing = torch.zeros((6, 6), dtype=torch.float64)
    xi = torch.ones(6, dtype=torch.float64)
    assert not normalized_error_squared(SE3.exp(xi), SE3.identity(), nothing).isfinite()
    assert not bool(within(SE3.exp(xi), SE3.exp(xi), nothing))


@given(tangents, tangents, tangents)
def test_error_is_a_distance_that_no_common_motion_changes(a: torch.Tensor, b: torch.Tensor, c: torch.Tensor) -> None:
    one, two, move = SE3.exp(a), SE3.exp(b), SE3.exp(c)
    error, back, moved = pose_error(one, two), pose_error(two, one), pose_error(move @ one, move @ two)
    for other in (back, moved):
        assert float(other.translation) == pytest.approx(float(error.translation), abs=1e-9)
        assert float(other.rotation_deg) == pytest.approx(float(error.rotation_deg), abs=1e-6)
    via = pose_error(one, move).rotation_deg + pose_error(move, two).rotation_deg
    assert error.rotation_deg <= via + 1e-6
    assert float(pose_error(one, one).rotation_deg) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0, math.pi / 2, 3.0, math.pi - 1e-6, math.pi - 1e-9, math.pi]
)
def test_angle_keeps_its_digits_at_both_ends(angle: float, generator: torch.Generator) -> None:
    for axis in random_units(20, generator):
        rotation = torch.from_numpy(Rotation.from_rotvec(angle * axis.numpy()).as_matrix())
        assert float(rotation_angle(rotation)) == pytest.approx(angle, abs=1e-15, rel=1e-6 if angle < 1 else 1e-14)


def test_error_of_a_batch_and_of_what_is_not_finite() -> None:
    true = SE3.identity()
    batch = SE3.exp(torch.diag(torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, torch.nan], dtype=torch.float64)))
    error = pose_error(batch, true)
    assert error.translation[:3].tolist() == pytest.approx([1, 2, 3])
    assert error.rotation_deg[3:5].deg2rad().tolist() == pytest.approx([0.1, 0.2])
    assert not error.rotation_deg[5].isfinite()
    for criterion in CRITERIA.values():
        assert not criterion(error, error[0])[5]
    half = SE3(true.rotation.float(), true.translation.float())
    assert pose_error(half, true).translation.dtype == torch.float64


def test_criteria_have_their_bars() -> None:
    start = trace([1.0], [10.0])[0]
    error = trace([0.1, 0.11, 0.04, 0.019, 0.019, 0.05], [90.0, 0.0, 4.9, 0.9, 1.1, 0.0])
    assert list(CRITERIA) == ["10%", "5deg 0.05", "1deg 0.02"]
    found = [criterion(error, start).tolist() for criterion in CRITERIA.values()]
    assert found == [
        [True, False, True, True, True, True],
        [False, False, True, True, True, False],
        [False, False, False, True, False, False],
    ]


@pytest.mark.parametrize(
    ("translation", "steps"),
    [
        ([1.0, 0.5, 0.09, 0.08], 2),
        ([1.0, 0.05, 0.2, 0.01], 3),  # it left again: that was no success
        ([1.0, 0.05, 0.2], None),
        ([1.0], None),
        ([1.0, 0.05, math.nan, 0.05], 3),
        ([1.0, 0.05, math.nan], None),
        ([0.0, 0.0], 0),
    ],
)
def test_steps_to_success(translation: list[float], steps: int | None) -> None:
    assert steps_to_success(trace(translation), Reduced(0.1)) == steps


def test_a_start_that_is_good_enough_takes_no_step() -> None:
    assert steps_to_success(trace([0.01, 0.01]), Within(5, 0.05)) == 0
    assert steps_to_success(trace([0.01, 0.1, 0.01]), Within(5, 0.05)) == 2
    for bad in (trace([]), PoseError(torch.zeros(()), torch.zeros(()))):
        with refused(where="steps to success", found=f"shape {tuple(bad.translation.shape)}"):
            steps_to_success(bad, Within(5, 0.05))


@pytest.mark.parametrize("trials", [1, 8, 24, 1000])
def test_wilson_interval(trials: int) -> None:
    for successes in {0, 1, trials // 2, trials}:
        found = success_rate(successes, trials)
        expected = binomtest(successes, trials).proportion_ci(method="wilson")
        assert (found.low, found.high) == pytest.approx(tuple(expected), abs=1e-9)
        assert 0 <= found.low <= found.rate <= found.high <= 1
    known = success_rate(23, 24)
    assert (known.low, known.high) == pytest.approx((0.798, 0.993), abs=5e-4)


def test_trials_of_one_frame_are_not_independent() -> None:
    frames = [n // 4 for n in range(24)]
    alike = success_rate_by_frame([True] * 24, frames)
    assert (alike.low, alike.high) == pytest.approx((success_rate(6, 6).low, 1.0))  # six frames tell what six tell
    assert (alike.successes, alike.trials, alike.frames) == (24, 24, 6)
    assert alike.low == pytest.approx(0.61, abs=5e-4)
    split = success_rate_by_frame([frame < 3 for frame in frames], frames)
    whole = success_rate(3, 6)
    assert split.low <= whole.low < 0.5 < whole.high <= split.high
    assert success_rate_by_frame([True, False, True], [1, 2, 3]) == success_rate(2, 3)


def test_intervals_by_frames_hold_what_they_promise() -> None:
    """Frames succeed with their own probability, with mean 0.7; trials of a frame are independent given it."""
    generator = np.random.default_rng(2)
    inside = plain = 0
    for _ in range(300):
        share = generator.beta(0.7, 0.3, size=12).repeat(6)
        outcomes = (generator.random(72) < share).tolist()
        found = success_rate_by_frame(outcomes, np.arange(12).repeat(6).tolist())
        inside += found.low <= 0.7 <= found.high
        every = success_rate(sum(outcomes), 72)
        plain += every.low <= 0.7 <= every.high
    assert inside > 270
    assert plain < 240


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 4)])
def test_impossible_counts_are_refused(successes: int, trials: int) -> None:
    with refused(where="success rate", found=f"{successes} of {trials}", expected="at least one trial"):
        success_rate(successes, trials)


@given(tangents, st.floats(0, 5), st.floats(0, 180), st.integers(0, 2**31))
def test_perturb_is_wrong_by_exactly_what_was_asked(
    tangent: torch.Tensor, translation: float, rotation: float, seed: int
) -> None:
    true = SE3.exp(tangent)
    error = pose_error(perturb(true, translation, rotation, seed), true)
    assert float(error.translation) == pytest.approx(translation, abs=1e-9)
    assert float(error.rotation_deg) == pytest.approx(rotation, abs=1e-6)


@pytest.mark.parametrize("widest", [math.pi / 4, 1.4])
@pytest.mark.parametrize("size", [0.5, 0.8, 1.2, 0.9, 1.7, 3.4])
def test_bid_has_the_lengths_of_its_tangent(widest: float, size: float) -> None:
    true = SE3.exp(torch.tensor([0.3, 1.0, -2.0, 0.5, -0.2, 0.9], dtype=torch.float64))
    starts = SE3.stack([bid_start(true, size, seed, widest) for seed in range(200)])
    tangents = (true.inverse() @ starts).log()
    assert tangents[:, :3].norm(dim=-1).tolist() == pytest.approx([size] * 200)
    assert tangents[:, 3:].norm(dim=-1).tolist() == pytest.approx([np.interp(size, (0.5, 3.4), (0.2, widest))] * 200)
    directions = torch.nn.functional.normalize(tangents.reshape(-1, 2, 3), dim=-1)
    assert directions.mean(0).abs().max() < 0.15  # three standard deviations of a mean of 200 uniform directions
    assert (directions[:, 0] * directions[:, 1]).sum(-1).mean().abs() < 0.15  # the two are independent


def test_starts_from_a_pose_of_few_digits_have_all_of_theirs() -> None:
    assert bool(bid_start(SE3.identity(torch.float32), 0.8, 0).is_rigid(1e-12))


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_impossible_lengths_are_refused(value: float) -> None:
    true = SE3.identity()
    for lengths in ((value, 1), (1, value)):
        with refused(where="perturbation", found=str(value), expected="finite numbers, 0 or more"):
            perturb(true, *lengths, 0)
