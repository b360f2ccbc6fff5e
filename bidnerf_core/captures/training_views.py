"""The views for training: with refined poses, and with the landmarks they show."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from bidnerf_core.captures.cameras import (
    PoseRefinement,
    StoredCamera,
    moved_from,
    pose_sentences,
    stored_cameras,
)
from bidnerf_core.captures.coverage import shows_distances
from bidnerf_core.captures.pose_conventions import pose_contradiction
from bidnerf_core.captures.training_poses import INCONSISTENT, training_poses
from bidnerf_core.carving import has_outline
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    ENOUGH_IMAGES,
    LEAST_VISIBLE_POINTS,
    SIFT,
    USUAL_FEATURES,
    ImageKeypoints,
    TrackedViews,
    depth_ratio,
    posed_keypoints,
    tracked_views,
)
from bidnerf_core.progress import counter

log = logging.getLogger("bidnerf")

RefinementChoice = Literal["auto", "always", "never"]
"""When to refine the given poses: ``auto`` refines them if they are inconsistent."""


UNUSUAL_RATIO = 0.05
"""Smallest relative error of measured depth, compared with triangulated points, that is reported."""


@dataclass(frozen=True, eq=False)
class TrainingViews:
    """Views prepared for training, and what is known about their poses."""

    views: list[View]
    tracked: TrackedViews | None  # the keypoints from which baking builds landmarks
    cameras: tuple[StoredCamera, ...]
    refinement: PoseRefinement | None = None  # None if nothing is known about the given poses
    distances: bool = True  # whether the views determine distances


def prepared(
    views: Sequence[View], refinement: RefinementChoice = "auto",
    features: str = USUAL_FEATURES, trust_poses: bool = False, depth_unit: float | None = None,
) -> TrainingViews:  # fmt: skip
    """Refine the poses of the views if requested, and find the landmarks that they show.

    ``features`` is the name of the keypoint detector. Raises ``InputError`` if the poses contradict most
    pairs of images, unless ``trust_poses`` is set, and if depth is clearly in another unit than
    ``depth_unit`` (metres per step of depth images, if another can be given), with which it was read.
    """
    if refinement == "never":
        tracked, seeing = located(views, features, trust_poses, depth_unit)
        if tracked is None and not trust_poses:
            # Up to twelve evenly spread runs of five consecutive views suffice to check the poses.
            every = 5 * max(1, math.ceil(len(views) / 60))
            some = [view for number, view in enumerate(views) if number % every < 5]
            _check_poses(posed_keypoints(some, SIFT))
        return TrainingViews(
            seeing, tracked, stored_cameras(views), distances=shows_distances(views, tracked)
        )
    tracked = _tracked(views, features, trust_poses, depth_unit)
    found = training_poses(tracked, views, 0.0 if refinement == "always" else INCONSISTENT)
    poses, motion = found.tracked.T_world_camera, found.tracked.motion
    moved = list(views)
    if found.refined or found.replaced:
        moved = [replace(view, T_ref_camera=poses[i]) for i, view in enumerate(views)]
        if bool(motion.any()):
            moved = [replace(view, motion=motion[i]) for i, view in enumerate(moved)]
    cameras = moved_from(views, stored_cameras(moved), found.pixels.tolist())
    summary = None
    if found.consistency is not None:
        names = tuple(views[number].frame.name for number in found.replaced)
        summary = replace(found.consistency, refined=found.refined, replaced=names)
        for line in pose_sentences(cameras, summary):
            log.info(line)
    elif refinement == "always" or len(views) >= ENOUGH_IMAGES:
        log.info(
            f"the poses are kept: refining them takes at least {ENOUGH_IMAGES} images with"
            f" {LEAST_VISIBLE_POINTS} triangulated points each; if these images overlap, check the order and"
            " the axes of their poses"
        )
    seeing, distances = _with_landmarks(moved, found.tracked), shows_distances(views, tracked)
    return TrainingViews(seeing, found.tracked, cameras, summary, distances)


def located(
    views: Sequence[View],
    features: str = USUAL_FEATURES,
    trust_poses: bool = False,
    depth_unit: float | None = None,
) -> tuple[TrackedViews | None, list[View]]:
    """Track the keypoints of the views, unless all have dense depth or a silhouette.

    Returns the tracks, from which baking builds the map's landmarks, and the views with the landmarks that
    each shows, from which training takes distances.
    """
    if not any(map(_lacks_distances, views)):
        return None, list(views)
    tracked = _tracked(views, features, trust_poses, depth_unit)
    return tracked, _with_landmarks(views, tracked)


def _lacks_distances(view: View) -> bool:
    """Return whether a view has neither dense depth nor a silhouette to show training where matter is."""
    return not (view.frame.has_dense_depth or has_outline(view))


def _tracked(
    views: Sequence[View], features: str, trust_poses: bool, depth_unit: float | None
) -> TrackedViews:
    """Track the keypoints of the views. Raises ``InputError`` if poses contradict the images, or depth is in another unit.

    The unit is checked last: under wrong poses, triangulated distances say nothing about it.
    """
    tracked = tracked_views(views, features)
    counter("checking poses", "stage")(0, 1)
    if not trust_poses:
        _check_poses(tracked.observations.images)
    check_depth_unit(tracked, depth_unit)
    return tracked


def _check_poses(images: Sequence[ImageKeypoints]) -> None:
    """Raise ``InputError`` if the poses contradict most pairs of images."""
    if (found := pose_contradiction(images)) is not None:
        raise InputError(f"{found.sentence} (--trust-poses, trust_poses in Python, trains with them anyway)")


def check_depth_unit(tracked: TrackedViews, depth_unit: float | None = None) -> None:
    """Raise ``InputError`` if measured depth is in another unit than the poses; log a scale that is a few percent off.

    ``depth_unit`` is the one with which depth images were read, if another can be given.
    """
    seen, points = tracked.triangulated(DEFAULT_LANDMARKS)
    ratio = depth_ratio(seen, points)
    if ratio is None or abs(ratio - 1) < UNUSUAL_RATIO:
        return
    remark = f"measured depth is {ratio:.3g} times the depth that the poses and photos imply"
    if 1 / 2 < ratio < 2:
        log.info(f"{remark}; training takes both as they are")
        return
    remedy = "check the unit of the depth images (depth_unit_scale_factor in a transforms.json)"
    if depth_unit is not None:
        right = depth_unit / ratio
        # The usual units (metres per step of depth images) of floats, and of the integers of sensors and datasets.
        usual = min(
            (1.0, 0.01, 0.001, 1e-4, 1 / 4000, 1 / 5000), key=lambda unit: abs(math.log(unit / right))
        )
        right = usual if abs(usual / right - 1) < UNUSUAL_RATIO else right
        remedy = (
            f"if the poses are in metres, a step of the depth images is {right:.3g} m and not {depth_unit:.3g} m (--depth-unit"
            f" {right:.3g}, depth_unit in Python, or depth_unit_scale_factor in a transforms.json)"
        )
    raise InputError(
        f"{remark};",
        expected=f"depth and poses in the same unit: {remedy}; otherwise scale the poses by {ratio:.3g}",
    )


def _with_landmarks(views: Sequence[View], tracked: TrackedViews) -> list[View]:
    """Return the views with the landmarks that each shows, unless no view needs them for distances."""
    if not any(map(_lacks_distances, views)):
        return list(views)
    seen = tracked.seen(DEFAULT_LANDMARKS)
    count = sum(len(part.distance) for part in seen)
    log.info(f"{count} sightings of landmarks in {len(views)} views")
    return [replace(view, landmarks=part) for view, part in zip(views, seen, strict=True)]
