"""Choice of the settings with which registration does best on the frames reserved for tuning."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, TypeVar

import torch
from registration_clouds import Points
from registration_methods import (
    Gicp,
    Matrix,
    Open3d,
    Ransac,
    Refine,
    SmallGicp,
    gicp_choices,
    ransac_choices,
    ransac_neighbours,
    refine_choices,
)

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.results.errors import CRITERIA, pose_error

LEAST = 4
"""Minimum number of cases to tune on; if there are fewer frames, each is tried with several seeds."""

Setting = TypeVar("Setting")


@dataclass(frozen=True, eq=False)
class Case:
    """A frame to tune on."""

    measured: Points
    truth: SE3
    seed: int


@dataclass(frozen=True)
class Score:
    """The performance of a setting."""

    successes: int  # number within 5 degrees and 0.05, plus number within 1 degree and 0.02
    error: float  # median sum of both errors, in units of the strict limits
    seconds: float  # median


def as_pose(T: Matrix) -> SE3:
    return SE3.from_matrix(torch.tensor(T, dtype=torch.float64))


def cases(frames: Sequence[tuple[Points, SE3]]) -> list[Case]:
    rounds = -(-LEAST // len(frames))
    return [Case(measured, truth, seed) for seed in range(rounds) for measured, truth in frames]


def tuned_open3d(library: Open3d, tries: Sequence[Case], voxel: float) -> tuple[Ransac, Refine, Refine]:
    """Return the best settings of the search and, from its answers, of point-to-plane and of coloured ICP."""
    rough = Refine(False, (voxel, voxel / 2), (1.5, 1.5))

    def search(setting: Ransac) -> tuple[Score, list[Matrix]]:
        library.features(setting.voxel)
        found, seconds = timed(tries, lambda i, case: _searched(library, case, setting))
        refined = [library.refine(case.measured, T, rough) for case, T in zip(tries, found, strict=True)]
        return scored(tries, refined, seconds), found

    results = {setting: search(setting) for setting in ransac_choices(voxel)}
    results |= {s: search(s) for s in ransac_neighbours(_quickest(results))}
    best = _quickest(results)
    starts = results[best][1]
    refines = [
        _nearest(tries, starts, library.refine, refine_choices(voxel, colour)) for colour in (False, True)
    ]
    return best, refines[0], refines[1]


def tuned_gicp(
    library: SmallGicp, tries: Sequence[Case], starts: Sequence[Matrix], voxel: float, near: bool
) -> Gicp:
    return _nearest(tries, starts, library.refine, gicp_choices(voxel, near))


def timed(tries: Sequence[Case], run: Callable[[int, Case], Matrix]) -> tuple[list[Matrix], list[float]]:
    """Return the answers, and the CPU seconds of each."""
    found, seconds = [], []
    for i, case in enumerate(tries):
        began = time.process_time()
        found.append(run(i, case))
        seconds.append(time.process_time() - began)
    return found, seconds


def scored(tries: Sequence[Case], found: Sequence[Matrix], seconds: Sequence[float]) -> Score:
    errors = pose_error(SE3.stack([as_pose(T) for T in found]), SE3.stack([case.truth for case in tries]))
    good = [int(CRITERIA[name](errors, errors).sum()) for name in ("5deg 0.05", "1deg 0.02")]
    shares = errors.translation / 0.02 + errors.rotation_deg
    return Score(sum(good), float(shares.nan_to_num(torch.inf).median()), median(seconds))


def _searched(library: Open3d, case: Case, setting: Ransac) -> Matrix:
    library.seed(case.seed)
    return library.search(case.measured, setting)


def _quickest(results: dict[Ransac, tuple[Score, list[Matrix]]]) -> Ransac:
    """Return the fastest of the settings that succeed most often; ICP does the fine alignment."""
    return max(results, key=lambda setting: (results[setting][0].successes, -results[setting][0].seconds))


def _nearest(
    tries: Sequence[Case],
    starts: Sequence[Matrix],
    refine: Callable[[Points, Matrix, Any], Matrix],
    choices: Iterable[Setting],
) -> Setting:
    """Return the settings that succeed most often and, among these, have the smallest errors."""

    def score(setting: Setting) -> tuple[int, float]:
        found, seconds = timed(tries, lambda i, case: refine(case.measured, starts[i], setting))
        result = scored(tries, found, seconds)
        return result.successes, -result.error

    return max(choices, key=score)
