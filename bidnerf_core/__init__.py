"""bidnerf: the 6-DoF pose of RGB-D images against a radiance field, whatever field that is."""

from __future__ import annotations

import importlib
import os
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

# OpenMP threads that wait should sleep. On cores shared with other work, spinning made training more than ten times
# slower in measurements. It has to be set before torch is loaded; a user's own setting is kept.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# When they are imported, torch and typeguard (which the command line's parser uses) look for plugins among all entry
# points, and fail if any package has a malformed file. Where there is such a file, they are imported without plugins.
try:
    entry_points(group="bidnerf.backends")
except Exception:
    os.environ.setdefault("TORCH_DEVICE_BACKEND_AUTOLOAD", "0")
    os.environ.setdefault("TYPEGUARD_DISABLE_PLUGIN_AUTOLOAD", "1")

if TYPE_CHECKING:
    from bidnerf_core.camera.intrinsics import Intrinsics
    from bidnerf_core.errors import InputError, InputWarning
    from bidnerf_core.fields.contract import (
        FieldValues,
        RadianceField,
        Rays,
        RaySampler,
        RaySamples,
        SceneBounds,
        levels,
    )
    from bidnerf_core.fields.observations import Observations
    from bidnerf_core.fields.rendering import render, render_image
    from bidnerf_core.frames.frame import Frame, View
    from bidnerf_core.geometry.se3 import SE3
    from bidnerf_core.localization import Localization, Localizer, Outcome, Tracker, TrackerConfig
    from bidnerf_core.maps.storage import Map, load_map
    from bidnerf_core.registry import list_backends, load_backend

HOMES = {
    "camera.intrinsics": ("Intrinsics",),
    "errors": ("InputError", "InputWarning"),
    "fields.contract": (
        "FieldValues",
        "RadianceField",
        "RaySampler",
        "RaySamples",
        "Rays",
        "SceneBounds",
        "levels",
    ),
    "frames.frame": ("Frame", "View"),
    "localization": ("Localization", "Localizer", "Outcome", "Tracker", "TrackerConfig"),
    "fields.observations": ("Observations",),
    "registry": ("list_backends", "load_backend"),
    "fields.rendering": ("render", "render_image"),
    "geometry.se3": ("SE3",),
    "maps.storage": ("Map", "load_map"),
}
"""The modules that define the public names. They are imported when a name is first used (PEP 562): importing torch takes
seconds, and ``bidnerf --help`` does not need it."""

__all__ = [
    "SE3",
    "FieldValues",
    "Frame",
    "InputError",
    "InputWarning",
    "Intrinsics",
    "Localization",
    "Localizer",
    "Map",
    "Observations",
    "Outcome",
    "RadianceField",
    "RaySampler",
    "RaySamples",
    "Rays",
    "SceneBounds",
    "Tracker",
    "TrackerConfig",
    "View",
    "levels",
    "list_backends",
    "load_backend",
    "load_map",
    "render",
    "render_image",
]


def __getattr__(name: str) -> Any:
    for module, names in HOMES.items():
        if name in names:
            found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{module}"), name)
            return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
