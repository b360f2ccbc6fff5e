"""A batch of rays with what was measured along them: the same for every pose that is tried."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, interpolate

from bidnerf_core.field import Rays, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.sampled import RayCounts
from bidnerf_core.observations import Observations
from bidnerf_core.pixels import DrawerName, draw, drawer
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Half-lines of the last camera's frame, and how much each measurement counts."""

    origins: Float[Tensor, "n 3"]  # metres
    directions: Float[Tensor, "n 3"]  # unit
    measured: Float[Tensor, "n 4"]  # red, green, blue, and metres along the ray
    share: Float[Tensor, "n 4"]  # of the objective; 0 where nothing was measured

    @property
    def distance(self) -> Float[Tensor, "n"]:
        """Metres; 0 where nothing was measured."""
        return self.measured[:, 3]

    def rays(self, T_world_last: SE3, bounds: SceneBounds) -> Rays:
        """Where each of h poses puts them: (h n)."""
        T = T_world_last.to(self.origins)
        many = SE3(T.rotation[:, None], T.translation[:, None])
        return bounds.rays(many.apply(self.origins), many.rotate(self.directions))


def draw_batch(
    problem: Problem,
    counts: RayCounts,
    pixels: DrawerName,
    depth_weight: float,
    blur: int,
    generator: Generator,
) -> RayBatch:
    """Pixels of all views and, where there are any, rays of depth; weighted as in eqs. 5 and 6.

    ``blur``: colours are means over so many pixels each way; 1: as they are.
    """
    views = [blurred(view, blur) for view in problem.views] if blur > 1 else problem.views
    seen = draw(views, counts.pixels, drawer(pixels), generator, device=problem.device)
    here = seen.distance > 0
    colour = torch.full_like(seen.rgb, 1 / here.numel())
    depth = depth_weight * here / (len(views) * here.sum(-1, keepdim=True).clamp(min=1))
    share = torch.cat([colour, depth[..., None]], -1)
    measured = torch.cat([seen.rgb, seen.distance[..., None]], -1)
    parts = (part.flatten(0, 1) for part in (seen.origins, seen.directions, measured, share))
    batch = RayBatch(*parts)
    if problem.depth_rays is None or depth_weight == 0 or counts.depth_rays == 0:
        return batch
    drawn = problem.depth_rays.drawn(counts.depth_rays, generator, device=problem.device)
    return _joined(batch, _of_depth(drawn, depth_weight))


def _of_depth(rays: Observations, depth_weight: float) -> RayBatch:
    """Rays that measured no colour."""
    none = rays.directions.new_zeros((len(rays), 3))
    share = torch.full_like(rays.distance, depth_weight / len(rays))
    measured, share = (torch.cat([none, part[:, None]], -1) for part in (rays.distance, share))
    return RayBatch(rays.origins, rays.directions, measured, share)


def _joined(one: RayBatch, other: RayBatch) -> RayBatch:
    names = ("origins", "directions", "measured", "share")
    return RayBatch(*(torch.cat([getattr(one, name), getattr(other, name)]) for name in names))


def blurred(view: View, size: int) -> View:
    """The view with colours averaged over squares of ``size`` pixels, and smooth in between; depth stays."""
    frame = view.frame
    height, width = frame.rgb.shape[:2]
    size = min(size, height, width)
    small = avg_pool2d(frame.rgb.permute(2, 0, 1)[None], size, ceil_mode=True, count_include_pad=False)
    # Of a size that the blocks cover, cut to the image: so that blocks stay where they were.
    covered = (small.shape[2] * size, small.shape[3] * size)
    smooth = interpolate(small, covered, mode="bilinear", align_corners=False)[..., :height, :width]
    return replace(view, frame=replace(frame, rgb=smooth[0].permute(1, 2, 0).contiguous()))
