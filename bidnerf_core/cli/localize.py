"""``bidnerf localize``."""

from __future__ import annotations

import json as jsonlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from bidnerf_core.cli.common import parse, print_json, read_views, say, value_of
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import protocols
from bidnerf_core.evaluation.errors import PoseError, pose_error
from bidnerf_core.localization import Localization, find_method, rig
from bidnerf_core.localization import localize as find_pose
from bidnerf_core.se3 import SE3
from bidnerf_core.storage import load_map


@dataclass(frozen=True)
class Beginning:
    """What the user says of where to start: exactly one of the three."""

    file: Path | None
    perturb: tuple[float, float] | None  # metres, degrees
    none: bool

    def __post_init__(self) -> None:
        given = [self.file is not None, self.perturb is not None, self.none]
        if sum(given) != 1:
            raise InputError("expected one of --start POSE.json, --perturb T R and --no-start")

    def pose(self, truth: SE3, method: str, seed: int) -> SE3:
        if self.file is not None:
            return read_pose(self.file)
        if self.perturb is not None:
            return protocols.perturb(truth, *self.perturb, seed)
        raise InputError(f"method {method!r} needs a start; give --start POSE.json or --perturb T R")


def run(arguments: list[str]) -> None:
    """Parse with the settings of the method that the arguments name."""
    kind = find_method(value_of("--method", arguments) or "auto").config_type

    def localize(
        map: tyro.conf.Positional[Path],
        data: tyro.conf.Positional[Path],
        frame: tuple[str, ...],
        split: str = "test",
        method: str = "auto",
        start: Annotated[
            Path | None, tyro.conf.arg(help="JSON file with a 4x4 T_world_camera to start from")
        ] = None,
        perturb: Annotated[
            tuple[float, float] | None,
            tyro.conf.arg(metavar="T R", help="start from the true pose moved by T metres and R degrees"),
        ] = None,
        no_start: Annotated[bool, tyro.conf.arg(help="no start is known")] = False,
        seed: int = 0,
        json: Annotated[bool, tyro.conf.arg(help="print one JSON object")] = False,
        config: Any = kind(),
    ) -> None:
        """Find the pose of a frame of the dataset in folder DATA in the map in folder MAP.

        Several frames are taken as a rig: their relative poses come from the dataset, and the pose found is that of the
        last one's camera. Poses are camera to world, OpenCV axes (x right, y down, z forward).
        """
        _localize(map, data, frame, split, method, Beginning(start, perturb, no_start), seed, json, config)

    localize.__annotations__["config"] = kind
    parse("localize", localize, arguments)


def _localize(
    folder: Path, data: Path, frames: tuple[str, ...], split: str, method: str, begin: Beginning, seed: int,
    as_json: bool, config: Any,
) -> None:  # fmt: skip
    if not frames:
        raise InputError("no frame to localize; name at least one with --frame")
    stored = load_map(folder)
    views = read_views(open_dataset(data, stored.bounds.background), split, frames)
    for view in views:
        if not view.frame.has_depth:
            say(f"{view.frame.name}: no measured depth; colour only")
    truth = views[-1].T_ref_camera
    start = begin.pose(truth, method, seed)
    found = find_pose(rig(stored.field, stored.bounds, views, start), method, config, seed)
    error = pose_error(found.T_world_camera, truth)
    if as_json:
        print_json(as_plain(found, stored.info.backend, error))
    else:
        _print(found, views[-1].frame.name, pose_error(start, truth), error)


def as_plain(found: Localization, backend: str, error: PoseError | None) -> dict[str, Any]:
    """The object that ``localize --json`` prints."""
    known = error and {"translation": float(error.translation), "rotation_deg": float(error.rotation_deg)}
    return {
        "T_world_camera": found.T_world_camera.matrix().tolist(),
        "converged": found.converged,
        "steps": found.steps,
        "seconds": found.seconds,
        "covariance": None if found.covariance is None else found.covariance.tolist(),
        "loss": found.loss if math.isfinite(found.loss) else None,
        "backend": backend,
        "method": found.method,
        "error": known,
    }


def read_pose(path: Path) -> SE3:
    """A 4x4 camera-to-world matrix, alone or under "T_world_camera", as ``localize --json`` prints it."""
    expected = 'expected {"T_world_camera": 4x4 rows}'
    try:
        found = jsonlib.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, {expected}") from error
    except ValueError as error:
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


def _print(found: Localization, name: str, before: PoseError, after: PoseError) -> None:
    print(f"{name}: {'converged' if found.converged else 'NOT converged'} ({found.reason})")
    print(f"  start error  {_shown(before)}")
    print(f"  final error  {_shown(after)}")
    print(f"  {found.steps} steps, {found.seconds:.1f} s, loss {found.loss:.5f}, method {found.method}")
    for row in found.T_world_camera.matrix().tolist():
        print("  " + " ".join(f"{value: .6f}" for value in row))


def _shown(error: PoseError) -> str:
    return f"{float(error.translation):.4f} m, {float(error.rotation_deg):.3f} deg"
