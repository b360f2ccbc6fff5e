"""bidnerf: the 6-DoF pose of RGB-D images against a radiance field, whatever field that is."""

from __future__ import annotations

import os
from importlib.metadata import entry_points

# Threads of OpenMP that wait should sleep. On cores that other work shares, spinning was measured to make training
# more than ten times slower. It must be said before torch is loaded, and a user's own setting goes first.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# torch and typeguard (of the command line's parser) look for plugins among all entry points as they are imported: one
# malformed file of any package would fail that. Where there is one, they do without.
try:
    entry_points(group="bidnerf.backends")
except Exception:
    os.environ.setdefault("TORCH_DEVICE_BACKEND_AUTOLOAD", "0")
    os.environ.setdefault("TYPEGUARD_DISABLE_PLUGIN_AUTOLOAD", "1")

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.field import FieldValues, RadianceField, Rays, RaySampler, RaySamples, SceneBounds, levels
from bidnerf_core.frames import Frame, View
from bidnerf_core.localization import Localization, Localizer, Outcome
from bidnerf_core.observations import Observations
from bidnerf_core.registry import list_backends, load_backend
from bidnerf_core.rendering import render, render_image
from bidnerf_core.se3 import SE3
from bidnerf_core.storage import Map, load_map

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
    "View",
    "levels",
    "list_backends",
    "load_backend",
    "load_map",
    "render",
    "render_image",
]
