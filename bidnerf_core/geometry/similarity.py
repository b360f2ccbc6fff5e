"""Poses in other frames, units and conventions, and similarity transforms between corresponding points.

Pose covariances follow the convention of ``se3``: they belong to a right update ``T exp(xi)``, xi = (translation, rotation),
metres and radians, along the camera's own axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import FARTHEST_CAMERA, SE3

LengthUnit = Literal["metres", "units"]
"""Unit of length of poses: ``"units"`` if its size in metres is unknown, as after structure from motion."""
CovarianceConvention = Literal["bidnerf", "gtsam", "ros"]
"""Order and frame of the rows of a covariance.

- ``"bidnerf"``: translation, then rotation, of a right update in the camera's axes (as in Sophus).
- ``"gtsam"``: rotation, then translation, of a right update in the camera's axes: the tangent of GTSAM's ``Pose3``.
- ``"ros"``: ``geometry_msgs/PoseWithCovariance``: x, y, z, then the rotations about the fixed x, y and z axes of the world.
"""
RIGID_TO = 5e-3
"""Largest entry of R^T R - I that is attributed to rounding (matrices printed with three decimals reach 2e-3)."""


def symbol(unit: LengthUnit) -> str:
    """Return the symbol printed after a length: ``"m"`` or ``"units"``."""
    return "m" if unit == "metres" else "units"


def scale_point(point: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    """Return a point with its coordinates multiplied by ``factor``."""
    x, y, z = point
    return x * factor, y * factor, z * factor


def rigid_pose(matrix: Float[Tensor, "3 4"], where: object, what: str = "the rotation") -> SE3:
    """Return the rigid transform that ``matrix`` represents up to rounding.

    Raises ``InputError``, whose message begins with ``where``, if the rotation block, called ``what``, is not a
    rotation.
    """
    given = SE3(matrix[:3, :3], matrix[:3, 3])
    if not given.is_rigid(RIGID_TO):
        deviation = (given.rotation.mT @ given.rotation - torch.eye(3, dtype=torch.float64)).abs().max().item()
        fault = f"off orthonormal by {deviation:.2g}" if not deviation <= RIGID_TO else "a mirror image"
        raise InputError(f"{what} is {fault}", where=where, expected="a rigid transform")
    return given.normalized()


def look_at(
    eye: Sequence[float] | Float[Tensor, "3"],
    target: Sequence[float] | Float[Tensor, "3"],
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> SE3:
    """Return ``T_world_camera`` (float64) of a camera at ``eye`` that looks at ``target``, with ``up``
    pointing upwards in the image.

    Raises ``InputError`` if ``eye`` and ``target`` coincide.
    """
    position = torch.as_tensor(eye, dtype=torch.float64)
    forward = torch.as_tensor(target, dtype=torch.float64) - position
    if not torch.linalg.vector_norm(forward) > 0:
        raise InputError(f"the camera position {position.tolist()} equals its target", where="look_at")
    forward = torch.nn.functional.normalize(forward, dim=0)
    right = torch.linalg.cross(forward, torch.as_tensor(up, dtype=torch.float64))
    if torch.linalg.vector_norm(right) < 1e-6:  # straight up or down: any right will do
        right = torch.linalg.cross(forward, forward.new_tensor([0.0, 1.0, 0.0]))
    right = torch.nn.functional.normalize(right, dim=0)
    return SE3(torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1), position)


def covariance_in(
    covariance: Float[Tensor, "6 6"], T_world_camera: SE3, convention: CovarianceConvention
) -> Float[Tensor, "6 6"]:
    """Convert a pose covariance in our convention, at ``T_world_camera``, to another convention (float64).

    A right update by (rho, phi) moves the position by ``R rho`` in the world and premultiplies the rotation
    by ``exp(R phi)``, to first order, so both blocks are rotated for ROS. The case of ``convention`` does not matter. Raises
    ``InputError`` for an unknown convention.
    """
    convention = cast(CovarianceConvention, str(convention).lower())
    if convention not in get_args(CovarianceConvention):
        raise InputError(
            f"convention is {convention!r}", expected=f"one of {', '.join(get_args(CovarianceConvention))}"
        )
    ours = covariance.detach().cpu().double()
    if convention == "gtsam":
        return ours.roll((3, 3), (0, 1))
    if convention == "ros":
        turn = torch.block_diag(*2 * [T_world_camera.rotation.detach().cpu().double()])
        return turn @ ours @ turn.mT
    return ours


@dataclass(frozen=True, eq=False)
class Similarity:
    """A similarity transform, ``x -> T_target_source.apply(scale * x)``."""

    scale: float  # target units per source unit
    T_target_source: SE3  # applied after scaling

    @property
    def is_identity(self) -> bool:
        """Whether the similarity maps every point to itself."""
        matrix = self.T_target_source.matrix()
        return self.scale == 1 and bool((matrix == torch.eye(4).to(matrix)).all())

    def apply(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        return self.T_target_source.apply(self.scale * points)

    def move(self, T_source_camera: SE3) -> SE3:
        """Return ``T_target_camera``, the pose of a camera in the target frame."""
        return SE3(self.T_target_source.rotation @ T_source_camera.rotation, self.apply(T_source_camera.translation))


def fit_similarity(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], weights: Float[Tensor, "n"] | None = None
) -> Similarity:
    """Return the similarity that maps ``source`` to ``target`` in the (weighted) least-squares sense (Umeyama 1991, eqs. 34 to 43).

    If the points are collinear, the rotation about their line is arbitrary, but the scale is still
    determined. Raises ``InputError`` if all points of either set coincide, or if no similarity fits.
    """
    source, target = source.double(), target.double()
    largest = max((float(x.abs().max()) for x in (source, target) if x.numel()), default=0.0)
    if not largest <= FARTHEST_CAMERA:
        raise InputError(f"a point is {largest:g} away from the origin", expected=f"at most {FARTHEST_CAMERA:g}")
    if len(source) < 2 or spread(source) == 0 or spread(target) == 0:
        raise InputError(f"{len(source)} pairs of points", expected="2 or more distinct ones")
    weights = torch.ones_like(source[:, 0]) if weights is None else weights
    share = (weights / weights.sum())[:, None]
    source_mean, target_mean = (share * source).sum(0), (share * target).sum(0)
    from_mean, to_mean = source - source_mean, target - target_mean
    u, values, vh = torch.linalg.svd(to_mean.mT @ (share * from_mean))  # eqs. 38, 39
    sign = torch.ones_like(values)
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vh))  # eq. 43: no reflection
    rotation = (u * sign) @ vh  # eq. 40
    scale = float((values * sign).sum() / (share * from_mean.square()).sum())  # eq. 42
    if not scale > 0:
        raise InputError(f"{len(source)} pairs of points, but no similarity maps one set to the other even roughly")
    translation = target_mean - scale * rotation @ source_mean  # eq. 41
    return Similarity(scale, SE3(rotation, translation))


def fit_most(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]
) -> tuple[Similarity, Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Return the similarity that maps most points of ``source`` to ``target``, all distances after it, and which pairs it fits.

    The sum of the distances is minimized by iteratively reweighted least squares (Weiszfeld 1937), where distances below a hundredth of
    the spread count as their squares (Huber 1964). Pairs fit whose distance is then at most three times the median, or below that
    hundredth; the result is their least-squares similarity. Raises ``InputError`` as ``fit_similarity`` does.
    """
    source, target = source.double(), target.double()
    weights = torch.ones(len(source), dtype=torch.float64)
    for _ in range(30):
        fit = fit_similarity(source, target, weights)
        distances = torch.linalg.vector_norm(fit.apply(source) - target, dim=-1)
        small = 0.01 * fit.scale * spread(source)
        weights = 1 / distances.clamp(min=small)
    fits = distances <= max(3 * float(distances.median()), small)
    fit = fit_similarity(source, target, fits.double())
    return fit, torch.linalg.vector_norm(fit.apply(source) - target, dim=-1), fits


def spread(points: Float[Tensor, "n 3"]) -> float:
    """Return the points' root mean square distance from their mean, or 0 if they all coincide up to rounding."""
    deviation = float((points - points.mean(0)).square().sum(-1).mean().sqrt())
    return deviation if deviation > 1e-12 * float(points.abs().amax()) else 0.0
