"""Poses by landmarks: image features matched with the map's, fused with measured depth and with what the field renders."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.localization.acceptance import landmark_verdict
from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.rendered import RenderedCost, RenderedCostSettings
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import FINEST
from bidnerf_core.localization.method_settings import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
)
from bidnerf_core.localization.normal_equations import Cost, Scaled, Sum
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Verdict
from bidnerf_core.localization.search.landmarks import LandmarkPose, propose
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3

POINTS = 2000
"""Measured points that are fused with the landmarks, at most."""
STEPS = 8


@dataclass(frozen=True, eq=False)
class LandmarkAnswer:
    """A pose by landmarks, fused with what else was measured, and the judgement of it."""

    found: LandmarkPose
    T: SE3
    covariance: Float[Tensor, "6 6"]
    verdict: Verdict


def localize_by_landmarks(
    problem: Problem, matcher: LandmarkMatcher, seed: int
) -> LandmarkAnswer | None:
    """Find the pose by landmarks. Returns None where too few features match for any pose."""
    found = propose(matcher, problem.views, seed=seed)
    if found is None:
        return None
    return LandmarkAnswer(found, found.T_world_camera, found.covariance, landmark_verdict(found))
