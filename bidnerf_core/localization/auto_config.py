"""Settings of method ``auto``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.depth.sensors import DEPTH_SENSORS
from bidnerf_core.localization.by_colour import ByColourConfig
from bidnerf_core.settings import EXPERT, OneOf, Range, Settings

LEAST_POINTS = 50
"""Least number of measured depths from which the shape of the scene can be recognised."""


@dataclass(frozen=True)
class AutoConfig(Settings):
    """Settings of method ``auto``."""

    # largest number of measured points that are aligned
    points: Annotated[int, Range(LEAST_POINTS, 10**6)] = 2000
    hypotheses: Annotated[int, Range(8, 10**5)] = 256  # number of poses with which a round of search begins
    # largest number of rounds of search, each with fresh hypotheses, until an answer is accepted
    rounds: Annotated[int, Range(1, 100)] = 3
    # steps on rendered rays that refine an answer by depth; 0: none
    refine_steps: Annotated[int, Range(0, 1000)] = 2
    refine_rays: Annotated[int, Range(64, 10**6)] = 512  # number of rays rendered for each of these steps
    landmarks: bool = True  # match image features with the map's landmarks first, where it has some
    # number of rendered rays that are fused with landmarks; 0: nothing is rendered, neither for that nor to tell cameras or mirror
    # images apart
    fused_rays: Annotated[int, Range(0, 10**6)] = 1024
    # what measured the depth: unknown, kinect, realsense, lidar or rendered
    depth_sensor: Annotated[str, OneOf(DEPTH_SENSORS)] = "unknown"
    by_colour: Annotated[ByColourConfig, EXPERT] = ByColourConfig()
