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
from bidnerf_core.mapping import DEFAULT_LANDMARKS, Sightings, TrackedKeypoints, TrackedViews

FACING = 0.9
"""Fraction of the cameras that must have the centre in front of them for the capture to count as going around
it."""
CONVERGING = 0.5
"""Largest distance at which a typical optical axis passes the centre, relative to the cameras' distance."""
BEYOND = 1.5
"""Distance of the point where the optical axes meet, relative to what the photos show, beyond which it does not
count: they look along a corridor."""
BEHIND = 0.05
"""Fraction of the landmarks behind a camera, on average, above which the scene surrounds the cameras (up to 0.02 in
captures of things seen from outside, 0.08 to 0.5 in those of rooms and corridors)."""
OPEN_SIDE = 120.0
"""Smallest range of directions (degrees) without a camera in a one-sided capture."""
LEAST_GAP = 15.0
"""Smallest width of a gap in degrees: SIFT matches well across narrower ones, so they do no harm."""
WIDE_GAP = 45.0
"""Degrees above which any gap counts, however irregular the capture: from its middle, SIFT matches neither
side well."""
RARE = 0.01
"""Probability that a capture with randomly spread cameras has a gap that counts."""
STEEP = 75.0
"""Degrees above or below the horizon beyond which a camera has no azimuth."""
FEW_POINTS = 50
"""Number of triangulated points below which a capture hardly constrains distances."""
FEW = 4
"""Number of photos below which gaps are not assessed."""


def coverage(
    views: Sequence[View], matched: TrackedKeypoints, seen: TrackedKeypoints, positions: Float[Tensor, "n 3"],
    least_parallax: float, up: UpDirection | None = None,
) -> CoverageRecord:  # fmt: skip
    """Return how well the views cover their scene.

    ``matched`` are all matched keypoints, ``seen`` those consistent with a triangulated point,
    ``positions`` these points, and ``least_parallax`` is the angle (degrees) between rays below which a point cannot be triangulated. ``up``
    is the upward direction of the scene, estimated from the cameras by default.
    """
    angle = parallax_deg(matched)
    centres = torch.stack([v.T_ref_camera.translation.cpu().double() for v in views])
    rotations = torch.stack([v.T_ref_camera.rotation.cpu().double() for v in views])
    upward = (up or up_direction(SE3(rotations, centres))).tensor()
    axes, depths = rotations[:, :, 2], seen.sightings.in_camera(positions)[:, 2]
    centre, converge = _meeting_point(centres, axes, _median(depths) or None)
    if not converge and len(positions):
        centre = positions.median(dim=0).values
    arrangement: Arrangement
    open_side, gaps = None, tuple[Gap, ...]()
    if not converge and (not len(positions) or _share_behind(centres, axes, positions) > BEHIND):
        arrangement = "inside" if len(positions) else "unknown"
        heights = _range_deg(axes @ upward)
    else:
        arrangement, open_side, gaps, heights = _around(views, centres - centre, upward)
    if angle is not None and angle < least_parallax:
        arrangement, open_side, gaps = "one place", None, ()
    views_of = torch.bincount(seen.point).double()
    cones = _cones_deg(seen.sightings, seen.count)
    return CoverageRecord(
        arrangement, _three(centre), _three(upward), angle or 0.0, seen.count, _median(views_of),
        float((views_of == 2).double().mean()) if len(views_of) else 0.0, _median(cones), open_side, gaps, heights,
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
    flat = (sines.abs() < math.sin(math.radians(STEEP))).nonzero()[:, 0]
    if len(views) < FEW or len(flat) < FEW:
        return "unknown", None, (), heights
    names = [views[i].frame.name for i in flat.tolist()]
    steps, named = _steps(_azimuths_deg(unit[flat], up), names)
    order = steps.argsort(descending=True).tolist()
    is_open = float(steps[order[0]]) >= OPEN_SIDE
    open_side = named[order[0]] if is_open else None
    # Random directions have exponentially distributed steps: among n, one exceeds mean * log(n / p) with
    # probability p.
    mean = float(steps.median()) / math.log(2)
    least = min(max(LEAST_GAP, mean * math.log(len(names) / RARE)), WIDE_GAP)
    gaps = tuple(named[i] for i in order[int(is_open) :] if float(steps[i]) > least)
    return "one side" if is_open else "around", open_side, gaps, heights


def _range_deg(sines: Float[Tensor, "v"]) -> tuple[float, float]:
    """Return the 5th and 95th percentiles of the angles (degrees) with these sines."""
    angles = sines.clamp(-1, 1).asin().rad2deg()
    low, high = angles.quantile(torch.tensor([0.05, 0.95], dtype=angles.dtype)).tolist()
    return low, high


def _share_behind(
    centres: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3"], positions: Float[Tensor, "n 3"]
) -> float:
    """Return the mean fraction of the points that lie behind a camera."""
    shares = [
        ((positions - centre) @ axis < 0).double().mean() for centre, axis in zip(centres, axes, strict=True)
    ]
    return float(torch.stack(shares).mean())


def _steps(azimuths: Float[Tensor, "v"], names: Sequence[str]) -> tuple[Float[Tensor, "v"], list[Gap]]:
    """Return the angles (degrees) from each direction to the next, all the way around, and the same as named
    gaps.
    """
    order = azimuths.argsort()
    steps = torch.diff(azimuths[order], append=azimuths[order[:1]] + 360)
    ends = [names[i] for i in order.tolist()]
    pairs = zip(steps.tolist(), ends, ends[1:] + ends[:1], strict=True)
    return steps, [Gap(round(step, 1), after, before) for step, after, before in pairs]


def _azimuths_deg(directions: Float[Tensor, "v 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "v"]:
    """Return the angles about ``up``, from an arbitrary zero."""
    first, second = horizontal_axes(up)
    return torch.atan2(directions @ second, directions @ first).rad2deg()


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return two unit axes that make a right-handed frame with ``up``."""
    helper = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    first = torch.nn.functional.normalize(helper - up * (helper @ up), dim=0)
    return first, torch.linalg.cross(up, first)


def _meeting_point(
    centres: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3"], depth: float | None
) -> tuple[Float[Tensor, "3"], bool]:
    """Return the point nearest to the optical axes, and whether they converge there, at what the cameras see.

    ``depth`` is the median distance of what they see, None if it is unknown.
    """
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None]
    matrix = across.sum(0) + 1e-9 * len(axes) * torch.eye(3, dtype=axes.dtype)  # parallel axes never converge
    point = torch.linalg.solve(matrix, (across @ centres[..., None]).sum(0))[:, 0]
    away = point - centres
    before = ((away * axes).sum(-1) > 0).double().mean()
    missed = torch.linalg.vector_norm(torch.linalg.cross(away, axes), dim=-1)
    distance = torch.linalg.vector_norm(away, dim=-1)
    typical = distance.median()
    here = depth is None or bool(typical <= BEYOND * depth)
    return point, here and bool(before >= FACING and missed.median() <= CONVERGING * typical)


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
    angle = None if tracked is None else parallax_deg(tracked.matched)
    if tracked is None or angle is None or angle >= DEFAULT_LANDMARKS.parallax:
        return True
    return len(tracked.triangulated(DEFAULT_LANDMARKS)[1]) >= FEW_POINTS


def parallax_deg(matched: TrackedKeypoints) -> float | None:
    """Return the median angle between the rays to a matched point; None without points."""
    return _median(_cones_deg(matched.sightings, matched.count)) if matched.count else None


def _cones_deg(sightings: Sightings, count: int) -> Float[Tensor, "n"]:
    """Return twice the largest angle between the rays of each point and their mean."""
    rays = sightings.directions()
    mean = torch.zeros((count, 3), dtype=rays.dtype).index_add_(0, sightings.point, rays)
    cosine = (torch.nn.functional.normalize(mean, dim=-1)[sightings.point] * rays).sum(-1).clamp(-1, 1)
    least = torch.ones(count, dtype=rays.dtype).scatter_reduce(0, sightings.point, cosine, "amin")
    return 2 * least.acos().rad2deg()


def _median(values: Float[Tensor, "n"]) -> float:
    return float(values.median()) if len(values) else 0.0


def _three(vector: Float[Tensor, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
