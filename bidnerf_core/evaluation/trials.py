"""One trial: a frame, a start, a method, and what came of it. The unit that benches are made of.

``run_trial`` depends on its argument and the files that this names alone, so trials may run in any order, in any process
and on any machine; two runs of one differ in ``seconds`` and ``peak_memory_bytes`` only.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from bidnerf_core.datasets import Dataset, open_dataset
from bidnerf_core.datasets.colmap import SparseChoice, SparsePoints
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.closed_form_data import closed_form_data, closed_form_map, is_closed_form
from bidnerf_core.evaluation.errors import PoseError, pose_error
from bidnerf_core.evaluation.memory import forget_peak_memory, peak_memory_bytes
from bidnerf_core.evaluation.protocols import find_protocol
from bidnerf_core.frames import View
from bidnerf_core.localization import Localization, Localizer
from bidnerf_core.localization import settings_of as checked_settings
from bidnerf_core.se3 import SE3
from bidnerf_core.serialization import from_plain, to_plain
from bidnerf_core.settings import to_flat
from bidnerf_core.storage import Map, MapInfo, cameras_of, load_info, load_map

Rows: TypeAlias = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Trial:
    """All that a trial depends on."""

    map: str  # folder, or demo:NAME
    data: str  # folder, or demo:NAME
    frames: tuple[str, ...]  # a rig's views, one for a single image; the pose sought is the last one's
    protocol: str = "bid"  # which starts
    size: tuple[float, ...] = ()  # how far off they are, in the protocol's terms
    method: str = "auto"
    config: str = "{}"  # JSON of the method's settings that differ from its defaults
    seed: int = 0  # of the start, and of all that the method draws
    split: str = "test"
    device: str = "cpu"  # that the field computes on
    depth: bool = True  # whether the method is given the measured depth
    depth_points: str | None = None  # COLMAP model (folder) whose points that the frames observe it is given

    @property
    def frame(self) -> str:
        return self.frames[-1]

    @property
    def portable(self) -> Trial:
        """The same with the names of folders only: it is one trial wherever they are."""
        points = None if self.depth_points is None else "/".join(_parts(self.depth_points)[-2:])  # sparse/0
        return replace(self, map=_name(self.map), data=_name(self.data), depth_points=points)


@dataclass(frozen=True)
class Off:
    """How far a pose is from the true one."""

    translation: float  # metres
    rotation_deg: float


@dataclass(frozen=True)
class Trace:
    """Errors of the start (entry 0; where there is none, of the method's first pose) and after each step."""

    translation: tuple[float | None, ...]  # metres; none where a pose was not finite
    rotation_deg: tuple[float | None, ...]

    def as_error(self) -> PoseError:
        rows = ([math.nan if x is None else x for x in row] for row in (self.translation, self.rotation_deg))
        return PoseError(*(torch.tensor(row, dtype=torch.float64) for row in rows))


@dataclass(frozen=True)
class TrialResult:
    """What one line of results holds: what ``bidnerf localize --json`` prints, and all that a report needs."""

    T_world_camera: Rows | None  # 4x4; none where it was not finite
    converged: bool  # the method's own judgement
    steps: int
    seconds: float
    covariance: Rows | None
    loss: float | None
    backend: str
    method: str
    error: Off | None
    frame: str
    seed: int
    start_error: Off | None  # none where no start was given
    errors: Trace
    reason: str  # why the method stopped
    peak_memory_bytes: int  # of the process during the trial: memory resident, or of the GPU
    settings: dict[str, Any]  # of the method, all of them
    weights: str  # which training of the map
    trial: Trial  # with the names of folders only
    outcome: str = ""  # the judgement's kind; empty in results of earlier versions


def run_trial(trial: Trial) -> TrialResult:
    """Localize once. Raises ``InputError`` where the trial cannot be: a bad name, a method that needs what is not there."""
    with one_thread():
        stored, dataset = opened(trial.map, trial.data, trial.device)
        views = dataset.views(trial.split, trial.frames)
        if not trial.depth:
            views = [View(replace(view.frame, depth=None), view.T_ref_camera) for view in views]
        truth, start = views[-1].T_ref_camera, start_of(trial, views, dataset)
        settings = settings_of(trial.method, trial.config)
        forget_peak_memory()
        points = opened_points(trial.depth_points, trial.map)
        rays = None
        if points is not None:
            rays = points.rays(views, trial.split)
        localizer = Localizer(stored, trial.method, settings, warm_up=False)
        found = localizer(views, start, rays, trial.seed)
        return _result(trial, stored, found, start, truth, settings)


def start_of(trial: Trial, views: list[View], dataset: Dataset) -> SE3 | None:
    """T_world_camera that the trial begins at."""
    protocol = find_protocol(trial.protocol)
    protocol.check_size(trial.size)
    frames = len(dataset.frame_names(trial.split))
    return protocol.start(views[-1].T_ref_camera, trial.size, trial.seed, frames)


def settings_of(method: str, config: str) -> Any:
    """The method's settings from the JSON of those that differ from the defaults."""
    try:
        plain = json.loads(config)
    except (ValueError, RecursionError) as error:
        raise InputError(f"config: not JSON ({error}), expected an object of settings of {method}") from error
    return checked_settings(method, plain)


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums of one thread are the same everywhere; several trials at once are faster than several threads in one."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=4)
def opened(map_folder: str, data: str, device: str = "cpu") -> tuple[Map, Dataset]:
    """Folders, or closed-form scenes by name. Both are read once a process."""
    where = _device(device)
    stored = closed_form_map(map_folder) if is_closed_form(map_folder) else load_map(Path(map_folder), where)
    if is_closed_form(data):
        return stored, closed_form_data(data)
    return stored, open_dataset(data, stored.bounds.background)


@lru_cache(maxsize=4)
def opened_points(folder: str | None, map_folder: str) -> SparsePoints | None:
    """Points in ``folder``, in the unit of a map, by the places of the cameras that this was trained with."""
    if folder is None:
        return None
    if is_closed_form(map_folder):
        raise InputError(f"{map_folder}: was trained with no cameras, which tell the unit of {folder}")
    return SparsePoints(Path(folder), places_of(load_info(Path(map_folder))), SparseChoice())


def places_of(info: MapInfo) -> list[tuple[str, SE3]]:
    """Names of the training images, and T_world_camera, float64."""
    return [(stored.name, T) for stored, (_, T) in zip(info.cameras, cameras_of(info), strict=True)]


def plain_localization(found: Localization, backend: str, error: PoseError | None) -> dict[str, Any]:
    """The object that ``bidnerf localize --json`` prints."""
    return found.plain() | {
        "backend": backend,
        "error": None if error is None else to_plain(_off(error)),
    }


def _result(
    trial: Trial, stored: Map, found: Localization, start: SE3 | None, truth: SE3, settings: Any
) -> TrialResult:
    trace = pose_error(found.poses, truth)
    plain = plain_localization(found, stored.info.backend, pose_error(found.T_world_camera, truth))
    more = {
        "frame": trial.frame,
        "seed": trial.seed,
        "start_error": None if start is None else to_plain(_off(pose_error(start, truth))),
        "errors": {"translation": _finite(trace.translation), "rotation_deg": _finite(trace.rotation_deg)},
        "peak_memory_bytes": peak_memory_bytes(),
        "settings": to_flat(settings),
        "weights": stored.info.weights,
        "trial": to_plain(trial.portable),
    }
    return from_plain(TrialResult, plain | more, "result")


def _device(name: str) -> torch.device:
    """One that computes here: its name alone does not tell."""
    try:
        device = torch.device(name)
        torch.ones((), device=device).item()
    except (RuntimeError, AssertionError) as error:  # torch's own builds differ in which
        raise InputError(f"no device {name!r} to compute on here, expected one as cpu or cuda") from error
    return device


def _name(folder: str) -> str:
    return folder if is_closed_form(folder) else Path(folder).resolve().name


def _parts(folder: str) -> tuple[str, ...]:
    return Path(folder).resolve().parts[1:]


def _off(error: PoseError) -> Off | None:
    pair = float(error.translation), float(error.rotation_deg)
    return Off(*pair) if all(map(math.isfinite, pair)) else None


def _rows(matrix: Tensor) -> list[list[float]] | None:
    return matrix.tolist() if bool(matrix.isfinite().all()) else None


def _finite(values: Tensor) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]
