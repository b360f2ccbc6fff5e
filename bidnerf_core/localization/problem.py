"""The localization problem: images with known relative poses, a map, and prior knowledge of the pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth import UNKNOWN, DepthSensorModel
from bidnerf_core.errors import InputError
from bidnerf_core.fields import Observations, RadianceField, SceneBounds, device_of
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.matching import LandmarkMatcher
from bidnerf_core.mapping import LandmarkMap, SurfaceMap


@runtime_checkable
class SceneMap(Protocol):
    """The parts of a map that localization uses, some of which may be absent; ``bidnerf.Map`` implements this protocol."""

    @property
    def field(self) -> RadianceField: ...

    @property
    def bounds(self) -> SceneBounds: ...

    @property
    def surface(self) -> SurfaceMap | None:
        """The baked surface; None if the map has no surface."""
        ...

    @property
    def landmarks(self) -> LandmarkMap | None:
        """The landmarks; None if the map has no landmarks."""
        ...

    @property
    def colour_noise(self) -> float | None:
        """Root mean square difference between the field's colours and its training images; None if unknown."""
        ...

    @property
    def has_distances(self) -> bool:
        """Whether the map's images determine distances; images from one place do not."""
        ...


def extent_of(scene: SceneMap | Problem) -> float:
    """Return the size (metres) of what a map shows: of its surface or, without one, of its box."""
    return math.dist(scene.bounds.lower, scene.bounds.upper) if scene.surface is None else scene.surface.extent


def start_covariance(extent: float) -> Float[Tensor, "6 6"]:
    """Return the covariance of a start of unknown uncertainty: errors of 3 % of the scene's ``extent`` (metres), and of 0.1 radians."""
    return torch.tensor([0.03 * extent] * 3 + [0.1] * 3, dtype=torch.float64).square().diag()


@dataclass(frozen=True, eq=False)
class Problem:
    """K images with known relative poses in a map; the unknown is the pose of the last image's camera.

    ``views[i].T_ref_camera`` is T_K_i, the pose of camera i in the frame of the last camera K, so the last pose is the identity.
    """

    field: RadianceField
    bounds: SceneBounds
    views: tuple[View, ...]
    start: SE3 | None  # guess at T_world_K; None if there is none
    depth_rays: Observations | None  # from a lidar or similar, in the frame of the last camera
    surface: SurfaceMap | None  # baked from the field
    # Matcher of the map's landmarks, with a cache of the images' keypoints, see ``for_query``
    matcher: LandmarkMatcher | None
    # Root mean square difference between the field's colours and its training images; None if unknown.
    colour_noise: float | None
    sensor: DepthSensorModel  # model of the sensor that measured the depth

    @property
    def has_depth(self) -> bool:
        return self.depth_rays is not None or any(view.frame.has_depth for view in self.views)

    @property
    def focal_is_approximate(self) -> bool:
        """Whether the focal length of a view's camera was only assumed or read from EXIF."""
        return any(view.frame.focal_is_approximate for view in self.views)

    @property
    def device(self) -> torch.device:
        """The field's device, to which rays are moved."""
        return device_of(self.field)

    def without_depth(self) -> Problem:
        """Return the problem without measured depth."""
        views = tuple(replace(view, frame=view.frame.replace(depth=None)) for view in self.views)
        return replace(self, views=views, depth_rays=None)


def rig(
    scene: SceneMap,
    views: Sequence[View],
    start: SE3 | None,
    depth_rays: Observations | None = None,
    matcher: LandmarkMatcher | None = None,
) -> Problem:
    """Return the problem of localizing ``views`` with known poses in any common frame.

    ``start`` and ``depth_rays`` belong to the last view. Raises ``InputError`` if there are no views, or if a pose is not rigid.
    """
    if not views:
        raise InputError("nothing to localize:", expected="at least one view")
    T_last_ref = views[-1].T_ref_camera.to("cpu", torch.float64).inverse()
    relative = tuple(View(v.frame, (T_last_ref @ v.T_ref_camera.to("cpu", torch.float64)).normalized()) for v in views)
    known = [] if start is None else [("start", start)]
    for what, pose in (*known, *((view.frame.name, view.T_ref_camera) for view in relative)):
        if not bool(pose.is_rigid().all()):
            raise InputError(f"pose of {what} is not a rigid transform: {pose.matrix().tolist()}")
    return Problem(
        scene.field,
        scene.bounds,
        relative,
        None if start is None else start.to("cpu", torch.float64),
        depth_rays,
        scene.surface,
        None if matcher is None else matcher.for_query(),
        scene.colour_noise,
        UNKNOWN,
    )
