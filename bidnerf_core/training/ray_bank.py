"""The rays of training views, and the batches drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor
from torch.nn.functional import pad

from bidnerf_core.camera import AT_REST, CameraBatch, Intrinsics, poses_of_rows
from bidnerf_core.devices import constant, move_to
from bidnerf_core.fields import Observations, Rays, SceneBounds
from bidnerf_core.frames import SPARSE, Frame, ImagePixels, View, bytes_of
from bidnerf_core.geometry import SE3
from bidnerf_core.progress import log

MEASURED_SHARE = 0.25
"""Fraction of a batch's rays drawn from pixels with depth, if these are so few that hardly any would be drawn
otherwise (in DS-NeRF: half)."""
HIDDEN_BLOCK = 16
"""Number of pixels in a block, whose visible pixels are counted together; the counts take half a byte per pixel."""
LARGEST_SHARE = 0.5
"""Largest fraction of a GPU's free memory that images may take; the rest is for the training itself."""
LANDMARK_SHARE = 0.125
"""Fraction of a batch's rays drawn from pixels that show a landmark."""


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Rays of training views, the measurements along them, and the background over which their colours were composited."""

    rays: Rays  # world
    observed: Observations  # of the same rays, in the world; all of them have a colour
    background: Float[Tensor, "r 3"]
    image: Int[Tensor, "r"]  # index of the view that contains the ray
    deviation: Float[Tensor, "r"]  # metres: of a landmark's distance; 0 where a sensor measured it

    def __len__(self) -> int:
        return len(self.observed)


class RayBank:
    """The pixels of all training views, from which batches of rays are drawn. The batches are on ``device``.

    The images are on ``device`` as well, unless they would take more than ``LARGEST_SHARE`` of a GPU's free memory: they then
    stay in host memory, and each batch is copied to the GPU. On the CPU, images that lie in a few blocks of memory, as in a
    ``PixelStore``, are not copied.
    The background of images with an alpha channel is replaced with random colours in each batch, so that a field cannot
    explain the background as matter of one colour (as in the code of Mueller et al. 2022).
    """

    def __init__(self, views: Sequence[View], bounds: SceneBounds, device: torch.device | str = "cpu") -> None:
        self.bounds, self.device = bounds, torch.device(device)
        frames = [view.frame for view in views]
        self.home = home = _home_of(frames, self.device)
        sizes = torch.tensor([frame.intrinsics.width * frame.intrinsics.height for frame in frames])
        offsets = sizes.cumsum(0) - sizes
        self.count = int(sizes.sum())
        self.has_alpha = any(frame.alpha is not None for frame in frames)
        self.has_depth = any(frame.has_depth for frame in frames)
        self._rgb = ImagePixels.of([frame.rgb_bytes for frame in frames], 3, 0.0, home)
        self._alpha = ImagePixels.of([frame.alpha for frame in frames], 1, 1.0, home)
        self._depth = ImagePixels.of([frame.depth for frame in frames], 1, 0.0, home)
        self._hidden = ImagePixels.of([frame.hidden for frame in frames], 1, 0.0, home)
        visible = _visible_pixels(frames)
        self._few = self._sparse_depth(frames, offsets).to(home)
        self._landmarks = move_to(_landmark_pixels(views, offsets), home)
        self._cameras = _PixelRays([frame.intrinsics for frame in frames], home)
        rotation = torch.stack([view.T_ref_camera.rotation for view in views]).float()
        origin = torch.stack([view.T_ref_camera.translation for view in views]).float()
        rows = torch.stack([AT_REST if view.motion is None else view.motion for view in views]).float()
        motion = None if all(view.motion is None for view in views) else rows
        self.offsets, self._visible, self._rotation, self._origin, self._motion = move_to(
            (offsets, visible, rotation, origin, motion), home
        )
        self._drawn = self.count if visible is None else int(visible[-1])

    @property
    def has_distances(self) -> bool:
        """Whether any ray has a measured distance."""
        return self.has_depth or len(self._landmarks[0]) > 0

    def draw(self, count: int, generator: Generator) -> TrainingBatch:
        """Return the rays of ``count`` pixels, drawn uniformly from all visible pixels of the views.

        If only a few pixels have depth, a fixed fraction of the rays is drawn from these; another fraction is
        drawn from pixels with landmarks. Nothing is copied between devices if the generator is on the images'
        device.
        """
        index = self._visible_pixel(self._random(self._drawn, count, generator))
        if len(self._few):
            some = round(MEASURED_SHARE * count)
            index[:some] = self._few[self._random(len(self._few), some, generator)]
        deviation, seen = torch.zeros(count, device=self.home), torch.zeros(0, device=self.home)
        if landmarks := len(self._landmarks[0]):
            some = round(LANDMARK_SHARE * count)
            chosen = self._random(landmarks, some, generator)
            index[:some], seen, deviation[:some] = (part[chosen] for part in self._landmarks)
        view = torch.searchsorted(self.offsets, index, right=True) - 1
        pixel = index - self.offsets[view]
        ray = self._cameras.rays(view, pixel)
        length = torch.linalg.vector_norm(ray, dim=-1)
        T = SE3(self._rotation[view], self._origin[view])
        if self._motion is not None:
            T = T @ poses_of_rows(self._cameras.exposure_times(view, pixel), self._motion[view])
        directions = T.rotate(ray / length[:, None])
        distance = self._depth.at(view, pixel)[:, 0] * length if self.has_depth else torch.zeros_like(length)
        distance[: len(seen)] = seen
        rgb = self._rgb.at(view, pixel)
        usual = background = constant(self.bounds.background, rgb).expand(count, 3)
        if self.has_alpha:
            background = torch.rand(rgb.shape, generator=generator, device=generator.device).to(rgb)
            rgb = rgb + (1 - self._alpha.at(view, pixel)) * (background - usual)
        origins, coloured = T.translation, torch.ones_like(index, dtype=torch.bool)
        observed = Observations(origins, directions, rgb, distance, coloured)
        rays = self.bounds.rays(origins, directions)
        return move_to(TrainingBatch(rays, observed, background, view, deviation), self.device)

    def _random(self, below: int, count: int, generator: Generator) -> Int[Tensor, "n"]:
        return torch.randint(below, (count,), generator=generator, device=generator.device).to(self.home)

    def _visible_pixel(self, rank: Int[Tensor, "r"]) -> Int[Tensor, "r"]:
        """Convert ranks among the visible pixels to indices among all pixels."""
        if self._visible is None:
            return rank
        block = torch.searchsorted(self._visible, rank, right=True) - 1
        index = block[:, None] * HIDDEN_BLOCK + torch.arange(HIDDEN_BLOCK, device=rank.device)
        within = index.clamp(max=self.count - 1).reshape(-1)
        view = torch.searchsorted(self.offsets, within, right=True) - 1
        hidden = self._hidden.at(view, within - self.offsets[view])[:, 0].view(index.shape) > 0
        # In its block, the pixel is preceded by as many visible pixels as the difference between its rank and
        # the block's.
        passed = (~hidden).cumsum(1) <= (rank - self._visible[block])[:, None]
        return block * HIDDEN_BLOCK + passed.sum(1)

    def _sparse_depth(self, frames: Sequence[Frame], offsets: Int[Tensor, "v"]) -> Int[Tensor, "m"]:
        """Return the indices of the pixels with depth if depth is sparse (structure from motion); otherwise no indices."""
        none = torch.zeros(0, dtype=torch.long)
        measured = sum(int((frame.depth > 0).sum()) for frame in frames if frame.depth is not None)
        if not measured or measured >= SPARSE * self.count:
            return none
        parts = [
            first + (frame.depth.reshape(-1) > 0).nonzero()[:, 0].cpu()
            for frame, first in zip(frames, offsets.tolist(), strict=True)
            if frame.depth is not None
        ]
        return torch.cat([none, *parts])


MOST_RAYS = 2**24
"""Largest number of pixels, over all distinct cameras, for which rays are computed in advance rather than per batch."""


class _PixelRays:
    """The pixel rays of many cameras, most of which usually have equal intrinsics; pixels are numbered row by row."""

    def __init__(self, cameras: Sequence[Intrinsics], device: torch.device) -> None:
        number = {kind: index for index, kind in enumerate(dict.fromkeys(cameras))}
        kinds = list(number)
        size = torch.tensor([[kind.width, kind.height] for kind in kinds])
        sizes, grid = size.prod(1), None
        if int(sizes.sum()) <= MOST_RAYS:
            grid = torch.cat([kind.unproject(kind.pixel_centres()).reshape(-1, 3) for kind in kinds])
        kind = torch.tensor([number[camera] for camera in cameras])
        self._kind, self._size, self._start, self._grid, self._batch = move_to(
            (kind, size, sizes.cumsum(0) - sizes, grid, CameraBatch.of(kinds)), device
        )

    def rays(self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> Float[Tensor, "r 3"]:
        """Return the direction of each pixel's ray in the camera frame of its view, with z = 1."""
        kind = self._kind[view]
        if self._grid is not None:
            return self._grid[self._start[kind] + pixel]
        return self._batch.unproject(self._centres(kind, pixel).float(), kind)

    def exposure_times(self, view: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> Float[Tensor, "r"]:
        """Return the exposure times of pixels as a fraction of the readout, -0.5 to 0.5, see ``camera.exposure_times``."""
        kind = self._kind[view]
        size, centres = self._size[kind], self._centres(kind, pixel)
        upright = size[:, 1] > size[:, 0]
        along = torch.where(upright[:, None], centres / size, (centres / size).flip(1))[:, 0]
        return (along - 0.5).float()

    def _centres(self, kind: Int[Tensor, "r"], pixel: Int[Tensor, "r"]) -> Float[Tensor, "r 2"]:
        width = self._size[kind, 0]
        return torch.stack([pixel % width, pixel // width], dim=-1).double() + 0.5


def _visible_pixels(frames: Sequence[Frame]) -> Int[Tensor, "b"] | None:
    """Return the number of visible pixels before each block of ``HIDDEN_BLOCK`` pixels, and in total; None if all pixels are visible."""
    if all(frame.hidden is None for frame in frames):
        return None
    hidden = [
        torch.zeros(frame.rgb_bytes.shape[:2], dtype=torch.bool) if frame.hidden is None else frame.hidden
        for frame in frames
    ]
    visible = ~torch.cat([part.cpu().reshape(-1) for part in hidden])
    counts = pad(visible, (0, -len(visible) % HIDDEN_BLOCK)).view(-1, HIDDEN_BLOCK).sum(1)
    return pad(counts.cumsum(0), (1, 0))


def _home_of(frames: Sequence[Frame], device: torch.device) -> torch.device:
    """Return the device that holds the images: ``device``, or the CPU if they are too large for it."""
    if device.type != "cuda":
        return device
    free, size = torch.cuda.mem_get_info(device)[0], sum(map(bytes_of, frames))
    if size <= LARGEST_SHARE * free:
        return device
    log.info(
        f"the images take {size / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free on {device}: they stay in the host's memory,"
        " and training copies each batch"
    )
    return torch.device("cpu")


def _landmark_pixels(
    views: Sequence[View], offsets: Int[Tensor, "v"]
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Return the pixels that show landmarks (indices over all views), and the distances of the landmarks with standard deviations (metres).

    Views with dense depth have none, since their own measurements are better.
    """
    parts: list[tuple[Tensor, Tensor, Tensor]] = [(torch.zeros(0, dtype=torch.long), torch.zeros(0), torch.zeros(0))]
    for view, first in zip(views, offsets.tolist(), strict=True):
        seen, camera = view.landmarks, view.frame.intrinsics
        if seen is None or view.frame.has_dense_depth:
            continue
        columns = seen.pixels[:, 0].long().clamp(0, camera.width - 1)
        rows = seen.pixels[:, 1].long().clamp(0, camera.height - 1)
        parts.append((first + rows * camera.width + columns, seen.distance.float(), seen.deviation.float()))
    pixel, distance, deviation = map(torch.cat, zip(*parts, strict=True))
    return pixel, distance, deviation
