"""What the node does, without ROS: messages in, poses out; localization runs in its own thread."""

from __future__ import annotations

import math
import queue
from dataclasses import dataclass
from typing import Any

import torch

from bidnerf.results import standard_deviations
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, covariance_in
from bidnerf_core.localization import Localization
from bidnerf_core.maps import Localizer, Tracker
from bidnerf_ros2.conversions import covariance_elsewhere, fill, seconds
from bidnerf_ros2.corrector import Corrector
from bidnerf_ros2.messages import frame_of, intrinsics

OK, WARN, ERROR, STALE = range(4)
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""


@dataclass(frozen=True)
class Estimate:
    """The answer to an image."""

    stamp: Any  # of the image
    found: Localization


class _Recorded:
    """A localizer, or without odometry a tracker, that keeps the answers with their image stamps."""

    def __init__(self, localizer: Localizer, has_odometry: bool) -> None:
        self._localizer, self._tracker = localizer, None if has_odometry else Tracker(localizer)
        self.answers: queue.SimpleQueue[Estimate] = queue.SimpleQueue()
        self.stamps: dict[str, Any] = {}

    def __call__(self, frame: Frame, start: SE3 | None = None) -> Localization:
        stamp = self.stamps.pop(frame.name)
        found = self._localizer(frame, start) if self._tracker is None else self._tracker(frame, seconds(stamp))
        self.answers.put(Estimate(stamp, found))
        return found


class Bridge:
    """Localizes images in the background. With odometry, it estimates the correction of its drift, as
    ``Corrector`` does.

    Without odometry, a ``Tracker`` tracks the images. An image is dropped if another one is already waiting.
    """

    def __init__(self, localizer: Localizer, has_odometry: bool) -> None:
        self._recorded, self._number = _Recorded(localizer, has_odometry), 0
        self._corrector = Corrector(self._recorded)  # type: ignore[arg-type]  # all that it does is to call it
        self.has_odometry = has_odometry

    def give(
        self, image: Any, info: Any, depth: Any | None, T_odom_camera: SE3 | None, rectified: bool = False
    ) -> bool:
        """Submit an image with its camera, its depth, and the pose of its optical frame from odometry.

        Returns False if it was dropped. Raises ``InputError`` for invalid messages, and the error of an
        earlier image.
        """
        self._number += 1
        frame = frame_of(image, intrinsics(info, rectified), depth, f"{self._number:06d}")
        self._recorded.stamps[frame.name] = image.header.stamp
        taken = False
        try:
            taken = self._corrector.give(frame, SE3.identity() if T_odom_camera is None else T_odom_camera)
        finally:
            if not taken:
                self._recorded.stamps.pop(frame.name, None)
        return taken

    @property
    def T_map_odom(self) -> SE3 | None:
        """The correction of the odometry; None without odometry, and until a pose was accepted."""
        return self._corrector.T_world_odom if self.has_odometry else None

    def answers(self) -> list[Estimate]:
        """Return the answers since the last call."""
        found = []
        while not self._recorded.answers.empty():
            found.append(self._recorded.answers.get())
        return found

    def close(self) -> None:
        """Stop the thread."""
        self._corrector.close()


def fill_pose(message: Any, found: Localization, T_camera_base: SE3 | None = None) -> None:
    """Write an accepted pose into a ``PoseWithCovariance``: that of the optical frame, or of a base fixed to
    the camera.

    Raises ``ValueError`` for a pose without a covariance: ROS has no way to mark it as unknown.
    """
    if found.covariance is None:
        raise ValueError("a pose without covariance")
    pose, covariance = found.T_world_camera.to("cpu", torch.float64), found.covariance
    if T_camera_base is not None:
        pose, covariance = pose @ T_camera_base, covariance_elsewhere(covariance, T_camera_base)
    fill(message.pose, pose)
    message.covariance = covariance_in(covariance, pose, "ros").flatten().tolist()


def diagnosis(found: Localization) -> tuple[int, str, dict[str, str]]:
    """Return the level, the message and the values of a ``DiagnosticStatus`` about an answer."""
    values = {"outcome": str(found.outcome), "reason": found.reason, "seconds": f"{found.seconds:.3f}"}
    if found.covariance is not None:
        position, rotation = standard_deviations(found.covariance)
        values |= {
            "sigma of position (m)": f"{position:.4f}",
            "sigma of rotation (deg)": f"{math.degrees(rotation):.3f}",
        }
    if found.confidence is not None:
        values["confidence"] = f"{found.confidence:.3f}"
    return (OK if found.converged else WARN), f"{found.outcome}: {found.reason}", values
