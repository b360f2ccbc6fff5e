"""A short flight over the textured ground, which tests of the tracker share."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import torch

from bidnerf import SE3, Frame, Localization, Localizer, Tracker
from bidnerf.results import pose_error
from bidnerf.testing import textured_map
from bidnerf.testing import textured_view as view
from bidnerf_core.geometry import look_at
from bidnerf_core.localization import AutoConfig
from localizations import assert_near
from localizations import without_depth as without_depth

FRAMES = 10
INTERVAL = 0.1  # seconds


def flight_pose(number: float) -> SE3:
    """Return the camera's pose at frame ``number``: an arc about the ground's middle, from a changing height."""
    angle = 0.6 + 0.035 * number
    eye = (0.75 * math.cos(angle), 0.75 * math.sin(angle), 1.5 + 0.02 * number)
    return look_at(eye, (0.02 * number, 0.0, 0.0))


@functools.cache
def flight_frame(number: int) -> Frame:
    return view(flight_pose(number), f"{number:04d}").frame


def flight() -> list[tuple[float, Frame, SE3]]:
    """Return times, frames with depth, and true poses."""
    return [(INTERVAL * n, flight_frame(n), flight_pose(n)) for n in range(FRAMES)]


def covered(frame: Frame) -> Frame:
    """Return what a camera with its lens cap on takes."""
    generator = torch.Generator().manual_seed(0)
    dark = 0.02 + 0.01 * torch.rand(frame.rgb.shape, generator=generator)
    depth = None if frame.depth is None else torch.zeros_like(frame.depth)
    return replace(frame, rgb=dark, depth=depth)


@functools.cache
def localizer(landmarks: bool = True) -> Localizer:
    """Return a localizer of a map with a surface; shared by all tests, as trackers share it."""
    return Localizer(textured_map(surface=True), config=AutoConfig(landmarks=landmarks, hypotheses=64, fused_rays=128))


def tracked(
    frames: list[tuple[float, Frame, SE3]], tracker: Tracker | None = None, timed: bool = True
) -> list[Localization]:
    tracker = Tracker(localizer()) if tracker is None else tracker
    return [tracker(frame, time if timed else None) for time, frame, _ in frames]


def assert_right(answers: list[Localization], frames: list[tuple[float, Frame, SE3]]) -> None:
    """Assert that all answers are accepted and near the truth."""
    for answer, (_, frame, truth) in zip(answers, frames, strict=True):
        assert answer.converged, (frame.name, answer.reason)
        assert_near(answer.T_world_camera, truth, 0.045, 1.3)  # a pixel is 1.3 cm and 0.44 degrees


def assert_honest(answers: list[Localization], frames: list[tuple[float, Frame, SE3]]) -> None:
    """Assert that no accepted answer is wrong."""
    for answer, (_, frame, truth) in zip(answers, frames, strict=True):
        error = pose_error(answer.T_world_camera, truth)
        wrong = float(error.translation) > 0.05 or float(error.rotation_deg) > 2
        assert not (answer.converged and wrong), frame.name
