"""Rigid transforms.

Convention, stated here once: ``T_a_b`` takes points of frame b to frame a, so that adjacent letters cancel:
``p_world = T_world_camera.apply(p_camera)`` and ``T_a_c = T_a_b @ T_b_c``. A tangent vector is (translation rho,
rotation phi), metres and radians; an update is a *right* update, ``T.retract(xi) = T @ SE3.exp(xi)``, that is, a motion
written in the local frame of the camera (Sola et al. 2018, "A micro Lie theory", which also gives every formula here).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float
from kornia.geometry.conversions import rotation_matrix_to_axis_angle, rotation_matrix_to_quaternion
from torch import Generator, Tensor

from bidnerf_core.devices import constant
from bidnerf_core.errors import InputError

QuaternionOrder = Literal["wxyz", "xyzw"]
"""Order of a quaternion's components: the scalar part w comes first or last."""
FARTHEST_CAMERA = 1e12
"""Largest coordinate of a camera; squares of larger coordinates lose all precision."""


@dataclass(frozen=True, eq=False)
class SE3:
    """A rigid transform, or a batch of them: ``x -> rotation @ x + translation``."""

    rotation: Float[Tensor, "*b 3 3"]
    translation: Float[Tensor, "*b 3"]  # metres

    @staticmethod
    def identity(dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> SE3:
        return SE3(torch.eye(3, dtype=dtype, device=device), torch.zeros(3, dtype=dtype, device=device))

    @staticmethod
    def unknown() -> SE3:
        """Return a transform of which nothing is known: all its numbers are NaN."""
        return SE3(*(torch.full(shape, math.nan, dtype=torch.float64) for shape in ((3, 3), (3,))))

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return bool(self.rotation.isfinite().all() and self.translation.isfinite().all())

    @staticmethod
    def from_matrix(matrix: Float[Tensor, "*b 4 4"]) -> SE3:
        """Convert homogeneous matrices to transforms; whether they are rigid is not checked (see ``is_rigid``).

        Raises ``InputError`` unless ``matrix`` is a tensor of 4x4 matrices.
        """
        if not isinstance(matrix, Tensor):
            raise InputError(f"matrix is a {type(matrix).__name__}", expected="a tensor; torch.as_tensor makes one")
        if matrix.shape[-2:] != (4, 4):
            raise InputError(f"the matrix has shape {tuple(matrix.shape)}", expected="(..., 4, 4)")
        return SE3(matrix[..., :3, :3], matrix[..., :3, 3])

    @staticmethod
    def exp(tangent: Float[Tensor, "*b 6"]) -> SE3:
        """Return the exponential ``[exp(phi), V(phi) rho]`` of tangent vectors (rho, phi) (Sola et al., eq. 172)."""
        rho, phi = tangent[..., :3], tangent[..., 3:]
        squared, small, angle = _guarded_angle(phi)
        b = torch.where(small, 0.5 - squared / 24 + squared**2 / 720, (1 - angle.cos()) / angle**2)
        c = torch.where(small, 1 / 6 - squared / 120 + squared**2 / 5040, (angle - angle.sin()) / angle**3)
        once = torch.linalg.cross(phi, rho)
        twice = torch.linalg.cross(phi, once)
        a = 1 - c * squared  # sin(t) / t
        return SE3(_polynomial(phi, a, b), rho + b[..., None] * once + c[..., None] * twice)

    def log(self) -> Float[Tensor, "*b 6"]:
        """Return the tangent vector ``[V(phi)^-1 translation, phi]`` of this transform (eq. 173), with an angle in [0, pi]."""
        phi = rotation_matrix_to_axis_angle(self.rotation)
        squared, small, angle = _guarded_angle(phi)
        half = angle / 2  # eq. 146, where (1 + cos t) / sin t = 1 / tan(t / 2): finite at pi
        series = 1 / 12 + squared / 720 + squared**2 / 30240
        c = torch.where(small, series, (1 - half / half.tan()) / angle**2)
        inverse = _polynomial(phi, torch.full_like(c, -0.5), c)
        return torch.cat([_matvec(inverse, self.translation), phi], dim=-1)

    def update_to(self, other: SE3) -> Float[Tensor, "*b 6"]:
        """Return ``(self.inverse() @ other).log()`` in fewer operations, for rotations that differ by clearly less than half a turn."""
        back = self.rotation.mT
        # Keeps 0 / 0 from being NaN without changing any other ratio.
        least = torch.finfo(back.dtype).tiny ** 0.5
        R, offset = back @ other.rotation, _matvec(back, other.translation - self.translation)
        twice = torch.stack([R[..., i, j] - R[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
        sine = twice.square().sum(-1).sqrt() / 2 + least
        angle = torch.atan2(sine, (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2) + least
        phi = (angle / (2 * sine))[..., None] * twice
        c = (1 - angle / 2 / (angle / 2).tan()) / angle.square()
        once = torch.linalg.cross(phi, offset)
        return torch.cat([offset - once / 2 + c[..., None] * torch.linalg.cross(phi, once), phi], -1)

    def matrix(self) -> Float[Tensor, "*b 4 4"]:
        top = torch.cat([self.rotation, self.translation[..., None]], dim=-1)
        return torch.cat([top, constant((0.0, 0.0, 0.0, 1.0), top).expand(*top.shape[:-2], 1, 4)], dim=-2)

    def quaternion(self, order: QuaternionOrder) -> Float[Tensor, "*b 4"]:
        """Return the unit quaternion of the rotation, with its scalar part w >= 0.

        ``order`` is ``"xyzw"`` (ROS, TUM, scipy, glTF, Unity) or ``"wxyz"`` (COLMAP, Eigen's constructor,
        Blender, nerfstudio). Raises ``InputError`` for any other value.
        """
        _check_order(order)
        quaternion = torch.nn.functional.normalize(rotation_matrix_to_quaternion(self.rotation), dim=-1)
        quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
        return quaternion if order == "wxyz" else quaternion.roll(-1, dims=-1)

    @staticmethod
    def from_quaternion(
        quaternion: Float[Tensor, "*b 4"], translation: Float[Tensor, "*b 3"], order: QuaternionOrder
    ) -> SE3:
        """Build the transform from a quaternion in ``order`` (see ``quaternion``) and a translation.

        Raises ``InputError`` for a quaternion whose length is 0 or not finite.
        """
        _check_order(order)
        length = torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
        if not bool((length.isfinite() & (length > 0)).all()):
            raise InputError("a quaternion has length 0 or is not finite", expected="a rotation")
        unit = (quaternion if order == "wxyz" else quaternion.roll(1, dims=-1)) / length
        w, v = unit[..., :1, None], unit[..., 1:]
        cross = skew(v)
        eye = torch.eye(3, dtype=unit.dtype, device=unit.device)
        return SE3(eye + 2 * w * cross + 2 * cross @ cross, translation)

    def __matmul__(self, other: SE3) -> SE3:
        return SE3(self.rotation @ other.rotation, self.apply(other.translation))

    def inverse(self) -> SE3:
        transposed = self.rotation.mT
        return SE3(transposed, -_matvec(transposed, self.translation))

    def apply(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*q 3"]:
        """Transform points from frame b to frame a of ``T_a_b``; the batch broadcasts against their leading axes."""
        return _matvec(self.rotation, points) + self.translation

    def rotate(self, vectors: Float[Tensor, "*p 3"]) -> Float[Tensor, "*q 3"]:
        """Rotate directions, which the translation does not affect."""
        return _matvec(self.rotation, vectors)

    def translated(self, offset: Float[Tensor, "3"]) -> SE3:
        """Return the transform with ``offset`` (metres) added to its translation, and the same rotation."""
        return SE3(self.rotation, self.translation + offset.to(self.translation))

    def retract(self, tangent: Float[Tensor, "*c 6"]) -> SE3:
        """Return the right update ``self @ exp(tangent)``."""
        return self @ SE3.exp(tangent)

    def retract_about(self, point: Float[Tensor, "3"], tangent: Float[Tensor, "*c 6"]) -> SE3:
        """Return the right update whose tangent vector is that of a parallel frame at ``point`` (metres, frame b of ``T_a_b``)."""
        T = self.translation
        T_b_point = SE3(torch.eye(3, dtype=T.dtype, device=T.device), point.to(T))
        return (self @ T_b_point).retract(tangent) @ T_b_point.inverse()

    def adjoint(self) -> Float[Tensor, "*b 6 6"]:
        """Return the adjoint matrix, for which ``T exp(xi) T^-1 = exp(adjoint(T) xi)`` (eq. 175)."""
        turned = skew(self.translation) @ self.rotation
        top = torch.cat([self.rotation, turned], dim=-1)
        bottom = torch.cat([torch.zeros_like(self.rotation), self.rotation], dim=-1)
        return torch.cat([top, bottom], dim=-2)

    def normalized(self) -> SE3:
        """Return the nearest rigid transform: rounding errors make long products of transforms drift away from rigidity."""
        u, _, vh = torch.linalg.svd(self.rotation)
        sign = torch.ones_like(self.translation)
        sign = torch.cat([sign[..., :2], torch.linalg.det(u @ vh)[..., None]], dim=-1)
        return SE3(u @ (sign[..., None] * vh), self.translation)

    def polished(self) -> SE3:
        """Remove a product's rounding errors by one Newton-Schulz step towards the nearest rotation.

        Unlike a factorization, this does not block the host. The rotation must be orthonormal up to rounding.
        """
        R = self.rotation
        return SE3(1.5 * R - 0.5 * R @ (R.mT @ R), self.translation)

    def is_rigid(self, tolerance: float = 1e-3) -> Bool[Tensor, "*b"]:
        """Return whether the transform is finite and its rotation orthonormal to ``tolerance``, with determinant 1."""
        eye = torch.eye(3, dtype=self.rotation.dtype, device=self.rotation.device)
        deviation = (self.rotation.mT @ self.rotation - eye).abs().amax(dim=(-1, -2))
        finite = torch.isfinite(self.translation).all(dim=-1)
        return finite & (deviation <= tolerance) & (torch.linalg.det(self.rotation) > 0)

    def detach(self) -> SE3:
        return SE3(self.rotation.detach(), self.translation.detach())

    @property
    def device(self) -> torch.device:
        return self.translation.device

    def to(self, *args: Any, **kwargs: Any) -> SE3:
        """Convert to another dtype or device; the arguments are those of ``Tensor.to``."""
        return SE3(self.rotation.to(*args, **kwargs), self.translation.to(*args, **kwargs))

    def __getitem__(self, index: Any) -> SE3:
        """Return a part of the batch; indices refer to batch axes only."""
        return SE3(self.rotation[index], self.translation[index])

    @staticmethod
    def stack(transforms: list[SE3]) -> SE3:
        return SE3(torch.stack([t.rotation for t in transforms]), torch.stack([t.translation for t in transforms]))

    @staticmethod
    def cat(batches: list[SE3]) -> SE3:
        """Concatenate batches of transforms along the first axis."""
        return SE3(torch.cat([b.rotation for b in batches]), torch.cat([b.translation for b in batches]))


def _check_order(order: str) -> None:
    if order not in get_args(QuaternionOrder):
        raise InputError(f"order is {order!r}", expected=f"one of {', '.join(get_args(QuaternionOrder))}")


def skew(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the matrix [a]x, for which ``skew(a) @ b = a x b``."""
    x, y, z = vector.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def _guarded_angle(phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the squared angle, whether the angle is small, and the angle (1 if small).

    Neither branch of a ``where`` may divide by 0. Below 0.01 rad, series are used, since sines and cosines cancel.
    """
    squared = (phi * phi).sum(-1)
    small = squared < 1e-4
    return squared, small, torch.where(small, torch.ones_like(squared), squared).sqrt()


def _polynomial(phi: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return ``I + b [phi]x + c [phi]x^2``."""
    s = skew(phi)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye + b[..., None, None] * s + c[..., None, None] * (s @ s)


def _matvec(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def pose_from_matrix(matrix: Float[Tensor, "..."], what: str, where: object = None) -> SE3:
    """Convert a row-major homogeneous 4x4 matrix to T_world_camera.

    Raises ``InputError``, whose message begins with ``where`` (if given) and ``what``, unless the matrix is 4x4,
    has the last row 0 0 0 1, has an orthonormal rotation, and is not too far away.
    """
    if matrix.shape != (4, 4):
        raise InputError(f"{what} has shape {tuple(matrix.shape)}", where=where, expected="a 4x4 matrix T_world_camera")
    last = matrix[3].tolist()
    if not _is_last_row(last):
        transposed = _is_last_row(matrix[:, 3].tolist())
        hint = "; its last column is, so the matrix is column-major: transpose it" if transposed else ""
        raise InputError(f"{what} has the last row {last}", where=where, expected=f"[0, 0, 0, 1]{hint}")
    pose = SE3.from_matrix(matrix.to(torch.float64))
    if not bool(pose.is_rigid()):
        raise InputError(
            f"{what} is not a rigid transform",
            where=where,
            expected="an orthonormal rotation of determinant 1",
        )
    if (farthest := float(pose.translation.abs().max())) > FARTHEST_CAMERA:
        raise InputError(
            f"{what} is {farthest:g} away from the origin", where=where, expected=f"at most {FARTHEST_CAMERA:g}"
        )
    return pose.normalized()


def _is_last_row(numbers: Sequence[float]) -> bool:
    return max(abs(a - b) for a, b in zip(numbers, (0.0, 0.0, 0.0, 1.0), strict=True)) <= 1e-6


def random_units(count: int, generator: Generator) -> Float[Tensor, "n 3"]:
    """Return ``count`` unit vectors, uniformly distributed on the sphere (float64)."""
    normal = torch.randn((count, 3), generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(normal, dim=-1)


def sphere(count: int) -> Float[Tensor, "n 3"]:
    """Return ``count`` unit directions spread evenly over the sphere (Fibonacci lattice), from the north pole down, in float64."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * number / count
    azimuth, flat = number * math.pi * (3 - math.sqrt(5)), (1 - z * z).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=-1)


def perturb(T_true: SE3, translation: float, rotation_deg: float, seed: int) -> SE3:
    """Return a start whose error is exactly ``translation`` (metres) and ``rotation_deg``, in random directions."""
    if not (0 <= translation < math.inf and 0 <= rotation_deg < math.inf):
        raise InputError(
            f"is {translation} and {rotation_deg} degrees",
            where="perturbation",
            expected="finite numbers, 0 or more",
        )
    u1, u2 = random_units(2, torch.Generator().manual_seed(seed))
    turn = SE3.exp(torch.cat([torch.zeros_like(u2), math.radians(rotation_deg) * u2])).rotation
    return T_true.to(dtype=torch.float64) @ SE3(turn, translation * u1)
