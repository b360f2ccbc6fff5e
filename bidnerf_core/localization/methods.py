"""Methods by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.localization.auto import AutoConfig
from bidnerf_core.localization.bid import BidConfig, bid
from bidnerf_core.localization.bid_lm import BidLmConfig, bid_lm
from bidnerf_core.localization.by_depth import by_depth_or_colour
from bidnerf_core.localization.inerf import InerfConfig, inerf
from bidnerf_core.localization.inerf_lm import InerfLmConfig, inerf_lm
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization


@dataclass(frozen=True)
class Method:
    """A way to find a pose, and the frozen dataclass of its settings."""

    run: Callable[[Problem, Any, int], Localization]
    config_type: type
    summary: str


METHODS = {
    "auto": Method(
        by_depth_or_colour, AutoConfig, "search on the baked surface, by depth or colour; no start needed"
    ),
    "bid": Method(bid, BidConfig, "Adam on colour and depth at the coarse level (BID-NeRF)"),
    "inerf": Method(inerf, InerfConfig, "Adam on the colours of one image in full detail (iNeRF)"),
    "bid-lm": Method(bid_lm, BidLmConfig, "second-order steps on colour and depth, from coarse to fine"),
    "inerf-lm": Method(inerf_lm, InerfLmConfig, "second-order steps on colour alone, from coarse to fine"),
}


def find_method(name: str) -> Method:
    chosen = METHODS.get(name)
    if chosen is None:
        raise InputError(f"method {name!r} is unknown, expected one of {', '.join(sorted(METHODS))}")
    return chosen


def localize(problem: Problem, method: str = "auto", config: Any = None, seed: int = 0) -> Localization:
    """Find the pose of ``problem``'s last camera.

    ``config`` is an instance of the method's config type, by default with all defaults. The same seed gives the same
    answer on the same machine. Raises ``InputError`` for an unknown method.
    """
    chosen = find_method(method)
    settings = chosen.config_type() if config is None else config
    if not isinstance(settings, chosen.config_type):
        expected, found = chosen.config_type.__name__, type(settings).__name__
        raise InputError(f"method {method!r} takes a {expected}, got a {found}")
    return chosen.run(problem, settings, seed)
