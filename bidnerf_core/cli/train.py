"""``bidnerf train``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch

from bidnerf_core.backend import Backend, load_backend
from bidnerf_core.captures.cameras import as_given, at_stored_poses, stored_cameras
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.cli.bake import bake_map
from bidnerf_core.cli.camera_options import DatasetCamera, RegisterDepth, depth_registration
from bidnerf_core.cli.folders import output_folder
from bidnerf_core.cli.options import (
    DEFAULT_BACKEND,
    DataFolder,
    Device,
    Flag,
    option,
    parse,
    require,
    value_of,
    wrong_usage,
)
from bidnerf_core.cli.output import read_views, say
from bidnerf_core.cli.progress import CHECKPOINT_SECONDS, StoredTraining
from bidnerf_core.cli.training_views import RefinementChoice, located, prepared
from bidnerf_core.datasets import Background, Dataset, DepthRegistration, open_dataset
from bidnerf_core.datasets.colmap import SparseChoice, SparsePoints
from bidnerf_core.devices import moved, working_device
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.frames.frame import View
from bidnerf_core.io.images import background_colour
from bidnerf_core.io.json import from_plain, to_plain
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.mapping.landmark_building import TrackedViews
from bidnerf_core.maps.description import MapInfo, load_info
from bidnerf_core.maps.files import load_state
from bidnerf_core.maps.map import build_field
from bidnerf_core.settings import to_flat
from bidnerf_core.training import TrainingStopped


@dataclass(frozen=True)
class Source:
    """The source of the views, as given by the arguments."""

    data: Path
    split: str
    background: str | None
    depth_points: Path | None  # folder of a COLMAP model
    choice: SparseChoice
    camera: Path | None = None
    registration: DepthRegistration | None = None

    def dataset(self, background: Background | None) -> Dataset:
        return open_dataset(self.data, background, camera=self.camera, register_depth=self.registration)

    def views(self, dataset: Dataset) -> tuple[list[View], int]:
        """Return the views of the split, and the number of their pixels whose depth comes from points."""
        plain = read_views(dataset, self.split)
        if self.depth_points is None:
            return plain, 0
        places = [(view.frame.name, view.T_ref_camera) for view in plain]
        sparse = SparsePoints(self.depth_points, places, self.choice, self.split)
        views = [sparse.onto(view, self.split) for view in plain]
        changed = [new for new, old in zip(views, plain, strict=True) if new is not old]
        count = sum(int((view.frame.depth > 0).sum()) for view in changed if view.frame.depth is not None)
        if count == 0:
            raise InputError(
                f"{self.depth_points}: gives no depth to split {self.split!r}, expected points that its images observe"
                " and images without depth"
            )
        say(f"{sparse.summary}; depth at {count} pixels of {len(changed)} of {len(views)} images")
        return views, count


def run(arguments: list[str]) -> None:
    """Parse with the options of the backend that the arguments name, and train."""
    named = value_of("--backend", arguments)
    resumed = None if named else _resumed_map(arguments)
    name = named or (resumed[1].backend if resumed else DEFAULT_BACKEND)
    chosen = load_backend(name, str(resumed[0]) if resumed else "")
    kind = chosen.config_type

    def train(
        data: DataFolder,
        out: Annotated[Path, option("MAP", "folder for the map")],
        backend: Annotated[str, option("NAME", "one of 'bidnerf backends'")] = DEFAULT_BACKEND,
        split: Annotated[str, option("NAME", "split of the dataset to train on")] = "train",
        camera: DatasetCamera = None,
        register_depth: RegisterDepth = None,
        background: Annotated[
            str | None,
            option("COLOUR", "colour behind images with alpha: white or black", "as the dataset has it"),
        ] = None,
        resume: Annotated[Flag, option(None, "continue the interrupted training in --out", "")] = False,
        overwrite: Annotated[Flag, option(None, "replace the map in --out", "")] = False,
        checkpoint_every: Annotated[
            float,
            option(
                "SECONDS", "time between checkpoints: at most this much work is lost if the program is killed"
            ),
        ] = CHECKPOINT_SECONDS,
        depth_points: Annotated[
            Path | None,
            option("MODEL", "COLMAP sparse model whose points give depth to images that have none", ""),
        ] = None,
        refine_poses: Annotated[
            RefinementChoice,
            option(
                "WHEN",
                "refine the given poses by the keypoints that images share: always, never, or auto: if inconsistent",
            ),
        ] = "auto",
        device: Device = "cpu",
        no_bake: Annotated[
            Flag, option(None, "leave the surface and the landmarks to 'bidnerf bake'", "")
        ] = False,
        model_points: SparseChoice = SparseChoice(),
        config: Any = None,
    ) -> None:
        """Make a map of a dataset.

        Ctrl-C stops after a step and saves the map; --resume continues from there, or from the last checkpoint if the
        program was killed, with the same result as an uninterrupted training. It also bakes a map that is trained but not
        baked.
        """
        require("--checkpoint-every", checkpoint_every, 0)
        if resume and overwrite:
            raise UsageError("--resume goes on with a map, --overwrite begins anew; expected one of them")
        if background is not None:
            with wrong_usage():
                background_colour(background)
        registration, there = depth_registration(register_depth), working_device(device)
        source = Source(data, split, background, depth_points, model_points, camera, registration)
        try:
            if resume:
                info = load_interrupted(out, not no_bake)
                _check_unchanged(out, info, named, kind(), config)
                _check_refinement(out, info, refine_poses)
                with output_folder(out, overwrite=True):
                    _resume(info, source, out, checkpoint_every, not no_bake, there)
            else:
                with output_folder(out, overwrite):
                    _start(
                        chosen, name, source, out, config, checkpoint_every, not no_bake, refine_poses, there
                    )
        except TrainingStopped as stopped:
            say(f"{out}: saved after step {stopped.step}; the same with --resume goes on from there")
            raise KeyboardInterrupt from stopped

    parse("train", train, arguments, kind())


def train_map(
    backend: Backend, name: str, views: Sequence[View], config: Any, out: Path, data: str,
    background: tuple[float, float, float], checkpoint_seconds: float = CHECKPOINT_SECONDS, baked: bool = True,
    sparse_depth: int = 0, refinement: RefinementChoice = "auto", device: torch.device | str = "cpu",
) -> None:  # fmt: skip
    """Train a new map on ``device`` and store it in folder ``out``, with progress on stderr.

    Raises ``TrainingStopped`` on Ctrl-C, after saving.
    """
    taken = prepared(views, refinement)
    if not taken.distances:
        say(
            f"{data}: the photos are from one place and show no distances; the map's depth will be arbitrary, and"
            " localization in it will tell directions, never positions"
        )
    bounds = estimate_bounds(taken.views, background)
    info = MapInfo(
        name, to_plain(config, "config"), bounds, 0, False, data, cameras=taken.cameras,
        pose_refinement=taken.refinement, distances=taken.distances, sparse_depth=sparse_depth,
    )  # fmt: skip
    _run(backend, info, out, taken.views, taken.tracked, checkpoint_seconds, baked, device)


def load_interrupted(out: Path, baking: bool) -> MapInfo:
    """Return the description of the map in ``out``, whose training or, with ``baking``, whose surface is incomplete.

    Raises ``InputError`` where nothing is left to do.
    """
    try:
        info = load_info(out)
    except InputError as error:
        raise InputError(f"{error}; nothing to resume, train without --resume") from error
    if info.complete and not (baking and info.surface is None):
        baked = " and baked" if info.surface is not None else ""
        raise InputError(
            f"{out}: training is complete ({amount(info.step, 'step')}){baked}, nothing to resume"
        )
    return info


def _resumed_map(arguments: list[str]) -> tuple[Path, MapInfo] | None:
    """Return the folder and description of the map to resume, if the arguments name one that can be read."""
    out = value_of("--out", arguments)
    if "--resume" not in arguments or out is None:
        return None
    try:
        return Path(out), load_info(Path(out))
    except InputError:  # reported later, if the arguments are otherwise right
        return None


def _check_unchanged(out: Path, info: MapInfo, backend: str | None, default: Any, config: Any) -> None:
    """Raise ``UsageError`` for settings that differ from the interrupted training's, since they would be ignored."""
    if backend not in (None, info.backend):
        raise UsageError(f"{out}: is of backend {info.backend!r}, cannot resume it with {backend!r}")
    began = from_plain(type(config), info.config, f"{out}: config")
    stored, given, usual = (to_flat(settings) for settings in (began, config, default))
    for key, value in given.items():
        if value not in (usual[key], stored[key]):
            raise UsageError(
                f"{out}: was begun with {key} {stored[key]}, got {value}; --resume keeps settings, --overwrite begins anew"
            )


def _check_refinement(out: Path, info: MapInfo, refinement: RefinementChoice) -> None:
    """Raise ``UsageError`` for a choice of pose refinement that differs from that of the interrupted training."""
    if info.pose_refinement is None:  # "never", or too few keypoints for any
        return
    refined = info.pose_refinement.refined or bool(info.pose_refinement.replaced)
    if refinement == ("never" if refined else "always"):
        has = "refined" if refined else "given"
        raise UsageError(
            f"{out}: was begun with {has} poses, got --refine-poses {refinement}; --resume keeps the poses"
        )


def _start(
    backend: Backend, name: str, source: Source, out: Path, config: Any, checkpoint_seconds: float, baked: bool,
    refinement: RefinementChoice, device: torch.device,
) -> None:  # fmt: skip
    dataset = source.dataset(source.background)
    views, sparse_depth = source.views(dataset)
    if not any(view.frame.has_depth for view in views):
        say(f"{source.data}: no measured depth in split {source.split!r}; training on colour only")
    train_map(
        backend, name, views, config, out, source.data.resolve().name, dataset.background, checkpoint_seconds,
        baked, sparse_depth, refinement, device,
    )  # fmt: skip


def _resume(
    info: MapInfo, source: Source, out: Path, checkpoint_seconds: float, baked: bool, device: torch.device,
) -> None:  # fmt: skip
    data, split, background = source.data, source.split, source.background
    dataset = source.dataset(info.bounds.background if background is None else background)
    if dataset.background != info.bounds.background:
        raise UsageError(f"{out}: was begun over background {info.bounds.background}, got {background!r}")
    views, sparse_depth = source.views(dataset)
    if stored_cameras(views) != as_given(info.cameras):
        raise InputError(
            f"{data}: split {split!r} has other frames or poses than {out} was begun with, expected those of"
            f" {info.data!r} unchanged"
        )
    if sparse_depth != info.sparse_depth:
        raise UsageError(
            f"{out}: was begun with the depth of {info.sparse_depth} pixels from points, got {sparse_depth}; "
            "--resume keeps --depth-points and what goes with it"
        )
    views = at_stored_poses(views, info.cameras)
    if info.complete:  # stopped between training and baking
        say(f"{out}: training is complete ({amount(info.step, 'step')}); baking its surface")
        bake_map(out, views, BakeConfig(), device=device)
        return
    tracked, views = located(views)  # the same as when the training began
    _run(load_backend(info.backend, str(out)), info, out, views, tracked, checkpoint_seconds, baked, device)


def _run(
    backend: Backend, info: MapInfo, out: Path, views: Sequence[View], tracked: TrackedViews | None,
    checkpoint_seconds: float, baked: bool, device: torch.device | str,
) -> None:  # fmt: skip
    built, config = build_field(backend, info, str(out))
    field = moved(built, device)
    state = load_state(out, info, field) if info.step else None
    if state is not None:
        say(f"{out}: going on from step {info.step}")
    with StoredTraining(out, info, state, getattr(config, "steps", 0), checkpoint_seconds) as report:
        backend.train(field, views, config, report)
        report.finish(field)
    if baked:
        try:
            bake_map(out, views, BakeConfig(), tracked=tracked, device=device)
        except InputError as error:  # the map itself is sound
            say(f"{out}: no surface baked: {error}")
    say(f"{out}: map of {info.data}, {sum(f.stat().st_size for f in out.iterdir()) / 2**20:.1f} MiB")
