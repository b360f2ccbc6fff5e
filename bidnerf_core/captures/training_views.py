"""Views prepared for training: poses are corrected where the photos contradict them, and visible landmarks are added."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.captures.cameras import (
    PoseRefinement,
    StoredCamera,
    pose_sentences,
    record_refinement,
    stored_cameras,
)
from bidnerf_core.captures.coverage import shows_distances
from bidnerf_core.captures.pose_conventions import pose_contradiction
from bidnerf_core.captures.survey import link_photos, relocate_photos, suspects
from bidnerf_core.carving import has_outline
from bidnerf_core.depth import likely_unit
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3, mad_deviation
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    ENOUGH_IMAGES,
    LEAST_NOISE,
    LEAST_VISIBLE_POINTS,
    SIFT,
    USUAL_FEATURES,
    Adjustment,
    ImageKeypoints,
    PosePrior,
    TrackedKeypoints,
    TrackedViews,
    adjust_bundle,
    depth_ratio,
    detect_keypoints,
    log_evidence,
    noise,
    pinhole,
    resections,
    track_views,
)
from bidnerf_core.progress import counter, log

RefinementChoice = Literal["auto", "always", "never"]
"""When to refine the given poses: ``auto`` refines them if they are inconsistent."""

INCONSISTENT = 0.25
"""Standard deviation (pixels) that errors of the given poses must add to the keypoint noise for the poses to be
refined. Poses from structure from motion or a renderer add less than a tenth of a pixel.
"""
ROUNDS = 3
"""Largest number of bundle adjustments. After each one, the keypoints are matched again, which finds matches that
wrong poses prevented."""
MOST_EVIDENCE = 10.0
"""Largest contribution of an image to the log evidence for or against a motion, so that a few images cannot decide."""


@dataclass(frozen=True, eq=False)
class TrainingViews:
    """Views prepared for training, and what is known about their poses."""

    views: list[View]
    tracked: TrackedViews | None  # the keypoints from which baking builds landmarks
    cameras: tuple[StoredCamera, ...]
    refinement: PoseRefinement | None = None  # None if nothing is known about the given poses
    distances: bool = True  # whether the views determine distances


def prepare_views(
    views: Sequence[View],
    refinement: RefinementChoice = "auto",
    features: str = USUAL_FEATURES,
    trust_poses: bool = False,
    depth_unit: float | None = None,
    labels: Int[Tensor, "m"] | None = None,
    tracks: Callable[[TrackedViews], None] = lambda tracked: None,
) -> TrainingViews:
    """Refine the poses of the views if requested, and find the landmarks visible in the views.

    ``features`` is the name of the keypoint detector. ``depth_unit`` is the unit with which depth images were read
    (metres per step), or None if the user cannot set another. ``tracks`` receives the tracks once the keypoints are matched, which takes
    longest; their ``labels`` from an earlier call with the same views spare it. Raises ``InputError`` if the poses contradict most
    pairs of images, unless ``trust_poses`` is set, and if measured depth is clearly in a different unit from the poses.
    """
    if refinement == "never":
        tracked, seeing = track_landmarks(views, features, trust_poses, depth_unit, labels)
        if tracked is None and not trust_poses:
            # Up to twelve evenly spread runs of five consecutive views suffice to check the poses.
            every = 5 * max(1, math.ceil(len(views) / 60))
            _check_poses(detect_keypoints([view for number, view in enumerate(views) if number % every < 5], SIFT))
        return TrainingViews(seeing, tracked, stored_cameras(views), distances=shows_distances(views, tracked))
    tracked = _track(views, features, trust_poses, depth_unit, labels)
    tracks(tracked)
    fit = training_poses(tracked, views, 0.0 if refinement == "always" else INCONSISTENT)
    poses, motion = fit.tracked.T_world_camera, fit.tracked.observations.motion
    moved = list(views)
    if fit.refined or fit.replaced:
        moved = [replace(view, T_ref_camera=poses[i]) for i, view in enumerate(views)]
        if bool(motion.any()):
            moved = [replace(view, motion=motion[i]) for i, view in enumerate(moved)]
    cameras = record_refinement(views, stored_cameras(moved), fit.pixels.tolist())
    summary = None
    if fit.consistency is not None:
        summary = replace(
            fit.consistency, refined=fit.refined, replaced=tuple(views[number].frame.name for number in fit.replaced)
        )
        for line in pose_sentences(cameras, summary):
            log.info(line)
    elif refinement == "always" or len(views) >= ENOUGH_IMAGES:
        log.info(
            f"the poses are kept: refining them takes at least {ENOUGH_IMAGES} images with"
            f" {LEAST_VISIBLE_POINTS} triangulated points each; if these images overlap, check the order and"
            " the axes of their poses"
        )
    seeing, distances = _with_landmarks(moved, fit.tracked), shows_distances(views, tracked)
    return TrainingViews(seeing, fit.tracked, cameras, summary, distances)


def track_landmarks(
    views: Sequence[View],
    features: str = USUAL_FEATURES,
    trust_poses: bool = False,
    depth_unit: float | None = None,
    labels: Int[Tensor, "m"] | None = None,
) -> tuple[TrackedViews | None, list[View]]:
    """Track the keypoints of the views, unless all have dense depth or a silhouette; with known ``labels``, without matching.

    Returns the tracks (None if none are needed), from which baking builds the map's landmarks, and the views with
    the landmarks visible in each, which provide distances for training.
    """
    tracked = _track(views, features, trust_poses, depth_unit, labels) if _lack_distances(views) else None
    return tracked, _with_landmarks(views, tracked)


def _lack_distances(views: Sequence[View]) -> bool:
    """Return whether a view has neither dense depth nor a silhouette, so that training has no cue to where the surfaces are."""
    return not all(view.frame.has_dense_depth or has_outline(view) for view in views)


def _track(
    views: Sequence[View],
    features: str,
    trust_poses: bool,
    depth_unit: float | None,
    labels: Int[Tensor, "m"] | None = None,
) -> TrackedViews:
    """Track the keypoints of the views. Raises ``InputError`` if poses contradict the images or depth is in another unit.

    The unit is checked last, since triangulated distances are meaningless under wrong poses.
    """
    tracked = track_views(views, features, labels=labels)
    counter("checking poses", "stage")(0, 1)
    if not trust_poses:
        _check_poses(tracked.observations.images)
    check_depth_unit(tracked, depth_unit)
    return tracked


def _check_poses(images: Sequence[ImageKeypoints]) -> None:
    """Raise ``InputError`` if the poses contradict most pairs of images."""
    if (contradiction := pose_contradiction(images)) is not None:
        raise InputError(f"{contradiction.sentence} (`trust_poses` trains with them anyway)")


def check_depth_unit(tracked: TrackedViews, depth_unit: float | None = None) -> None:
    """Raise ``InputError`` if measured depth is in a different unit from the poses; only log a smaller scale difference.

    ``depth_unit`` is the unit with which depth images were read, or None if the user cannot set another.
    """
    seen, points = tracked.triangulate(DEFAULT_LANDMARKS)
    ratio = depth_ratio(seen, points)
    if ratio is None or abs(ratio - 1) < 0.05:  # within the errors of sensors and triangulation
        return
    finding = f"measured depth is {ratio:.3g} times the depth that the poses and photos imply"
    if 1 / 2 < ratio < 2:
        log.info(f"{finding}; training takes both as they are")
        return
    remedy = "check the unit of the depth images (depth_unit_scale_factor in a transforms.json)"
    if depth_unit is not None:
        right = likely_unit(depth_unit / ratio)
        remedy = (
            f"if the poses are in metres, a step of the depth images is {right:.3g} m and not {depth_unit:.3g} m (`depth_unit`"
            f" {right:.3g}, or depth_unit_scale_factor in a transforms.json)"
        )
    raise InputError(
        f"{finding};",
        expected=f"depth and poses in the same unit: {remedy}; otherwise scale the poses by {ratio:.3g}",
    )


def _with_landmarks(views: Sequence[View], tracked: TrackedViews | None) -> list[View]:
    """Return the views with the landmarks visible in each, or unchanged if no view needs landmarks for distances."""
    if tracked is None or not _lack_distances(views):
        return list(views)
    seen = tracked.landmarks_by_image(DEFAULT_LANDMARKS)
    log.info(f"{sum(len(part.distance) for part in seen)} sightings of landmarks in {len(views)} views")
    return [replace(view, landmarks=part) for view, part in zip(views, seen, strict=True)]


@dataclass(frozen=True, eq=False)
class TrainingPoses:
    """The poses used for training, and how far they are from the given poses."""

    tracked: TrackedViews  # tracks at these poses
    pixels: Float[Tensor, "v"]  # median shift of the points in an image; 0 if its pose was kept
    replaced: list[int]  # images whose given pose was wrong, localized with the others' landmarks
    refined: bool  # whether all poses were refined
    consistency: PoseRefinement | None  # of the given poses; None if not known


def training_poses(
    tracked: TrackedViews,
    views: Sequence[View],
    least: float = INCONSISTENT,
) -> TrainingPoses:
    """Return the poses with which to train on ``views``, whose keypoints are ``tracked``.

    If no group of photos supports the given pose of a photo, that pose is replaced with the pose found from the
    landmarks of the other photos. All poses are refined if errors of the given poses add at least ``least`` pixels to the
    standard deviation of the keypoints; otherwise they are kept.
    """
    seen, points = tracked.triangulate(DEFAULT_LANDMARKS)
    wrong = {
        number: photo
        for number, photo in relocate_photos(tracked, views, suspects(seen, link_photos(seen))).items()
        if photo.problem in ("badly posed", "turned")
    }
    replaced = list(wrong)
    if wrong:
        updates = torch.zeros(len(views), 6, dtype=torch.float64)
        updates[replaced] = torch.stack([photo.update for photo in wrong.values()])
        tracked = tracked.at(tracked.T_world_camera.retract(updates)).rematch(DEFAULT_LANDMARKS, seen, points)
    fit = adjust_poses(tracked, least)
    pixels, refined = torch.zeros(len(views), dtype=torch.float64), False
    if fit is not None and fit[2].inconsistency >= least:
        (tracked, pixels, _), refined = fit, True
    elif fit is not None and wrong:
        poses, better = tracked.T_world_camera, fit[0].T_world_camera
        poses.rotation[replaced] = better.rotation[replaced]
        poses.translation[replaced] = better.translation[replaced]
        tracked = tracked.at(poses).rematch(DEFAULT_LANDMARKS, *fit[0].triangulate(DEFAULT_LANDMARKS))
    for number, photo in wrong.items():
        pixels[number] = photo.pixels
    return TrainingPoses(tracked, pixels, replaced, refined, None if fit is None else fit[2])


def adjust_poses(
    tracked: TrackedViews, least: float = 0.0
) -> tuple[TrackedViews, Float[Tensor, "v"], PoseRefinement] | None:
    """Bundle-adjust the poses and points of the ``tracked`` images; None if there are too few images or points.

    Returns the tracks matched with the adjusted poses; the median shift (pixels) of the points in each
    image, 0 without points; and how well the given and the adjusted poses fit the keypoints.

    The errors of the given poses are assumed to be independent, and as large as resection of the images
    suggests. This prior alone fixes the gauge (position, orientation and scale), so the mean
    motion of the images is about zero. If the keypoints show a rolling shutter, the motions of the cameras
    during readout are estimated too. Otherwise, if the first adjustment finds an inconsistency of less than
    ``least`` pixels, its poses are returned at once.
    """

    def noise_of(seen: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> float:
        return max(LEAST_NOISE, noise(seen.sightings, points))

    given = tracked.T_world_camera
    seen, points = tracked.triangulate(DEFAULT_LANDMARKS)
    before = noise_of(seen, points)
    updates = tracked.triangulation(DEFAULT_LANDMARKS).pose_updates
    if len(updates) < ENOUGH_IMAGES:
        return None
    deviations, motion = _deviations(torch.stack(updates)), STILL
    for number in range(ROUNDS):
        counter("refining poses", "rounds")(number, ROUNDS)
        fit = adjust_bundle(
            seen.sightings,
            Adjustment(tracked.T_world_camera, points, tracked.observations.motion),
            PosePrior(given, *deviations, motion),
            noise_of(seen, points),
            KEYPOINTS_PER_INDEPENDENT,
        )
        step = _image_motion(seen, fit.points, tracked.T_world_camera, fit.T_world_camera)
        moved = _deviations((given.inverse() @ fit.T_world_camera).log())
        deviations = max(deviations[0], moved[0]), max(deviations[1], moved[1])
        pixels = _image_motion(seen, fit.points, given, fit.T_world_camera)
        tracked, noticed = tracked.at(fit.T_world_camera, fit.motion), False
        seen, points = tracked.triangulate(DEFAULT_LANDMARKS)
        # A motion found in the last round could not be estimated any more.
        if motion == STILL and number < ROUNDS - 1:
            motion = common_motion(seen, points, KEYPOINTS_PER_INDEPENDENT)
            noticed = motion != STILL
        consistency = PoseRefinement(before, noise_of(seen, points))
        if number == 0 and not noticed and consistency.inconsistency < least:
            break
        tracked = tracked.rematch(DEFAULT_LANDMARKS, seen, points)
        seen, points = tracked.triangulate(DEFAULT_LANDMARKS)
        consistency = PoseRefinement(before, noise_of(seen, points))
        if float(step.max()) <= 0.25 and not noticed:  # pixels
            break
    return tracked, pixels, consistency


def _deviations(updates: Float[Tensor, "v 6"]) -> tuple[float, float]:
    """Return robust standard deviations about zero, per axis, of the translation (metres) and rotation (radians) of updates."""
    return max(1e-9, mad_deviation(updates[:, :3])), max(1e-9, mad_deviation(updates[:, 3:]))


def _image_motion(
    seen: TrackedKeypoints, points: Float[Tensor, "n 3"], given: SE3, estimated: SE3
) -> Float[Tensor, "v"]:
    """Return the median shift (pixels) of each image's points between its given and estimated pose."""
    shown, image = points[seen.point], seen.image
    focal = seen.sightings.focal[:, None]
    pixels = [pinhole(T[image].inverse().apply(shown))[0] * focal for T in (given, estimated)]
    away = torch.linalg.vector_norm(pixels[1] - pixels[0], dim=-1)
    medians = torch.zeros(len(seen.images), dtype=torch.float64)
    for number in image.unique().tolist():
        medians[number] = away[image == number].median()
    return medians


def common_motion(seen: TrackedKeypoints, points: Float[Tensor, "n 3"], correlation: float) -> MotionPrior:
    """Return a prior for camera motions if a rolling shutter is more probable than none, otherwise ``STILL``.

    The hypotheses concern the capture as a whole: either all images have a rolling shutter, or none. Each of up to 60
    images is resected from ``points`` with and without motion. ``correlation`` is the number of keypoints
    that count as one independent measurement.
    """
    sightings = seen.sightings
    numbers = (torch.bincount(seen.image) >= LEAST_VISIBLE_POINTS).nonzero()[:, 0]
    if len(numbers) < ENOUGH_IMAGES:
        return STILL
    prior = MotionPrior.usual(float(sightings.in_camera(points)[:, 2].median()))
    total, some = 0.0, numbers[:: -(-len(numbers) // 60)]
    for _, states, normal in resections(sightings, points, some, correlation, (STILL, prior)):
        still, moving = log_evidence(states, normal).view(2, -1)
        total += float((moving - still).clamp(-MOST_EVIDENCE, MOST_EVIDENCE).nan_to_num(-MOST_EVIDENCE).sum())
    return prior if total > 0 else STILL
