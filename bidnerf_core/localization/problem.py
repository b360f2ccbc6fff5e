"""What is to be localized."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.field import RadianceField, SceneBounds, levels
from bidnerf_core.frames import Frame, View
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.observations import Observations
from bidnerf_core.se3 import SE3

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Problem:
    """K images with known relative poses in a map; the pose sought is that of the last one's camera.

    ``views[i].T_ref_camera`` is T_K_i, camera i in the frame of the last camera K, so the last view's is the identity.
    """

    field: RadianceField
    bounds: SceneBounds
    views: tuple[View, ...]
    start: SE3 | None  # T_world_K; none where nothing is known of it
    depth_rays: Observations | None = None  # of a lidar or the like, in the frame of the last camera
    surface: SurfaceMap | None = None  # baked from the field; on the CPU, wherever the field is

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("nothing to localize: expected at least one view")
        known = [] if self.start is None else [("start", self.start)]
        for what, pose in (*known, *((v.frame.name, v.T_ref_camera) for v in self.views)):
            if not bool(pose.is_rigid().all()):
                raise InputError(f"pose of {what} is not a rigid transform: {pose.matrix().tolist()}")

    def start_for(self, method: str) -> SE3:
        """The start, for a method that cannot do without one."""
        if self.start is None:
            raise InputError(f"method {method!r} needs a start; give one, or take method 'auto'")
        return self.start

    @property
    def has_depth(self) -> bool:
        return self.depth_rays is not None or any(view.frame.has_depth for view in self.views)

    @property
    def device(self) -> torch.device:
        """Where the field computes; rays are brought there."""
        for kind in ("parameters", "buffers"):
            first = next(iter(getattr(self.field, kind, tuple)()), None)
            if isinstance(first, torch.Tensor):
                return first.device
        return torch.device("cpu")

    def level(self, number: int | None) -> RadianceField:
        """A level of the field, counted from the coarsest, negative from the finest; ``None`` is the field itself."""
        if number is None:
            return self.field
        offered = levels(self.field)
        if not -len(offered) <= number < len(offered):
            raise InputError(f"level is {number}, expected 0 (coarsest) to {len(offered) - 1}")
        return offered[number]


def single(
    field: RadianceField,
    bounds: SceneBounds,
    frame: Frame,
    start: SE3 | None,
    depth_rays: Observations | None = None,
    surface: SurfaceMap | None = None,
) -> Problem:
    """One image, and what else was measured from there."""
    return Problem(field, bounds, (View(frame, SE3.identity()),), _exact(start), depth_rays, surface)


def rig(
    field: RadianceField,
    bounds: SceneBounds,
    views: Sequence[View],
    start: SE3 | None,
    depth_rays: Observations | None = None,
    surface: SurfaceMap | None = None,
) -> Problem:
    """Views whose poses are known in any common frame; ``start`` is for the last of them, as are ``depth_rays``."""
    if not views:
        raise InputError("nothing to localize: expected at least one view")
    T_last_ref = views[-1].T_ref_camera.to("cpu", torch.float64).inverse()
    relative = tuple(
        View(v.frame, (T_last_ref @ v.T_ref_camera.to("cpu", torch.float64)).normalized()) for v in views
    )
    return Problem(field, bounds, relative, _exact(start), depth_rays, surface)


def _exact(pose: SE3 | None) -> SE3 | None:
    return None if pose is None else pose.to("cpu", torch.float64)


def window(sequence: Sequence[Item], last: int, size: int, stride: int = 1) -> tuple[Item, ...]:
    """Item ``last`` and those before it, ``size`` of them, ``stride`` apart; fewer where the sequence begins.

    Of views in the order of time, it is what ``rig`` takes for a moving window. Raises ``InputError`` where there is no
    such item.
    """
    if size < 1 or stride < 1:
        raise InputError(f"a window of {size} with stride {stride}, expected 1 or more of both")
    if not 0 <= last < len(sequence):
        raise InputError(f"a window up to item {last} of {len(sequence)}")
    return tuple(sequence[i] for i in range(last, -1, -stride)[:size][::-1])
