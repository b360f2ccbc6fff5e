"""Finding poses: ``Localizer``, the methods by name, and their settings."""

from bidnerf_core.geometry.se3 import pose_from_matrix
from bidnerf_core.localization.auto_config import AutoConfig
from bidnerf_core.localization.bid import BidConfig
from bidnerf_core.localization.bid_lm import BidLmConfig
from bidnerf_core.localization.inerf import InerfConfig
from bidnerf_core.localization.inerf_lm import InerfLmConfig
from bidnerf_core.localization.localizer import Localizer
from bidnerf_core.localization.methods import METHODS, Method, find_method, settings_of
from bidnerf_core.localization.problem import window
from bidnerf_core.localization.result import Localization, Outcome
from bidnerf_core.localization.tracker import Tracker
from bidnerf_core.localization.tracking.settings import TrackerConfig

__all__ = [
    "METHODS",
    "AutoConfig",
    "BidConfig",
    "BidLmConfig",
    "InerfConfig",
    "InerfLmConfig",
    "Localization",
    "Localizer",
    "Method",
    "Outcome",
    "Tracker",
    "TrackerConfig",
    "find_method",
    "pose_from_matrix",
    "settings_of",
    "window",
]
