"""The rays of training views, and the batches drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from bidnerf_core.camera import AT_REST, CameraBatch, Intrinsics, poses_of_rows
from bidnerf_core.devices import moved
from bidnerf_core.fields import Observations, Rays, SceneBounds
from bidnerf_core.frames import SPARSE, Frame, ImagePixels, View
from bidnerf_core.geometry import SE3

MEASURED_SHARE = 0.25
"""Fraction of a batch's rays drawn from pixels with depth, if these are so few that hardly any would be drawn
otherwise (in DS-NeRF: half)."""
REDRAWN = 64
"""Number of attempts to redraw rays of hidden pixels before the visible pixels are listed."""
LANDMARK_SHARE = 0.125
"""Fraction of a batch's rays drawn from pixels that show a landmark."""


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Rays of training views, the measurements along them, and the background over which their colours were
    composited.
    """

    rays: Rays  # world
    observed: Observations  # of the same rays, in the world; all of them have a colour
    background: Float[Tensor, "r 3"]
    image: Int[Tensor, "r"]  # index of the view that contains the ray
    deviation: Float[Tensor, "r"]  # metres: of a landmark's distance; 0 where a sensor measured it

    def __len__(self) -> int:
        return len(self.observed)


class RayBank:
    """All pixels of the training views, from which batches are drawn. Pixels stay in host memory; batches are on ``device``.

    If an image has an alpha channel, each batch replaces its background by random colours, so that a field
    cannot explain the background by matter of one colour (as in the code of Mueller et al. 2022). The images
    are those of the views: they are not copied if they lie in few blocks of memory, as in a ``PixelStore``.
    """

    def __init__(
        self, views: Sequence[View], bounds: SceneBounds, device: torch.device | str = "cpu"
    ) -> None:
        self.bounds, self.device = bounds, torch.device(device)
        frames = [view.frame for view in views]
        sizes = torch.tensor([frame.intrinsics.width * frame.intrinsics.height for frame in frames])
        self.offsets = sizes.cumsum(0) - sizes
        self.count = int(sizes.sum())
        self.has_alpha = any(frame.alpha is not None for frame in frames)
        self.has_depth = any(frame.has_depth for frame in frames)
        self._rgb = ImagePixels.of([frame.rgb_bytes for frame in frames], 3)
        self._alpha = ImagePixels.of([frame.alpha for frame in frames], 1, default=1.0)
        self._depth = ImagePixels.of([frame.depth for frame in frames], 1)
        self._hidden = ImagePixels.of([frame.hidden for frame in frames], 1)
        self._visible_counts = _visible_pixels(frames)
        self._few = self._few_measured(frames)
        self._landmarks = _landmark_pixels(views, self.offsets)
        self._rotation = torch.stack([view.T_ref_camera.rotation for view in views]).float()
        self._origin = torch.stack([view.T_ref_camera.translation for view in views]).float()
        self._cameras = _PixelRays([frame.intrinsics for frame in frames])
        self._motion = _motion_of(views)

    def draw(self, count: int, generator: Generator) -> TrainingBatch:
        """Return the rays of ``count`` pixels, drawn uniformly from all visible pixels of the views.

        If only few pixels have depth, a fixed fraction is drawn from these; another fraction is drawn from
        those with landmarks.
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
        pixel = index - self.offsets[view]
        ray = self._cameras.rays(view, pixel)
        length = torch.linalg.vector_norm(ray, dim=-1)
        T = self._poses(view, pixel)
        directions = T.rotate(ray / length[:, None])
        distance = self._depth.at(view, pixel)[:, 0] * length if self.has_depth else torch.zeros(count)
        distance[: len(seen)] = seen
        rgb, background = self._coloured(view, pixel, generator)
        origins, coloured = T.translation, torch.ones(count, dtype=torch.bool)
        observed = Observations(origins, directions, rgb, distance, coloured)
        rays = self.bounds.rays(origins, directions)
        return moved(TrainingBatch(rays, observed, background, view, deviation), self.device)

    def _visible(self, index: Int[Tensor, "r"], generator: Generator) -> Int[Tensor, "r"]:
        """Redraw the indices of hidden pixels."""
        if self._visible_counts is None:
            return index
        for _ in range(REDRAWN):
            again = self._is_hidden(index).nonzero()[:, 0]
            if not len(again):
                return index
            index[again] = torch.randint(self.count, (len(again),), generator=generator)
        again = self._is_hidden(index).nonzero()[:, 0]
        chosen = torch.multinomial(
            self._visible_counts, max(1, len(again)), replacement=True, generator=generator
        )
        for place, view in zip(again.tolist(), chosen.tolist(), strict=False):
            index[place] = self._any_visible(view, generator)
        return index

    def _any_visible(self, view: int, generator: Generator) -> int:
        """Return the index of one visible pixel of a view."""
        first, last = [*self.offsets.tolist(), self.count][view : view + 2]
        left = (~self._is_hidden(torch.arange(first, last))).nonzero()[:, 0]
        return first + int(left[torch.randint(len(left), (1,), generator=generator)])

    def _is_hidden(self, index: Int[Tensor, "r"]) -> Bool[Tensor, "r"]:
        view = torch.searchsorted(self.offsets, index, right=True) - 1
        return self._hidden.at(view, index - self.offsets[view])[:, 0] > 0

    def _poses(self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> SE3:
        """Return the camera poses at the times at which pixels of the views were exposed."""
        T = SE3(self._rotation[view], self._origin[view])
        if self._motion is None:
            return T
        return T @ poses_of_rows(self._cameras.exposure_times(view, pixel), self._motion[view])

    def _few_measured(self, frames: Sequence[Frame]) -> Int[Tensor, "m"]:
        """Return the indices of the pixels with depth if it is sparse (structure from motion); otherwise none."""
        none = torch.zeros(0, dtype=torch.long)
        measured = sum(int((frame.depth > 0).sum()) for frame in frames if frame.depth is not None)
        if not measured or measured >= SPARSE * self.count:
            return none
        parts = [
            first + (frame.depth.reshape(-1) > 0).nonzero()[:, 0].cpu()
            for frame, first in zip(frames, self.offsets.tolist(), strict=True)
            if frame.depth is not None
        ]
        return torch.cat([none, *parts])

    def _coloured(
        self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"], generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Return the pixels' colours and the background colours over which they are composited."""
        usual = torch.tensor(self.bounds.background).expand(len(view), 3)
        rgb = self._rgb.at(view, pixel)
        if not self.has_alpha:
            return rgb, usual
        background = torch.rand((len(view), 3), generator=generator)
        return rgb + (1 - self._alpha.at(view, pixel)) * (background - usual), background


MOST_RAYS = 2**24
"""Number of pixels, over all different cameras, up to which rays are computed once; beyond that, per batch."""


class _PixelRays:
    """The rays of the pixels of many cameras, usually mostly equal ones; pixels are numbered row by row."""

    def __init__(self, cameras: Sequence[Intrinsics]) -> None:
        number = {kind: place for place, kind in enumerate(dict.fromkeys(cameras))}
        kinds = list(number)
        self._kind = torch.tensor([number[camera] for camera in cameras])
        self._size = torch.tensor([[kind.width, kind.height] for kind in kinds])
        self._batch = CameraBatch.of(kinds)
        sizes = self._size.prod(1)
        self._start = sizes.cumsum(0) - sizes
        self._grid = None
        if int(sizes.sum()) <= MOST_RAYS:
            grids = [kind.unproject(kind.pixel_centres()).reshape(-1, 3) for kind in kinds]
            self._grid = torch.cat(grids)

    def rays(self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> Float[Tensor, "r 3"]:
        """Return the points on the plane z = 1 shown by pixels of the views' cameras."""
        kind = self._kind[view]
        if self._grid is not None:
            return self._grid[self._start[kind] + pixel]
        return self._batch.unproject(self._centres(kind, pixel).float(), kind)

    def exposure_times(self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> Float[Tensor, "r"]:
        """Return the times at which pixels were exposed, see ``rolling_shutter``."""
        kind = self._kind[view]
        size, centres = self._size[kind], self._centres(kind, pixel)
        upright = size[:, 1] > size[:, 0]
        along = torch.where(upright[:, None], centres / size, (centres / size).flip(1))[:, 0]
        return (along - 0.5).float()

    def _centres(self, kind: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> Float[Tensor, "r 2"]:
        width = self._size[kind, 0]
        return torch.stack([pixel % width, pixel // width], dim=-1).double() + 0.5


def _visible_pixels(frames: Sequence[Frame]) -> Float[Tensor, "v"] | None:
    """Return how many pixels of each frame are visible; None if all are."""
    if all(frame.hidden is None for frame in frames):
        return None
    counts = [
        frame.intrinsics.width * frame.intrinsics.height
        if frame.hidden is None
        else int((~frame.hidden).sum())
        for frame in frames
    ]
    return torch.tensor(counts, dtype=torch.float64)


def _motion_of(views: Sequence[View]) -> Float[Tensor, "v 6"] | None:
    """Return the motions of the cameras during the readout of their images; None if none moved."""
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
    """Return the landmarks of the views without dense depth, whose measurements are better."""
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
