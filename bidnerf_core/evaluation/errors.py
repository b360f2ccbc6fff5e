"""How wrong a pose is, and whether that counts as success. Poses are ``T_world_camera``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from scipy.stats import binomtest
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class PoseError:
    """Of one pose, or of a batch: of all steps of a run, say."""

    translation: Float[Tensor, "*b"]  # metres between the camera centres
    rotation_deg: Float[Tensor, "*b"]  # geodesic angle, degrees, 0 to 180

    def __getitem__(self, index: Any) -> PoseError:
        return PoseError(self.translation[index], self.rotation_deg[index])


def pose_error(found: SE3, true: SE3) -> PoseError:
    """In float64; batches broadcast. Not finite where a pose is not."""
    found, true = found.to(dtype=torch.float64), true.to(dtype=torch.float64)
    distance = torch.linalg.vector_norm(found.translation - true.translation, dim=-1)
    return PoseError(distance, torch.rad2deg(rotation_angle(true.rotation.mT @ found.rotation)))


def normalized_error_squared(
    found: SE3, true: SE3, covariance: Float[Tensor, "*c 6 6"]
) -> Float[Tensor, "*b"]:
    """``xi^T C^-1 xi`` with ``true = found exp(xi)``: chi-squared with 6 degrees of freedom where C tells the truth
    (Bar-Shalom et al. 2001, "Estimation with applications to tracking and navigation", 5.4.2).

    Infinite or not a number where the covariance has no inverse.
    """
    xi = (found.to(dtype=torch.float64).inverse() @ true.to(dtype=torch.float64)).log()
    solved, _ = torch.linalg.solve_ex(covariance.double(), xi[..., None])
    return (xi * solved[..., 0]).sum(-1)


def rotation_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Radians, 0 to pi. ``acos`` of the trace would lose half of the digits near both ends, ``atan2`` loses none."""
    skewed = rotation - rotation.mT
    twice_axis = torch.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], dim=-1)
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(torch.linalg.vector_norm(twice_axis, dim=-1), trace - 1)  # both twice sin and cos


@runtime_checkable
class Criterion(Protocol):
    """Whether an error counts as success, given the error that the start had. A pose that is not finite never does."""

    def __call__(self, error: PoseError, start: PoseError) -> Bool[Tensor, "*b"]: ...


@dataclass(frozen=True)
class Reduced:
    """The centre came to within ``fraction`` of the distance it started at (BID-NeRF, section IV)."""

    fraction: float

    def __call__(self, error: PoseError, start: PoseError) -> Bool[Tensor, "*b"]:
        return (error.translation <= self.fraction * start.translation) & error.rotation_deg.isfinite()


@dataclass(frozen=True)
class Within:
    """Both errors are under a bar, wherever the start was."""

    rotation_deg: float
    translation: float  # metres

    def __call__(self, error: PoseError, start: PoseError) -> Bool[Tensor, "*b"]:
        return (error.rotation_deg < self.rotation_deg) & (error.translation < self.translation)


CRITERIA: dict[str, Criterion] = {
    "10%": Reduced(0.1),
    "5deg 0.05": Within(5.0, 0.05),
    "1deg 0.02": Within(1.0, 0.02),
}
"""Reported side by side: the one of the paper, a usual one, a strict one."""


def steps_to_success(trace: PoseError, criterion: Criterion) -> int | None:
    """The first step from which on the error stays under the bar; None where it is over it at the end.

    ``trace`` has one axis: entry 0 is the start's error, entry n the error after step n.
    """
    if trace.translation.dim() != 1 or len(trace.translation) == 0:
        shape = tuple(trace.translation.shape)
        raise InputError(
            f"steps to success: expected errors of the start and of each step, got shape {shape}"
        )
    failures = (~criterion(trace, trace[0])).nonzero()
    first = int(failures[-1]) + 1 if len(failures) else 0
    return first if first < len(trace.translation) else None


@dataclass(frozen=True)
class Rate:
    """A share of successes and the ends of Wilson's interval for it."""

    successes: int
    trials: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        return self.successes / self.trials

    def __str__(self) -> str:
        count = f"{self.successes} of {self.trials}"
        return f"{self.rate:.1%} ({count}; {self.low:.1%} to {self.high:.1%})"


def success_rate(successes: int, trials: int, confidence: float = 0.95) -> Rate:
    if not (trials >= 1 and 0 <= successes <= trials):
        raise InputError(f"success rate: {successes} of {trials}, expected 0 to n of at least one trial")
    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return Rate(successes, trials, float(interval.low), float(interval.high))
