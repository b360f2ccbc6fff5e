"""Localization: ``Localizer`` and ``Tracker``, the methods by name, their settings, and their building blocks."""

from bidnerf_core.geometry.se3 import pose_from_matrix
from bidnerf_core.localization.by_landmarks import LandmarkAnswer, answer_by_landmarks
from bidnerf_core.localization.costs.rendered import RayCounts, RenderedCost, RenderedCostSettings
from bidnerf_core.localization.costs.sampled import SampledLoss
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.first_order import BidConfig, InerfConfig
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.landmarks.propose import confirm, propose
from bidnerf_core.localization.localizer import Localizer
from bidnerf_core.localization.methods import METHODS, Method, SharedSettings, find_method, settings_of
from bidnerf_core.localization.normal_equations import Cost, GaussianPrior, NormalEquations, Scaled, Sum
from bidnerf_core.localization.problem import Problem, SceneMap, rig, window
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.second_order import BidLmConfig, InerfLmConfig
from bidnerf_core.localization.settings import (
    AdamSettings,
    AutoConfig,
    ByColourConfig,
    ColourSettings,
    DepthSettings,
    DescentSettings,
    ReachSettings,
    RefinementSettings,
    RefinementStage,
    TrackerConfig,
    objective_of,
)
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.solvers.pivots import Pivot, pivot
from bidnerf_core.localization.tracker import Tracker

__all__ = [
    "METHODS",
    "AdamSettings",
    "AutoConfig",
    "BidConfig",
    "BidLmConfig",
    "ByColourConfig",
    "ColourSettings",
    "Cost",
    "DepthSettings",
    "DescentSettings",
    "GaussianPrior",
    "InerfConfig",
    "InerfLmConfig",
    "LandmarkAnswer",
    "LandmarkMatcher",
    "LandmarkPose",
    "Localization",
    "Localizer",
    "Method",
    "NormalEquations",
    "Outcome",
    "Pivot",
    "PointCloud",
    "PointScales",
    "Problem",
    "RayCounts",
    "ReachSettings",
    "RefinementSettings",
    "RefinementStage",
    "RenderedCost",
    "RenderedCostSettings",
    "SampledLoss",
    "Scaled",
    "SceneMap",
    "SharedSettings",
    "Sum",
    "SurfaceCost",
    "Tracker",
    "TrackerConfig",
    "Verdict",
    "answer_by_landmarks",
    "confirm",
    "descend",
    "find_method",
    "objective_of",
    "pivot",
    "pose_from_matrix",
    "propose",
    "rig",
    "settings_of",
    "window",
]
