"""The coverage of a capture: the directions from which its scene was photographed, and those missing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures.report import Arrangement, CoverageRecord, Gap
from bidnerf_core.captures.up_direction import UpDirection, up_direction
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import DEFAULT_LANDMARKS, TrackedKeypoints, TrackedViews


def coverage(
    views: Sequence[View], matched: TrackedKeypoints, seen: TrackedKeypoints, positions: Float[Tensor, "n 3"],
    least_parallax: float, up: UpDirection | None = None,
) -> CoverageRecord:  # fmt: skip
    """Return how well the views cover their scene.

    ``matched`` are all matched keypoints, ``seen`` those consistent with a triangulated point,
    ``positions`` these points, and ``least_parallax`` is the angle (degrees) between rays below which a point cannot be
    triangulated. ``up`` is the upward direction of the scene, estimated from the cameras by default.
    """
    angle = _median(_cones_deg(matched))
    centres = torch.stack([v.T_ref_camera.translation.cpu().double() for v in views])
    rotations = torch.stack([v.T_ref_camera.rotation.cpu().double() for v in views])
    upward = (up or up_direction(SE3(rotations, centres))).tensor()
    axes, depths = rotations[:, :, 2], seen.sightings.in_camera(positions)[:, 2]
    centre, converge = _meeting_point(centres, axes, _median(depths) or math.inf)
    surrounded = not len(positions)
    if not converge and len(positions):
        centre = positions.median(dim=0).values
        behind = [((positions - c) @ axis < 0).double().mean() for c, axis in zip(centres, axes, strict=True)]
        # On average, up to 0.02 of the landmarks are behind a camera if things are seen from outside, and 0.08 to 0.5 in rooms
        # and corridors.
        surrounded = float(torch.stack(behind).mean()) > 0.05
    arrangement: Arrangement = "inside" if len(positions) else "unknown"
    open_side, gaps, heights = None, tuple[Gap, ...](), _range_deg(axes @ upward)
    if converge or not surrounded:
        arrangement, open_side, gaps, heights = _around(views, centres - centre, upward)
    if matched.count and angle < least_parallax:
        arrangement, open_side, gaps = "one place", None, ()
    views_of = torch.bincount(seen.point).double()
    return CoverageRecord(
        arrangement, (*centre.tolist(),), (*upward.tolist(),), angle, seen.count, _median(views_of),
        float((views_of == 2).double().mean()) if len(views_of) else 0.0, _median(_cones_deg(seen)), open_side, gaps, heights,
    )  # fmt: skip


def _around(
    views: Sequence[View], directions: Float[Tensor, "v 3"], up: Float[Tensor, "3"]
) -> tuple[Arrangement, Gap | None, tuple[Gap, ...], tuple[float, float]]:
    """Return how the ``directions`` of the cameras from the centre are arranged about the vertical.

    Also returns the open side, the gaps and the range of elevations (degrees) for a ``CoverageRecord``.
    """
    unit = torch.nn.functional.normalize(directions, dim=-1)
    sines = unit @ up
    heights = _range_deg(sines)
    flat = (sines.abs() < math.sin(math.radians(75))).nonzero()[:, 0]  # steeper ones have no azimuth
    if len(flat) < 4:
        return "unknown", None, (), heights
    first, second = horizontal_axes(up)
    azimuths = torch.atan2(unit[flat] @ second, unit[flat] @ first).rad2deg()
    order = azimuths.argsort()
    steps = torch.diff(azimuths[order], append=azimuths[order[:1]] + 360)  # from each to the next
    names = [views[i].frame.name for i in flat[order].tolist()]
    named = [Gap(round(step, 1), *ends) for step, *ends in zip(steps.tolist(), names, names[1:] + names[:1], strict=True)]  # fmt: skip
    widest = steps.argsort(descending=True).tolist()
    is_open = float(steps[widest[0]]) >= 120
    # Random directions have exponentially distributed steps: among n, one exceeds mean * log(n / p) with
    # probability p. Gaps below 15 degrees do no harm, since SIFT matches well across them. Those above 45 count however irregular
    # the capture: from their middle, SIFT matches neither side well.
    mean = float(steps.median()) / math.log(2)
    least = min(max(15.0, mean * math.log(len(names) / 0.01)), 45.0)
    gaps = tuple(named[i] for i in widest[int(is_open) :] if float(steps[i]) > least)
    return "one side" if is_open else "around", named[widest[0]] if is_open else None, gaps, heights


def _range_deg(sines: Float[Tensor, "v"]) -> tuple[float, float]:
    """Return the 5th and 95th percentiles of the angles (degrees) with these sines."""
    angles = sines.clamp(-1, 1).asin().rad2deg()
    low, high = angles.quantile(torch.tensor([0.05, 0.95], dtype=angles.dtype)).tolist()
    return low, high


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return two unit axes that make a right-handed frame with ``up``."""
    helper = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    first = torch.nn.functional.normalize(helper - up * (helper @ up), dim=0)
    return first, torch.linalg.cross(up, first)


def _meeting_point(
    centres: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3"], depth: float
) -> tuple[Float[Tensor, "3"], bool]:
    """Return the point nearest to the optical axes, and whether they converge there, at what the cameras see.

    ``depth`` is the median distance of what they see, infinite if it is unknown. Cameras whose axes meet far beyond it look along
    a corridor.
    """
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None]
    matrix = across.sum(0) + 1e-9 * len(axes) * torch.eye(3, dtype=axes.dtype)  # parallel axes never converge
    point = torch.linalg.solve(matrix, (across @ centres[..., None]).sum(0))[:, 0]
    away = point - centres
    before = ((away * axes).sum(-1) > 0).double().mean()
    missed = torch.linalg.vector_norm(torch.linalg.cross(away, axes), dim=-1).median()
    typical = torch.linalg.vector_norm(away, dim=-1).median()
    # Nine tenths of the cameras must have the point in front of them.
    return point, bool((typical <= 1.5 * depth) & (before >= 0.9) & (missed <= 0.5 * typical))


def shows_distances(views: Sequence[View], tracked: TrackedViews | None) -> bool:
    """Return whether views determine distances: by measured depth, or by enough parallax.

    They do not if hardly any point can be triangulated for lack of parallax, or if all cameras are in exactly
    one place.
    """
    if any(view.frame.has_depth for view in views):
        return True
    centres = torch.stack([view.T_ref_camera.translation.double() for view in views])
    if float((centres - centres[:1]).abs().max()) <= 0:
        return False
    if tracked is None or not tracked.matched.count:
        return True
    angle = _median(_cones_deg(tracked.matched))
    return angle >= DEFAULT_LANDMARKS.parallax or len(tracked.triangulated(DEFAULT_LANDMARKS)[1]) >= 50


def _cones_deg(seen: TrackedKeypoints) -> Float[Tensor, "n"]:
    """Return twice the largest angle between the rays of each point and their mean."""
    sightings, count = seen.sightings, seen.count
    rays = sightings.directions()
    mean = torch.zeros((count, 3), dtype=rays.dtype).index_add_(0, sightings.point, rays)
    cosine = (torch.nn.functional.normalize(mean, dim=-1)[sightings.point] * rays).sum(-1).clamp(-1, 1)
    least = torch.ones(count, dtype=rays.dtype).scatter_reduce(0, sightings.point, cosine, "amin")
    return 2 * least.acos().rad2deg()


def _median(values: Float[Tensor, "n"]) -> float:
    return float(values.median()) if len(values) else 0.0
