"""Building maps: landmarks, a trained field and a surface from posed images, and resuming interrupted work.

Landmarks are built first: they can localize images without a field, and remain if later stages are interrupted.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.backend import load_backend, quick_config
from bidnerf_core.captures import (
    RefinementChoice,
    given_cameras,
    prepare_views,
    stored_cameras,
    track_landmarks,
)
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.datasets import HOLD_OUT_EVERY, POSERS, DatasetOptions, SparseChoice, lacks_poses
from bidnerf_core.devices import move_to, working_device
from bidnerf_core.errors import Cancelled, InputError, amount, enumeration
from bidnerf_core.fields import NoField, device_of, trained_field
from bidnerf_core.frames import View
from bidnerf_core.io import from_plain, pack_tensors, read_tensors, to_plain, write_file
from bidnerf_core.mapping import (
    USUAL_FEATURES,
    BakeConfig,
    TrackedViews,
    find_features,
)
from bidnerf_core.maps.description import MapInfo, load_info, longest_side
from bidnerf_core.maps.description_file import DESCRIPTION
from bidnerf_core.maps.map import USUAL_BAKE, Map, load_map
from bidnerf_core.maps.store import (
    MATCHES,
    MATCHES_STAY,
    NEEDED,
    STORED_PARTS,
    USUAL_SECONDS,
    Checkpoints,
    build_field,
    build_frozen_field,
    check_backend,
    load_state,
    map_folder,
    matches_file,
    read_part,
    write_parts,
)
from bidnerf_core.maps.views import ViewSource, choose_origin, read_views, views_again
from bidnerf_core.progress import Cancel, ProgressCallback, counter, duration_text, job_context, log
from bidnerf_core.registry import USUAL_BACKEND, USUAL_POSER, PluginError
from bidnerf_core.settings import NotNegative, Settings, WholeNumbers
from bidnerf_core.training import TrainingState, TrainingStopped


@dataclass(frozen=True)
class MapOptions(Settings):
    """What training and importing have in common: which images are used, and where the map goes."""

    images: DatasetOptions = DatasetOptions()
    """how the images are read: split, camera, size and so on"""

    features: str = USUAL_FEATURES
    """name of the detector of the landmarks"""

    device: torch.device | str = "cpu"
    """device of the training and of the map that is returned"""

    overwrite: bool = False
    """whether a folder that is not empty is replaced"""

    def __post_init__(self) -> None:
        super().__post_init__()
        find_features(self.features)


@dataclass(frozen=True)
class TrainOptions(MapOptions):
    """How a map is trained, beside the settings of its backend."""

    refine_poses: RefinementChoice = "auto"
    """when the given poses are refined with the keypoints that images share: always, never, or auto (if the images contradict
    them)"""

    trust_poses: bool = False
    """whether poses that contradict most pairs of images are accepted"""

    poser: str = USUAL_POSER
    """name of the poser that finds the poses of photos without any"""

    depth_points: str | Path | None = None
    """folder of a COLMAP sparse model whose points provide depth for images without any"""

    point_choice: SparseChoice = SparseChoice()
    """which of these points are used"""

    first: Annotated[int, WholeNumbers(1)] | None = None
    """how many images of the split are used, from the first one; None: all"""

    checkpoint_seconds: NotNegative = USUAL_SECONDS
    """time between checkpoints: the most work lost if the program is killed"""


USUAL_TRAINING = TrainOptions()
TRACKS = "tracks"
"""The name, in the state of an interrupted training, of the labels of the keypoints' tracks."""


class OtherSettings(InputError):
    """Raised if a training run would be resumed with settings that differ from its original ones."""


def train(
    data: ViewSource,
    backend: str = USUAL_BACKEND,
    out: str | Path | None = None,
    config: Any = None,
    *,
    bake: bool | BakeConfig = True,
    options: TrainOptions = USUAL_TRAINING,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Map:
    """Train a map on images: check and refine their poses, train the field, and bake a surface and landmarks.

    ``data`` is a dataset, the path to one, or views whose reference frame is the world; ``options.images``
    holds the split and other options for reading it. The path may also be a folder of photos without poses, or
    a video: ``find_poses`` then finds the poses first, in the folder OUT-poses next to the map. ``backend`` is
    the name of an installed backend, and ``config`` holds its settings: an object of its ``config_type``, a
    dict of the settings that differ from the defaults, or "quick" for the settings of a short training. The map
    is stored in folder ``out`` during training, or kept only in memory if ``out`` is None. ``bake`` is whether
    to bake, or the settings of baking. If ``out`` holds a landmark-only map, such as an imported one, a field
    and a surface are added to it, and its landmarks, cameras and poses are kept.

    ``progress`` receives each step, and remarks go to the logger "bidnerf". Once ``cancel`` returns True,
    ``Cancelled`` is raised; a map in a folder then keeps the parts finished so far, landmarks first, and
    ``resume`` continues it. An exception raised by ``progress`` ends the training as well; the map in the
    folder is then that of the last checkpoint, at most ``options.checkpoint_seconds`` old.

    Images with more than ``options.images.largest`` pixels along the longer side are downscaled to that size,
    by default to 1600 pixels, or to fewer if the images would take more than 2 GB or a quarter of the available
    memory; the map's cameras are scaled accordingly.

    Raises ``InputError`` if data, settings or folder cannot be used, and if the poses contradict most pairs of
    images unless ``options.trust_poses`` is set; the folder must be empty unless ``options.overwrite`` is set.
    """
    chosen = load_backend(backend)
    settings = settings_from(
        quick_config(chosen) if config == "quick" else config, chosen.config_type, f"backend {backend!r}"
    )
    baking = bake_settings(bake)
    working_device(options.device)  # an invalid one is rejected before anything is read
    folder, known = None if out is None else Path(out), None
    check_backend(backend, to_plain(settings, "config"), str(folder or "train"))
    if folder is not None and not options.overwrite:
        with contextlib.suppress(InputError):
            there = load_info(folder)
            # A map that is complete without a field, such as an imported COLMAP model, gets a field.
            known = there if there.complete and not there.step else None
    points = options.depth_points, options.point_choice
    with (
        job_context(progress, cancel),
        report_finished_parts(folder),
        contextlib.nullcontext() if folder is None else map_folder(folder, options.overwrite or known is not None),
        open_posed_images(data, options.images, folder, options.overwrite, options.poser) as (posed, images),
    ):
        if known is not None and folder is not None:
            scene = load_map(folder)
            images = replace(images, largest=longest_side(scene.info))
            read, views = views_again(scene.info, posed, images, *points, folder, options.first)
            own = {camera.name for camera in scene.info.cameras}
            if unknown := [view.frame.name for view in read.views if view.frame.name not in own]:
                raise InputError(
                    f"image {unknown[0]!r} is none of those of {scene.name}",
                    where=read.where,
                    expected="images of that map",
                )
            tracked, views = track_landmarks(views, scene.info.landmark_features, True, read.depth_unit)
            info = replace(
                scene.info,
                backend=backend,
                config=to_plain(settings, "config"),
                bounds=estimate_bounds(views, read.background),
                complete=False,
                hidden=read.hidden,
                sparse_depth=read.sparse_depth,
            )
            return _complete(replace(scene, info=info), views, tracked, options, baking)
        read = read_views(posed, images, *points, folder, options.first)
        origin = choose_origin(torch.stack([view.T_ref_camera.translation.cpu() for view in read.views]))
        if any(origin):
            log.info(f"{read.where}: the map's own coordinates begin at {origin}, near its cameras")
        read = read.about(origin)
        if not any(view.frame.has_depth for view in read.views):
            log.info(
                f"{read.where}: no measured depth{f' in split {images.split!r}' if read.source else ''}; training on"
                " colour only"
            )
        matches = None if folder is None else matches_file(folder, stored_cameras(read.views), options.features)

        def keep_matches(tracked: TrackedViews) -> None:
            if matches is not None:
                with contextlib.suppress(OSError):  # they only spare time
                    write_file(matches, STORED_PARTS["training"].encode(_stored_tracks(tracked)))

        taken = prepare_views(
            read.views,
            options.refine_poses,
            features=options.features,
            trust_poses=options.trust_poses,
            depth_unit=read.depth_unit,
            labels=read_tensors(matches, NEEDED)[TRACKS] if matches is not None and matches.exists() else None,
            tracks=keep_matches,
        )
        if not taken.distances:
            log.info(
                f"{read.where}: the photos are from one place and do not determine distances; the map's"
                " depth will be arbitrary, and localization in it will give directions, but no positions"
            )
        counter("finding the bounds of the scene", "stage")(0, 1)
        info = MapInfo(
            backend,
            to_plain(settings, "config"),
            estimate_bounds(taken.views, read.background),
            0,
            False,
            read.source,
            cameras=read.with_files(taken.cameras),
            pose_refinement=taken.refinement,
            distances=taken.distances,
            sparse_depth=read.sparse_depth,
            hidden=read.hidden,
            landmark_features=options.features,
            unit=read.unit,
            origin=origin,
            gravity_up=read.gravity_up,
        )
        scene = Map(info, NoField())
        # A map that is already there stays until the first checkpoint.
        if baking is not None and folder is not None and not (folder / DESCRIPTION).exists():
            info = write_parts(folder, info, TrainingState(0, {}, _stored_tracks(taken.tracked)))
            scene = replace(scene, info=info, folder=folder)
        return _complete(scene, taken.views, taken.tracked, options, baking, out=folder)


def settings_from(config: Any, kind: type, what: str) -> Any:
    """Return the settings of a backend or an importer, given as an object or as a dict of non-default values.

    Raises ``InputError`` if ``config`` is neither, and for unknown settings or values out of range.
    """
    if config is None or isinstance(config, dict):
        return from_plain(kind, config or {}, f"settings of {what}")
    if not isinstance(config, kind):
        raise InputError(
            f"config is a {type(config).__name__}", expected=f"a {kind.__name__} or a dict of its settings"
        )
    return config


@contextlib.contextmanager
def report_finished_parts(folder: Path | None) -> Iterator[None]:
    """Add the finished parts of the map to the message of a ``Cancelled`` that is raised within the context."""
    try:
        yield
    except Cancelled as stopped:
        info = None
        with contextlib.suppress(InputError):
            info = None if folder is None else load_info(folder)
        if info is None and folder is not None and any(folder.glob(MATCHES)):
            raise Cancelled(f"{folder}: {stopped}; {MATCHES_STAY}") from stopped
        if info is None or isinstance(stopped.__cause__, TrainingStopped):
            raise
        stages = (("landmarks", info.landmarks), ("field", info.step), ("surface", info.surface))
        raise Cancelled(
            f"{folder}: {stopped}; the map has its {enumeration([part for part, done in stages if done]) or 'nothing'}"
            " so far; `resume` continues, `finish` ends it as it is"
        ) from stopped


def resume(
    folder: str | Path,
    data: ViewSource,
    *,
    bake: bool | BakeConfig = True,
    finish: bool = False,
    options: TrainOptions = USUAL_TRAINING,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Map:
    """Resume the interrupted training of the map in ``folder``, with the same result as an uninterrupted run.

    A map that is trained but not baked is baked. With ``finish``, training ends with the steps done so far, and
    the map is baked as it stands; if no steps were done, the result is a landmark-only map. Backend, settings
    and poses are those of the original run; ``data`` and the ``options`` for reading must yield the same views.
    The other arguments and the errors are as for ``train``. Raises ``InputError`` if nothing is left to do.
    """
    out, baking, device = Path(folder), bake_settings(bake), working_device(options.device)
    check_resumable(out, baking is not None)
    with (
        job_context(progress, cancel),
        report_finished_parts(out),
        map_folder(out, overwrite=True),
        open_posed_images(data, options.images, out, poser=options.poser) as (posed, images),
    ):
        info = check_resumable(out, baking is not None)  # another process may have finished meanwhile
        images = replace(images, largest=longest_side(info))
        points = options.depth_points, options.point_choice
        read, views = views_again(info, posed, images, *points, out, options.first)
        if stored_cameras(read.views) != given_cameras(info.cameras):
            raise InputError(
                f"{f'split {images.split!r} has' if read.source else 'these have'} frames or poses that differ from those"
                f" {out} was started with",
                where=read.where,
                expected=f"those of {info.data!r} unchanged",
            )
        background = info.bounds.background
        for before, now, what in (
            (background, read.background if read.source else background, "background {}, got {}"),
            (info.hidden, read.hidden, "{} pixels hidden by masks, got {}; resuming keeps the masks (`masks`)"),
            (
                info.sparse_depth,
                read.sparse_depth,
                "the depth of {} pixels from points, got {}; resuming keeps the points (`depth_points`) and their selection",
            ),
        ):
            if before != now:
                raise OtherSettings(f"was started with {what.format(before, now)}", where=out)
        # These are the keypoints and views with which training began.
        optimizer = dict[str, Tensor]()
        with contextlib.suppress(*([InputError] if finish else [])):  # a map that is finished needs no such state
            optimizer = read_part(out, info, "training") or {}
        tracked, views = track_landmarks(views, info.landmark_features, True, read.depth_unit, optimizer.get(TRACKS))
        if info.complete or finish:
            scene = load_map(out, device)
            if not info.complete:
                log.info(f"{out}: ends with the {amount(info.step, 'step')} done so far")
                field = cast(nn.Module, trained_field(scene.field)).state_dict()
                info = replace(info, complete=True)  # the state that resuming would need is dropped
                info = write_parts(out, info, TrainingState(info.step, field, {}), keep=True)
                scene = replace(scene, info=info)
            return _complete(scene, views, tracked, options, baking, out=out)
        scene, state = Map(info, NoField(), None, read_part(out, info, "landmarks"), out), None
        if info.step:
            state = load_state(out, info, build_field(info, str(out)), optimizer)
            log.info(f"{out}: resuming from step {info.step}")
        return _complete(scene, views, tracked, options, baking, state, out)


def check_resumable(folder: Path, baking: bool = True) -> MapInfo:
    """Check that the map in ``folder`` has work left to resume, and return its description.

    Work is left if training is incomplete or, with ``baking``, if the surface or the capture record is
    missing. Raises ``InputError`` if nothing is left to do.
    """
    try:
        info = load_info(folder)
    except InputError as error:
        raise InputError(f"{error}; nothing to resume, train without `resume`") from error
    if info.complete and not (baking and (info.surface is None or info.capture is None)):
        raise InputError(
            f"training is complete ({amount(info.step, 'step')}){'' if info.surface is None else ' and baked'}, nothing"
            " to resume",
            where=folder,
        )
    return info


def bake_settings(bake: bool | BakeConfig) -> BakeConfig | None:
    """Return the settings of baking, or None for False. Raises ``InputError`` for anything else."""
    if not isinstance(bake, bool | BakeConfig):
        raise InputError(f"bake is {bake!r}", expected="True, False or a BakeConfig")
    return bake if isinstance(bake, BakeConfig) else USUAL_BAKE if bake else None


@contextlib.contextmanager
def open_posed_images(
    data: ViewSource, options: DatasetOptions, out: Path | None, overwrite: bool = False, poser: str = USUAL_POSER
) -> Iterator[tuple[ViewSource, DatasetOptions]]:
    """Yield images with poses, and the options with which to read them.

    For a folder of photos without poses, or a video, structure from motion finds the poses and writes a
    dataset, whose path is yielded. The dataset is in a folder next to the map ``out``, or in a temporary
    folder for a map in memory; poses found earlier are reused. Any other ``data`` is yielded unchanged.
    """
    if not isinstance(data, str | Path) or not lacks_poses(data, options):
        yield data, options
        return
    with tempfile.TemporaryDirectory() if out is None else contextlib.nullcontext(poses_folder(out)) as folder:
        found = POSERS.load(poser, str(data))(data, folder, options.camera, overwrite, reuse=True)
        if options.split == "train":
            tested = len(range(0, found.placed, HOLD_OUT_EVERY))
            log.info(
                f"{folder}: {amount(tested, 'photo')} of {found.placed} {'is' if tested == 1 else 'are'} held out to test"
                " the map; split 'all' trains on all"
            )
        yield folder, replace(options, camera=None)


def poses_folder(out: Path) -> Path:
    """Return the folder next to a map that holds the poses of its photos: MAP-poses."""
    folder = out if out.name else out.absolute()  # "." has no name
    return folder.with_name(f"{folder.name}-poses")


def _complete(
    scene: Map,
    views: Sequence[View],
    tracked: TrackedViews | None,
    options: TrainOptions,
    baking: BakeConfig | None,
    state: TrainingState | None = None,
    out: Path | None = None,
) -> Map:
    """Run the stages that the map has not completed: landmarks, field, surface, and the capture record of its photos.

    ``tracked`` holds the keypoints of ``views``, ``state`` the training state to resume from, and ``out`` the
    folder in which to store the field. Nothing is baked if ``baking`` is None.
    """
    if baking is not None and scene.landmarks is None:
        scene, tracked = scene.with_landmarks(views, tracked=tracked)
    scene = replace(scene, folder=out or scene.folder)
    if not scene.info.complete:
        scene = train_field(views, scene, options, state, beside=_stored_tracks(tracked))
    if baking is not None and scene.has_field:
        if scene.surface is None:
            scene = bake_if_possible(scene, views, baking)
        scene = scene.with_survey(views, tracked)
    if scene.folder is not None:
        log.info(
            f"{scene.folder}: map of {scene.info.data or 'views in memory'},"
            f" {sum(file.stat().st_size for file in scene.folder.iterdir()) / 2**20:.1f} MiB"
        )
    return scene


def _stored_tracks(tracked: TrackedViews | None) -> dict[str, Tensor]:
    """Return the labels of the tracks, with which a resumed training need not match the keypoints again."""
    return {} if tracked is None else {TRACKS: tracked.observations.point.int()}


def train_field(
    views: Sequence[View],
    scene: Map,
    options: TrainOptions,
    state: TrainingState | None = None,
    weights: dict[str, Tensor] | None = None,
    beside: Mapping[str, Tensor] = MappingProxyType({}),
) -> Map:
    """Train the field described by a map to completion: from ``state``, from the ``weights`` of a field, or from scratch.

    What is ``beside`` is stored with each checkpoint. The poses and depths of ``views`` are in the field's length unit. Raises ``Cancelled`` if training is stopped.
    """
    out, device = scene.folder, working_device(options.device)
    backend, where = load_backend(scene.info.backend, str(out or "")), scene.name
    unsaved = scene.landmarks if scene.info.landmarks is None else None
    report = Checkpoints(scene.info, out, state, options.checkpoint_seconds, unsaved, beside)
    del state  # the report frees it once training resumes from it
    field = move_to(build_field(scene.info, where), device)
    if weights is not None:
        cast(nn.Module, field).load_state_dict(weights)
    config: Any = from_plain(backend.config_type, scene.info.config, f"{where}: config")
    try:
        backend.train(field, views, config, report)
    except TrainingStopped as stopped:
        outcome, advice = (
            ("cancelled", ", nothing is stored") if out is None else ("saved", "; `resume` continues from there")
        )
        raise Cancelled(f"{where}: {outcome} after step {stopped.step}{advice}") from stopped
    report.finish(field)
    steps, seconds = report.info.step - scene.info.step, report.info.seconds - scene.info.seconds
    log.info(f"{where}: field trained for {amount(steps, 'step')}, {duration_text(seconds)}")
    frozen = build_frozen_field(report.info, pack_tensors(cast(nn.Module, field).state_dict()), out)
    return Map(report.info, frozen, None, scene.landmarks, out, scene.record).to(device)


def bake_if_possible(
    scene: Map,
    views: Sequence[View],
    config: BakeConfig,
    scan: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]] | None = None,
) -> Map:
    """Return the map with a new surface, see ``Map.with_surface``; if none can be baked, the map without a new surface."""
    try:
        return scene.with_surface(views, config, scan)
    except PluginError:  # nothing that other images would fix
        raise
    except InputError as error:
        log.info(f"{scene.name}: no surface baked: {error}")
        return scene if scene.folder is None else load_map(scene.folder, device_of(scene.field))
