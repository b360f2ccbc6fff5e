"""Running one trial: localize a frame from a start with a method, and measure the result.

``run_trial`` depends only on its arguments and the files that these name, so trials may run in any order, in
any process and on any machine; two runs of the same trial differ only in ``seconds`` and
``peak_memory_bytes``.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import torch
from torch import Tensor

from bidnerf_core.datasets import Capture, SparseChoice, SparsePoints, open_dataset
from bidnerf_core.devices import one_thread, working_device
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.faults import faulty, parse_faults
from bidnerf_core.evaluation.protocols import find_protocol
from bidnerf_core.evaluation.trial import (
    InputDigests,
    Trial,
    TrialResult,
    folder_digest,
    views_digest,
)
from bidnerf_core.frames import HiddenColour, MaskFolder, View
from bidnerf_core.geometry import SE3
from bidnerf_core.io import from_plain, parse_record, to_plain
from bidnerf_core.localization import Localization, Localizer, settings_of
from bidnerf_core.maps import DESCRIPTION, Map, MapInfo, cameras_of, load_map
from bidnerf_core.registry import registered_names, require_registered
from bidnerf_core.results import plain_localization, pose_error
from bidnerf_core.scenes import closed_form_data, closed_form_map, is_closed_form
from bidnerf_core.settings import to_flat

if TYPE_CHECKING:
    from bidnerf_core.evaluation.bench import Plan

Opened: TypeAlias = tuple[Map, Capture]
"""A map, and a dataset of the same scene."""

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def run_trial(
    trial: Trial, scene: Opened | None = None, registered: Sequence[tuple[str, str]] = ()
) -> TrialResult:
    """Run a trial on the map and dataset ``scene``, by default those named by the trial.

    ``registered`` has the group and name of everything that the planning process registered for it. Raises
    ``InputError`` for an unknown name, for a method that lacks an input it needs, and if this process has not
    registered the same names.
    """
    require_registered(registered)
    with one_thread():
        stored, dataset = scene or opened_for(trial)
        views = trial_views(trial, dataset)
        truth, start = views[-1].T_ref_camera, start_of(trial, views, dataset)
        settings = parse_settings(trial.method, trial.config)
        digests = input_digests(trial, stored, views)
        forget_peak_memory()
        found = _localized(trial, stored, views, start, settings)
        return _result(trial, stored, found, start, truth, settings, digests)


def registered_for(trial: Trial) -> list[tuple[str, str]]:
    """Return the group and name of everything registered in this process that a trial may need.

    The map may need any detector and backend, and the dataset any reader.
    """
    named = {("methods", trial.method), *(("faults", fault.name) for fault in parse_faults(trial.fault))}
    needed = ("backends", "features", "readers")
    return [found for found in registered_names() if found in named or found[0] in needed]


def _localized(
    trial: Trial, stored: Map, views: list[View], start: SE3 | None, settings: Any
) -> Localization:
    """Return the answer of the trial's method. This is the only place in this package that calls the localizer."""
    points = None if trial.depth_points is None else opened_points(trial.depth_points, stored)
    rays = None if points is None else points.rays(views, trial.split)
    localizer = Localizer(stored, trial.method, settings, warm_up=False)
    return localizer(views, start, rays, trial.seed)


def trial_views(trial: Trial, dataset: Capture) -> list[View]:
    """Return the views that the method receives, with T_world_camera.

    They include the trial's faults, and have no depth if the trial withholds it.
    """
    views = [faulty(view, trial.fault, trial.seed) for view in dataset.views(trial.split, trial.frames)]
    if trial.depth:
        return views
    return [View(view.frame.replace(depth=None), view.T_ref_camera) for view in views]


def input_digests(trial: Trial, stored: Map, views: list[View]) -> InputDigests:
    """Return digests of everything that the trial reads apart from the map's weights."""
    points = None if trial.depth_points is None else folder_digest(trial.depth_points)
    return InputDigests(views_digest(views), points, stored.info.surface)


def start_of(trial: Trial, views: list[View], dataset: Capture) -> SE3 | None:
    """Return T_world_camera at which the trial starts; None if its protocol gives no start."""
    protocol = find_protocol(trial.protocol)
    protocol.check_size(trial.size)
    frames = len(dataset.frame_names(trial.split))
    return protocol.start(views[-1].T_ref_camera, trial.size, trial.seed, frames)


def parse_settings(method: str, config: str) -> Any:
    """Return the settings of ``method`` from the JSON of those that differ from its defaults."""
    return settings_of(
        method, dict(parse_record("config", config, f"an object of settings of {method}").values)
    )


def open_map(name: str, device: str = "cpu") -> Map:
    """Return the map in a folder, or of a closed-form scene."""
    where = working_device(device)
    return closed_form_map(name) if is_closed_form(name) else load_map(Path(name), where)


@dataclass(frozen=True)
class Reading:
    """The options with which a trial's dataset is opened, see ``open_dataset``; its ``split`` may be "all"."""

    masks: str | None = None
    mask_hides: HiddenColour = "black"
    camera: str | None = None
    register_depth: bool | str | None = None
    depth_unit: float | None = None
    split: str = "test"

    @classmethod
    def of(cls, work: Trial | Plan) -> Reading:
        """Return the options of a trial or a plan."""
        return cls(work.masks, work.mask_hides, work.camera, work.register_depth, work.depth_unit, work.split)

    def open(self, name: str, stored: Map | None = None) -> Capture:
        """Return the dataset in a folder, or of a closed-form scene; a map gives the colour behind its images."""
        if is_closed_form(name):
            return self.in_memory(closed_form_data(name))
        found = open_dataset(
            name, None if stored is None else stored.bounds.background, camera=self.camera,
            register_depth=self.register_depth, depth_unit=self.depth_unit,
        )  # fmt: skip
        return self._masked(found)

    def in_memory(self, dataset: Capture) -> Capture:
        """Return a dataset that is open already, with its masks. Raises ``InputError`` for options of files."""
        files = self.camera, self.register_depth, self.depth_unit
        if any(option is not None for option in files):
            raise InputError(
                "has its own cameras and depth; leave out camera, register_depth and depth_unit",
                where=dataset.path,
            )
        return self._masked(dataset)

    def _masked(self, dataset: Capture) -> Capture:
        return dataset if self.masks is None else dataset.masked(MaskFolder(self.masks, self.mask_hides))


def opened(map_name: str, data_name: str, device: str = "cpu", reading: Reading = Reading()) -> Opened:
    """Return the map and dataset with these names, which are read once per process unless the map has changed since."""
    try:
        file = os.stat(Path(map_name) / DESCRIPTION)
    except OSError:  # a closed-form scene, or not a map, which is detected below
        return _opened(map_name, data_name, device, reading, None)
    return _opened(map_name, data_name, device, reading, (file.st_ino, file.st_mtime_ns))


def opened_for(work: Trial | Plan) -> Opened:
    """Return the map and the dataset that a trial or a plan names, as ``opened`` does."""
    return opened(work.map, work.data, work.device, Reading.of(work))


@lru_cache(maxsize=4)
def _opened(
    map_name: str, data_name: str, device: str, reading: Reading, version: tuple[int, int] | None
) -> Opened:
    stored = open_map(map_name, device)
    return stored, reading.open(data_name, stored)


@lru_cache(maxsize=4)
def opened_points(folder: str, stored: Map) -> SparsePoints:
    """Return the points of the COLMAP model in ``folder``, scaled to the map with the poses of its training cameras."""
    if not stored.info.cameras:
        raise InputError("the map has no training cameras to determine the scale from", where=folder)
    return SparsePoints(Path(folder), places_of(stored.info), SparseChoice())


def places_of(info: MapInfo) -> list[tuple[str, SE3]]:
    """Return the name and T_world_camera (float64) of each training image."""
    return [(stored.name, T) for stored, (_, T) in zip(info.cameras, cameras_of(info), strict=True)]


def _result(
    trial: Trial,
    stored: Map,
    found: Localization,
    start: SE3 | None,
    truth: SE3,
    settings: Any,
    digests: InputDigests,
) -> TrialResult:
    trace = pose_error(found.poses, truth)
    plain = plain_localization(found, stored.info.backend, pose_error(found.T_world_camera, truth))
    more = {
        "frame": trial.frame,
        "seed": trial.seed,
        "start_error": None if start is None else pose_error(start, truth).plain(),
        "errors": {"translation": _finite(trace.translation), "rotation_deg": _finite(trace.rotation_deg)},
        "peak_memory_bytes": peak_memory_bytes(),
        "settings": to_flat(settings),
        "weights": stored.training,
        "trial": to_plain(trial.portable),
        "inputs": to_plain(digests),
    }
    return from_plain(TrialResult, plain | more, "result")


def _finite(values: Tensor) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]


def forget_peak_memory() -> None:
    """Reset the peaks that ``peak_memory_bytes`` reports.

    Where the operating system cannot do that, the peak resident memory remains that since the process began.
    """
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()
    with contextlib.suppress(OSError):
        RESET.write_text("5")  # proc(5): resets the peak resident set to the present one


def peak_memory_bytes() -> int:
    """Return the peak GPU memory if a GPU is in use, else the peak resident memory of this process."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return int(torch.cuda.max_memory_allocated())
    with contextlib.suppress(OSError):
        for line in STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return _peak_since_start()


def _peak_since_start() -> int:
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
