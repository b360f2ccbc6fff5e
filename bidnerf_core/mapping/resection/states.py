"""The unknowns of a query under h hypotheses at once, and the projection of points with its derivatives.

Shapes: h hypotheses, m points, P = 19 unknowns: the pose (6: translation, rotation; a right update, metres and radians) and the N = 13
nuisances below. All in float64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import constant
from bidnerf_core.geometry import SE3, skew

NUISANCES = (
    "log_focal",
    "cx",
    "cy",
    "k1",
    "log_aspect",
    "skew",
    *("vx", "vy", "vz", "wx", "wy", "wz"),
    "log_depth",
)
"""Corrections of the stated camera (the principal point as a fraction of the focal length, the aspect fx / fy), the motion
from the first row of the image to the last (metres, radians), and the scale of measured depth."""
N, P = len(NUISANCES), 6 + len(NUISANCES)
CAMERA, MOTION, DEPTH = slice(0, 6), slice(6, 12), 12
_twists = torch.zeros(6, 4, 4)
_twists[:3, :3, 3], _twists[3:, :3, :3] = torch.eye(3), skew(torch.eye(3))
TWISTS = tuple(_twists.flatten().tolist())
"""The 4x4 matrices, flattened, of a unit translation along each axis and of a unit rotation about each axis."""


@dataclass(frozen=True, eq=False)
class States:
    """A pose and nuisances for each of h hypotheses.

    The nuisances are in standard deviations of their prior, ``mean + deviation * z`` with ``z ~ N(0, I)``, so that all priors are
    alike and a fixed nuisance is one with deviation 0.
    """

    T: SE3  # T_world_rig (h)
    z: Float[Tensor, "h N"]
    mean: Float[Tensor, "h N"]
    deviation: Float[Tensor, "h N"]
    log_prior: Float[Tensor, "h"]
    noise: Float[Tensor, "h"]  # pixels: standard deviation of a keypoint along each axis
    mode: Int[Tensor, "h"]  # number of the matches (see ``Landmarks``) that belong to the hypothesis
    row: Int[Tensor, "h"]  # number of the prior, as the caller counts them

    def __len__(self) -> int:
        return len(self.z)

    def __getitem__(self, index: Tensor | slice) -> States:
        return States(self.T[index], *(getattr(self, name)[index] for name in PARTS))

    @cached_property
    def nuisances(self) -> Float[Tensor, "h N"]:
        return self.mean + self.deviation * self.z

    @property
    def unit(self) -> Float[Tensor, "h P"]:
        """The factors that convert derivatives with respect to whitened unknowns to those with respect to the unknowns themselves."""
        return torch.cat([torch.ones_like(self.z[:, :6]), 1 / self.deviation.clamp(min=1e-9)], -1)

    def retract(self, step: Float[Tensor, "h P"]) -> States:
        """Return the states after a step, with poses ``T exp(step)``, polished. The formula is fast, but has no derivative at 0."""
        R, t = self.T.rotation, self.T.translation
        twist = (step[:, :6] @ constant(TWISTS, step).view(6, 16)).view(-1, 4, 4)
        squared = step[:, 3:6].square().sum(-1)[:, None, None]
        angle = squared.sqrt() / math.pi
        # exp(M) = 1 + M + (1 - cos a) / a^2 M^2 + (a - sin a) / a^3 M^3 for a rotation by a (Sola et al. 2018, eqs. 146 and 171).
        second, third = (angle / 2).sinc().square() / 2, (1 - angle.sinc()) / squared.clamp(min=1e-300)
        square = twist @ twist
        moved = R @ (twist.addcmul(second, square).addcmul(third, square @ twist))[:, :3]
        R = R + moved[..., :3]
        R = torch.baddbmm(R, R, R.mT @ R, beta=1.5, alpha=-0.5)  # see ``SE3.polished``
        return replace(self, T=SE3(R, t + moved[..., 3]), z=self.z + step[:, 6:])

    def where(self, mask: Bool[Tensor, "h"], other: States) -> States:
        """Return the poses and nuisances of these states where ``mask`` is true, and of ``other`` elsewhere."""
        R = torch.where(mask[:, None, None], self.T.rotation, other.T.rotation)
        t = torch.where(mask[:, None], self.T.translation, other.T.translation)
        return replace(self, T=SE3(R, t), z=torch.where(mask[:, None], self.z, other.z))

    def with_rows(self, which: Int[Tensor, "r"], other: States) -> States:
        """Return these states with ``other`` in the place of the states ``which``."""
        index = torch.arange(len(self), device=which.device)
        index[which] = len(self) + torch.arange(len(which), device=which.device)
        return States.cat([self, other])[index]

    def under(self, mean: Float[Tensor, "N"], deviation: Float[Tensor, "N"]) -> States:
        """Return the same poses and nuisances with another prior; a nuisance that the prior fixes takes the prior's mean."""
        free = deviation > 0
        z = torch.where(free, (self.nuisances - mean) / torch.where(free, deviation, 1), 0)
        return replace(self, z=z, mean=mean.expand_as(z), deviation=deviation.expand_as(z))

    @staticmethod
    def cat(parts: list[States]) -> States:
        joined = (torch.cat([getattr(part, name) for part in parts]) for name in PARTS)
        return States(SE3.cat([part.T for part in parts]), *joined)

    @staticmethod
    def known(T: SE3, camera: Float[Tensor, "6"]) -> States:
        """Return the single state of a known camera at rest."""
        mean = torch.cat([camera, camera.new_zeros(N - len(camera))])[None]
        zero = torch.zeros_like(mean)
        number = torch.zeros(1, dtype=torch.long)
        return States(T[None], zero, mean, zero, zero[:, 0], zero[:, 0] + 1, number, number)


PARTS = ("z", "mean", "deviation", "log_prior", "noise", "mode", "row")


@dataclass(frozen=True, eq=False)
class Sights:
    """Where and when the points of a rig's images were seen; leading axes broadcast against the hypotheses."""

    image: Float[Tensor, "*h m 2"]  # on the plane z = 1 of the stated camera
    times: Float[Tensor, "*h m"]  # of exposure, as fractions of the readout (-0.5 to 0.5)
    rotation: Float[Tensor, "*h m 3 3"]  # T_camera_rig
    translation: Float[Tensor, "*h m 3"]
    single: bool = False  # whether T_camera_rig is the identity for all points, and need not be applied

    def __getitem__(self, index: Tensor | slice) -> Sights:
        rotation, translation = self.rotation[index], self.translation[index]
        return Sights(self.image[index], self.times[index], rotation, translation, self.single)

    @property
    def mirrored(self) -> Sights:
        """The sights in the mirror image of a single image, left and right swapped."""
        return replace(self, image=self.image * constant((-1.0, 1.0), self.image))


@dataclass(frozen=True, eq=False)
class Projections:
    """Where h states see m points, on the plane z = 1 of the stated camera."""

    image: Float[Tensor, "h m 2"]
    local: Float[Tensor, "h m 3"]  # metres, in the frame of the camera when the point's row was exposed
    flat: Float[Tensor, "h m 2"]  # of the ideal camera
    front: Bool[Tensor, "h m"]
    depth: Float[Tensor, "h m"]  # metres; 1 behind the camera
    square: Float[Tensor, "h m 1"]  # of the radius of ``flat``
    bend: Float[Tensor, "h m 1"]  # the factor by which the lens distorts ``flat``
    linear: Float[Tensor, "h 2 2"]  # see ``linear``


def project(states: States, points: Float[Tensor, "*h m 3"], sights: Sights) -> Projections:
    """Project points (metres, world) into the images of a rig in each state."""
    local = (points - states.T.translation[:, None]) @ states.T.rotation
    if not sights.single:
        local = (sights.rotation @ local[..., None])[..., 0] + sights.translation
    return imaged(states, local, sights.times)


def imaged(states: States, local: Float[Tensor, "h m 3"], times: Float[Tensor, "*h m"]) -> Projections:
    """Project points given in the frame (metres) that the camera has at the middle row."""
    nuisances, times = states.nuisances[:, None], times[..., None]
    w = nuisances[..., 9:12]
    speed = torch.linalg.cross(w, local) + nuisances[..., 6:9]
    # The camera moves by exp(time * motion), to second order.
    local = local.addcmul(times, speed, value=-1)
    local = local.addcmul(times.square(), torch.linalg.cross(w, speed), value=0.5)
    flat, depth, front = pinhole(local)
    square = flat.square().sum(-1, keepdim=True)
    bend, A = 1 + nuisances[..., 3:4] * square, linear(states)
    image = torch.baddbmm(nuisances[..., 1:3], flat * bend, A.mT)
    return Projections(image, local, flat, front, depth, square, bend, A)


def jacobian(states: States, seen: Projections, sights: Sights) -> Float[Tensor, "h P m 2"]:
    """Return the derivative of ``seen.image`` with respect to the unknowns.

    ``image = A bend flat``, where ``bend = 1 + k1 flat^2`` and A is ``seen.linear``, plus the principal point.
    """
    flat, A = seen.flat, seen.linear.mT
    lens = flat.mT[..., None] * (2 * states.nuisances[:, None, 3:4] * flat)[:, None]
    lens.diagonal(dim1=1, dim2=3).add_(seen.bend)  # ``bend flat`` by ``flat`` (h 2 m 2)
    radial = flat * (2 - 3 * seen.bend)
    by_point = torch.cat([lens, radial[:, None]], 1) / seen.depth[:, None, :, None]
    by_point = (by_point.flatten(1, 2) @ A).view(by_point.shape)
    by_row = _by_update(by_point, seen.local)  # with respect to the camera at the row's exposure
    by_pose = by_row
    if not sights.single:
        back = sights.rotation.mT
        rig = (back @ (seen.local - sights.translation)[..., None])[..., 0]
        by_pose = _by_update((back @ by_point.transpose(1, 2)).transpose(1, 2), rig)
    by_camera, zero = _by_camera(flat, seen.square, seen.bend, seen.linear), torch.zeros_like(flat)
    by_motion = by_row * sights.times[..., None, :, None]
    found = torch.cat([by_pose, by_camera, by_motion, zero[:, None]], 1)
    found[:, 6:] *= states.deviation[:, :, None, None]
    return found


def _by_camera(
    flat: Float[Tensor, "h m 2"],
    square: Float[Tensor, "h m 1"],
    bend: Float[Tensor, "h m 1"],
    A: Float[Tensor, "h 2 2"],
) -> Float[Tensor, "h 6 m 2"]:
    """Return the derivative of the image with respect to the camera's nuisances; the arguments are fields of ``Projections``."""
    bent = flat * bend
    scaled = bent * A.diagonal(dim1=-2, dim2=-1)[:, None]
    return torch.stack(
        [
            scaled,
            *(constant(e, flat).expand_as(flat) for e in ((1.0, 0.0), (0.0, 1.0))),
            (flat * square) @ A.mT,
            scaled * constant((0.5, -0.5), flat),
            pad(bent[..., 1:], (0, 1)),
        ],
        1,
    )


def _by_update(by_point: Float[Tensor, "h 3 m k"], points: Float[Tensor, "h m 3"]) -> Float[Tensor, "h 6 m k"]:
    """Return the same as ``by_update``, with the axes in the order of the annotated result (h 6 m k)."""
    return torch.cat([-by_point, torch.linalg.cross(by_point, points.mT[..., None], dim=1)], 1)


def pinhole(
    local: Float[Tensor, "*m 3"],
) -> tuple[Float[Tensor, "*m 2"], Float[Tensor, "*m"], Bool[Tensor, "*m"]]:
    """Return the projections on the plane z = 1 of points in a camera's frame (metres), their depths, and whether they are in front.

    The depth of points behind the camera is taken as 1.
    """
    front = local[..., 2] > 1e-9
    depth = torch.where(front, local[..., 2], 1.0)
    return local[..., :2] / depth[..., None], depth, front


def by_camera_point(flat: Float[Tensor, "*m 2"], depth: Float[Tensor, "*m"]) -> Float[Tensor, "*m 2 3"]:
    """Return the derivative of ``flat``, projections on the plane z = 1, with respect to the points in the camera's frame."""
    eye = torch.eye(2, dtype=flat.dtype, device=flat.device).expand(*flat.shape, 2)
    return torch.cat([eye, -flat[..., None]], -1) / depth[..., None, None]


def by_update(by_point: Float[Tensor, "*m k 3"], points: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m k 6"]:
    """Return derivatives with respect to a right update of a pose, given the derivatives with respect to ``points`` in its frame.

    A point moves by -rho + p x phi under T exp(rho, phi), and r (p x phi) = (r x p) phi.
    """
    return torch.cat([-by_point, torch.linalg.cross(by_point, points[..., None, :])], -1)


def linear(states: States) -> Float[Tensor, "h 2 2"]:
    """Return the map from the plane z = 1 of the true camera to that of the stated one, without the shift: ``[[a, s], [0, b]]``."""
    nuisances = states.nuisances
    a, b = (nuisances[:, 0:1] + nuisances[:, 4:5] * constant((0.5, -0.5), nuisances)).exp().unbind(-1)
    return torch.stack([a, nuisances[:, 5], torch.zeros_like(a), b], -1).unflatten(-1, (2, 2))


def true_intrinsics(stated: Intrinsics, camera: Float[Tensor, "6"]) -> Intrinsics:
    """Return ``stated`` intrinsics corrected by ``camera`` (see ``NUISANCES``), except for skew, which intrinsics cannot express."""
    log_focal, cx, cy, k1, log_aspect, _ = camera.tolist()
    bent, *others = stated.distortion or (0.0, 0.0, 0.0, 0.0)
    return replace(
        stated,
        fx=stated.fx * math.exp(log_focal + log_aspect / 2),
        fy=stated.fy * math.exp(log_focal - log_aspect / 2),
        cx=stated.cx + cx * stated.fx,
        cy=stated.cy + cy * stated.fy,
        distortion=(bent + k1, *others),
    )


def rays_through(states: States, image: Float[Tensor, "m 2"]) -> Float[Tensor, "h m 3"]:
    """Return the points on the plane z = 1 of the true cameras that appear at ``image`` on that of the stated camera."""
    nuisances = states.nuisances
    x, y = (image - nuisances[:, None, 1:3]).unbind(-1)
    (a, c), (_, b) = (row.unbind(-1) for row in linear(states)[:, None].unbind(-2))
    bent = flat = torch.stack([(x - c * y / b) / a, y / b], -1)
    for _ in range(4):  # fixed-point iteration as in OpenCV's undistortPoints
        flat = bent / (1 + nuisances[:, None, 3:4] * flat.square().sum(-1, keepdim=True))
    return torch.cat([flat, torch.ones_like(flat[..., :1])], -1)


def rays_by_camera(rays: Float[Tensor, "h m 3"], states: States) -> Float[Tensor, "h m 3 6"]:
    """Return the derivative of ``rays_through`` with respect to the camera's (whitened) nuisances.

    The image does not move, so that ``flat`` moves by ``-(A (bend + 2 k1 flat flat^T))^-1`` times the derivative of ``_by_camera``.
    """
    flat, k1 = rays[..., :2], states.nuisances[:, None, 3:4]
    square = flat.square().sum(-1, keepdim=True)
    bend, A = 1 + k1 * square, linear(states)
    (a, c), (_, b) = (row.unbind(-1) for row in A[:, None, None].unbind(-2))
    x, y = _by_camera(flat, square, bend, A).transpose(1, 2).unbind(-1)  # h m 6
    moved = torch.stack([(x - c * y / b) / a, y / b], -2) / bend[..., None]
    # The inverse of ``bend + 2 k1 flat flat^T`` by Sherman and Morrison 1950.
    inward = (2 * k1 / (bend + 2 * k1 * square))[..., None] * flat[..., None] * (flat[..., None, :] @ moved)
    return pad((inward - moved) * states.deviation[:, None, None, CAMERA], (0, 0, 0, 1))
