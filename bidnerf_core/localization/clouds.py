"""What views measured, as points in the frame of the camera that is sought."""

from __future__ import annotations

import torch
from torch import Generator

from bidnerf_core.frames import View
from bidnerf_core.localization.alignment import Cloud
from bidnerf_core.localization.problem import Problem
from bidnerf_core.pixels import observe


def measured_cloud(problem: Problem, count: int, generator: Generator) -> Cloud:
    """Up to ``count`` of the measured pixels of all views, in random order, equally shared out; on the CPU."""
    share = -(-count // len(problem.views))
    parts = [_cloud_of(view, share, generator) for view in problem.views]
    order = torch.randperm(sum(map(len, parts)), generator=generator)[:count]
    names = ("points", "rgb", "origins")
    return Cloud(*(torch.cat([getattr(part, name) for part in parts])[order] for name in names))


def _cloud_of(view: View, count: int, generator: Generator) -> Cloud:
    depth = torch.zeros((0, 0)) if view.frame.depth is None else view.frame.depth.cpu()
    measured = ((depth > 0) & depth.isfinite()).nonzero()
    rows, columns = measured[torch.randperm(len(measured), generator=generator)[:count]].unbind(-1)
    seen = observe(view, torch.stack([columns, rows], dim=-1), device="cpu")
    points = seen.origins + seen.distance[:, None] * seen.directions
    return Cloud(points, seen.rgb, seen.origins)
