"""How finely images resolve a scene: the width of what a pixel shows."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import torch

from bidnerf_core.carving.boxes import AxisBox
from bidnerf_core.frames import View


def footprint(views: Sequence[View], box: AxisBox) -> float:
    """Return the width (metres) of what a pixel in the middle of an image shows, at the usual distance: a median over views.

    The distance is the median of a view's measured depth or, without any, of its landmarks. Views that have neither, where all
    have neither, are taken to see the middle of the box; those inside of the box, its walls.
    """
    known = [width for view in views if (width := _known(view)) is not None]
    return statistics.median(known or [_assumed(view, box) for view in views])


def _known(view: View) -> float | None:
    depth, seen, focal = view.frame.depth, view.landmarks, _focal(view)
    if depth is not None and view.frame.has_depth:
        return float(depth[depth > 0].median()) / focal
    if seen is not None and len(seen.distance):
        return float(seen.distance.median()) / focal
    return None


def _assumed(view: View, box: AxisBox) -> float:
    middle, half = (box[0] + box[1]) / 2, float((box[1] - box[0]).amax()) / 2
    away = float(torch.linalg.vector_norm(view.T_ref_camera.translation.double() - middle))
    return max(away, half) / _focal(view)


def _focal(view: View) -> float:
    camera = view.frame.intrinsics
    return (camera.fx + camera.fy) / 2
