"""What tests of localization share: maps of any field, problems of one image, and methods by name with flat settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bidnerf_core.fields import Observations, RadianceField, SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Localization, Problem, find_method, rig, settings_of
from bidnerf_core.mapping import LandmarkMap, SurfaceMap


@dataclass(frozen=True, eq=False)
class FieldMap:
    """A field as a map."""

    field: RadianceField
    bounds: SceneBounds
    surface: SurfaceMap | None = None
    landmarks: LandmarkMap | None = None
    colour_noise: float | None = None
    has_distances: bool = True


def single(
    field: RadianceField,
    bounds: SceneBounds,
    frame: Frame,
    start: SE3 | None,
    depth_rays: Observations | None = None,
    surface: SurfaceMap | None = None,
) -> Problem:
    """Return the problem of one image."""
    return rig(FieldMap(field, bounds, surface), [View(frame, SE3.identity())], start, depth_rays)


def localize(problem: Problem, method: str, config: Any = None, seed: int = 0) -> Localization:
    """Solve a problem by a method. ``config``: its settings, or some of them by flat name."""
    if config is None or isinstance(config, dict):
        config = settings_of(method, config or {})
    return find_method(method).solve(problem, config, seed)
