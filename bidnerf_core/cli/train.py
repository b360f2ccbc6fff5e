"""``bidnerf train``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.backend import Backend
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.cli.common import check_free, make_folder, parse, read_views, say, value_of
from bidnerf_core.cli.progress import StoredTraining
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.plain import to_plain
from bidnerf_core.registry import load_backend
from bidnerf_core.storage import MapInfo, build_field, load_info, stored_cameras
from bidnerf_core.training import TrainingStopped

DEFAULT_BACKEND = "hashgrid"


def run(arguments: list[str]) -> None:
    """Parse with the options of the backend that the arguments name."""
    name = value_of("--backend", arguments) or DEFAULT_BACKEND
    chosen = load_backend(name)
    kind = chosen.config_type

    def train(
        data: tyro.conf.Positional[Path],
        out: Path,
        backend: Annotated[str, tyro.conf.arg(help="name from 'bidnerf backends'")] = DEFAULT_BACKEND,
        split: str = "train",
        background: Annotated[
            str | None, tyro.conf.arg(help="white or black, under images with alpha")
        ] = None,
        resume: Annotated[bool, tyro.conf.arg(help="go on with an interrupted training in --out")] = False,
        overwrite: Annotated[bool, tyro.conf.arg(help="replace the map in --out")] = False,
        config: Any = kind(),
    ) -> None:
        """Make a map of the dataset in folder DATA."""
        if resume:
            _resume(data, out, split, background)
        else:
            check_free(out, overwrite)
            _start(chosen, backend, data, out, split, background, config)

    train.__annotations__["config"] = kind
    parse("train", train, arguments)


def train_map(
    backend: Backend, name: str, views: Sequence[View], config: Any, out: Path, data: str,
    background: tuple[float, float, float],
) -> None:  # fmt: skip
    """A new map in folder ``out``, with progress on stderr; stops early, but resumable, on Ctrl-C."""
    bounds = estimate_bounds(views, background)
    info = MapInfo(name, to_plain(config), bounds, 0, False, data, cameras=stored_cameras(views))
    make_folder(out)
    _run(backend, info, out, views)


def _start(
    backend: Backend, name: str, data: Path, out: Path, split: str, background: str | None, config: Any
) -> None:
    dataset = open_dataset(data, background)
    views = read_views(dataset, split)
    if not any(view.frame.has_depth for view in views):
        say(f"{data}: no measured depth in split {split!r}; training on colour only")
    train_map(backend, name, views, config, out, data.resolve().name, dataset.background)


def _resume(data: Path, out: Path, split: str, background: str | None) -> None:
    info = load_info(out)
    if info.complete:
        raise InputError(f"{out}: training is complete ({info.step} steps), nothing to resume")
    dataset = open_dataset(data, background)
    views = read_views(dataset, split)
    if tuple(view.frame.name for view in views) != tuple(camera.name for camera in info.cameras):
        raise InputError(
            f"{data}: its frames are not those that {out} was trained on; expected {info.data!r} again"
        )
    say(f"{out}: going on from step {info.step}")
    _run(load_backend(info.backend), info, out, views)


def _run(backend: Backend, info: MapInfo, out: Path, views: Sequence[View]) -> None:
    field, config = build_field(backend, info, str(out))
    with StoredTraining(out, info, getattr(config, "steps", 0)) as report:
        try:
            backend.train(field, views, config, report)
        except TrainingStopped as stopped:
            say(f"{out}: stopped after step {stopped.step}; go on with --resume")
            raise KeyboardInterrupt from stopped
    say(f"{out}: map of {info.data}, {sum(f.stat().st_size for f in out.iterdir()) / 2**20:.1f} MiB")
