"""Building maps: training a field on posed images, baking what localization needs, and resuming interrupted work."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

import torch
from torch import nn

from bidnerf_core.backend import Backend, load_backend
from bidnerf_core.camera import Intrinsics, checked_side
from bidnerf_core.captures import (
    RefinementChoice,
    as_given,
    at_stored_poses,
    located,
    prepared,
    stored_cameras,
)
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.datasets import SparseChoice
from bidnerf_core.devices import moved, working_device
from bidnerf_core.errors import Cancelled, InputError, amount
from bidnerf_core.fields import device_of
from bidnerf_core.frames import View
from bidnerf_core.io import Background, from_plain, packed, to_plain
from bidnerf_core.mapping import USUAL_FEATURES, BakeConfig, TrackedViews, find_features
from bidnerf_core.maps.checkpoints import CHECKPOINT_SECONDS, Checkpoints
from bidnerf_core.maps.description import MapInfo, load_info, longest_side
from bidnerf_core.maps.files import load_state, map_folder
from bidnerf_core.maps.map import Map, build_field, frozen_field, load_map
from bidnerf_core.maps.photos import posed_images
from bidnerf_core.maps.views import Images, ReadViews, chosen_origin, read_views
from bidnerf_core.progress import Cancel, ProgressCallback, check_cancelled
from bidnerf_core.registry import PluginError
from bidnerf_core.training import TrainingStopped

log = logging.getLogger("bidnerf")
USUAL_BAKE = BakeConfig()


class OtherSettings(InputError):
    """A training run cannot be resumed with settings that differ from its original ones."""


@dataclass(frozen=True)
class _Work:
    """How to train and bake, independent of the views."""

    out: Path | None
    bake: BakeConfig | None
    device: torch.device
    checkpoint_seconds: float
    progress: ProgressCallback | None
    cancel: Cancel | None


def train(
    data: Images,
    backend: str = "hashgrid",
    out: str | Path | None = None,
    config: Any = None,
    split: str = "train",
    refine_poses: RefinementChoice = "auto",
    bake: bool | BakeConfig = True,
    device: torch.device | str = "cpu",
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
    *,
    background: Background | None = None,
    depth_points: str | Path | None = None,
    point_choice: SparseChoice | None = None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    features: str = USUAL_FEATURES,
    largest: int | None = None,
    trust_poses: bool = False,
    camera: Intrinsics | str | Path | None = None,
) -> Map:
    """Train a map on images: check and refine their poses, train the field, and bake a surface and landmarks.

    ``data`` is a dataset, the path to one, or views whose reference frame is the world; ``split`` selects the
    views of a dataset, and "all" stands for all splits. The path may also be a folder of photos without
    poses, or a video: ``find_poses`` then finds the poses first, in the folder OUT-poses next to the map.
    ``camera`` (intrinsics or a file) is for such photos, and for the path to a dataset that stores no camera.
    ``backend`` is the name of an installed backend, and ``config`` holds its settings: an object of its
    ``config_type``, or a dict of those that differ from the defaults. The map is stored in folder ``out``
    during training, or only kept in memory if that is None. ``refine_poses`` is "always", "never", or "auto"
    (if the images contradict the given poses). ``bake`` may hold the settings of baking.

    ``progress`` receives each step, and remarks go to the logger "bidnerf". Once ``cancel`` returns True,
    ``Cancelled`` is raised; a map in a folder whose training has begun is saved first, and ``resume``
    continues it. An exception raised by ``progress`` ends the training as well; the map in the folder is then
    that of the last checkpoint, at most ``checkpoint_seconds`` old.

    ``background`` is the colour behind images with an alpha channel. Images without depth take it from the
    points of the COLMAP sparse model in folder ``depth_points``, filtered by ``point_choice``. ``features``
    is the name of the landmarks' detector. Images with more than ``largest`` pixels along the longer side are
    downscaled to that, by default to 1600, or fewer if they would take more than 2 GB or a quarter of the
    available memory; the map's cameras are scaled accordingly. Poses that contradict most pairs of images are
    rejected unless ``trust_poses`` is set.

    Raises ``InputError`` if data, settings or folder cannot be used; the folder must be empty unless
    ``overwrite`` is set.
    """
    chosen = load_backend(backend)
    find_features(features)
    settings = _settings(chosen, backend, config)
    if refine_poses not in get_args(RefinementChoice):
        choices = ", ".join(get_args(RefinementChoice))
        raise InputError(f"refine_poses is {refine_poses!r}", expected=f"one of {choices}")
    work = _work(out, bake, device, checkpoint_seconds, progress, cancel)
    with (
        contextlib.nullcontext() if work.out is None else map_folder(work.out, overwrite),
        posed_images(data, split, work.out, camera, overwrite, progress, cancel) as (images, camera),
    ):
        side = checked_side(largest)
        read = read_views(
            images, split, background, depth_points, point_choice, progress, cancel, side, work.out, camera
        )
        origin = chosen_origin(torch.stack([view.T_ref_camera.translation.cpu() for view in read.views]))
        if any(origin):
            log.info(f"{read.place}: the map's own coordinates begin at {origin}, near its cameras")
        read = read.about(origin)
        part = f" in split {split!r}" if read.source else ""
        if not any(view.frame.has_depth for view in read.views):
            log.info(f"{read.place}: no measured depth{part}; training on colour only")
        taken = prepared(read.views, refine_poses, progress, cancel, features, trust_poses, read.depth_unit)
        if not taken.distances:
            log.info(
                f"{read.place}: the photos are from one place and do not determine distances; the map's"
                " depth will be arbitrary, and localization in it will give directions, but no positions"
            )
        check_cancelled("training", cancel)
        bounds = estimate_bounds(taken.views, read.background)
        info = MapInfo(
            backend, to_plain(settings, "config"), bounds, 0, False, read.source, cameras=taken.cameras,
            pose_refinement=taken.refinement, distances=taken.distances, sparse_depth=read.sparse_depth,
            hidden=read.hidden,
            landmark_features=features, unit=read.unit, origin=origin, gravity_up=read.gravity_up,
        )  # fmt: skip
        return _trained(chosen, info, taken.views, taken.tracked, work)


def resume(
    folder: str | Path,
    data: Images,
    split: str = "train",
    bake: bool | BakeConfig = True,
    device: torch.device | str = "cpu",
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
    *,
    background: Background | None = None,
    depth_points: str | Path | None = None,
    point_choice: SparseChoice | None = None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    camera: Intrinsics | str | Path | None = None,
) -> Map:
    """Resume the interrupted training of the map in ``folder``, with the same result as an uninterrupted run.

    A map that is trained but not baked is baked. Backend, settings and poses are those of the original run;
    ``data``, ``split``, ``background``, ``depth_points``, ``point_choice`` and ``camera`` must give the same
    views. The other arguments and the errors are as for ``train``. Raises ``InputError`` if nothing is left
    to do.
    """
    work = _work(folder, bake, device, checkpoint_seconds, progress, cancel)
    out = Path(folder)
    interrupted(out, work.bake is not None)
    with (
        map_folder(out, overwrite=True),
        posed_images(data, split, out, camera, False, progress, cancel) as (images, camera),
    ):
        info = interrupted(out, work.bake is not None)  # another process may have finished meanwhile
        if background is None and isinstance(images, str | Path):
            background = info.bounds.background
        side = longest_side(info)
        read = read_views(
            images, split, background, depth_points, point_choice, progress, cancel, side, out, camera
        ).about(info.origin)
        _check_same_views(out, info, read, split)
        views = at_stored_poses(read.views, info.cameras)
        if info.complete:  # interrupted between training and baking
            log.info(f"{out}: training is complete ({amount(info.step, 'step')}); baking its surface")
            scene = load_map(out, work.device, baked=False)
            return scene.with_baked_parts(views, work.bake or USUAL_BAKE, progress=progress, cancel=cancel)
        tracked, views = located(
            views, progress, cancel, info.landmark_features, trust_poses=True, depth_unit=read.depth_unit
        )  # the same as when training began
        return _trained(load_backend(info.backend, str(out)), info, views, tracked, work)


def interrupted(folder: Path, baking: bool = True) -> MapInfo:
    """Return the description of the map in ``folder``, whose training or, with ``baking``, whose surface is
    incomplete.

    Raises ``InputError`` if nothing is left to do.
    """
    try:
        info = load_info(folder)
    except InputError as error:
        raise InputError(f"{error}; nothing to resume, train without --resume") from error
    if info.complete and not (baking and info.surface is None):
        baked = " and baked" if info.surface is not None else ""
        raise InputError(
            f"training is complete ({amount(info.step, 'step')}){baked}, nothing to resume", where=folder
        )
    return info


def _settings(chosen: Backend, name: str, config: Any) -> Any:
    kind = chosen.config_type
    if config is None or isinstance(config, dict):
        return from_plain(kind, config or {}, f"settings of backend {name!r}")
    if not isinstance(config, kind):
        found = type(config).__name__
        raise InputError(f"config is a {found}", expected=f"a {kind.__name__} or a dict of its settings")
    return config


def _work(
    out: str | Path | None, bake: bool | BakeConfig, device: torch.device | str, seconds: float,
    progress: ProgressCallback | None, cancel: Cancel | None,
) -> _Work:  # fmt: skip
    if not seconds >= 0:
        raise InputError(f"checkpoint_seconds is {seconds}", expected="0 or more")
    if not isinstance(bake, bool | BakeConfig):
        raise InputError(f"bake is {bake!r}", expected="True, False or a BakeConfig")
    if progress is not None and not callable(progress):
        raise InputError(
            f"progress is a {type(progress).__name__}", expected="a function that takes a Progress"
        )
    config = bake if isinstance(bake, BakeConfig) else USUAL_BAKE if bake else None
    place = None if out is None else Path(out)
    return _Work(place, config, working_device(device), seconds, progress, cancel)


def _check_same_views(out: Path, info: MapInfo, read: ReadViews, split: str) -> None:
    """Raise ``InputError`` for views (or their depth or background) that differ from those the training began with."""
    if read.source and read.background != info.bounds.background:
        raise OtherSettings(
            f"was started with background {info.bounds.background}, got {read.background}", where=out
        )
    if stored_cameras(read.views) != as_given(info.cameras):
        part = f"split {split!r} has" if read.source else "these have"
        raise InputError(
            f"{part} frames or poses that differ from those {out} was started with",
            where=read.place,
            expected=f"those of {info.data!r} unchanged",
        )
    if read.hidden != info.hidden:
        raise OtherSettings(
            f"was started with {info.hidden} pixels hidden by masks, got {read.hidden}; resuming keeps the"
            " masks (--masks)",
            where=out,
        )
    if read.sparse_depth != info.sparse_depth:
        raise OtherSettings(
            f"was started with the depth of {info.sparse_depth} pixels from points, got {read.sparse_depth};"
            " resuming keeps the points (--depth-points) and their selection",
            where=out,
        )


def _trained(
    backend: Backend, info: MapInfo, views: Sequence[View], tracked: TrackedViews | None, work: _Work
) -> Map:
    """Train from the state that ``info`` describes, and bake."""
    where = str(work.out or info.data or "map in memory")
    built, config = build_field(backend, info, where)
    field = moved(built, work.device)
    state = None
    if info.step and work.out is not None:
        state = load_state(work.out, info, field)
        log.info(f"{where}: resuming from step {info.step}")
    report = Checkpoints(info, work.out, state, work.checkpoint_seconds, work.progress, work.cancel)
    del state  # the report frees it once training resumes from it
    try:
        backend.train(field, views, config, report)
    except TrainingStopped as stopped:
        kept = "saved" if work.out is not None else "cancelled"
        advice = "; --resume continues from there" if work.out is not None else ", nothing is stored"
        raise Cancelled(f"{where}: {kept} after step {stopped.step}{advice}") from stopped
    report.finish(field)
    weights = packed(cast(nn.Module, field).state_dict())
    del field, built
    scene = Map(report.info, frozen_field(report.info, weights, work.out), folder=work.out).to(work.device)
    if (config := work.bake) is not None:
        scene = baked_or_kept(
            scene,
            lambda whole: whole.with_baked_parts(
                list(views), config, False, tracked, work.progress, work.cancel
            ),
        )
    if work.out is not None:
        size = sum(file.stat().st_size for file in work.out.iterdir()) / 2**20
        log.info(f"{where}: map of {info.data or 'views in memory'}, {size:.1f} MiB")
    return scene


def baked_or_kept(scene: Map, bake: Callable[[Map], Map]) -> Map:
    """Return what ``bake`` returns or, if the images do not allow it, the map as it is: it is valid without a surface."""
    try:
        return bake(scene)
    except PluginError:  # nothing that other images would fix
        raise
    except InputError as error:
        log.info(f"{scene.name}: no surface baked: {error}")
        return scene if scene.folder is None else load_map(scene.folder, device_of(scene.field))
