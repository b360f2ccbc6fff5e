"""``Method``, which a plugin provides to register a localization method, and the registry of methods."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.registry import USUAL_METHOD as USUAL_METHOD
from bidnerf_core.registry import PluginError, Plugins, interface_defects
from bidnerf_core.settings import from_flat


@dataclass(frozen=True)
class Method:
    """A localization method: its solver, its settings, its inputs and its presets.

    If its settings have the names of those of ``auto``, trackers and collections of maps use them as well: ``landmarks``, whether images are
    matched with landmarks; ``depth_sensor``; ``fused_rays``, a number of rays; and ``risk``.
    """

    solve: Callable[[Problem, Any, int], Localization]
    """Solves a problem with settings of ``config_type``; all random choices are drawn from the seed."""
    config_type: type  # a frozen dataclass of settings, with a default for every field
    needs_start: bool  # whether it needs a guess at the pose
    uses_depth: bool = True  # whether it uses measured depth
    presets: Mapping[str, Any] = field(default_factory=dict)  # alternatives to the default settings, by name
    uses_landmarks: bool = False  # whether the map's landmarks are prepared for it, as ``Problem.matcher``
    _: KW_ONLY
    summary: str  # one line

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


METHODS: Plugins[Method] = Plugins("methods", _defects, first=("auto", "bid", "inerf"))
"""The localization methods by name, those of plugins included."""


def find_method(name: str) -> Method:
    """Return a method by name. Raises ``PluginError`` (an ``InputError``) for an unknown name or a broken plugin."""
    return METHODS.load(name)


def require_fit(method: str, fits: Callable[[Method], bool], problem: str) -> None:
    """Raise ``InputError`` with the ``problem`` unless a method ``fits``; the message names the methods that do and can be loaded."""
    if fits(find_method(method)):
        return
    others = []
    for name in METHODS:
        with contextlib.suppress(PluginError):
            others += [repr(name)] if fits(METHODS[name]) else []
    raise InputError(f"method {method!r} {problem} {' or '.join(others) or '(none has that)'}")


def matches_landmarks(method: str, config: Any) -> bool:
    """Return whether a method, with these settings, matches images with a map's landmarks."""
    return find_method(method).uses_landmarks and getattr(config, "landmarks", True)


def settings_of(method: str, values: dict[str, Any], where: str = "config", preset: str | None = None) -> Any:
    """Return a method's settings; ``values`` are the settings, by flat name, that differ from its defaults or a preset.

    Raises ``InputError``, prefixed with ``where``, for an unknown method or name, or a value that is not allowed.
    """
    return from_flat(find_method(method).settings(preset), values, where)
