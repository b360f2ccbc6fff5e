"""``Method``, by which plugins register their own localization methods, and the methods by name."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bidnerf_core.depth import UNKNOWN_SENSOR
from bidnerf_core.errors import InputError
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.settings import ByColourConfig
from bidnerf_core.registry import PluginError, Plugins, interface_defects
from bidnerf_core.settings import from_flat


@dataclass(frozen=True)
class SharedSettings:
    """Settings of a method that trackers, collections of maps and the command line take into account as well."""

    matches_landmarks: bool = True  # whether images are matched with the map's landmarks
    depth_sensor: str = UNKNOWN_SENSOR  # name of the sensor that measured the depth
    by_colour: ByColourConfig = ByColourConfig()  # how a tracker refines poses by colour alone
    rays: int = 0  # number of rays that may be rendered to compare explanations of an image
    risk: float | None = None  # tolerated fraction of wrong answers among the accepted ones


@dataclass(frozen=True)
class Method:
    """A localization method: how it finds poses, its settings, what it needs and what it offers."""

    solve: Callable[[Problem, Any, int], Localization]
    """Solves a problem with settings of ``config_type``; all random choices are drawn from the seed."""
    config_type: type  # a frozen dataclass of settings, with a default for every field
    needs_start: bool  # whether it needs a guess at the pose
    uses_depth: bool = True  # whether it uses measured depth
    presets: Mapping[str, Any] = field(default_factory=dict)  # alternatives to the default settings, by name
    uses_landmarks: bool = False  # whether the map's landmarks are prepared for it, as ``Problem.matcher``
    # returns those of its settings that matter elsewhere too
    shared: Callable[[Any], SharedSettings] = lambda config: SharedSettings()
    summary: str = field(kw_only=True)  # one line

    def settings(self, preset: str | None = None) -> Any:
        """Return the default settings or those of a preset. Raises ``InputError`` for an unknown preset."""
        if preset is None:
            return self.config_type()
        if preset not in self.presets:
            offered = ", ".join(self.presets) or "none"
            raise InputError(f"preset {preset!r} is unknown, this method offers {offered}")
        return self.presets[preset]


def _defects(method: Any) -> Iterator[str]:
    if not isinstance(method, Method):
        yield f"it is a {type(method).__name__}, expected a bidnerf_core.localization.Method"
        return
    yield from interface_defects(method, ("summary", "config_type"), {"solve": ("problem", "config", "seed")})


METHODS: Plugins[Method] = Plugins("methods", _defects, first=("auto", "bid", "inerf", "bid-lm", "inerf-lm"))
"""The methods by name."""
USUAL_METHOD = "auto"
"""The name of the default method."""

RENAMED = {"play": "surface_sigma"}
"""Current names of renamed settings, by the names under which earlier versions stored them."""


def find_method(name: str) -> Method:
    """Return a method by name. Raises ``PluginError`` (an ``InputError``) for an unknown name or a broken plugin."""
    return METHODS.load(name)


def require_use_of_depth(method: str) -> None:
    """Raise ``InputError`` for a method that would ignore explicitly given depth points."""
    if not find_method(method).uses_depth:
        others = _names_of(lambda other: other.uses_depth)
        raise InputError(f"method {method!r} uses colour alone, got depth points; use method {others}")


def require_start(method: str, given: bool) -> None:
    """Raise ``InputError`` for a method that needs a start if none is given."""
    if find_method(method).needs_start and not given:
        others = _names_of(lambda other: not other.needs_start)
        raise InputError(f"method {method!r} needs a start; give one by --start, or use method {others}")


def _names_of(wanted: Callable[[Method], bool]) -> str:
    """Return the names of the methods with a property, except those that cannot be loaded."""
    found = []
    for name in METHODS:
        with contextlib.suppress(PluginError):
            found += [name] if wanted(METHODS[name]) else []
    return " or ".join(map(repr, found)) or "(none has that)"


def matches_landmarks(method: str, config: Any) -> bool:
    """Return whether a method, with these settings, matches images with a map's landmarks."""
    chosen = find_method(method)
    return chosen.uses_landmarks and chosen.shared(config).matches_landmarks


def settings_of(method: str, values: dict[str, Any], where: str = "config", preset: str | None = None) -> Any:
    """Return a method's settings; ``values`` are those that differ from its defaults or a preset, by their flat names.

    Raises ``InputError``, prefixed with ``where``, for an unknown method or name, or a value that is not allowed.
    """
    return from_flat(find_method(method).settings(preset), values, where, RENAMED)
