"""Errors of trajectories: raw, after alignment (ATE), and of the motion between frames (RPE).

The measures follow Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems". Poses in a map
need no alignment, so their raw error is what counts; the others make them comparable with odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, LengthUnit, Similarity, fit_similarity, symbol
from bidnerf_core.results.errors import PoseError, pose_error


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
        """Return the summary of a batch of errors. Raises ``InputError`` for an empty one."""
        if not errors.translation.numel():
            raise InputError("no errors to summarize", expected="those of at least one pose")
        return ErrorSummary(*_three(errors.translation), *_three(errors.rotation_deg), errors.unit)

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
    def of(found: SE3, true: SE3, unit: LengthUnit = "units") -> TrajectoryErrors:
        """Compare poses ``T_world_camera`` (n, in ``unit``), in chronological order.

        Raises ``InputError`` if there are none.
        """
        count = len(found.translation)
        # Fewer than three poses do not determine an alignment.
        distances = alignment_errors(found, true) if count >= 3 else None
        return TrajectoryErrors(
            count,
            ErrorSummary.of(pose_error(found, true, unit)),
            None if distances is None else float(distances.square().mean().sqrt()),
            ErrorSummary.of(replace(relative_errors(found, true), unit=unit)) if count > 1 else None,
        )


def alignment_errors(found: SE3, true: SE3) -> Float[Tensor, "n"] | None:
    """Return the absolute trajectory error of each pose: its distance (metres) from the truth after a rigid alignment.

    The alignment brings the camera centres nearest to the true ones, without scaling. Returns None if the camera did not move,
    since the rotation is then undetermined.
    """
    source, target = found.translation.double(), true.translation.double()
    try:
        rotation = fit_similarity(source, target).T_target_source.rotation
    except InputError:
        return None
    return torch.linalg.vector_norm(
        (source - source.mean(0)) @ rotation.mT - (target - target.mean(0)), dim=-1
    )


def relative_errors(found: SE3, true: SE3) -> PoseError:
    """Return the relative pose errors (n - 1), of the motion from each pose to the next (Sturm et al. 2012, eq. 2)."""
    found, true = found.to(torch.float64), true.to(torch.float64)
    moved = [T[:-1].inverse() @ T[1:] for T in (found, true)]
    return pose_error(moved[0], moved[1])


def world_of_truth(found: SE3, true: SE3) -> Similarity | None:
    """Return the similarity that maps the world of the ``true`` poses to that of the ``found`` ones (n each).

    None unless it explains all errors. Its rotation is the mean of those between the orientations, so that the
    positions confirm it.
    """
    # A transformation of seven degrees of freedom explains nearly any errors of fewer poses.
    if len(found.translation) < 3:
        return None
    found, true = found.to(torch.float64), true.to(torch.float64)
    u, _, vh = torch.linalg.svd((found.rotation @ true.rotation.mT).sum(0))
    sign = torch.ones(3, dtype=u.dtype)
    sign[2] = torch.sign(torch.linalg.det(u @ vh))
    rotation = (u * sign) @ vh
    source, target = true.translation @ rotation.mT, found.translation
    from_mean, to_mean = source - source.mean(0), target - target.mean(0)
    scale = float((from_mean * to_mean).sum() / from_mean.square().sum())
    if not scale > 0:
        return None
    worlds = Similarity(scale, SE3(rotation, target.mean(0) - scale * source.mean(0)))
    left, error = (
        torch.linalg.vector_norm(source - target, dim=-1)
        for source in (worlds.apply(true.translation), true.translation)
    )
    # No pose may keep more than a tenth of the median error.
    return worlds if bool(left.max() < 0.1 * error.median()) else None


def spans(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return the runs of true flags as (first, last), both included."""
    found: list[tuple[int, int]] = []
    for place, flag in enumerate(flags):
        if flag and found and found[-1][1] == place - 1:
            found[-1] = (found[-1][0], place)
        elif flag:
            found.append((place, place))
    return found


def _three(values: Float[Tensor, "n"]) -> tuple[float, float, float]:
    values = values.double()
    return float(values.quantile(0.5)), float(values.quantile(0.95)), float(values.square().mean().sqrt())
