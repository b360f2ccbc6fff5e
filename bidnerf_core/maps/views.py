"""The views that a map is built from: a dataset's, those at the path to one, or views in memory."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Dataset,
    Georeferenced,
    ReadingProgress,
    SparseChoice,
    SparsePoints,
    open_dataset,
    reading_at,
    with_all,
)
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import (
    BLACK,
    INVERTED,
    Frame,
    PixelStore,
    View,
    WhollyHidden,
    bytes_of,
    masks_sentence,
)
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.io import Background, available_memory, background_colour
from bidnerf_core.progress import Cancel, ProgressCallback, counter

log = logging.getLogger("bidnerf")

Images: TypeAlias = Dataset | Sequence[View] | str | Path
"""Images with poses: a dataset, the path to one, or views whose reference frame is the world."""


Origin: TypeAlias = tuple[float, float, float]
"""The origin of a map's own coordinates, see ``Map.origin``."""
LARGEST_COORDINATE = 1000.0
"""Smallest coordinates that may be recentred. Single precision resolves 0.06 mm there, in metres."""
FAR = 10.0
"""Smallest ratio of the distance from 0 to the size of a scene at which it is recentred: it gains one digit."""


def chosen_origin(points: Float[Tensor, "n 3"]) -> Origin:
    """Return the origin for a map of ``points``, such as its cameras: 0, or a round position near their middle
    if they are far from 0.
    """
    low, high = points.double().amin(0), points.double().amax(0)
    middle, size = (low + high) / 2, float((high - low).max())
    if not float(middle.abs().max()) > max(LARGEST_COORDINATE, FAR * size):
        return 0.0, 0.0, 0.0
    step = 10.0 ** math.ceil(math.log10(max(size, 1.0)))
    x, y, z = (step * (middle / step).round()).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class ReadViews:
    """Views that were read, and their source."""

    views: list[View]
    source: str  # name of the dataset's folder; empty for views from memory
    place: str  # path of the dataset, or a description for views in memory
    background: tuple[float, float, float]  # behind images with an alpha channel
    hidden: int = 0  # pixels that masks hide
    unit: LengthUnit = "units"  # of the poses
    gravity_up: tuple[float, float, float] | None = (
        None  # upward direction (world), if the capture measured gravity
    )
    sparse_depth: int = 0  # pixels whose depth comes from the points of a COLMAP model
    depth_unit: float | None = None  # metres per step of depth images, if their format accepts another

    def about(self, origin: Origin) -> ReadViews:
        """Return the views with poses relative to ``origin``, a point of their world."""
        if not any(origin):
            return self
        offset = -torch.tensor(origin, dtype=torch.float64)
        views = [replace(view, T_ref_camera=view.T_ref_camera.translated(offset)) for view in self.views]
        return replace(self, views=views)


def read_views(
    data: Images,
    split: str = "train",
    background: Background | None = None,
    depth_points: str | Path | None = None,
    point_choice: SparseChoice | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
    largest: int | None = None,
    folder: Path | None = None,
    camera: Intrinsics | str | Path | None = None,
) -> ReadViews:
    """Read the views of ``data``; ``split`` selects those of a dataset, and "all" stands for all splits.

    Images of a dataset with more than ``largest`` pixels along the longer side are downscaled to that, by
    default to ``useful_size``. They are held as bytes, and if they are many in a nameless file in ``folder``,
    see ``PixelStore``.

    ``background`` is the colour behind images with an alpha channel, by default the dataset's. Images without
    depth take it from the points of the COLMAP model in folder ``depth_points``, see ``SparsePoints``.
    ``camera`` is for the path to a dataset that stores no camera. Raises ``InputError`` if there are no
    views, and if they or the model cannot be used.
    """
    stated: LengthUnit | None = None
    up: tuple[float, float, float] | None = None
    step: float | None = None
    if isinstance(data, str | Path):
        data, camera = open_dataset(data, background, camera=camera), None
        background = None
    if camera is not None:
        raise InputError(
            "camera is given for images that have cameras; it is only for the path to images without"
        )
    if isinstance(data, Dataset):
        if background is not None and background_colour(background) != data.background:
            raise InputError(
                f"was opened with background {data.background}, got {background!r}", where=data.path
            )
        if isinstance(data, Georeferenced):
            stated, up = data.unit, data.up
        step, data = getattr(data, "depth_unit", None), with_all(data, split)
        if not data.frame_names(split):
            raise InputError(f"split {split!r} has no frames", where=data.path)
        views = _read(data, split, largest, folder, counter("reading", "images", progress, cancel))
        if left_out := len(data.frame_names(split)) - len(views):
            log.info(f"{data.path}: {amount(left_out, 'image')} left out, being entirely hidden; {INVERTED}")
        if not views:
            raise InputError(
                f"masks hide every image in split {split!r} entirely; {INVERTED}", where=data.path
            )
        source, place, colour = data.path.resolve().name, str(data.path), data.background
    else:
        views, source, place = _checked(data), "", "views in memory"
        colour = BLACK if background is None else background_colour(background)
    hidden = _hidden(views, place)
    unit = stated or _unit_of(views)
    if depth_points is None:
        return ReadViews(views, source, place, colour, hidden, unit, up, depth_unit=step)
    views, count = _with_depth(views, Path(depth_points), point_choice or SparseChoice(), split)
    return ReadViews(views, source, place, colour, hidden, unit, up, count, step)


def _hidden(views: Sequence[View], place: str) -> int:
    """Return how many pixels masks hide, and log it."""
    hidden = [view.frame.hidden for view in views]
    if (sentence := masks_sentence(hidden)) is not None:
        log.info(f"{place}: {sentence}")
    return sum(int(pixels.sum()) for pixels in hidden if pixels is not None)


def _read(
    data: Dataset, split: str, largest: int | None, folder: Path | None, progress: ReadingProgress
) -> list[View]:
    """Read the views of a split one after another, so that only one image is in memory at full size."""
    names = data.frame_names(split)
    views: list[View] = []
    store, limit = PixelStore(0), 0  # the first image is read at full size, which is logged
    for place, name in enumerate(names):
        for view in _one(data, split, name, limit if views else None, largest is not None):
            if not views:
                limit = largest or useful_size(view.frame, len(names))
                small = view.frame.at_most(limit)
                store = PixelStore(len(names) * bytes_of(small), folder)
                _say_size(str(data.path), view.frame, small, len(names))
            views.append(replace(view, frame=store.stored(view.frame.at_most(limit))))
        progress(place + 1, len(names))
    return views


def _one(data: Dataset, split: str, name: str, limit: int | None, asked: bool) -> list[View]:
    """Read a frame, at most ``limit`` pixels wide and high, which the user may have requested (``asked``).

    Returns none if a mask hides it entirely, as when a whole split is read.
    """
    try:
        with reading_at(limit, asked):
            return data.views(split, [name])
    except WhollyHidden:
        return []


USEFUL_SIDE, LEAST_SIDE = 1600, 800
"""Pixels along the longer side: more are of little use to a map, whose keypoints are found at the latter;
fewer harm it."""
MOST_BYTES = 2_000_000_000
"""Bytes that the images of a training run use by default; on machines with little memory, a quarter of what
is available."""


def useful_size(frame: Frame, count: int) -> int:
    """Return the longer side (pixels) to which ``count`` images like ``frame`` are downscaled by default.

    It is ``USEFUL_SIDE``, or less if the images would not fit into memory, but not less than ``LEAST_SIDE``.
    """
    most = min(MOST_BYTES, available_memory() // 4)
    longer = max(frame.intrinsics.width, frame.intrinsics.height)
    fitting = int(longer * (most / (count * bytes_of(frame))) ** 0.5)
    return min(USEFUL_SIDE, max(LEAST_SIDE, fitting))


def _say_size(place: str, frame: Frame, small: Frame, count: int) -> None:
    if small is frame:
        return
    before, after = (f"{f.intrinsics.width}x{f.intrinsics.height}" for f in (frame, small))
    size = count * bytes_of(small) / 1e6
    log.info(
        f"{place}: {amount(count, 'image')} of {before} read at {after}, {size:.0f} MB; --largest (largest=) sets another size"
    )


def _unit_of(views: Sequence[View]) -> LengthUnit:
    """Return metres for views with dense measured depth: training rejects poses that contradict it."""
    return "metres" if any(view.frame.has_dense_depth for view in views) else "units"


def _checked(views: Sequence[View]) -> list[View]:
    found = list(views) if isinstance(views, Sequence) else [views]
    for view in found:
        if not isinstance(view, View):
            raise InputError(
                f"data is or holds a {type(view).__name__}", expected="a dataset, a path, or views with poses"
            )
    if not found:
        raise InputError("data holds no views", expected="at least one")
    return found


def _with_depth(views: list[View], model: Path, choice: SparseChoice, split: str) -> tuple[list[View], int]:
    """Return the views with depth from the model's points, and the number of pixels that have it."""
    places = [(view.frame.name, view.T_ref_camera) for view in views]
    sparse = SparsePoints(model, places, choice, split)
    changed = [sparse.onto(view, split) for view in views]
    new = [after for after, before in zip(changed, views, strict=True) if after is not before]
    count = sum(int((view.frame.depth > 0).sum()) for view in new if view.frame.depth is not None)
    if count == 0:
        raise InputError(
            f"gives no depth to split {split!r}",
            where=model,
            expected="points that its images observe and images without depth",
        )
    log.info(f"{sparse.summary}; depth at {count} pixels of {len(new)} of {len(views)} images")
    return changed, count
