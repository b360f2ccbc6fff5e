"""One trial: localize a frame from a start with a method, and measure the result.

``run_trial`` depends only on its arguments and the files that these name, so trials may run in any order, in any process
and on any machine; two runs of the same trial differ only in ``seconds``, ``cpu_seconds`` and ``peak_memory_bytes``.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import torch

from bidnerf.evaluation.faults import faulty, parse_faults
from bidnerf.evaluation.plan import USUAL_SETUP, Setup, Trial, find_protocol, parse_settings
from bidnerf.results import PoseError, plain_localization, pose_error
from bidnerf.scenes import closed_form_data, closed_form_map, is_closed_form
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Capture, DatasetOptions, capture_of
from bidnerf_core.devices import threads_at_most, working_device
from bidnerf_core.errors import InputError, UsageError, enumeration
from bidnerf_core.frames import View
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.io import from_plain, to_plain
from bidnerf_core.maps import DESCRIPTION, Localizer, Map, ViewSource, load_map
from bidnerf_core.registry import registered, require_registered
from bidnerf_core.settings import to_flat

Rows: TypeAlias = tuple[tuple[float, ...], ...]
MapSource: TypeAlias = Map | str | Path
"""A map in memory, the folder of a map, or demo:NAME."""
Scene: TypeAlias = tuple[Map, Capture]
"""A map, and a dataset of the same scene."""


@dataclass(frozen=True)
class ScalarPoseError:
    """The distance and the angle between a pose and the true one, as plain numbers."""

    translation: float  # metres
    rotation_deg: float


@dataclass(frozen=True)
class Trace:
    """Errors at the start and after each step; without a start, entry 0 is the error of the method's first pose.

    Raises ``ValueError`` if the two sequences differ in length or are empty.
    """

    translation: tuple[float | None, ...]  # metres; None if a pose was not finite
    rotation_deg: tuple[float | None, ...]

    def __post_init__(self) -> None:
        if not len(self.translation) == len(self.rotation_deg) > 0:
            lengths = f"{len(self.translation)} translation and {len(self.rotation_deg)} rotation errors"
            raise ValueError(f"{lengths}, expected as many of each")

    def as_error(self) -> PoseError:
        """Return the errors as tensors (n), NaN where a pose was not finite."""
        rows = [[math.nan if x is None else x for x in row] for row in (self.translation, self.rotation_deg)]
        values = torch.tensor(rows, dtype=torch.float64)
        return PoseError(values[0], values[1])


@dataclass(frozen=True)
class InputDigests:
    """Digests of the content of a trial's input: folders may move and machines may differ, but the content must not."""

    views: str  # images, depth, intrinsics and true poses of the frames, in hexadecimal
    surface: str | None = None  # file name of the map's baked surface, which changes with every baking


@dataclass(frozen=True)
class TrialResult:
    """One line of results: the output of ``bidnerf localize --json``, and everything that a report needs."""

    T_world_camera: Rows | None  # 4x4; None if it was not finite
    converged: bool  # according to the method itself
    steps: int
    seconds: float
    covariance: Rows | None
    loss: float | None
    backend: str
    method: str
    error: ScalarPoseError | None  # None if the pose was not finite
    frame: str
    seed: int
    start_error: ScalarPoseError | None  # None if no start was given
    errors: Trace
    reason: str  # why the method stopped
    peak_memory_bytes: int  # of the process during the trial: resident memory, or memory of the GPU
    settings: dict[str, Any]  # all settings of the method
    weights: str  # identifies the map's training run, see ``Map.training``
    trial: Trial  # with folders' names instead of paths
    outcome: str  # the method's
    inputs: InputDigests
    cpu_seconds: float  # of the process; unlike ``seconds``, other processes do not lengthen it
    focal_factor: float = 1.0  # ratio of the true to the given focal length, if it was estimated as well
    intrinsics: Intrinsics | None = None  # those used for the pose, if they differ from the given ones
    confidence: float | None = None  # probability that the pose is right; None if unknown
    unit: LengthUnit = "units"  # of all lengths: that of the map

    def plain(self) -> dict[str, Any]:
        """Return the result as an object of strict JSON, in which the trial has flat names."""
        return to_plain(self) | {"trial": to_flat(self.trial)}


def run_trial(trial: Trial, scene: Scene | None = None, registered: Sequence[tuple[str, str]] = ()) -> TrialResult:
    """Run a trial on the map and dataset ``scene``, by default those named by the trial.

    ``registered`` has the group and name of everything that the planning process registered for it. Raises
    ``InputError`` for an unknown name, for a method that lacks an input it needs, and if this process has not
    registered the same names.
    """
    require_registered(registered)
    with threads_at_most(1):
        stored, dataset = scene or open_scene(trial.map, trial.data, trial)
        views = trial_views(trial, dataset)
        truth, protocol = views[-1].T_ref_camera, find_protocol(trial.protocol)
        protocol.check_size(trial.size)
        start = protocol.start(truth, trial.size, trial.seed)
        settings = parse_settings(trial.method, trial.config)
        localizer = Localizer(stored, trial.method, settings, warm_up=False)
        inputs = InputDigests(views_digest(views), stored.info.surface)
        reset_peak_memory()
        began = time.process_time()
        answer = localizer(views, start, seed=trial.seed)
        cpu_seconds = time.process_time() - began
    trace, error = (pose_error(poses, truth) for poses in (answer.poses, answer.T_world_camera))
    more = {
        "frame": trial.frame,
        "seed": trial.seed,
        "start_error": None if start is None else pose_error(start, truth).plain(),
        "errors": {
            name: [x if math.isfinite(x) else None for x in getattr(trace, name).tolist()]
            for name in ("translation", "rotation_deg")
        },
        "peak_memory_bytes": peak_memory_bytes(),
        "settings": to_flat(settings),
        "weights": stored.training,
        "trial": to_flat(trial.portable),
        "inputs": to_plain(inputs),
        "cpu_seconds": cpu_seconds,
    }
    return from_plain(TrialResult, plain_localization(answer, stored.info.backend, error) | more, "result")


def registered_for(trial: Trial) -> list[tuple[str, str]]:
    """Return the group and name of everything registered in this process that a trial may need.

    The map may need any detector and backend, and the dataset any reader.
    """
    named = {("methods", trial.method), *(("faults", fault.name) for fault in parse_faults(trial.fault))}
    return [key for key in list(registered) if key in named or key[0] in ("backends", "features", "readers")]


def trial_views(trial: Trial, dataset: Capture) -> list[View]:
    """Return the views that the method receives, with their true poses T_world_camera.

    The trial's faults are applied to the views, and their depth is removed if the trial withholds depth.
    """
    views = (faulty(view, trial.fault, trial.seed) for view in dataset.views(trial.images.split, trial.frames))
    return [v if trial.depth else View(v.frame.replace(depth=None), v.T_ref_camera) for v in views]


def open_map(name: str, device: str = "cpu") -> Map:
    """Load the map in a folder, or build the map of a closed-form scene."""
    where = working_device(device)
    return closed_form_map(name) if is_closed_form(name) else load_map(Path(name), where)


def open_data(data: ViewSource, options: DatasetOptions, stored: Map | None = None) -> Capture:
    """Return a dataset, read from its folder unless it is in memory or demo:NAME; ``stored`` gives the background colour.

    Raises ``InputError`` for ``data`` of another type, and for options about files with data that has no files.
    """
    if isinstance(data, str | Path) and not is_closed_form(str(data)):
        return replace(options, background=None if stored is None else stored.bounds.background).open(data)
    if isinstance(data, str | Path):
        capture: Capture = closed_form_data(str(data))
    elif isinstance(data, Capture):
        capture = data
    else:
        views = [view for view in data if isinstance(view, View)] if isinstance(data, Sequence) else []
        if not views or len(views) < len(data):
            raise InputError(f"data is a {type(data).__name__}", expected="a folder, a dataset or a list of views")
        name, count = Counter(view.frame.name for view in views).most_common(1)[0]
        if count > 1:  # trials identify their frames by name
            raise InputError(f"data holds {count} frames named {name!r}", expected="different names")
        capture = capture_of(views, Path("views"))
    usual = replace(options, camera=None, register_depth=None, depth_unit=None, largest=None)
    if superfluous := [name for name, value in vars(options).items() if value != getattr(usual, name)]:
        raise UsageError(
            f"has its own cameras and depth; leave out {enumeration([f'`{name}`' for name in superfluous])}",
            where=capture.path,
        )
    return capture if options.mask_folder is None else capture.with_masks(options.mask_folder)


def open_scene(source: MapSource, data: ViewSource, setup: Setup = USUAL_SETUP) -> Scene:
    """Return a map and a dataset, each read from its folder unless it is in memory.

    If both are in folders, they are read once per process unless the map has changed since.
    """
    if not (isinstance(source, str | Path) and isinstance(data, str | Path)):
        stored = source if isinstance(source, Map) else open_map(str(source), setup.device)
        return stored, open_data(data, setup.images, stored)
    version: tuple[int, int] | None = None
    with contextlib.suppress(OSError):  # a closed-form scene, or not a map, which is detected on reading
        file = os.stat(Path(source) / DESCRIPTION)
        version = file.st_ino, file.st_mtime_ns
    return _read_scene(str(source), str(data), setup.device, setup.images, version)


@lru_cache(maxsize=4)
def _read_scene(
    map_name: str, data_name: str, device: str, options: DatasetOptions, version: tuple[int, int] | None
) -> Scene:
    stored = open_map(map_name, device)
    return stored, open_data(data_name, options, stored)


def views_digest(views: Sequence[View]) -> str:
    """Return the digest of the images, depth, alpha, hidden pixels, intrinsics and poses of ``views``; it depends on their order."""
    hashed = hashlib.blake2b(digest_size=16)
    for view in views:
        frame, images = view.frame, [view.frame.rgb, view.frame.depth, view.frame.alpha, view.T_ref_camera.matrix()]
        camera = json.dumps(to_plain(frame.intrinsics), sort_keys=True)
        hashed.update(f"{frame.name}\n{camera}\n".encode(errors="surrogatepass"))
        for image in images if frame.hidden is None else [*images, frame.hidden]:
            if image is None:
                hashed.update(b"none\n")
                continue
            array = image.detach().cpu().contiguous().numpy()
            hashed.update(f"{array.dtype} {array.shape}\n".encode())
            hashed.update(array.tobytes())
    return hashed.hexdigest()


def reset_peak_memory() -> None:
    """Reset the peaks that ``peak_memory_bytes`` reports.

    If the operating system cannot reset the peak resident memory, it remains the peak since the process began.
    """
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()
    with contextlib.suppress(OSError):
        # 5 resets the peak resident set to the present one, see proc(5).
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_bytes() -> int:
    """Return the peak GPU memory if a GPU is in use, else the peak resident memory of this process."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return int(torch.cuda.max_memory_allocated())
    with contextlib.suppress(OSError):
        if peak := re.search(r"^VmHWM:\s*(\d+)", Path("/proc/self/status").read_text(), re.MULTILINE):
            return int(peak[1]) * 1024
    import resource  # absent on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
