"""Estimation of a scene's box and its near and far distances, from depth, silhouettes, landmarks or the cameras alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.carving.boxes import MARGIN, AxisBox, corner, grown, rays_of
from bidnerf_core.carving.hull import carved_box, has_outline
from bidnerf_core.carving.pixel_footprint import (
    distance_of_middle,
    landmark_distance,
    measured_distance,
    pixel_footprint,
)
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import View

OUTLIERS = 1e-3  # fraction of the measured points, at either end of each axis, that may be wrong
POINTS, POINTS_OF_VIEW = 400_000, 500  # measurements to use: in all, and at least from each view
SPARSE_MARGIN = 0.1  # of the box's size, at each end, where only a few points were measured
FAR_MARGIN = 1.1  # a camera may be slightly farther away than any of the views
LEAST_NEAR = 0.01  # of far, where cameras are inside the box and nothing was measured
LEAST_SPREAD = 0.01  # mean squared sine of the angles between optical axes and their mean: about 6 degrees
INWARD = 0.8  # fraction of the cameras that must see the point they all look at
FAR_BEYOND = 2.0  # times the largest known distance, where there is matter beyond the box
LEAST_LANDMARKS = 50  # sightings of landmarks in all views, for a box around them
LANDMARKS_BEYOND = 0.05  # fraction of the landmarks, at either end of each axis, that may lie beyond the box
LANDMARKS_NEARER = 0.01  # fraction of the landmarks that is ignored in finding the nearest one
ROOM = 4.0  # assumed range of a hand-held camera's view, in multiples of the extent of its positions

ONE_PLACE = 1.0  # extent (scene units) assumed if all positions coincide


def estimate_bounds(
    views: Sequence[View], background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> SceneBounds:
    """Estimate the box of the scene that ``views`` (poses in the world) show, its range of distances from
    their cameras, and how finely they resolve it.

    With depth (dense in half of the views, or any if there are no silhouettes) the box holds the middle 99.8
    % of the measured points along each axis. With silhouettes (alpha) it is the box of the visual hull. With
    colour only, it holds the middle 90 % of the landmarks that the views see. Without landmarks it is a
    guess: for cameras that look inward, a cube around the point they look at, as large as the visible region
    there; otherwise (a room), the box of the cameras and of everything they see within ``ROOM`` times the
    extent of their positions. Unless half of the views have dense depth or silhouettes, there may be matter
    beyond the box, and the scene is contracted. Images from exactly one place do not determine a scale; the
    extent of their positions is then taken to be ``ONE_PLACE``. The footprint of a pixel refers to the median
    distance of the data that gave the box: measured depth, landmarks, or else the box's middle, for which at
    least half the longest side is assumed. Raises ``InputError`` if there are no views.
    """
    if not views:
        raise InputError("no views to estimate them from", where="scene bounds")
    measured = [view for view in views if view.frame.has_depth]
    dense = [view for view in measured if view.frame.has_dense_depth]
    outlined = [view for view in views if has_outline(view)]
    if measured and (2 * len(dense) >= len(views) or not outlined):
        box, near = _measured_box(measured, MARGIN if dense else SPARSE_MARGIN)
        footprint = pixel_footprint(measured, measured_distance)
        return _with_far(views, box, near, background, 2 * len(dense) < len(views), footprint)
    if 2 * len(outlined) < len(views) and sum(_landmarks_of(view) for view in views) >= LEAST_LANDMARKS:
        return _around_landmarks([view for view in views if _landmarks_of(view)], background)
    box = _guessed_box(views)
    if 2 * len(outlined) >= len(views):
        box = carved_box(box, outlined)
    least = LEAST_NEAR * _farthest(views, box)
    near = max(_nearest(views, box) / 2, least)
    footprint = pixel_footprint(views, partial(distance_of_middle, box=box))
    return _with_far(views, box, near, background, 2 * len(outlined) < len(views), footprint)


def _with_far(
    views: Sequence[View], box: AxisBox, near: float, background: tuple[float, float, float], contracted: bool,
    footprint: float,
) -> SceneBounds:  # fmt: skip
    """Return bounds that reach to the box's farthest corner or, if the scene is contracted, well beyond it."""
    far = _farthest(views, box) * (FAR_BEYOND if contracted else FAR_MARGIN)
    return SceneBounds(corner(box[0]), corner(box[1]), near, far, background, contracted, footprint)


def _around_landmarks(views: Sequence[View], background: tuple[float, float, float]) -> SceneBounds:
    """Return the bounds of a scene from the landmarks that the views see."""
    points = torch.cat([_landmark_points(view) for view in views]).sort(dim=0).values
    distances = (
        torch.cat([view.landmarks.distance for view in views if view.landmarks is not None]).sort().values
    )
    last, cut = len(points) - 1, round(LANDMARKS_BEYOND * (len(points) - 1))
    box = grown(points[cut], points[last - cut], distances[0].item() / 100)
    near = distances[round(LANDMARKS_NEARER * last)].item() / 2
    far = max(distances[round((1 - OUTLIERS) * last)].item(), _farthest(views, box)) * FAR_BEYOND
    footprint = pixel_footprint(views, landmark_distance)
    return SceneBounds(corner(box[0]), corner(box[1]), near, far, background, True, footprint)


def _landmarks_of(view: View) -> int:
    return 0 if view.landmarks is None else len(view.landmarks.distance)


def _landmark_points(view: View) -> Float[Tensor, "n 3"]:
    """Return the landmarks that a view sees (metres, world)."""
    seen = view.landmarks
    if seen is None:
        return torch.zeros(0, 3, dtype=torch.float64)
    ray = view.frame.intrinsics.unproject(seen.pixels.double())
    points = ray * (seen.distance.double() / torch.linalg.vector_norm(ray, dim=-1))[:, None]
    return view.T_ref_camera.to(torch.float64).apply(points)


def _measured_box(views: Sequence[View], margin: float) -> tuple[AxisBox, float]:
    """Return the box of the measured points, and half the smallest distance from a camera to a point, both
    without outliers.
    """
    share = max(POINTS_OF_VIEW, POINTS // len(views))
    parts = [measured_points(view, share) for view in views]
    points, distances = torch.cat([p for p, _ in parts]), torch.cat([d for _, d in parts])
    last = len(points) - 1
    first = round(OUTLIERS * last)
    ordered, nearest = points.sort(dim=0).values, distances.sort().values[first].item()
    return grown(ordered[first], ordered[last - first], nearest / 100, margin), nearest / 2


def measured_points(view: View, share: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return about ``share`` of a view's measured points (metres, world) and their distances from the camera (metres)."""
    depth = view.frame.depth
    if depth is None:
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    ray, chosen = rays_of(view, depth > 0, share)
    points = ray * depth[chosen][:, None].double()
    return view.T_ref_camera.to(torch.float64).apply(points), torch.linalg.vector_norm(points, dim=-1)


def _guessed_box(views: Sequence[View]) -> AxisBox:
    """Return the box that the cameras alone suggest, see ``estimate_bounds``."""
    places = _places(views)
    if (middle := _looked_at(views)) is not None:
        half = (torch.linalg.vector_norm(places - middle, dim=-1) * _tangents(views)).amax()
        return middle - half, middle + half
    extent = (places.amax(dim=0) - places.amin(dim=0)).amax()
    reach = ROOM * (float(extent) or ONE_PLACE)
    ends = [view.T_ref_camera.to(torch.float64).apply(_corner_rays(view) * reach) for view in views]
    points = torch.cat([places, *ends])
    return points.amin(dim=0), points.amax(dim=0)


def _looked_at(views: Sequence[View]) -> Float[Tensor, "3"] | None:
    """Return the point nearest to all optical axes (least squares), if most cameras see it and from different sides."""
    places, tangents = _places(views), _tangents(views)
    axes = torch.stack([view.T_ref_camera.rotation[:, 2].double() for view in views])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(dim=0)
    if torch.linalg.eigvalsh(normal)[0] < LEAST_SPREAD:
        return None
    middle = torch.linalg.solve(normal, (across @ places[:, :, None]).mean(dim=0))[:, 0]
    ahead = ((middle - places) * axes).sum(dim=-1)
    off = torch.linalg.vector_norm(middle - places - ahead[:, None] * axes, dim=-1)
    return middle if (off < ahead * tangents).double().mean() >= INWARD else None


def _corner_rays(view: View) -> Float[Tensor, "4 3"]:
    """Return the points at z = 1 (camera frame) that the corners of the image show."""
    camera = view.frame.intrinsics
    corners = [[x, y] for x in (0, camera.width) for y in (0, camera.height)]
    return camera.unproject(torch.tensor(corners, dtype=torch.float64))


def _tangents(views: Sequence[View]) -> Float[Tensor, "v"]:
    """Return the tangent of the angle between each view's optical axis and the farthest corner of its image."""
    return torch.stack([torch.linalg.vector_norm(_corner_rays(view)[:, :2], dim=-1).amax() for view in views])


def _places(views: Sequence[View]) -> Float[Tensor, "v 3"]:
    return torch.stack([view.T_ref_camera.translation.double() for view in views])


def _nearest(views: Sequence[View], box: AxisBox) -> float:
    """Return the distance of the box from the nearest camera (metres); 0 if a camera is inside."""
    outside = torch.maximum(box[0] - _places(views), _places(views) - box[1]).clamp(min=0)
    return torch.linalg.vector_norm(outside, dim=-1).amin().item()


def _farthest(views: Sequence[View], box: AxisBox) -> float:
    """Return the largest distance of a corner of the box from a camera (metres)."""
    across = torch.maximum((_places(views) - box[0]).abs(), (_places(views) - box[1]).abs())
    return torch.linalg.vector_norm(across, dim=-1).amax().item()
