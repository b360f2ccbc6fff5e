"""A method: the pose from the map's landmarks alone, without depth, renderings or a second attempt."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Localization, Loop, Method, Outcome, Problem
from bidnerf_core.settings import Settings


@dataclass(frozen=True)
class LandmarksAloneConfig(Settings):
    """Each field becomes an option of ``bidnerf localize --method landmarks-alone``."""

    least_inliers: int = 12  # minimum number of inliers for an accepted pose


def solve(problem: Problem, config: LandmarksAloneConfig, seed: int) -> Localization:
    """Return the pose of the last image. Raises ``InputError`` for a map without landmarks."""
    if problem.matcher is None:
        raise InputError("method 'landmarks-alone' needs a map with landmarks, which 'bidnerf bake' builds")
    began = time.perf_counter()
    found = Loop(problem.views, problem.matcher, seed=seed)()
    agreeing = 0 if found is None else found.evidence.inliers
    T = SE3.identity() if found is None else found.T_world_rig
    accepted = found is not None and agreeing >= config.least_inliers
    return Localization(
        T_world_camera=T,
        outcome=Outcome.CONVERGED if accepted else Outcome.TOO_FEW_MATCHES,
        reason=f"{agreeing} landmark inliers, {config.least_inliers} are needed",
        steps=0,
        seconds=time.perf_counter() - began,
        loss=0.0 if found is None else found.evidence.noise_ratio,
        method="landmarks-alone",
        poses=SE3.stack([T]),
        losses=torch.zeros(0, dtype=torch.float64),
    )


method = Method(
    solve,
    LandmarksAloneConfig,
    needs_start=False,
    uses_depth=False,
    uses_landmarks=True,
    summary="the pose from landmarks alone, accepted if there are enough inliers",
)
