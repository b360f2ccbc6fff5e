"""``bidnerf localize``."""

from __future__ import annotations

import json as jsonlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from bidnerf_core.cli.common import (
    LARGEST_SEED,
    DataFolder,
    Flag,
    MapFolder,
    Names,
    UsageError,
    chosen_method,
    option,
    parse,
    print_json,
    read_views,
    require,
    require_different,
    say,
)
from bidnerf_core.datasets import Dataset, open_dataset
from bidnerf_core.datasets.colmap import SparseChoice, SparsePoints
from bidnerf_core.datasets.points import read_depth_points
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import protocols
from bidnerf_core.evaluation.errors import PoseError, pose_error
from bidnerf_core.evaluation.trials import places_of, plain_localization, with_points
from bidnerf_core.frames import View
from bidnerf_core.localization import METHODS, InerfConfig, Localization, rig
from bidnerf_core.localization import localize as find_pose
from bidnerf_core.localization import window as windowed
from bidnerf_core.observations import Observations
from bidnerf_core.se3 import SE3
from bidnerf_core.storage import Map, load_map

one_of = tyro.conf.create_mutex_group(required=True, title="where to start")


@dataclass(frozen=True)
class Beginning:
    """What the user says of where to start: one of the two, or that nothing is known."""

    file: Path | None
    perturb: tuple[float, float] | None  # metres, degrees

    def pose(self, truth: SE3, seed: int) -> SE3 | None:
        if self.file is not None:
            return read_pose(self.file)
        return None if self.perturb is None else protocols.perturb(truth, *self.perturb, seed)

    def judge(self) -> None:
        if self.perturb is not None:
            limits = (("T", "metres", protocols.FARTHEST), ("R", "degrees", 180.0))
            for (what, unit, most), value in zip(limits, self.perturb, strict=True):
                if not 0 <= value <= most:
                    raise UsageError(f"--perturb: {what} is {value:g}, expected {unit} from 0 to {most:g}")


@dataclass(frozen=True)
class Seen:
    """What the user says was seen."""

    split: str
    frames: Sequence[str]
    window: int
    depth_points: Path | None  # a file, or the folder of a COLMAP model
    choice: SparseChoice

    def judge(self) -> None:
        if not self.frames:
            raise UsageError("no frame to localize; name at least one with --frame")
        require_different("--frame", self.frames)
        require("--window", self.window, 1)
        if self.window > 1 and len(self.frames) > 1:
            raise UsageError(
                f"--window {self.window} with {len(self.frames)} frames, expected one: the last of the window"
            )

    def views(self, dataset: Dataset) -> list[View]:
        """The frames, or the last one and those before it in the split."""
        names = self.frames
        if self.window > 1:
            listed = dataset.frame_names(self.split)
            require("--window", self.window, 1, len(listed))
            if names[0] in listed:  # else the dataset will tell
                names = windowed(listed, listed.index(names[0]), self.window)
                if len(names) < self.window:
                    said = f"{names[-1]} has {len(names) - 1} before it in split {self.split!r}"
                    say(f"--window {self.window}: {said}; a rig of {len(names)}")
        return read_views(dataset, self.split, names)

    def with_points(
        self, views: list[View], method: str, stored: Map
    ) -> tuple[list[View], Observations | None]:
        """The views with what ``depth_points`` holds for them: depth images, or rays of the last one's camera."""
        if self.depth_points is None or not self.depth_points.is_dir():
            return views, None if self.depth_points is None else read_depth_points(self.depth_points)
        sparse = SparsePoints(self.depth_points, places_of(stored.info), self.choice)
        given = with_points(sparse, views, self.split, method, stored)
        counts = {v.frame.name: len(sparse.seen(v.frame.name, self.split)) for v in views}
        blind = ", ".join(name for name, count in counts.items() if count == 0)
        say(f"{sparse.summary}; {sum(counts.values())} points seen{blind and f', none by {blind}'}")
        return given


def run(arguments: list[str]) -> None:
    """Parse with the settings of the method that the arguments name."""
    kind = chosen_method(arguments, "auto").config_type

    def localize(
        map: MapFolder,
        data: DataFolder,
        frame: Annotated[Names, option("NAME...", "names of frames, the stems of their image files")],
        split: Annotated[str, option("NAME", "which of the dataset's splits")] = "test",
        method: Annotated[str, option("NAME", ", ".join(METHODS))] = "auto",
        start: Annotated[
            Path | None, one_of, option("POSE.json", "file with a 4x4 T_world_camera to start from", "")
        ] = None,
        perturb: Annotated[
            tuple[float, float] | None,
            one_of,
            option("T R", "start from the true pose moved by T metres and R degrees", ""),
        ] = None,
        no_start: Annotated[Flag, one_of, option(None, "no start is known", "")] = False,
        window: Annotated[
            int, option("K", "take the frame and those before it in the split, K in all, as a rig")
        ] = 1,
        depth_points: Annotated[
            Path | None,
            option(
                "FILE",
                "points that a sensor measured from there, metres: x y z a row, .npy, or .npz; or the folder of a "
                "COLMAP sparse model, of which the points that the frames observe are taken",
                "",
            ),
        ] = None,
        seed: Annotated[int, option("N", "of all that is drawn at random")] = 0,
        json: Annotated[Flag, option(None, "print one JSON object", "")] = False,
        choice: SparseChoice = SparseChoice(),
        config: Any = kind(),
    ) -> None:
        """Find the pose of a dataset's frame in a map.

        Several frames are taken as a rig: their relative poses come from the dataset, and the pose found is that of the
        last one's camera. Poses are camera to world, OpenCV axes (x right, y down, z forward); so are points, unless a .npz
        has T_camera_sensor beside them.
        """
        seen = Seen(split, [name for group in frame for name in group], window, depth_points, choice)
        _localize(map, data, seen, method, Beginning(start, perturb), seed, json, config)

    localize.__annotations__["config"] = kind
    parse("localize", localize, arguments)


def _localize(
    folder: Path, data: Path, seen: Seen, method: str, begin: Beginning, seed: int, as_json: bool, config: Any
) -> None:
    seen.judge()
    begin.judge()
    require("--seed", seed, 0, LARGEST_SEED)
    stored = load_map(folder)
    views = seen.views(open_dataset(data, stored.bounds.background))
    views, depth_rays = seen.with_points(views, method, stored)
    if depth_rays is not None and isinstance(config, InerfConfig):
        say(f"{seen.depth_points}: method inerf heeds no depth")
    truth = views[-1].T_ref_camera
    start = begin.pose(truth, seed)
    bare = [view.frame.name for view in views if not view.frame.has_depth]
    if bare and depth_rays is None:
        say(f"{', '.join(bare)}: no measured depth; colour only")
    problem = rig(stored.field, stored.bounds, views, start, depth_rays, stored.surface)
    found = find_pose(problem, method, config, seed)
    if depth_rays is not None and found.method == "auto":
        taken = "colours" if len(bare) == len(views) else "depth"
        say(
            f"{seen.depth_points}: method auto took the {taken} of the images instead; --method bid takes both"
        )
    if not bool(found.T_world_camera.matrix().isfinite().all()):
        raise InputError(f"{folder}: {found.method} came to a pose that is not finite, expected a sound map")
    error = pose_error(found.T_world_camera, truth)
    if as_json:
        print_json(plain_localization(found, stored.info.backend, error))
    else:
        _print(found, views[-1].frame.name, None if start is None else pose_error(start, truth), error)


def read_pose(path: Path) -> SE3:
    """A 4x4 camera-to-world matrix, alone or under "T_world_camera", as ``localize --json`` prints it."""
    expected = 'expected {"T_world_camera": 4x4 rows}'
    try:
        found = jsonlib.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), {expected}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error}), {expected}") from error
    rows = found.get("T_world_camera") if isinstance(found, dict) else found
    try:
        matrix = torch.tensor(rows, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: no matrix of numbers in it, {expected}") from error
    pose = SE3.from_matrix(matrix) if matrix.shape == (4, 4) else None
    if pose is None or not bool(pose.is_rigid()):
        raise InputError(f"{path}: not a rigid transform, {expected} with an orthonormal rotation")
    return pose.normalized()


def _print(found: Localization, name: str, before: PoseError | None, after: PoseError) -> None:
    print(f"{name}: {'converged' if found.converged else 'NOT converged'} ({found.reason})")
    print(f"  start error  {'no start' if before is None else _shown(before)}")
    print(f"  final error  {_shown(after)}")
    if found.covariance is not None:
        print(f"  by itself    {_sure(found.covariance)}")
    print(f"  {found.steps} steps, {found.seconds:.2f} s, loss {found.loss:.5f}, method {found.method}")
    for row in found.T_world_camera.matrix().tolist():
        print("  " + " ".join(f"{value: .6f}" for value in row))


def _shown(error: PoseError) -> str:
    return f"{float(error.translation):.4f} m, {float(error.rotation_deg):.3f} deg"


def _sure(covariance: Tensor) -> str:
    """One standard deviation, as the method itself has it."""
    translation, rotation = (float(part.sum().clamp(min=0).sqrt()) for part in covariance.diagonal().split(3))
    return f"{translation:.4f} m, {math.degrees(rotation):.3f} deg (one standard deviation)"
