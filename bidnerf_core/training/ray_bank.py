"""The rays of training views, and the batches that are drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from bidnerf_core.camera.rolling_shutter import AT_REST, exposure_times, poses_of_rows
from bidnerf_core.devices import moved
from bidnerf_core.fields.contract import Rays, SceneBounds
from bidnerf_core.fields.observations import Observations
from bidnerf_core.frames.frame import SPARSE, Frame, View
from bidnerf_core.geometry.se3 import SE3

MEASURED_SHARE = 0.25
"""Fraction of a batch's rays that are drawn from pixels with depth, if these are so few that hardly any would be drawn
otherwise (in DS-NeRF: half)."""
REDRAWN = 64
"""Rounds in which rays of hidden pixels are drawn anew, before the visible pixels are listed."""
LANDMARK_SHARE = 0.125
"""Fraction of a batch's rays that are drawn from pixels that show a landmark."""


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Rays of training views, the measurements along them, and the background over which their colours were composited."""

    rays: Rays  # world
    observed: Observations  # of the same rays, in the world; all of them have a colour
    background: Float[Tensor, "r 3"]
    image: Int[Tensor, "r"]  # number of the view that shows the ray
    deviation: Float[Tensor, "r"]  # metres: of a landmark's distance; 0 where a sensor measured it

    def __len__(self) -> int:
        return len(self.observed)


class RayBank:
    """All pixels of the training views, from which batches are drawn. Pixels stay in host memory; batches are on ``device``.

    Where an image has an alpha channel, each batch replaces its background by random colours, so that a field cannot
    explain the background by matter of one colour (as in the code of Mueller et al. 2022).
    """

    def __init__(
        self, views: Sequence[View], bounds: SceneBounds, device: torch.device | str = "cpu"
    ) -> None:
        self.bounds, self.device = bounds, torch.device(device)
        frames = [view.frame for view in views]
        sizes = torch.tensor([frame.rgb.shape[0] * frame.rgb.shape[1] for frame in frames])
        self.offsets = sizes.cumsum(0) - sizes
        self.count = int(sizes.sum())
        self.has_alpha = any(frame.alpha is not None for frame in frames)
        self.has_depth = any(frame.has_depth for frame in frames)
        self._rgb = torch.cat([frame.rgb.reshape(-1, 3) for frame in frames])
        self._hidden = _hidden_pixels(frames)
        if self.has_alpha:
            one = [torch.ones(f.rgb.shape[:2]) if f.alpha is None else f.alpha for f in frames]
            self._alpha = torch.cat([a.reshape(-1) for a in one])
        if self.has_depth:
            zero = [torch.zeros(f.rgb.shape[:2]) if f.depth is None else f.depth for f in frames]
            self._depth = torch.cat([d.reshape(-1) for d in zero])
        self._few = self._few_measured()
        self._landmarks = _landmark_pixels(views, self.offsets)
        self._rotation = torch.stack([view.T_ref_camera.rotation for view in views]).float()
        self._origin = torch.stack([view.T_ref_camera.translation for view in views]).float()
        kinds = list(dict.fromkeys(frame.intrinsics for frame in frames))
        grids = [kind.unproject(kind.pixel_centres()).reshape(-1, 3) for kind in kinds]
        starts = torch.tensor([0, *[len(grid) for grid in grids]]).cumsum(0)
        self._camera_rays = torch.cat(grids)  # z = 1
        self._motion = _motion_of(views)
        if self._motion is not None:
            times = [exposure_times(kind.pixel_centres().reshape(-1, 2), kind) for kind in kinds]
            self._exposure_times = torch.cat(times).float()
        self._camera_start = torch.stack([starts[kinds.index(frame.intrinsics)] for frame in frames])

    def draw(self, count: int, generator: Generator) -> TrainingBatch:
        """Return the rays of ``count`` pixels, drawn uniformly from those of all views that are not hidden.

        Where only few pixels have depth, a fixed share is drawn from these; another share is drawn from those with landmarks.
        """
        index = self._visible(torch.randint(self.count, (count,), generator=generator), generator)
        if len(self._few):
            some = round(MEASURED_SHARE * count)
            index[:some] = self._few[torch.randint(len(self._few), (some,), generator=generator)]
        deviation, seen = torch.zeros(count), torch.zeros(0)
        if len(self._landmarks):
            some = round(LANDMARK_SHARE * count)
            chosen = torch.randint(len(self._landmarks), (some,), generator=generator)
            index[:some] = self._landmarks.pixel[chosen]
            seen, deviation[:some] = self._landmarks.distance[chosen], self._landmarks.deviation[chosen]
        view = torch.searchsorted(self.offsets, index, right=True) - 1
        ray = self._camera_rays[self._camera_start[view] + index - self.offsets[view]]
        length = torch.linalg.vector_norm(ray, dim=-1)
        T = self._poses(view, index - self.offsets[view])
        directions = T.rotate(ray / length[:, None])
        distance = self._depth[index] * length if self.has_depth else torch.zeros(count)
        distance[: len(seen)] = seen
        rgb, background = self._coloured(index, generator)
        origins, coloured = T.translation, torch.ones(count, dtype=torch.bool)
        observed = Observations(origins, directions, rgb, distance, coloured)
        rays = self.bounds.rays(origins, directions)
        return moved(TrainingBatch(rays, observed, background, view, deviation), self.device)

    def _visible(self, index: Int[Tensor, "r"], generator: Generator) -> Int[Tensor, "r"]:
        """Return the indices of pixels with those of hidden pixels drawn anew."""
        if self._hidden is None:
            return index
        for _ in range(REDRAWN):
            again = self._hidden[index].nonzero()[:, 0]
            if not len(again):
                return index
            index[again] = torch.randint(self.count, (len(again),), generator=generator)
        again, left = self._hidden[index].nonzero()[:, 0], (~self._hidden).nonzero()[:, 0]
        index[again] = left[torch.randint(len(left), (len(again),), generator=generator)]
        return index

    def _poses(self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> SE3:
        """Return the poses of the cameras at the times at which pixels of the views were exposed."""
        T = SE3(self._rotation[view], self._origin[view])
        if self._motion is None:
            return T
        return T @ poses_of_rows(self._exposure_times[self._camera_start[view] + pixel], self._motion[view])

    def _few_measured(self) -> Int[Tensor, "m"]:
        """Return the indices of the pixels with depth if it is sparse (structure from motion); otherwise none."""
        if not self.has_depth:
            return torch.zeros(0, dtype=torch.long)
        measured = (self._depth > 0).nonzero()[:, 0]
        return measured if len(measured) < SPARSE * self.count else measured[:0]

    def _coloured(self, index: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Return the pixels' colours and the background colours over which they are composited."""
        usual = torch.tensor(self.bounds.background).expand(len(index), 3)
        if not self.has_alpha:
            return self._rgb[index], usual
        background = torch.rand((len(index), 3), generator=generator)
        return self._rgb[index] + (1 - self._alpha[index])[:, None] * (background - usual), background


def _hidden_pixels(frames: Sequence[Frame]) -> Bool[Tensor, "n"] | None:
    """Return which pixels of all frames are hidden; None if none is."""
    if all(frame.hidden is None for frame in frames):
        return None
    parts = [torch.zeros(f.rgb.shape[:2], dtype=torch.bool) if f.hidden is None else f.hidden for f in frames]
    return torch.cat([part.reshape(-1) for part in parts])


def _motion_of(views: Sequence[View]) -> Float[Tensor, "v 6"] | None:
    """Return the motions of the cameras while the rows of their images were exposed; None if none moved."""
    if all(view.motion is None for view in views):
        return None
    return torch.stack([AT_REST if view.motion is None else view.motion for view in views]).float()


@dataclass(frozen=True, eq=False)
class _LandmarkPixels:
    """The pixels, in all views, that show a landmark."""

    pixel: Int[Tensor, "m"]  # index among the pixels of all views
    distance: Float[Tensor, "m"]  # metres
    deviation: Float[Tensor, "m"]  # metres

    def __len__(self) -> int:
        return len(self.pixel)


def _landmark_pixels(views: Sequence[View], offsets: Int[Tensor, "v"]) -> _LandmarkPixels:
    """Return the landmarks of the views without dense depth; where depth is dense, its measurements are better."""
    parts: list[tuple[Tensor, Tensor, Tensor]] = [
        (torch.zeros(0, dtype=torch.long), torch.zeros(0), torch.zeros(0))
    ]
    for view, first in zip(views, offsets.tolist(), strict=True):
        seen, camera = view.landmarks, view.frame.intrinsics
        if seen is None or view.frame.has_dense_depth:
            continue
        columns = seen.pixels[:, 0].long().clamp(0, camera.width - 1)
        rows = seen.pixels[:, 1].long().clamp(0, camera.height - 1)
        parts.append((first + rows * camera.width + columns, seen.distance.float(), seen.deviation.float()))
    return _LandmarkPixels(*(torch.cat(part) for part in zip(*parts, strict=True)))
