"""Settings of a tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.settings import EXPERT, Above, Range, Settings


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """Settings of a tracker."""

    points: Annotated[int, Range(20, 10**4)] = 250  # landmarks that are followed from image to image, at most
    depth_points: Annotated[int, Range(50, 10**6)] = 400  # of the measured pixels, at most
    window: Annotated[int, Range(1, 64)] = 1  # frames whose measured depth is aligned together
    keypoints: Annotated[int, Range(50, 10**5), EXPERT] = 600  # of an image in which landmarks are sought
    refresh_share: Annotated[float, Range(0, 1), EXPERT] = (
        0.5  # of the points left at which new ones are sought
    )
    refresh_frames: Annotated[int, Range(1, 10**6), EXPERT] = 20  # after which new ones are sought anyway
    depth_steps: Annotated[int, Range(1, 100), EXPERT] = 1  # second-order steps on depth beside landmarks
    patience: Annotated[int, Range(1, 10**6), EXPERT] = (
        3  # lost frames that are all searched; then every second
    )
    frame_seconds: Annotated[float, Above(0.0, 1e4)] = 1 / 30  # between frames without time stamps
