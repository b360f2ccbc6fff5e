"""The start of ``bidnerf localize``: a pose from a file, the perturbed true pose, or none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from bidnerf_core.cli.options import UsageError
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import protocols
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import read_file
from bidnerf_core.io.json import parse_json
from bidnerf_core.localization import pose_from_matrix

EXPECTED_POSE = '{"T_world_camera": 4x4 rows}'


@dataclass(frozen=True)
class StartSpec:
    """A start as given by the arguments: one of the two, or none."""

    fixed: SE3 | None = None  # T_world_camera
    perturb: tuple[float, float] | None = None  # metres, degrees

    def check(self) -> None:
        """Raise ``UsageError`` for a perturbation out of range."""
        if self.perturb is not None:
            limits = (("T", "metres", protocols.FARTHEST_START), ("R", "degrees", 180.0))
            for (what, unit, most), value in zip(limits, self.perturb, strict=True):
                if not 0 <= value <= most:
                    raise UsageError(f"--perturb: {what} is {value:g}, expected {unit} from 0 to {most:g}")

    @property
    def given(self) -> bool:
        return self.fixed is not None or self.perturb is not None

    def pose(self, truth: SE3 | None, seed: int) -> SE3 | None:
        """Return T_world_camera to start from. ``seed`` determines the direction in which the true pose is perturbed."""
        if self.perturb is None or truth is None:
            return self.fixed
        return protocols.perturb(truth, *self.perturb, seed)


def read_pose(path: Path) -> SE3:
    """Read a 4x4 camera-to-world matrix, alone or under "T_world_camera", as ``localize --json`` prints it.

    A list of one such object is accepted as well. Raises ``InputError`` where the file does not hold the rows of a rigid
    transform.
    """
    content = read_file(path, "a pose file")
    try:
        found = parse_json(content, str(path), EXPECTED_POSE)
    except InputError as error:
        lines = [line for line in content.splitlines() if line.strip()]
        if len(lines) > 1 and all(line.startswith(b"{") for line in lines):  # as ``--json`` prints several
            raise _not_one(path, len(lines)) from error
        raise
    if isinstance(found, list) and all(isinstance(entry, dict) for entry in found):
        if len(found) != 1:  # as ``--out`` writes several
            raise _not_one(path, len(found))
        (found,) = found
    rows = found.get("T_world_camera") if isinstance(found, dict) else found
    try:
        matrix = torch.tensor(rows, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(f"{path}: no matrix of numbers in it, expected {EXPECTED_POSE}") from error
    return pose_from_matrix(matrix, f"{path}: T_world_camera")


def _not_one(path: Path, count: int) -> InputError:
    return InputError(f"{path}: holds {count} poses, expected one")
