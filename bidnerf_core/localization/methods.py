"""The table of methods, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.localization.auto import auto
from bidnerf_core.localization.auto_config import AutoConfig
from bidnerf_core.localization.bid import BID_PRESETS, BidConfig, bid
from bidnerf_core.localization.bid_lm import BidLmConfig, bid_lm
from bidnerf_core.localization.inerf import INERF_PRESETS, InerfConfig, inerf
from bidnerf_core.localization.inerf_lm import InerfLmConfig, inerf_lm
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.settings import from_flat


@dataclass(frozen=True)
class Method:
    """A localization method: its function and the frozen dataclass of its settings.

    ``needs_start``: whether it needs a guess at the pose. ``uses_depth``: whether it uses measured depth. ``presets``: other
    settings than the defaults, by name.
    """

    run: Callable[[Problem, Any, int], Localization]
    config_type: type
    summary: str
    needs_start: bool
    uses_depth: bool = True
    presets: Mapping[str, Any] = field(default_factory=dict)

    def settings(self, preset: str | None = None) -> Any:
        """Return the default settings or those of a preset. Raises ``InputError`` for an unknown one."""
        if preset is None:
            return self.config_type()
        if preset not in self.presets:
            offered = ", ".join(self.presets) or "none"
            others = "" if self.presets else "; 'bid' and 'inerf' have presets"
            raise InputError(f"preset {preset!r} is unknown, this method offers {offered}{others}")
        return self.presets[preset]


METHODS = {
    "auto": Method(
        auto,
        AutoConfig,
        "landmarks, then search on the baked surface by depth or colour; no start needed",
        False,
    ),
    "bid": Method(
        bid, BidConfig, "Adam on colour and depth at the coarse level (BID-NeRF)", True, presets=BID_PRESETS
    ),
    "inerf": Method(
        inerf,
        InerfConfig,
        "Adam on the colours of one image in full detail (iNeRF)",
        True,
        False,
        INERF_PRESETS,
    ),
    "bid-lm": Method(
        bid_lm, BidLmConfig, "second-order steps on colour and depth, from coarse to fine", True
    ),
    "inerf-lm": Method(
        inerf_lm, InerfLmConfig, "second-order steps on colour alone, from coarse to fine", True, False
    ),
}

RENAMED = {"play": "surface_sigma"}
"""Current names of renamed settings, by the names under which earlier versions stored them."""


def find_method(name: str) -> Method:
    """Return a method by name. Raises ``InputError`` for an unknown one."""
    chosen = METHODS.get(name)
    if chosen is None:
        raise InputError(f"method {name!r} is unknown, expected one of {', '.join(sorted(METHODS))}")
    return chosen


def require_use_of_depth(method: str) -> None:
    """Raise ``InputError`` for a method that would ignore depth points, which were given on purpose."""
    if not find_method(method).uses_depth:
        others = " or ".join(name for name, other in METHODS.items() if other.uses_depth)
        raise InputError(f"method {method!r} uses colour alone, got depth points; take method {others}")


def settings_of(method: str, values: dict[str, Any], where: str = "config", preset: str | None = None) -> Any:
    """Return a method's settings; ``values`` are those that differ from its defaults or from a preset, by their flat names.

    Raises ``InputError``, which begins with ``where``, for an unknown method or name, or a value that is not allowed.
    """
    return from_flat(find_method(method).settings(preset), values, where, RENAMED)
