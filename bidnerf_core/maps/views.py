"""Reading the views from which a map is built: from a dataset, from the path to a dataset, or from memory."""

from __future__ import annotations

import math
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import UPRIGHT, check_side
from bidnerf_core.captures import StoredCamera, apply_stored_poses
from bidnerf_core.datasets import (
    AS_STORED,
    Capture,
    DatasetOptions,
    SparseChoice,
    SparsePoints,
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
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import available_memory, background_colour
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.progress import log, report_each

ViewSource: TypeAlias = Capture | Sequence[View] | str | Path
"""Images with poses: a dataset, the path to one, or views whose reference frame is the world."""

Origin: TypeAlias = tuple[float, float, float]
"""The origin of a map's local coordinate frame, in world coordinates; see ``Map.origin``."""


def choose_origin(points: Float[Tensor, "n 3"]) -> Origin:
    """Choose the origin of a map with the given ``points``, such as its camera centres.

    The origin is 0, or a round position near the middle of the points if they are far from 0.
    """
    low, high = points.double().amin(0), points.double().amax(0)
    middle, size = (low + high) / 2, float((high - low).max())
    # At 1000 m, single precision still resolves 0.06 mm, and at ten times the scene's size, recentring gains one digit.
    if not float(middle.abs().max()) > max(1000.0, 10 * size):
        return 0.0, 0.0, 0.0
    step = 10.0 ** math.ceil(math.log10(max(size, 1.0)))
    x, y, z = (step * (middle / step).round()).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class ReadViews:
    """Views as read, with information about their source."""

    views: list[View]
    source: str  # name of the dataset's folder; empty for views from memory
    where: str  # path of the dataset, or a description for views in memory
    background: tuple[float, float, float]  # behind images with an alpha channel
    hidden: int = 0  # pixels that masks hide
    unit: LengthUnit = "units"  # of the poses
    # upward direction (world), if the capture measured gravity
    gravity_up: tuple[float, float, float] | None = None
    sparse_depth: int = 0  # pixels whose depth comes from the points of a COLMAP model
    depth_unit: float | None = None  # metres per step of depth images, if their format accepts another
    # files of images by name, relative to the dataset's folder
    files: Mapping[str, str] = field(default_factory=dict)

    def about(self, origin: Origin) -> ReadViews:
        """Return the views with poses relative to ``origin``, a point in their world frame."""
        if not any(origin):
            return self
        offset = -torch.tensor(origin, dtype=torch.float64)
        return replace(
            self, views=[replace(view, T_ref_camera=view.T_ref_camera.translated(offset)) for view in self.views]
        )

    def scaled(self, factor: float) -> ReadViews:
        """Return the views with all lengths, poses and measured depth, multiplied by ``factor``."""
        return self if factor == 1 else replace(self, views=[scaled_view(view, factor) for view in self.views])

    def with_files(self, cameras: Sequence[StoredCamera]) -> tuple[StoredCamera, ...]:
        """Return the cameras of the views, with the file of each image.

        An image gets no file if it shows only part of the file (a face of a panorama, the pinhole image of
        another lens) or its mirror image, since its camera is then not that of the file.
        """
        frames = {view.frame.name: view.frame for view in self.views}
        found = []
        for camera in cameras:
            frame, file = frames.get(camera.name), self.files.get(camera.name)
            if frame is not None and file is not None and frame.lens is None:
                turned = frame.orientation
                if (turned.mirrors_columns + turned.mirrors_rows + turned.transposes) % 2 == 0:
                    camera = replace(camera, file=file, orientation=None if turned == UPRIGHT else turned)
            found.append(camera)
        return tuple(found)


def read_views(
    data: ViewSource,
    options: DatasetOptions = AS_STORED,
    depth_points: str | Path | None = None,
    point_choice: SparseChoice | None = None,
    folder: Path | None = None,
    first: int | None = None,
) -> ReadViews:
    """Read the ``first`` so many views of ``data``, or all; of a dataset, ``options.split`` selects the split, or "all" for all splits.

    Dataset images with more than ``options.largest`` pixels along the longer side are downscaled to that size,
    by default to ``useful_size``. Images are held as bytes and, if there are many, in an unnamed file in
    ``folder``, see ``PixelStore``. The background behind images with an alpha channel is by default that of the
    dataset; the other options apply only if ``data`` is a path.

    Images without depth get depth from the points of the COLMAP model in folder ``depth_points``, see
    ``SparsePoints``. Raises ``InputError`` if there are no views, and if the views or the model cannot be used.
    """
    split, background, largest = options.split, options.background, check_side(options.largest)
    if isinstance(data, str | Path):
        data, background = options.open(data), None
    elif options.camera is not None:
        raise InputError("camera is given for images that have cameras; it is only for the path to images without")
    if isinstance(data, Capture):
        if background is not None and background_colour(background) != data.background:
            raise InputError(f"was opened with background {data.background}, got {background!r}", where=data.path)
        read = _read_dataset(data, split, first, largest, folder)
    else:
        given: Sequence[object] = data if isinstance(data, Sequence) else [data]
        views = [view for view in given if isinstance(view, View)]
        if odd := [type(other).__name__ for other in given if not isinstance(other, View)]:
            raise InputError(f"data is or holds a {odd[0]}", expected="a dataset, a path, or views with poses")
        if not views:
            raise InputError("data holds no views", expected="at least one")
        colour = BLACK if background is None else background_colour(background)
        views = [view.over(colour) for view in views[:first]]
        read = ReadViews(views, "", "views in memory", colour, unit=_unit_of(views))
    hidden = [view.frame.hidden for view in read.views]
    if (sentence := masks_sentence(hidden)) is not None:
        log.info(f"{read.where}: {sentence}")
    read = replace(read, hidden=sum(int(pixels.sum()) for pixels in hidden if pixels is not None))
    if depth_points is None:
        return read
    return _with_depth(read, Path(depth_points), point_choice or SparseChoice(), split)


def _read_dataset(data: Capture, split: str, first: int | None, largest: int | None, folder: Path | None) -> ReadViews:
    """Read the views of a split one after another, so that only one image at a time is in memory at full size."""
    where, shots = str(data.path), data.select(split)[:first]
    if not shots:
        raise InputError(f"split {split!r} has no frames", where=where)
    views = list[View]()
    whole = data if largest is None else data.at_most(sys.maxsize)  # the first image's own size is logged
    store, limit = PixelStore(0), 0
    for shot in report_each(shots, "reading", "images"):
        try:
            view = whole.view(shot, limit or None)
        except WhollyHidden:  # by a mask
            pass
        else:
            if not views:
                whole = data if largest is None else data.at_most(largest)
                limit = largest or useful_size(view.frame, len(shots))
                small = view.frame.at_most(limit)
                store = PixelStore(len(shots) * bytes_of(small), folder)
                if small is not view.frame:
                    before, after = (f"{f.intrinsics.width}x{f.intrinsics.height}" for f in (view.frame, small))
                    log.info(
                        f"{where}: {amount(len(shots), 'image')} of {before} read at {after},"
                        f" {len(shots) * bytes_of(small) / 1e6:.0f} MB; `largest` sets another size"
                    )
            views.append(replace(view, frame=store.store(view.frame.at_most(limit))))
    if left_out := len(shots) - len(views):
        log.info(f"{where}: {amount(left_out, 'image')} left out, being entirely hidden; {INVERTED}")
    if not views:
        raise InputError(f"masks hide every image in split {split!r} entirely; {INVERTED}", where=where)
    source, folder = os.path.basename(os.path.abspath(data.path)), data.path if data.path.is_dir() else data.path.parent
    files = {shot.name: shot.file for shot in shots if shot.file is not None}
    once = Counter(files.values())
    return ReadViews(
        views,
        source,
        where,
        data.background,
        0,
        data.unit or _unit_of(views),
        data.up,
        depth_unit=data.depth_unit,
        files={name: Path(os.path.relpath(file, folder)).as_posix() for name, file in files.items() if once[file] == 1},
    )


def scaled_view(view: View, factor: float) -> View:
    """Return a view with all lengths multiplied by ``factor``: pose, motion, measured depth and distances of landmarks."""
    T, depth, seen, motion = view.T_ref_camera, view.frame.depth, view.landmarks, view.motion
    return replace(
        view,
        frame=view.frame if depth is None else view.frame.replace(depth=depth * factor),
        T_ref_camera=SE3(T.rotation, T.translation * factor),
        landmarks=seen and replace(seen, distance=seen.distance * factor, deviation=seen.deviation * factor),
        motion=None if motion is None else torch.cat([motion[:3] * factor, motion[3:]]),
    )


USEFUL_SIDE, LEAST_SIDE = 1600, 800
"""Pixels along the longer side of images. More than 1600 are of little use to a map; fewer than 800, the size
at which keypoints are detected, harm it."""
MOST_BYTES = 2_000_000_000
"""Default limit on the bytes of a training run's images, unless a quarter of the available memory is less."""


def useful_size(frame: Frame, count: int) -> int:
    """Return the longer side (pixels) to which ``count`` images like ``frame`` are downscaled by default.

    This is ``USEFUL_SIDE``, or less if the images would not fit into memory, but at least ``LEAST_SIDE``.
    """
    most = min(MOST_BYTES, available_memory() // 4)
    longer = max(frame.intrinsics.width, frame.intrinsics.height)
    return min(USEFUL_SIDE, max(LEAST_SIDE, int(longer * (most / (count * bytes_of(frame))) ** 0.5)))


def _unit_of(views: Sequence[View]) -> LengthUnit:
    """Return "metres" if a view has dense measured depth, since training rejects poses that contradict it; else "units"."""
    return "metres" if any(view.frame.has_dense_depth for view in views) else "units"


def _with_depth(read: ReadViews, model: Path, choice: SparseChoice, split: str) -> ReadViews:
    """Return the views with depth from the points of a COLMAP model, and with the number of pixels that have such depth."""
    sparse = SparsePoints(model, [(view.frame.name, view.T_ref_camera) for view in read.views], choice, split)
    changed = [sparse.onto(view, split) for view in read.views]
    new = [after for after, before in zip(changed, read.views, strict=True) if after is not before]
    count = sum(int((view.frame.depth > 0).sum()) for view in new if view.frame.depth is not None)
    if count == 0:
        raise InputError(
            f"gives no depth to split {split!r}",
            where=model,
            expected="points that its images observe and images without depth",
        )
    log.info(f"{sparse.summary}; depth at {count} pixels of {len(new)} of {len(read.views)} images")
    return replace(read, views=changed, sparse_depth=count)


def views_again(
    info: MapInfo,
    data: ViewSource,
    options: DatasetOptions = AS_STORED,
    depth_points: str | Path | None = None,
    point_choice: SparseChoice | None = None,
    folder: Path | None = None,
    first: int | None = None,
) -> tuple[ReadViews, list[View]]:
    """Read images of the map that ``info`` describes, as ``read_views`` does, with poses relative to the map's origin.

    The background is by default that with which the training of the field began. Of a map that was scaled after training, the
    images may be in the unit of before, in which case they are scaled as the map was. Also returns the views at the poses stored
    in the map, which training may have refined.
    """
    if options.background is None and isinstance(data, str | Path) and info.backend:
        options = replace(options, background=info.bounds.background)
    read = read_views(data, options, depth_points, point_choice, folder, first)
    poses = {camera.name: camera.pose for camera in info.cameras}
    pairs = [(view.T_ref_camera, poses[view.frame.name]) for view in read.views if view.frame.name in poses]
    if pairs and info.field_frame is not None:
        given, own = (torch.stack([T.translation for T in part]) for part in zip(*pairs, strict=True))
        own, factors = own + torch.tensor(info.origin, dtype=torch.float64), (1.0, info.field_frame.scale)
        factor = min(factors, key=lambda factor: float((factor * given - own).norm(dim=-1).median()))
        read = read.scaled(factor)
    read = read.about(info.origin)
    return read, apply_stored_poses(read.views, info.cameras)
