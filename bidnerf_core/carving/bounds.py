"""Estimation of a scene's box and its near and far distances, from depth, silhouettes, landmarks or the cameras alone."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.carving.free_space import occupied_cells
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds, intersect_box
from bidnerf_core.frames import SeenLandmarks, View

AxisBox: TypeAlias = tuple[Float[Tensor, "3"], Float[Tensor, "3"]]
"""Lower and upper corner: metres, world, float64."""


def grow(lower: Float[Tensor, "3"], upper: Float[Tensor, "3"], at_least: float = 0.0, share: float = 0.03) -> AxisBox:
    """Return the box with a margin of ``share`` of its size at each end, or of ``at_least`` metres if that is more.

    A flat box is given some thickness.
    """
    size = upper - lower
    margin = torch.maximum(size * share, size.amax() * 0.01).clamp(min=at_least)
    return lower - margin, upper + margin


def rays_of(
    view: View, wanted: Bool[Tensor, "h w"], share: int
) -> tuple[Float[Tensor, "n 3"], tuple[Int[Tensor, "n"], Int[Tensor, "n"]]]:
    """Return about ``share`` (a number) of the wanted pixels, evenly spread.

    The result holds their points at z = 1 (camera frame), and their rows and columns.
    """
    rows, columns = wanted.nonzero(as_tuple=True)
    stride = max(1, len(rows) // share)
    rows, columns = rows[::stride], columns[::stride]
    ray = view.frame.intrinsics.unproject(torch.stack([columns, rows], dim=-1).double() + 0.5)
    return ray, (rows, columns)


def has_outline(view: View) -> bool:
    """Return whether the image shows background; an alpha channel that is 1 everywhere carries no information."""
    alpha, hidden = view.frame.alpha, view.frame.hidden
    return alpha is not None and bool((alpha if hidden is None else alpha[~hidden]).amin() <= 0)


def carve_box(box: AxisBox, views: Sequence[View]) -> AxisBox:
    """Return the box of the cells that no two views see through and at which many views see something.

    The threshold on the number of views that see something at a cell, as a fraction of its maximum over all cells, is the largest for which
    the box still meets 99.9 % of the rays to pixels with matter. It removes peripheral cells, which so few views see that hardly any could
    have emptied them. Each of three rounds carves the box that the previous round found.
    """
    side, origins, directions = 64, [], []  # of rays (world) through a sample of the pixels whose alpha is over a half
    for view in views:
        alpha, hidden = view.frame.alpha, view.frame.hidden
        assert alpha is not None  # every view has an outline
        ray, _ = rays_of(view, alpha > 0.5 if hidden is None else (alpha > 0.5) & ~hidden, 500)
        directions.append(view.T_ref_camera.to(torch.float64).rotate(ray))
        origins.append(view.T_ref_camera.translation.double().expand_as(ray))
    for _ in range(3):
        lower, upper = box
        cell = (upper - lower) / side
        occupied = occupied_cells(views, lower.tolist(), upper.tolist(), (side,) * 3).nonzero()
        if len(occupied) == 0:
            return box
        points = lower + (occupied + 0.5) * cell
        witnesses = torch.stack([_shows_something(view, points) for view in views]).sum(dim=0)
        for share in (0.5, 0.25, 0.1, 0.0):
            cells = occupied[witnesses >= share * witnesses.amax()]
            box = grow(lower + cells.amin(dim=0) * cell, lower + (cells.amax(dim=0) + 1) * cell)
            near, far = intersect_box(torch.cat(origins), torch.cat(directions), *box)
            if (far >= near.clamp(min=0)).double().mean() >= 0.999:
                break
    return box


def _shows_something(view: View, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return whether a view shows matter (alpha over 0) at each point (metres, world)."""
    camera, alpha, hidden = view.frame.intrinsics, view.frame.alpha, view.frame.hidden
    row, column, inside = camera.cells(view.T_ref_camera.to(torch.float64).inverse().apply(points).float())
    inside = inside if hidden is None else inside & ~hidden[row, column]
    return inside if alpha is None else inside & (alpha[row, column] > 0)


OUTLIERS = 1e-3
"""Fraction of the measured points, at either end of each axis, that may be wrong."""


def estimate_bounds(views: Sequence[View], background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SceneBounds:
    """Estimate the box of the scene that ``views`` show, its range of distances from their cameras, and how finely they resolve it.

    The poses of ``views`` are T_world_camera. With depth (dense in half of the views, or any if there are no silhouettes), the box holds
    the middle 99.8 % of the measured points along each axis. With silhouettes (alpha), it is the box of the visual hull. With colour only,
    it holds the middle 90 % of the landmarks that the views see. Without landmarks, it is a guess: for cameras that look inward, a cube
    around the point they look at, as large as the visible region there; otherwise (in a room), the box of the cameras and of everything
    they see within four times the extent of their positions.

    Unless half of the views have dense depth or silhouettes, there may be matter beyond the box, and the scene is contracted. Images from a
    single position do not determine a scale; the extent of their positions is then taken to be one. The footprint of a pixel refers to the
    median distance of the data that gave the box: measured depth, landmarks, or else the box's middle, for which at least half the longest
    side is assumed. Raises ``InputError`` if there are no views.
    """
    if not views:
        raise InputError("no views to estimate them from", where="scene bounds")
    measured = [view for view in views if view.frame.has_depth]
    dense = sum(view.frame.has_dense_depth for view in measured)
    outlined = [view for view in views if has_outline(view)]
    seeing = [(v, v.landmarks) for v in views if v.landmarks is not None and len(v.landmarks.distance)]
    centres = torch.stack([view.T_ref_camera.translation.double() for view in views])
    contracted, beyond = 2 * len(outlined) < len(views), 0.0
    if measured and (2 * dense >= len(views) or not outlined):
        contracted = 2 * dense < len(views)
        share = max(500, 400_000 // len(measured))
        points, distances = map(torch.cat, zip(*(measured_points(v, share) for v in measured), strict=True))
        nearest = distances.sort().values[round(OUTLIERS * (len(points) - 1))].item()
        box = grow(*_middle(points, OUTLIERS), nearest / 100, 0.03 if dense else 0.1)
        near = nearest / 2
        shown = [(view, float(d[d > 0].median())) for view in measured if (d := view.frame.depth) is not None]
    elif contracted and sum(len(seen.distance) for _, seen in seeing) >= 50:
        distances = torch.cat([seen.distance for _, seen in seeing]).sort().values
        points = torch.cat([_landmark_points(view, seen) for view, seen in seeing])
        box = grow(*_middle(points, 0.05), distances[0].item() / 100)
        last = len(points) - 1
        near = distances[round(0.01 * last)].item() / 2
        beyond = distances[round((1 - OUTLIERS) * last)].item()
        shown = [(view, float(seen.distance.median())) for view, seen in seeing]
    else:
        box = _guessed_box(views, centres)
        box = box if contracted else carve_box(box, outlined)
        outside = torch.maximum(box[0] - centres, centres - box[1]).clamp(min=0)
        nearest = torch.linalg.vector_norm(outside, dim=-1).amin().item()  # 0 if a camera is inside
        near = max(nearest / 2, 0.01 * _farthest(centres, box))
        middle, half = (box[0] + box[1]) / 2, float((box[1] - box[0]).amax()) / 2
        away = torch.linalg.vector_norm(centres - middle, dim=-1).clamp(min=half)
        shown = list(zip(views, away.tolist(), strict=True))
    # A camera may be slightly farther away than any of the views, and a contracted scene reaches well beyond its box.
    far = max(beyond, _farthest(centres, box)) * (2.0 if contracted else 1.1)
    cameras = [(view.frame.intrinsics, distance) for view, distance in shown]
    footprint = statistics.median(2 * distance / (camera.fx + camera.fy) for camera, distance in cameras)
    lower, upper = ((x, y, z) for x, y, z in (end.tolist() for end in box))
    return SceneBounds(lower, upper, near, far, background, contracted, footprint)


def _middle(points: Float[Tensor, "n 3"], left_out: float) -> AxisBox:
    """Return the bounding box of the points, leaving out the fraction ``left_out`` of them at either end of each axis."""
    ordered, first = points.sort(dim=0).values, round(left_out * (len(points) - 1))
    return ordered[first], ordered[len(points) - 1 - first]


def _landmark_points(view: View, seen: SeenLandmarks) -> Float[Tensor, "n 3"]:
    """Return the landmarks that a view sees (metres, world)."""
    ray = view.frame.intrinsics.unproject(seen.pixels.double())
    points = ray * (seen.distance.double() / torch.linalg.vector_norm(ray, dim=-1))[:, None]
    return view.T_ref_camera.to(torch.float64).apply(points)


def measured_points(view: View, share: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return about ``share`` (a number) of a view's measured points (metres, world), and their distances from the camera (metres)."""
    depth = view.frame.depth
    if depth is None:
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    ray, chosen = rays_of(view, depth > 0, share)
    points = ray * depth[chosen][:, None].double()
    return view.T_ref_camera.to(torch.float64).apply(points), torch.linalg.vector_norm(points, dim=-1)


def _guessed_box(views: Sequence[View], centres: Float[Tensor, "v 3"]) -> AxisBox:
    """Return the box suggested by the cameras alone, see ``estimate_bounds``."""
    cameras = [view.frame.intrinsics for view in views]
    pixels = [torch.cartesian_prod(*torch.tensor([[0.0, c.width], [0.0, c.height]]).double()) for c in cameras]
    corners = torch.stack([c.unproject(ends) for c, ends in zip(cameras, pixels, strict=True)])  # at z = 1
    # The tangent of the farthest corner's angle to the optical axis
    tangents = torch.linalg.vector_norm(corners[..., :2], dim=-1).amax(dim=-1)
    # The point nearest to all optical axes (least squares) counts if most cameras see it, and from different sides: the mean
    # squared sine of the angles between the axes and their mean is at least that of about 6 degrees.
    axes = torch.stack([view.T_ref_camera.rotation[:, 2].double() for view in views])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(dim=0)
    if torch.linalg.eigvalsh(normal)[0] >= 0.01:
        middle = torch.linalg.solve(normal, (across @ centres[:, :, None]).mean(dim=0))[:, 0]
        ahead = ((middle - centres) * axes).sum(dim=-1)
        distance = torch.linalg.vector_norm(middle - centres - ahead[:, None] * axes, dim=-1)
        if (distance < ahead * tangents).double().mean() >= 0.8:
            half = (torch.linalg.vector_norm(centres - middle, dim=-1) * tangents).amax()
            return middle - half, middle + half
    reach = 4 * (float((centres.amax(dim=0) - centres.amin(dim=0)).amax()) or 1.0)
    poses = [view.T_ref_camera.to(torch.float64) for view in views]
    points = torch.cat([centres, *(T.apply(rays * reach) for T, rays in zip(poses, corners, strict=True))])
    return points.amin(dim=0), points.amax(dim=0)


def _farthest(centres: Float[Tensor, "v 3"], box: AxisBox) -> float:
    """Return the largest distance (metres) between a corner of the box and a camera."""
    across = torch.maximum((centres - box[0]).abs(), (centres - box[1]).abs())
    return torch.linalg.vector_norm(across, dim=-1).amax().item()
