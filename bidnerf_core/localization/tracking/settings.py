"""Settings of a tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.settings import EXPERT, Above, Range, Settings


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """Settings of a tracker."""

    # largest number of landmarks that are followed from image to image
    points: Annotated[int, Range(20, 10**4)] = 250
    depth_points: Annotated[int, Range(50, 10**6)] = 400  # largest number of measured pixels that are aligned
    # number of keypoints of an image in which landmarks are sought
    keypoints: Annotated[int, Range(50, 10**5), EXPERT] = 600
    # share of the followed landmarks that is left when new ones are sought
    refresh_share: Annotated[float, Range(0, 1), EXPERT] = 0.5
    # number of frames after which new landmarks are sought anyway
    refresh_frames: Annotated[int, Range(1, 10**6), EXPERT] = 20
    # number of second-order steps on depth in addition to landmarks
    depth_steps: Annotated[int, Range(1, 100), EXPERT] = 1
    # number of lost frames that are all searched; afterwards every second one is
    patience: Annotated[int, Range(1, 10**6), EXPERT] = 3
    # interval between frames without time stamps, seconds
    frame_seconds: Annotated[float, Above(0.0, 1e4)] = 1 / 30
