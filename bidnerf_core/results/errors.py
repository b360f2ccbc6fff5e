"""Errors of poses (``T_world_camera``), and criteria for success."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, LengthUnit, chi_squared_quantile, symbol


@dataclass(frozen=True, eq=False)
class PoseError:
    """The translation and rotation error of one pose or a batch, for example of all steps of a run."""

    translation: Float[Tensor, "*b"]  # between the camera centres, in ``unit``
    rotation_deg: Float[Tensor, "*b"]  # geodesic angle, degrees, 0 to 180
    unit: LengthUnit = "units"  # of the poses

    def __getitem__(self, index: Any) -> PoseError:
        return replace(self, translation=self.translation[index], rotation_deg=self.rotation_deg[index])

    def __str__(self) -> str:
        shown = (
            (float(v.median()), "median ") if v.ndim else (float(v), "")
            for v in (self.translation, self.rotation_deg)
        )
        return " and ".join(
            f"{note}{v:.3g} {unit}" for (v, note), unit in zip(shown, (symbol(self.unit), "deg"), strict=True)
        )

    def plain(self) -> dict[str, float] | None:
        """Return the error of one pose as JSON values, or None if it is not finite."""
        values = {"translation": float(self.translation), "rotation_deg": float(self.rotation_deg)}
        return values if all(map(math.isfinite, values.values())) else None


def pose_error(found: SE3, true: SE3, unit: LengthUnit = "units") -> PoseError:
    """Return the error of ``found`` in float64; batches broadcast. It is not finite if a pose is not.

    ``unit`` is that of the poses, for printing the error.
    """
    found, true = found.to(dtype=torch.float64), true.to(dtype=torch.float64)
    distance = torch.linalg.vector_norm(found.translation - true.translation, dim=-1)
    return PoseError(distance, torch.rad2deg(rotation_angle(true.rotation.mT @ found.rotation)), unit)


def normalized_error_squared(
    found: SE3, true: SE3, covariance: Float[Tensor, "*c 6 6"]
) -> Float[Tensor, "*b"]:
    """Return ``xi^T C^-1 xi`` with ``true = found exp(xi)``.

    It follows a chi-squared distribution with 6 degrees of freedom if the covariance C is consistent
    (Bar-Shalom et al. 2001, "Estimation with applications to tracking and navigation", 5.4.2). It is infinite
    or NaN if the covariance has no inverse.
    """
    xi = (found.to(dtype=torch.float64).inverse() @ true.to(dtype=torch.float64)).log()
    solved, _ = torch.linalg.solve_ex(covariance.double(), xi[..., None])
    return (xi * solved[..., 0]).sum(-1)


def standard_deviations(covariance: Float[Tensor, "6 6"]) -> tuple[float, float]:
    """Return the standard deviations of the position (metres) and of the rotation (radians) implied by a covariance."""
    position, rotation = (float(part.sum().clamp(min=0).sqrt()) for part in covariance.diagonal().split(3))
    return position, rotation


def within(
    found: SE3, true: SE3, covariance: Float[Tensor, "*c 6 6"], probability: float = 0.95
) -> Bool[Tensor, "*b"]:
    """Return whether the error of ``found`` lies within its covariance's bound for a probability.

    The bound is the quantile of the chi-squared distribution with 6 degrees of freedom, 12.59 for 0.95. With
    a consistent covariance, that fraction of errors lies within. False if the covariance has no inverse.
    """
    return normalized_error_squared(found, true, covariance) <= chi_squared_quantile(probability, 6)


def rotation_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return the angle in radians, 0 to pi. ``acos`` of the trace would lose half of the digits near either end."""
    skewed = rotation - rotation.mT
    twice_axis = torch.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], dim=-1)
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(torch.linalg.vector_norm(twice_axis, dim=-1), trace - 1)  # twice sine and cosine


@runtime_checkable
class Criterion(Protocol):
    """Decides whether an error counts as success, given the error of the start. A pose that is not finite never succeeds."""

    def __call__(self, error: PoseError, start: PoseError) -> Bool[Tensor, "*b"]: ...


@dataclass(frozen=True)
class Reduced:
    """Success if the translation error is at most ``fraction`` of the start's (BID-NeRF, section IV)."""

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


CRITERIA: dict[str, Criterion] = {
    "10%": Reduced(0.1),
    "5deg 0.05": Within(5.0, 0.05),
    "1deg 0.02": Within(1.0, 0.02),
}
"""The criteria reported side by side: the paper's, a common one and a strict one."""


def steps_to_success(trace: PoseError, criterion: Criterion) -> int | None:
    """Return the first step from which the criterion holds to the end; None if it does not hold at the end.

    ``trace`` has one axis: entry 0 is the start's error, entry n the error after step n.
    """
    if trace.translation.dim() != 1 or len(trace.translation) == 0:
        shape = tuple(trace.translation.shape)
        raise InputError(
            f"expected errors of the start and of each step, got shape {shape}", where="steps to success"
        )
    failures = (~criterion(trace, trace[0])).nonzero()
    first = int(failures[-1]) + 1 if len(failures) else 0
    return first if first < len(trace.translation) else None


@dataclass(frozen=True)
class Rate:
    """A success rate with the ends of its Wilson interval, which accounts for repeated trials of a frame."""

    successes: int
    trials: int
    low: float
    high: float
    frames: int | None = None  # number of distinct frames, if some were tried several times

    @property
    def rate(self) -> float:
        return self.successes / self.trials

    def __str__(self) -> str:
        count = f"{self.successes} of {self.trials}"
        on = "" if self.frames is None else f" on {self.frames} frame{'' if self.frames == 1 else 's'}"
        return f"{self.rate:.1%} ({count}{on}; {self.low:.1%} to {self.high:.1%})"


def success_rate(successes: int, trials: int, confidence: float = 0.95) -> Rate:
    """Return the success rate of independent trials with Wilson's interval (Wilson 1927)."""
    if not (trials >= 1 and 0 <= successes <= trials):
        raise InputError(
            f"{successes} of {trials}", where="success rate", expected="0 to n of at least one trial"
        )
    low, high = wilson_interval(successes / trials, trials, confidence)
    return Rate(successes, trials, low, high)


def success_rate_by_frame(
    outcomes: Sequence[bool], frames: Sequence[Hashable], confidence: float = 0.95
) -> Rate:
    """Return the success rate of trials that repeat some frames, with an interval that accounts for it.

    Trials of one frame share its difficulty. Wilson's interval is that of the effective number of trials: the
    number of independent ones whose rate would vary as much as this rate does from frame to frame (Korn and
    Graubard 1998, "Confidence intervals for proportions with small expected number of positive counts
    estimated from survey data"; Dean and Pagano 2015). If all trials have the same outcome, nothing shows how
    similar those of one frame are, and each frame counts once.
    """
    trials, successes = len(outcomes), sum(map(bool, outcomes))
    grouped: dict[Hashable, list[bool]] = {}
    for outcome, frame in zip(outcomes, frames, strict=True):
        grouped.setdefault(frame, []).append(bool(outcome))
    count = len(grouped)
    if count in (0, trials):
        return success_rate(successes, trials, confidence)
    share = successes / trials
    effective = float(count)
    if count > 1 and 0 < successes < trials:
        from scipy.stats import t  # imported here, because it takes longer than any help page should

        squares = sum((sum(own) - share * len(own)) ** 2 for own in grouped.values())
        variance = count / (count - 1) * squares / trials**2
        quantiles = [float(t.ppf(0.5 + confidence / 2, n - 1)) for n in (trials, count)]
        correction = (quantiles[0] / quantiles[1]) ** 2
        found = correction * share * (1 - share) / variance if variance > 0 else math.inf
        effective = min(max(found, 1.0), float(trials))
    low, high = wilson_interval(share, effective, confidence)
    return Rate(successes, trials, low, high, count)


def wilson_interval(share: float, trials: float, confidence: float = 0.95) -> tuple[float, float]:
    """Return the ends of Wilson's interval for a rate of ``trials``, which need not be an integer."""
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    middle = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(share * (1 - share) / trials + (z / (2 * trials)) ** 2)
    low, high = min(middle - half, share), max(middle + half, share)  # up to rounding
    return max(low, 0.0), min(high, 1.0)
