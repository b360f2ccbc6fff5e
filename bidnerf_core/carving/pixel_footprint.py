"""The resolution of images in a scene: the width covered by a pixel."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence

import torch

from bidnerf_core.carving.boxes import AxisBox
from bidnerf_core.frames import View


def pixel_footprint(views: Sequence[View], distance: Callable[[View], float]) -> float:
    """Return the width (metres) that a pixel covers at each view's ``distance`` (metres): the median over the views."""
    cameras = [(view, view.frame.intrinsics) for view in views]
    return statistics.median(2 * distance(view) / (camera.fx + camera.fy) for view, camera in cameras)


def measured_distance(view: View) -> float:
    """Return the median depth (metres) of a view with depth."""
    depth = view.frame.depth
    assert depth is not None
    return float(depth[depth > 0].median())


def landmark_distance(view: View) -> float:
    """Return the median distance (metres) of the landmarks that a view sees."""
    seen = view.landmarks
    assert seen is not None
    return float(seen.distance.median())


def distance_of_middle(view: View, box: AxisBox) -> float:
    """Return the distance (metres) of the box's middle, or half of the longest side if that is more."""
    middle, half = (box[0] + box[1]) / 2, float((box[1] - box[0]).amax()) / 2
    return max(float(torch.linalg.vector_norm(view.T_ref_camera.translation.double() - middle)), half)
