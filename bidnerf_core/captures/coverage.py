"""Coverage of a capture: the viewing directions that it covers or lacks, and the upward direction of the scene.

People hold cameras level but point them down at desks and objects, so the mean of the cameras' upward axes is
tilted as much as the cameras are. Two cues do not suffer from this tilt: the horizontal image axes of level
cameras are perpendicular to the vertical, and floors, ceilings and tables are horizontal planes. The upward
direction is opposite to gravity if the capture measured gravity; otherwise it is the direction best supported by both cues.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from bidnerf_core.captures.report import Arrangement, CoverageRecord, Gap
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, sphere
from bidnerf_core.mapping import DEFAULT_LANDMARKS, TrackedKeypoints, TrackedViews, viewing_cones

UpSource = Literal["gravity", "planes", "cameras"]
"""What an upward direction was derived from."""

ROLL = math.sin(math.radians(6.0)) ** 2
"""Variance of the sine of a hand-held camera's roll relative to the horizon."""
INDEPENDENT = 8
"""Largest number of cameras whose rolls count as independent, since many frames of a video share the same roll."""
ALIKE_DEG = 8.0
"""Largest angle (degrees) between a plane's normal and the surfel normals that support it."""
CHANCE = 1 - math.cos(math.radians(ALIKE_DEG))
"""Fraction of randomly oriented surfels whose normals are within ``ALIKE_DEG`` of a direction or its opposite."""
DIRECTIONS = 1500
"""Number of candidate directions for the normals of planes."""


@dataclass(frozen=True)
class UpDirection:
    """The upward direction of a scene, and its source."""

    direction: tuple[float, float, float]  # unit, world
    source: UpSource

    def tensor(self) -> Float[Tensor, "3"]:
        """Return the direction as a tensor (float64)."""
        return torch.tensor(self.direction, dtype=torch.float64)


def up_from_gravity(direction: Sequence[float]) -> UpDirection:
    """Return a capture's measured upward ``direction`` (a vector of any length in the world frame), normalized."""
    return UpDirection((*normalize(torch.tensor(tuple(direction), dtype=torch.float64), dim=0).tolist(),), "gravity")


def coverage(
    views: Sequence[View],
    matched: TrackedKeypoints,
    seen: TrackedKeypoints,
    positions: Float[Tensor, "n 3"],
    up: UpDirection | None = None,
) -> CoverageRecord:
    """Measure how well the views cover their scene.

    ``matched`` holds all matched keypoints, ``seen`` those consistent with a triangulated point, and ``positions`` these
    points (metres, world). ``up`` is the upward direction of the scene; by default, it is estimated from the cameras.
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
        # On average, at most 2 % of the landmarks lie behind a camera if an object is seen from outside, and 8 % to 50 % in
        # rooms and corridors.
        surrounded = float(torch.stack(behind).mean()) > 0.05
    arrangement: Arrangement = "inside" if len(positions) else "unknown"
    open_side, gaps, heights = None, tuple[Gap, ...](), _range_deg(axes @ upward)
    if converge or not surrounded:
        arrangement, open_side, gaps, heights = _around(views, centres - centre, upward)
    if matched.count and angle < DEFAULT_LANDMARKS.parallax:  # below which a point cannot be triangulated
        arrangement, open_side, gaps = "one place", None, ()
    views_of = torch.bincount(seen.point).double()
    return CoverageRecord(
        arrangement,
        (*centre.tolist(),),
        (*upward.tolist(),),
        angle,
        seen.count,
        _median(views_of),
        float((views_of == 2).double().mean()) if len(views_of) else 0.0,
        _median(_cones_deg(seen)),
        open_side,
        gaps,
        heights,
    )


def _around(
    views: Sequence[View], directions: Float[Tensor, "v 3"], up: Float[Tensor, "3"]
) -> tuple[Arrangement, Gap | None, tuple[Gap, ...], tuple[float, float]]:
    """Return how the cameras are arranged, from the ``directions`` in which they lie as seen from the scene centre.

    Also returns the open side (None if there is none), the gaps and the range of elevations (degrees).
    """
    unit = normalize(directions, dim=-1)
    sines = unit @ up
    heights = _range_deg(sines)
    flat = (sines.abs() < math.sin(math.radians(75))).nonzero()[:, 0]  # steeper directions have no azimuth
    if len(flat) < 4:
        return "unknown", None, (), heights
    first, second = horizontal_axes(up)
    azimuths = torch.atan2(unit[flat] @ second, unit[flat] @ first).rad2deg()
    order = azimuths.argsort()
    steps = torch.diff(azimuths[order], append=azimuths[order[:1]] + 360)  # from each azimuth to the next
    names = [views[i].frame.name for i in flat[order].tolist()]
    named = [
        Gap(round(step, 1), *ends) for step, *ends in zip(steps.tolist(), names, names[1:] + names[:1], strict=True)
    ]
    widest = steps.argsort(descending=True).tolist()
    is_open = float(steps[widest[0]]) >= 120
    # From the middle of a wider gap, SIFT matches neither side well.
    gaps = tuple(named[i] for i in widest[int(is_open) :] if float(steps[i]) > 45)
    return "one side" if is_open else "around", named[widest[0]] if is_open else None, gaps, heights


def _range_deg(sines: Float[Tensor, "v"]) -> tuple[float, float]:
    """Return the 5th and 95th percentiles of the angles (degrees) whose sines are ``sines``."""
    angles = sines.clamp(-1, 1).asin().rad2deg()
    low, high = angles.quantile(torch.tensor([0.05, 0.95], dtype=angles.dtype)).tolist()
    return low, high


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return two horizontal unit axes that form a right-handed frame with ``up``."""
    helper = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    first = normalize(helper - up * (helper @ up), dim=0)
    return first, torch.linalg.cross(up, first)


def _meeting_point(
    centres: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3"], depth: float
) -> tuple[Float[Tensor, "3"], bool]:
    """Return the point nearest to all optical axes, and whether the axes converge there, within the depth of the scene.

    ``depth`` is the median distance of the visible surfaces, infinite if unknown. Cameras whose axes meet far beyond
    this distance look along a corridor.
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
    """Return whether the views determine distances, either by measured depth or by sufficient parallax.

    Without depth, distances are undetermined if hardly any point can be triangulated for lack of parallax, or if
    all cameras are at exactly the same position.
    """
    if any(view.frame.has_depth for view in views):
        return True
    centres = torch.stack([view.T_ref_camera.translation.double() for view in views])
    if float((centres - centres[:1]).abs().max()) <= 0:
        return False
    if tracked is None or not tracked.matched.count:
        return True
    return (
        _median(_cones_deg(tracked.matched)) >= DEFAULT_LANDMARKS.parallax
        or len(tracked.triangulate(DEFAULT_LANDMARKS)[1]) >= 50
    )


def _cones_deg(seen: TrackedKeypoints) -> Float[Tensor, "n"]:
    """Return, for each point, twice the largest angle (degrees) between one of its rays and their mean."""
    return 2 * viewing_cones(seen.sightings.directions(), seen.sightings.point, seen.count)[1].rad2deg()


def _median(values: Float[Tensor, "n"]) -> float:
    return float(values.median()) if len(values) else 0.0


def up_direction(poses: SE3, normals: Float[Tensor, "n 3"] | None = None) -> UpDirection:
    """Estimate the upward direction of a scene from its cameras and, if there is a surface, its surfels' normals.

    ``poses`` holds T_world_camera of one or more images. The signs of ``normals`` (world) do not matter.
    """
    rotations = poses.rotation.detach().cpu().double()
    planes = _planes(normals)
    weight = min(len(rotations), INDEPENDENT)
    tried = list[tuple[float, Tensor, UpSource]]()
    # Prior log odds of images stored sideways, as by phones that are held upright, mostly with the camera at the top.
    for up_axis, level_axis, prior in (
        (-rotations[:, :, 1], rotations[:, :, 0], 0.0),
        (-rotations[:, :, 0], rotations[:, :, 1], -2.0),
        (rotations[:, :, 0], rotations[:, :, 1], -3.0),
    ):
        for direction, support, source in [*planes, (_level(up_axis, level_axis), 0.0, "cameras")]:
            # Cameras that look along the vertical, as from a drone, look down.
            direction = direction if float(((up_axis - rotations[:, :, 2]) @ direction).mean()) >= 0 else -direction
            looking_up = max(0.0, float((rotations[:, :, 2] @ direction).mean()))
            tilt = (level_axis @ direction).square().mean() / ROLL
            score = prior + math.log(CHANCE + support) - 0.5 * weight * float(tilt)
            # Cameras rarely all look upwards; the log odds fall with the mean sine of their elevation.
            tried.append((score - 3 * looking_up, direction, source))
    _, up, source = max(tried, key=lambda one: one[0])
    near = [(share, axis) for axis, share, _ in planes if abs(float(axis @ up)) > 1 - CHANCE]
    if source == "cameras" and near:  # snap to the normal of a nearly horizontal plane
        axis = max(near, key=lambda one: one[0])[1]
        up, source = axis * torch.sign(axis @ up), "planes"
    return UpDirection((*up.tolist(),), source)


def _level(up_axis: Float[Tensor, "v 3"], level_axis: Float[Tensor, "v 3"]) -> Float[Tensor, "3"]:
    """Return the direction most nearly perpendicular to all level image axes, with a prior at the mean upward axis.

    If all cameras face the same way, their level axes determine only a plane of directions. The direction in that plane
    nearest to the mean is then chosen, and its tilt has a standard deviation of about 20 degrees.
    """
    mean = normalize(up_axis.mean(0), dim=0)
    spread = level_axis.mT @ level_axis / len(level_axis)
    prior = (torch.eye(3, dtype=torch.float64) - torch.outer(mean, mean)) / 0.35**2
    return torch.linalg.eigh(min(len(up_axis), INDEPENDENT) * spread / ROLL + prior)[1][:, 0]


def _planes(normals: Float[Tensor, "n 3"] | None) -> list[tuple[Tensor, float, UpSource]]:
    """Return up to six directions about which the normals cluster; the signs of normals are ignored.

    Each direction comes with the fraction of the normals near it, less the fraction expected by chance, and with its source.
    """
    if normals is None or not len(normals):
        return []
    some = normals.detach().cpu().double()[:: max(1, len(normals) // 20_000)]
    tried = sphere(2 * DIRECTIONS)[:DIRECTIONS]  # the upper half
    share = ((some.float() @ tried.float().mT).abs() > 1 - CHANCE).double().mean(0)
    planes = list[tuple[Tensor, float, UpSource]]()
    for _ in range(6):
        start = axis = tried[int(share.argmax())]
        # Refine the axis to the mean of the normals near it, in ever smaller cones.
        for degrees in (ALIKE_DEG, ALIKE_DEG, ALIKE_DEG / 2, ALIKE_DEG / 4):
            along = some @ axis
            near = along.abs() > math.cos(math.radians(degrees))
            if not bool(near.any()):
                break
            axis = normalize((some[near] * torch.sign(along[near])[:, None]).sum(0), dim=0)
        support = float(((some @ axis).abs() > 1 - CHANCE).double().mean()) - CHANCE
        if support >= 3 * CHANCE:
            planes.append((axis, support, "planes"))
        share[(tried @ start).abs() > math.cos(2 * math.radians(ALIKE_DEG))] = 0
    return planes
