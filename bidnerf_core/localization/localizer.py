"""``Localizer``: prepares a map once, and is then called with frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.depth.sensors import DepthSensorModel, find_depth_sensor
from bidnerf_core.devices import constant
from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import device_of
from bidnerf_core.fields.observations import Observations
from bidnerf_core.fields.rendering import render
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.geometry.se3 import SE3, pose_from_matrix
from bidnerf_core.io.json import LARGEST_INTEGER
from bidnerf_core.localization.direction_only import NO_DISTANCES, direction_only
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.methods import USUAL_METHOD, Method, find_method, require_use_of_depth
from bidnerf_core.localization.problem import Problem, SceneMap, landmark_cameras, on_device, rig, unit_of
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.settings import ByColourConfig

WARM_UP_RAYS = 64

Start = SE3 | Float[Tensor, "4 4"] | np.ndarray | Sequence[Sequence[float]]
"""A pose T_world_camera: an ``SE3``, or a 4x4 matrix of any kind, by rows."""


class Localizer:
    """Finds the poses of frames in one map, by one method.

    The map, the method and its settings are checked once, when the localizer is made. It keeps no state between calls, so
    threads may share it; the same seed gives the same answer on the same machine.
    """

    def __init__(
        self,
        map: SceneMap,
        method: str = USUAL_METHOD,
        config: Any = None,
        device: torch.device | str | None = None,
        warm_up: bool = True,
        preset: str | None = None,
    ) -> None:
        """Prepare ``map`` for ``method``.

        ``config``: an instance of the method's settings (``METHODS[method].config_type``), by default with its defaults.
        ``preset``: the name of other settings (``METHODS[method].presets``), in place of ``config``.
        ``device``: where the field, the surface and the landmarks lie, by default where they are; the parts of a map that lie
        elsewhere are copied. ``warm_up``: do now what the first call would otherwise have to wait for. Raises ``InputError``
        for what does not fit.
        """
        map = checked_map(map, "Localizer")
        self.method = method
        self.map: SceneMap = map if device is None else on_device(map, device)
        self._method = find_method(method)
        self.config = _checked_config(self._method, method, config, preset)
        landmarks = self.map.landmarks if self._method.uses_landmarks else None
        self.matcher = None if landmarks is None else LandmarkMatcher(landmarks)
        if warm_up:
            self._warm_up()

    def __call__(
        self,
        query: Frame | View | Sequence[View],
        start: Start | None = None,
        depth_rays: Observations | None = None,
        seed: int = 0,
    ) -> Localization:
        """Find T_world_camera of a frame, or of the last of several views.

        ``query``: a frame, or views with known relative poses (``T_ref_camera`` in any common frame): a rig, or a window of
        a sequence. ``start``: a guess at T_world_camera of the last view, which some methods do without.
        ``depth_rays``: distances that another sensor measured, such as a lidar, in the frame of the last camera; methods
        that use colour alone refuse them. Raises ``InputError`` for a query that cannot be localized at all; a pose that is
        merely doubtful is returned, with an ``outcome`` other than ``CONVERGED``.
        """
        if depth_rays is not None:
            require_use_of_depth(self.method)
        return self.solved(self.problem(query, start, depth_rays), seed)

    def problem(
        self,
        query: Frame | View | Sequence[View],
        start: Start | None = None,
        depth_rays: Observations | None = None,
    ) -> Problem:
        """Return what ``__call__`` solves, which may be solved several times: the images' keypoints are found once."""
        T_world_camera = None if start is None else start_pose(start)
        return rig(self.map, _views(query), T_world_camera, depth_rays, self.matcher)

    def solved(self, problem: Problem, seed: int = 0) -> Localization:
        """Return the answer to a ``problem`` that this localizer made."""
        found = self._method.solve(problem, self.config, _checked_seed(seed))
        if not isinstance(found, Localization):
            raise InputError(
                f"method {self.method!r} returned a {type(found).__name__}, expected a Localization"
            )
        found = replace(found, unit=unit_of(self.map))
        return found if self.map.has_distances else direction_only(found)

    @property
    def depth_sensor(self) -> DepthSensorModel:
        """The noise model of the depth sensor; the generic one if the method has no such setting."""
        return find_depth_sensor(self.depth_sensor_name)

    @property
    def depth_sensor_name(self) -> str:
        """The name of the sensor that measures depth, as the settings say."""
        return self._method.depth_sensor(self.config)

    @property
    def risk(self) -> float | None:
        """The tolerated share of wrong answers among the accepted ones; None: answers are accepted as usual."""
        return self._method.risk(self.config)

    @property
    def by_colour(self) -> ByColourConfig:
        """The settings of refinement by colour alone; methods without such settings have the usual ones."""
        return self._method.by_colour(self.config)

    @property
    def rays(self) -> int:
        """The number of rays that may be rendered to tell explanations of an image apart; 0 where nothing is rendered."""
        return self._method.rays(self.config)

    @property
    def assumed_cameras(self) -> tuple[Intrinsics, ...]:
        """The cameras that photos without a focal length may have, which takes landmarks: those of the map's images."""
        return landmark_cameras(self.map) if self.matches_landmarks else ()

    @property
    def matches_landmarks(self) -> bool:
        """Whether the map has landmarks and the method matches them, with its settings."""
        return self.matcher is not None and self._method.matches_landmarks(self.config)

    @torch.no_grad()
    def _warm_up(self) -> None:
        """Render some rays and fill the caches of the surface, so that lazy initialisation does not delay the first call."""
        bounds, field = self.map.bounds, self.map.field
        directions = torch.nn.functional.normalize(
            torch.randn((WARM_UP_RAYS, 3), generator=torch.Generator().manual_seed(0)), dim=-1
        ).to(device_of(field))
        middle = constant(bounds.centre, directions)
        render(field, bounds.rays(middle - directions * bounds.near, directions), bounds.background)
        if self.map.surface is not None:
            self.map.surface.warm_up()


def map_with_distances(localizer: Localizer) -> SceneMap:
    """Return the localizer's map. Raises ``InputError`` where it was made from one place: nothing has a position in it."""
    if not localizer.map.has_distances:
        raise InputError(
            f"tracking needs positions, but {NO_DISTANCES}; expected a map of photos from several places"
        )
    return localizer.map


def checked_map(given: object, where: str) -> SceneMap:
    """Return a map. Raises ``InputError``, which begins with ``where``, for anything else, such as its folder."""
    if isinstance(given, SceneMap):
        return given
    is_path = isinstance(given, str | bytes) or hasattr(given, "__fspath__")
    hint = "; load_map(folder) gives one" if is_path else ""
    raise InputError(f"{where}: got a {type(given).__name__}, expected a Map{hint}")


def _checked_config(method: Method, name: str, config: Any, preset: str | None) -> Any:
    if config is None:
        return method.settings(preset)
    if preset is not None:
        raise InputError(
            f"preset {preset!r} and a config are given; expected one, or settings_of({name!r}, ..., preset={preset!r})"
        )
    if not isinstance(config, method.config_type):
        expected, found = method.config_type.__name__, type(config).__name__
        hint = f"; settings_of({name!r}, ...) makes one of it" if isinstance(config, dict) else ""
        raise InputError(f"method {name!r} takes a {expected}, got a {found}{hint}")
    return config


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= int(seed) <= LARGEST_INTEGER:
        raise InputError(f"seed is {seed!r}, expected a whole number from 0 to 2**63 - 1")
    return int(seed)


def _views(query: Frame | View | Sequence[View]) -> Sequence[View]:
    if isinstance(query, Frame):
        return [View(query, SE3.identity())]
    if isinstance(query, View):
        return [query]
    if isinstance(query, Sequence) and all(isinstance(item, View) for item in query):
        return query
    items: list[Any] = list(query) if isinstance(query, Sequence) else []
    if len(items) == 1 and isinstance(items[0], Frame):
        return [View(items[0], SE3.identity())]
    if any(isinstance(item, Frame) for item in items):
        raise InputError(
            f"{len(query)} frames without relative poses, expected views: View(frame, T_ref_camera)"
        )
    raise InputError(
        f"query is a {type(query).__name__}, expected a Frame (Frame.open reads a file, Frame.from_numpy takes an"
        " array), a View, or a list of views"
    )


def start_pose(start: Start, what: str = "start") -> SE3:
    """Return a pose given in any form as a rigid transform; float64.

    Raises ``InputError``, which begins with ``what``, for anything that is not one pose.
    """
    if isinstance(start, SE3):
        found, count = start.translation.shape, start.translation.numel() // 3
        if len(found) > 1 and found[-1] == 3:
            raise InputError(f"{what} holds {count} poses, expected one")
        if found != (3,) or start.rotation.shape != (3, 3):
            shapes = f"{tuple(start.rotation.shape)} and {tuple(found)}"
            raise InputError(
                f"{what} has a rotation and a translation of shapes {shapes}, expected (3, 3) and (3)"
            )
        return SE3(start.rotation.detach(), start.translation.detach()).to("cpu", torch.float64)
    if isinstance(start, torch.Tensor):
        start = start.detach().cpu()
    try:
        matrix = torch.as_tensor(np.asarray(start, dtype=np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} is a {type(start).__name__}, expected an SE3 or a 4x4 matrix") from error
    return pose_from_matrix(matrix, what)
