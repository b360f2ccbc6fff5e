"""Finding poses: ``localize`` and its parts."""

from bidnerf_core.localization.auto import AutoConfig
from bidnerf_core.localization.bid import BidConfig
from bidnerf_core.localization.bid_lm import BidLmConfig
from bidnerf_core.localization.inerf import InerfConfig
from bidnerf_core.localization.inerf_lm import InerfLmConfig
from bidnerf_core.localization.methods import METHODS, Method, find_method, localize
from bidnerf_core.localization.problem import Problem, rig, single, window
from bidnerf_core.localization.result import Localization

__all__ = [
    "METHODS",
    "AutoConfig",
    "BidConfig",
    "BidLmConfig",
    "InerfConfig",
    "InerfLmConfig",
    "Localization",
    "Method",
    "Problem",
    "find_method",
    "localize",
    "rig",
    "single",
    "window",
]
