"""Errors of poses (``T_world_camera``) and of trajectories, and criteria for success.

The errors of a trajectory are measured without alignment (raw), after a rigid alignment (ATE), and for the motion between
frames (RPE), as in Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems". Poses in a map need no
alignment, so the raw error is what counts; ATE and RPE allow comparison with odometry.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from statistics import NormalDist
from typing import Any, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, LengthUnit, chi_squared_quantile, fit_similarity, symbol


@dataclass(frozen=True, eq=False)
class PoseError:
    """The translation and rotation error of one pose, or of a batch of poses such as all steps of a run."""

    translation: Float[Tensor, "*b"]  # between the camera centres, in ``unit``
    rotation_deg: Float[Tensor, "*b"]  # geodesic angle, degrees, 0 to 180
    unit: LengthUnit = "units"  # of the poses

    def __getitem__(self, index: Any) -> PoseError:
        return replace(self, translation=self.translation[index], rotation_deg=self.rotation_deg[index])

    def __str__(self) -> str:
        shown = (
            (float(v.quantile(0.5)), "median ") if v.ndim else (float(v), "")
            for v in (self.translation, self.rotation_deg)
        )
        return " and ".join(
            f"{note}{v:.3g} {unit}" for (v, note), unit in zip(shown, (symbol(self.unit), "deg"), strict=True)
        )

    def plain(self) -> dict[str, float] | None:
        """Return the error of one pose as JSON values, or None if it is not finite."""
        values = {"translation": float(self.translation), "rotation_deg": float(self.rotation_deg)}
        return values if all(map(math.isfinite, values.values())) else None


def pose_error(estimated: SE3, true: SE3, unit: LengthUnit = "units") -> PoseError:
    """Return the error of ``estimated`` relative to ``true`` in float64, with broadcasting over batches.

    The error is not finite if a pose is not finite. ``unit`` is the length unit of the poses, used to print the
    error.
    """
    estimated, true = estimated.to(dtype=torch.float64), true.to(dtype=torch.float64)
    distance = torch.linalg.vector_norm(estimated.translation - true.translation, dim=-1)
    return PoseError(distance, torch.rad2deg(rotation_angle(true.rotation.mT @ estimated.rotation)), unit)


def normalized_error_squared(estimated: SE3, true: SE3, covariance: Float[Tensor, "*c 6 6"]) -> Float[Tensor, "*b"]:
    """Return the squared error normalized by its covariance C: ``xi^T C^-1 xi`` with ``true = estimated exp(xi)``.

    xi and C hold the translation (unit of the poses), then the rotation (radians). If C is consistent, the
    result follows a chi-squared distribution with 6 degrees of freedom (Bar-Shalom et al. 2001, "Estimation
    with applications to tracking and navigation", 5.4.2). It is infinite or NaN if C has no inverse.
    """
    xi = (estimated.to(dtype=torch.float64).inverse() @ true.to(dtype=torch.float64)).log()
    solved, _ = torch.linalg.solve_ex(covariance.double(), xi[..., None])
    return (xi * solved[..., 0]).sum(-1)


def standard_deviations(covariance: Float[Tensor, "6 6"]) -> tuple[float, float]:
    """Return the standard deviations of position (metres) and rotation (radians), given their covariance (position first)."""
    position, rotation = (float(part.sum().clamp(min=0).sqrt()) for part in covariance.diagonal().split(3))
    return position, rotation


def within(estimated: SE3, true: SE3, covariance: Float[Tensor, "*c 6 6"]) -> Bool[Tensor, "*b"]:
    """Return whether the error of ``estimated`` lies within the 95 % confidence bound that its covariance implies.

    The bound is the quantile of the chi-squared distribution with 6 degrees of freedom, 12.59. If the covariances are
    consistent, 95 % of the errors lie within the bound. The result is False if the covariance has no inverse.
    """
    return normalized_error_squared(estimated, true, covariance) <= chi_squared_quantile(0.95, 6)


def rotation_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return the angle of a rotation (radians, 0 to pi); ``acos`` of the trace would lose half of the digits near 0 and pi."""
    skewed = rotation - rotation.mT
    twice_axis = torch.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], dim=-1)
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(torch.linalg.vector_norm(twice_axis, dim=-1), trace - 1)  # twice sine and cosine


@dataclass(frozen=True)
class Reduced:
    """Success if the translation error is at most ``fraction`` of the start's translation error (BID-NeRF, section IV).

    A pose that is not finite never succeeds.
    """

    fraction: float

    def __call__(self, error: PoseError, start: PoseError) -> Bool[Tensor, "*b"]:
        return (error.translation <= self.fraction * start.translation) & error.rotation_deg.isfinite()


@dataclass(frozen=True)
class Within:
    """Success if the rotation and translation errors are below fixed thresholds, regardless of the start."""

    rotation_deg: float
    translation: float  # metres

    def __call__(self, error: PoseError, start: PoseError) -> Bool[Tensor, "*b"]:
        return (error.rotation_deg < self.rotation_deg) & (error.translation < self.translation)


Criterion: TypeAlias = Reduced | Within
"""Decides whether an error counts as success, given the error of the start."""

CRITERIA: dict[str, Criterion] = {
    "10%": Reduced(0.1),
    "5deg 0.05": Within(5.0, 0.05),
    "1deg 0.02": Within(1.0, 0.02),
}
"""The criteria reported side by side: that of BID-NeRF, a common one and a strict one."""


def steps_to_success(trace: PoseError, criterion: Criterion) -> int | None:
    """Return the first step from which the criterion holds to the end; None if it does not hold at the end.

    ``trace`` has one axis: entry 0 is the start's error, entry n the error after step n.
    """
    if trace.translation.dim() != 1 or len(trace.translation) == 0:
        shape = tuple(trace.translation.shape)
        raise InputError(f"expected errors of the start and of each step, got shape {shape}", where="steps to success")
    failures = (~criterion(trace, trace[0])).nonzero()
    first = int(failures[-1]) + 1 if len(failures) else 0
    return first if first < len(trace.translation) else None


@dataclass(frozen=True)
class Rate:
    """A success rate and its Wilson interval, which accounts for repeated trials of the same frame."""

    successes: int
    trials: int
    low: float
    high: float
    frames: int | None = None  # number of distinct frames, if some were tried several times

    @property
    def rate(self) -> float:
        return self.successes / self.trials


def success_rate(successes: int, trials: int, effective: float = 0.0, frames: int | None = None) -> Rate:
    """Return the success rate of trials with Wilson's 95 % interval (Wilson 1927).

    ``effective`` is the number of independent trials, which need not be an integer, by default ``trials``.
    """
    if not (trials >= 1 and 0 <= successes <= trials):
        raise InputError(f"{successes} of {trials}", where="success rate", expected="0 to n of at least one trial")
    share, z, n = successes / trials, NormalDist().inv_cdf(0.975), effective or trials
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2)
    low, high = min(middle - half, share), max(middle + half, share)  # up to rounding
    return Rate(successes, trials, max(low, 0.0), min(high, 1.0), frames)


def success_rate_by_frame(outcomes: Sequence[bool], frames: Sequence[Hashable]) -> Rate:
    """Return the success rate of trials that repeat frames, with a 95 % interval that accounts for the repetition.

    Trials of the same frame share its difficulty. The interval is Wilson's for the effective number of trials:
    the number of independent trials whose rate would vary as much as the observed rate varies from frame to
    frame (Korn and Graubard 1998, "Confidence intervals for proportions with small expected number of positive
    counts estimated from survey data"; Dean and Pagano 2015). If all trials have the same outcome, nothing
    shows how similar the trials of one frame are, and each frame counts once.
    """
    trials, successes = len(outcomes), sum(map(bool, outcomes))
    grouped: dict[Hashable, list[bool]] = {}
    for outcome, frame in zip(outcomes, frames, strict=True):
        grouped.setdefault(frame, []).append(bool(outcome))
    count = len(grouped)
    if count in (0, trials):
        return success_rate(successes, trials)
    share, effective = successes / trials, float(count)
    if count > 1 and 0 < successes < trials:
        from scipy.stats import t  # imported here, because it takes longer than any help page should

        squares = sum((sum(own) - share * len(own)) ** 2 for own in grouped.values())
        variance = count / (count - 1) * squares / trials**2
        quantiles = t.ppf(0.975, [trials - 1, count - 1])
        correction = float(quantiles[0] / quantiles[1]) ** 2
        size = correction * share * (1 - share) / variance if variance > 0 else math.inf
        effective = min(max(size, 1.0), float(trials))
    return success_rate(successes, trials, effective, count)


@dataclass(frozen=True)
class ErrorSummary:
    """Median, 95th percentile and root mean square of translation and rotation errors."""

    translation_median: float  # in ``unit``
    translation_p95: float
    translation_rmse: float
    rotation_deg_median: float
    rotation_deg_p95: float
    rotation_deg_rmse: float
    unit: LengthUnit = "units"  # of the translations

    @staticmethod
    def of(errors: PoseError) -> ErrorSummary:
        """Return the summary of a batch of errors. Raises ``InputError`` for an empty batch."""
        if not errors.translation.numel():
            raise InputError("no errors to summarize", expected="those of at least one pose")
        t, r = (
            (*values.quantile(values.new_tensor([0.5, 0.95])).tolist(), float(values.square().mean().sqrt()))
            for values in (errors.translation.double(), errors.rotation_deg.double())
        )
        return ErrorSummary(t[0], t[1], t[2], r[0], r[1], r[2], errors.unit)

    def __str__(self) -> str:
        unit = symbol(self.unit)
        return (
            f"median {self.translation_median:.4f} {unit}, {self.rotation_deg_median:.3f} deg;"
            f" 95 % within {self.translation_p95:.4f} {unit}, {self.rotation_deg_p95:.3f} deg"
        )


@dataclass(frozen=True)
class TrajectoryErrors:
    """The errors of a trajectory; a measure is None if there are too few poses for it."""

    poses: int
    raw: ErrorSummary
    ate: float | None  # in the unit of ``raw``: root mean square distance after a rigid alignment
    rpe: ErrorSummary | None  # of the motion between consecutive poses

    @staticmethod
    def of(estimated: SE3, true: SE3, unit: LengthUnit = "units") -> TrajectoryErrors:
        """Compare estimated with true poses ``T_world_camera`` (n, in ``unit``), in chronological order.

        Raises ``InputError`` if there are no poses.
        """
        count = len(estimated.translation)
        # Fewer than three poses do not determine an alignment.
        distances = alignment_errors(estimated, true) if count >= 3 else None
        return TrajectoryErrors(
            count,
            ErrorSummary.of(pose_error(estimated, true, unit)),
            None if distances is None else float(distances.square().mean().sqrt()),
            ErrorSummary.of(replace(relative_errors(estimated, true), unit=unit)) if count > 1 else None,
        )


def alignment_errors(estimated: SE3, true: SE3) -> Float[Tensor, "n"] | None:
    """Return the absolute trajectory error of each pose: its distance from the true position after a rigid alignment.

    The alignment minimizes the squared distances between the estimated and the true camera centres, without scaling. The
    errors are in the unit of the poses. Returns None if the camera did not move, since the rotation is then undetermined.
    """
    source, target = estimated.translation.double(), true.translation.double()
    try:
        rotation = fit_similarity(source, target).T_target_source.rotation
    except InputError:
        return None
    return torch.linalg.vector_norm((source - source.mean(0)) @ rotation.mT - (target - target.mean(0)), dim=-1)


def relative_errors(estimated: SE3, true: SE3) -> PoseError:
    """Return the relative pose errors (n - 1) of the motion between consecutive poses (Sturm et al. 2012, eq. 2)."""
    estimated, true = estimated.to(torch.float64), true.to(torch.float64)
    moved = [T[:-1].inverse() @ T[1:] for T in (estimated, true)]
    return pose_error(moved[0], moved[1])


def spans(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return each run of true flags as its first and last index, both inclusive."""
    runs = (list(group) for flag, group in groupby(range(len(flags)), flags.__getitem__) if flag)
    return [(run[0], run[-1]) for run in runs]
