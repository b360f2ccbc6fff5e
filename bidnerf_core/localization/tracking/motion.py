"""The motion of a camera: its pose and velocity, with their uncertainties.

An error-state Kalman filter on SE(3) with right errors (Sola et al. 2018) and white-noise acceleration. As in a Schmidt-Kalman
filter, two kinds of error are kept separate: noise, which is independent between frames and averages out, and the bias of the
map and the camera, which consecutive frames share, so that fusion does not reduce it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, retract, update_between
from bidnerf_core.io import LARGEST_NUMBER


@dataclass(frozen=True)
class Clock:
    """The time of the last frame. A frame without a time stamp is assumed to follow at the interval of the last two frames that had one."""

    now: float | None  # seconds, from any origin
    interval: float  # seconds
    stamped: bool = True  # whether the last frame had a time stamp

    def step(self, time: Any) -> tuple[Clock, float]:
        """Return the clock at the next frame and the seconds since the last frame, negative if the next frame is out of order.

        ``time`` is in seconds, or None. Raises ``InputError`` for anything else, and for a time that is not finite.
        """
        if time is None:
            now = None if self.now is None else self.now + self.interval
            return Clock(now, self.interval, stamped=False), self.interval
        is_number = isinstance(time, Real) and not isinstance(time, bool)
        if not is_number or not abs(time) <= LARGEST_NUMBER:
            raise InputError(f"time of the frame is {str(time)[:40]!r}", expected="seconds or None")
        time = float(time)
        if self.now is None:
            return Clock(time, self.interval), self.interval
        seconds = time - self.now
        return Clock(time, seconds if seconds > 0 else self.interval), seconds


LONGEST_GAP = 0.6
"""Interval without frames, in seconds, after which the velocity is no longer used."""
LEAST_SECONDS = 1e-3
"""Minimum interval for which process noise is added, in seconds; frames may be repeated or lack distinct times."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The pose measured from one image. Its covariance, of a right update (translation in metres, rotation in radians), has two parts."""

    T_world_camera: SE3  # float64
    noise: Float[Tensor, "6 6"]  # independent of other frames'
    bias: Float[Tensor, "6 6"]  # shared with the frames before and after


@dataclass(frozen=True, eq=False)
class Motion:
    """A camera's pose and velocity at one time; float64."""

    T_world_camera: SE3
    velocity: Float[Tensor, "6"]  # right update of the pose (metres, radians) per second
    noise: Float[Tensor, "12 12"]  # covariance of pose and velocity
    bias: Float[Tensor, "6 6"]  # covariance of the pose error shared by frames
    reach: float  # metres: distance to the visible scene, which scales translations
    agility: float  # factor on the acceleration: how briskly the camera has recently changed its velocity

    @staticmethod
    def at(pose: PoseEstimate, reach: float) -> Motion:
        """Return the motion of a camera at a known pose with an unknown velocity."""
        noise = torch.zeros((12, 12), dtype=torch.float64)
        noise[:6, :6] = pose.noise
        # An unknown velocity has a standard deviation of one reach, and of one radian, per second.
        noise[6:, 6:] = _diagonal(reach, 1.0)
        return Motion(pose.T_world_camera, torch.zeros(6, dtype=torch.float64), noise, pose.bias, reach, 1.0)

    @property
    def covariance(self) -> Float[Tensor, "6 6"]:
        """Covariance of the pose as a right update (translation in metres, rotation in radians)."""
        return self.noise[:6, :6] + self.bias

    def predict(self, seconds: float, stamped: bool = True) -> Motion:
        """Return the state ``seconds`` later, or earlier if negative.

        After a gap of more than ``LONGEST_GAP``, the pose is unchanged, and its uncertainty grows with the camera's possible speed. Without
        a time stamp, the interval is an assumption, so the distance covered during the interval is uncertain in proportion.
        """
        motion = self
        if abs(seconds) > LONGEST_GAP:  # the velocity is unknown
            motion = Motion.at(PoseEstimate(self.T_world_camera, self.noise[:6, :6], self.bias), self.reach)
        step = motion.velocity * seconds
        T = retract(motion.T_world_camera, step)
        back = _adjoint_of_inverse(step)
        transition = torch.eye(12, dtype=torch.float64)
        transition[:6, :6] = back
        transition[:6, 6:] = seconds * torch.eye(6, dtype=torch.float64)
        elapsed = max(abs(seconds), LEAST_SECONDS)
        spread = self._acceleration(self.agility)
        pairs = torch.tensor([[elapsed**4 / 4, elapsed**3 / 2], [elapsed**3 / 2, elapsed**2]])
        noise = transition @ motion.noise @ transition.T + torch.kron(pairs.double(), spread)
        if not stamped:
            # As frames may be missing, the interval is uncertain by half of it.
            way, turn = (0.5 * float(torch.linalg.vector_norm(part)) for part in step.split(3))
            noise[:6, :6] += _diagonal(way, turn)
        return replace(motion, T_world_camera=T, noise=_symmetric(noise), bias=back @ self.bias @ back.T)

    def correct(self, measured: PoseEstimate) -> Motion:
        """Return the state after fusion with a measured pose.

        The biases of the measurement and the state are assumed to be fully correlated, so fusion does not reduce them.
        """
        innovation = update_between(self.T_world_camera, measured.T_world_camera)
        gain = torch.linalg.solve(self.noise[:6, :6] + measured.noise, self.noise[:6]).T
        delta = gain @ innovation
        rest = torch.eye(12, dtype=torch.float64)
        rest[:, :6] -= gain
        # Joseph's form stays positive semidefinite.
        noise = rest @ self.noise @ rest.T + gain @ measured.noise @ gain.T
        shared = rest[:6, :6] @ symmetric_root(self.bias) + gain[:6] @ symmetric_root(measured.bias)
        return Motion(
            retract(self.T_world_camera, delta[:6]).polished(),
            self.velocity + delta[6:],
            _symmetric(noise),
            shared @ shared.T,
            self.reach,
            self.agility,
        )

    def refine(self, T_world_camera: SE3, information: Float[Tensor, "6 6"]) -> Motion:
        """Return the state at a pose that was fused with measurements of this ``information``, with the velocity updated accordingly.

        Half of the variance of the measurements is common to consecutive frames.
        """
        fused = torch.linalg.inv(torch.linalg.inv(self.covariance) + information)
        rest, own = torch.eye(6).double() - fused @ information, fused @ information @ fused / 2
        gain = torch.linalg.solve(self.noise[:6, :6], self.noise[:6]).T
        delta = gain @ update_between(self.T_world_camera, T_world_camera)
        change = rest @ self.noise[:6, :6] @ rest.T + own - self.noise[:6, :6]
        return replace(
            self,
            T_world_camera=T_world_camera,
            velocity=self.velocity + delta[6:],
            noise=_symmetric(self.noise + gain @ change @ gain.T),
            bias=rest @ self.bias @ rest.T + own,
        )

    def update(self, measured: PoseEstimate) -> Motion:
        """Return the state after fusion with a measured pose, or reset to that pose if the prediction is incompatible with it.

        A pose whose covariance is not finite carries no information: the state is returned unchanged.
        """
        if not bool(measured.noise.isfinite().all() and measured.bias.isfinite().all()):
            return self
        innovation = update_between(self.T_world_camera, measured.T_world_camera)
        spread = self.noise[:6, :6] + measured.noise
        # Beyond this squared Mahalanobis distance, the prediction is discarded.
        if float(innovation @ torch.linalg.solve(spread, innovation)) > 60.0:
            return Motion.at(measured, self.reach)
        return replace(self.correct(measured), agility=self._observed_agility(innovation[:3], spread[:3, :3]))

    def _acceleration(self, agility: float = 1.0) -> Float[Tensor, "6 6"]:
        """Return the covariance of the acceleration (metres and radians per second squared) of a hand-held camera that is moved briskly."""
        return _diagonal(agility * self.reach * 2.0, 4.0)

    def _observed_agility(self, innovation: Float[Tensor, "3"], spread: Float[Tensor, "3 3"]) -> float:
        """Return the agility after a position innovation with covariance ``spread`` (Mehra 1970).

        While the velocity is still unknown, the agility is unchanged. Rotations are ignored: they change more abruptly than the
        translation of a walking person, and measurements determine them well.
        """
        velocity = float(self.noise.diagonal()[6:9].mean()) / self.reach**2
        # Innovations update the agility only once the variance of the velocity is less than half that of an unknown one.
        if velocity > 0.5:
            return self.agility
        # Each pose updates a fraction of the squared agility by the squared innovation, relative to what is expected.
        ratio = min(9.0, float(innovation @ torch.linalg.solve(spread, innovation)) / 3)
        return min(1.0, max(0.1, self.agility * math.sqrt(1 - 0.4 + 0.4 * ratio)))

    def move(self, T_world_camera: SE3, relative: Float[Tensor, "6 6"], seconds: float) -> Motion:
        """Return the state ``seconds`` later, at a pose whose motion was measured between the images themselves.

        ``relative`` is the covariance of that motion, as a right update of the new pose.
        """
        step = update_between(self.T_world_camera, T_world_camera)
        back = _adjoint_of_inverse(step)
        seconds = max(abs(seconds), LEAST_SECONDS) * (-1 if seconds < 0 else 1)
        noise = torch.zeros((12, 12), dtype=torch.float64)
        noise[:6, :6] = back @ self.noise[:6, :6] @ back.T + relative
        noise[6:, 6:] = 2 * relative / seconds**2 + self._acceleration() * seconds**2
        bias = back @ self.bias @ back.T
        return replace(self, T_world_camera=T_world_camera, velocity=step / seconds, noise=_symmetric(noise), bias=bias)


def _diagonal(translation: float, rotation: float) -> Float[Tensor, "6 6"]:
    return torch.diag(torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64) ** 2)


def _adjoint_of_inverse(step: Float[Tensor, "6"]) -> Float[Tensor, "6 6"]:
    return retract(SE3.identity(), -step).adjoint()


def _symmetric(matrix: Tensor) -> Tensor:
    return (matrix + matrix.T) / 2


def symmetric_root(covariance: Float[Tensor, "6 6"]) -> Float[Tensor, "6 6"]:
    """Return the symmetric square root of a positive semidefinite matrix."""
    values, axes = torch.linalg.eigh(covariance)
    return (axes * values.clamp(min=0).sqrt()) @ axes.T
