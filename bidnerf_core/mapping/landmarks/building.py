"""Building landmarks: match the keypoints of posed images, join them into tracks, and triangulate or back-project them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import ceil, radians
from typing import Annotated, TypeAlias, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera import MotionPrior
from bidnerf_core.devices import map_tasks
from bidnerf_core.errors import InputError, enumeration
from bidnerf_core.frames import SeenLandmarks, View
from bidnerf_core.geometry import SE3, chi_squared_quantile, inlier_weight
from bidnerf_core.mapping.geometry.triangulation import (
    fits_points,
    noise,
    parallax,
    refine_points,
    sum_by,
    triangulate,
)
from bidnerf_core.mapping.landmarks.features import (
    USUAL_FEATURES,
    CachedFeatures,
    Features,
    ImageKeypoints,
    Sift,
    detect,
    find_features,
    image_keypoints,
)
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap, concatenate
from bidnerf_core.mapping.landmarks.tracks import (
    PairMatches,
    TrackedKeypoints,
    back_project,
    epipolar_matches,
    fuse_landmarks,
    keypoint_depth_noise,
    landmarks_by_image,
    likely_pairs,
    link_tracks,
)
from bidnerf_core.mapping.resection.reprojection import resections
from bidnerf_core.mapping.resection.states import pinhole
from bidnerf_core.progress import counter
from bidnerf_core.registry import PluginError
from bidnerf_core.settings import Above, Range, Settings

LEAST_VISIBLE_POINTS = 20
"""Minimum number of points from which the pose of an image is estimated."""
SETTLED_PIXELS = 0.25
"""Motion of points in an image (pixels) up to which the matches of a pair are kept when poses change: an eighth of the epipolar band."""
SAMPLED_POINTS = 32
"""Number of points from which that motion is estimated; images that see fewer than a quarter of it are matched again."""
ENOUGH_IMAGES = 8
"""Minimum number of images from which the covariance of pose updates is estimated."""
Result = TypeVar("Result")
PosedMatches: TypeAlias = dict[tuple[int, int], tuple[SE3, PairMatches]]
"""The matches of pairs of images, with the pose T_second_first of the cameras with which they were found."""


def update_scatter(updates: Sequence[Float[Tensor, "6"] | None]) -> Float[Tensor, "6 6"] | None:
    """Return a robust covariance of pose updates.

    It is None, which means unknown, if there are too few updates, or if fewer than half of the images have one.
    """
    known = [update for update in updates if update is not None]
    return robust_covariance(torch.stack(known)) if len(known) >= max(ENOUGH_IMAGES, len(updates) / 2) else None


def pose_updates(
    tracked: TrackedKeypoints, positions: Float[Tensor, "n 3"], most: int | None = None
) -> dict[int, Float[Tensor, "6"]]:
    """Return the right updates from the given to the resected poses, by image number, for images with enough points.

    Each update holds a translation (metres), then a rotation (radians). If ``most`` is given, at most that many images, at
    regular intervals, are resected.

    The points from which an image is resected were triangulated from that image as well, so the resected poses scatter too
    little. With k views of each point, their variance is (1 - 1/k) times that for exactly known points; for a new image, it is
    (1 + 1/k) times that. The updates are rescaled to the scatter of new images.
    """
    sightings, image = tracked.sightings, tracked.image
    count = torch.bincount(image)
    views = sum_by(torch.bincount(sightings.point)[sightings.point].double(), image, len(count)) / count
    factor = ((1 + 1 / views) / (1 - 1 / views)).sqrt()
    known, updates = (count >= LEAST_VISIBLE_POINTS).nonzero()[:, 0], dict[int, Float[Tensor, "6"]]()
    known = known[:: 1 if most is None else max(1, ceil(len(known) / most))]
    for numbers, states, _ in resections(sightings, positions, known):
        updates |= zip(numbers.tolist(), states.T.log() * factor[numbers, None], strict=True)
    return {number: updates[number] for number in known.tolist()}


def robust_covariance(values: Float[Tensor, "n c"]) -> Float[Tensor, "c c"]:
    """Return an M-estimate of the covariance about zero (Maronna 1976).

    Weights bound the influence of each value. The result is scaled so that the median of the squared Mahalanobis
    distances equals the median of the chi-squared distribution.
    """
    channels = values.shape[1]
    scale = values.square().median(0).values.clamp(min=1e-30)
    covariance = torch.diag(scale)
    for _ in range(10):  # the weights hardly change after five
        squared = (values @ torch.linalg.inv(covariance) * values).sum(-1).clamp(min=1e-12)
        squared = squared * (chi_squared_quantile(0.5, channels) / float(squared.median()))
        weight = inlier_weight(squared, channels**0.5)
        covariance = (values.mT * weight) @ values / weight.sum() + 1e-9 * torch.diag(scale)
    squared = (values @ torch.linalg.inv(covariance) * values).sum(-1)
    covariance = covariance * (float(squared.median()) / chi_squared_quantile(0.5, channels))
    return (covariance + covariance.mT) / 2


@dataclass(frozen=True)
class LandmarkConfig(Settings):
    """Settings for building landmarks."""

    neighbours: Annotated[int, Range(1, 1000)] = 8  # number of images with which each image is matched
    # minimum angle between the rays of a point, degrees; below it, the point is placed by measured depth
    parallax: Annotated[float, Above(0.0, 89.0)] = 2.0
    singles: bool = True  # make landmarks of keypoints seen in a single image if their depth was measured
    # maximum number of landmarks, 168 bytes each with SIFT, of up to 1,000 images; of more images, in proportion
    most: Annotated[int, Range(1, 10**8)] = 200_000


DEFAULT_LANDMARKS = LandmarkConfig()


def build_landmarks(
    views: Sequence[View],
    features: str | Features = USUAL_FEATURES,
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    report: Callable[[str], None] = lambda sentence: None,
) -> LandmarkMap:
    """Build landmarks from ``views``, whose poses are T_world_camera, and from their measured depth where available.

    ``report`` is called with a sentence if landmarks had to be dropped. Raises ``InputError`` if no landmark was found.
    """
    return track_views(views, features, config).landmarks(config, report)


@dataclass(frozen=True, eq=False)
class Triangulation:
    """The points that tracked keypoints show."""

    keypoints: TrackedKeypoints  # those that fit the points
    points: Float[Tensor, "n 3"]  # metres, world
    covariance: Float[Tensor, "n 3 3"]  # of the points, for a noise of one pixel

    @property
    def seen(self) -> TrackedKeypoints:
        """A copy of the keypoints without their sightings, which take much memory and last as long as the copy."""
        return replace(self.keypoints)

    @cached_property
    def pose_updates(self) -> list[Float[Tensor, "6"]]:
        """The updates (see ``pose_updates``) of 200 images, which show deviations to 7 %."""
        return list(pose_updates(self.seen, self.points, 200).values())


@dataclass(frozen=True, eq=False)
class TrackedViews:
    """The keypoints of posed images, joined into tracks."""

    observations: TrackedKeypoints
    features: str | Features = USUAL_FEATURES  # the detector of the keypoints: its name, if it is registered
    # Positions (metres, world, float64) of the points by number, if they are known; otherwise they are triangulated.
    points: Float[Tensor, "p 3"] | None = None
    matches: PosedMatches = field(default_factory=dict)  # from which the tracks were joined, if they are known
    _triangulations: dict[float, Triangulation] = field(default_factory=dict, init=False)  # by the minimum parallax

    def detector_of(self, view: View, number: int) -> Features:
        """Return a detector for queries with ``view``, which is image ``number``; the detector reuses the image's keypoints."""
        known = (view.frame.rgb_bytes, self.observations.images[number].keypoints)
        features = find_features(self.features) if isinstance(self.features, str) else self.features
        return CachedFeatures(partial(detect, features), [known])

    def landmarks(
        self,
        config: LandmarkConfig,
        report: Callable[[str], None] = lambda sentence: None,
        exact_poses: bool = False,
    ) -> LandmarkMap:
        """Return the landmarks built from the tracks. Raises ``InputError`` if there are none.

        Unless ``exact_poses`` is set, the errors of the images' poses are estimated.
        """
        known = self.points is not None
        found = _triangulate(self.observations, config, self.points) if known else self.triangulation(config)
        landmarks = _build(self.observations, config, found, exact_poses)
        if not len(landmarks):
            images = len(self.observations.images)
            raise InputError(
                f"no landmarks found in {images} images:",
                expected="texture that several images show from different places",
            )
        moving = float((self.observations.motion != 0).any(1).double().mean())
        usual = USUAL_FEATURES if isinstance(self.features, Sift) else ""
        name = self.features if isinstance(self.features, str) else usual
        most = round(config.most * max(1.0, len(self.observations.images) / 1000))
        if len(landmarks) > most:
            report(f"{len(landmarks)} landmarks found, {most} kept: those seen in the most images")
            landmarks = landmarks[landmarks.views.argsort(descending=True, stable=True)[:most].sort().values]
        return replace(landmarks, moving=moving, features=name).indexed()

    def landmarks_by_image(self, config: LandmarkConfig) -> list[SeenLandmarks]:
        """Return the triangulated landmarks seen in each image; training uses their depth where none was measured."""
        found = self.triangulation(config)
        seen, points = found.seen, found.points
        return landmarks_by_image(seen, points, noise(seen.sightings, points) ** 2 * found.covariance)

    def triangulate(self, config: LandmarkConfig) -> tuple[TrackedKeypoints, Float[Tensor, "n 3"]]:
        """Return the inlier keypoints of the triangulated points, and these points (metres, world)."""
        found = self.triangulation(config)
        return found.seen, found.points

    def triangulation(self, config: LandmarkConfig) -> Triangulation:
        """Return the triangulated points, which are triangulated once."""
        if config.parallax not in self._triangulations:
            self._triangulations[config.parallax] = _triangulate(self.observations, config)
        return self._triangulations[config.parallax]

    @property
    def T_world_camera(self) -> SE3:
        """The poses of the images (v)."""
        return SE3.stack([image.T_ref_camera for image in self.observations.images])

    @property
    def matched(self) -> TrackedKeypoints:
        """The keypoints that were matched with keypoints of other images."""
        return self.observations[_is_tracked(self.observations)].compact()[0]

    def at(self, T_world_camera: SE3, motion: Float[Tensor, "v 6"] | None = None) -> TrackedViews:
        """Return the tracks with the images' poses (v) replaced, and also their motions (metres, then radians) if ``motion`` is given."""
        motion = self.observations.motion if motion is None else motion
        images = [
            replace(p, T_ref_camera=T_world_camera[i], motion=motion[i]) for i, p in enumerate(self.observations.images)
        ]
        return replace(self, observations=replace(self.observations, images=images))

    def at_distance(self, distance: float) -> TrackedViews:
        """Return the tracks with ``distance`` (metres from the camera) as the measured distance of every keypoint."""
        images = [
            replace(p, depth=distance / torch.linalg.vector_norm(p.rays, dim=-1)) for p in self.observations.images
        ]
        return replace(self, observations=replace(self.observations, images=images))

    def rematch(self, config: LandmarkConfig, seen: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> TrackedViews:
        """Match the keypoints again where the poses have changed since they were matched, and return the new tracks.

        A pair of images keeps its matches if its relative pose has hardly moved the ``points`` (metres, world) that are ``seen`` in the
        image.
        """
        images = self.observations.images
        pairs = likely_pairs([image.T_ref_camera for image in images], config.neighbours)
        matches = {pair: self.matches[pair] for pair in _settled(images, pairs, self.matches, _samples(seen, points))}
        matches = _match_pairs(images, pairs, matches, _counter("poses", "image pairs", len(pairs)))
        return replace(self, observations=_link_keypoints(images, matches), matches=matches)

    def without(self, images: Sequence[int]) -> TrackedViews:
        """Return the tracks without the keypoints of ``images``, and without known points, whose positions may come from these images."""
        left = ~torch.isin(self.observations.image, torch.tensor(images))
        return replace(self, observations=self.observations[left], points=None)

    def of_points_in(self, images: Sequence[int]) -> TrackedViews:
        """Return the tracks that have a keypoint in at least one of ``images``."""
        own = torch.isin(self.observations.image, torch.tensor(images))
        left = torch.isin(self.observations.point, self.observations.point[own].unique())
        return replace(self, observations=self.observations[left])


def track_views(
    views: Sequence[View],
    features: str | Features = USUAL_FEATURES,
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    known: Callable[[Sequence[ImageKeypoints]], list[tuple[int, int, PairMatches]]] = lambda images: [],
    labels: Int[Tensor, "m"] | None = None,
) -> TrackedViews:
    """Detect the keypoints of ``views``, match those of likely neighbours, and join the matches into tracks.

    ``known`` returns further matches of the keypoints, which take precedence over contradicting ones. If the ``labels`` of the
    tracks (see ``link_tracks``) are known from an earlier call with the same views, nothing is matched. ``features`` is a detector or its name, which is stored with the landmarks so that queries use the same detector. Raises
    ``InputError`` if there are no views, for an unknown name, and for unusable keypoints.
    """
    detector = find_features(features) if isinstance(features, str) else features
    if not views:
        raise InputError("nothing to build landmarks from:", expected="at least one view")
    pairs = likely_pairs([view.T_ref_camera for view in views if labels is None], config.neighbours)
    step = _counter("landmarks", "images and pairs", len(views) + len(pairs))
    images = _counted(map_tasks(image_keypoints, ((view, detector) for view in views)), step)
    lengths = sorted({image.keypoints.descriptors.shape[1] for image in images})
    if len(lengths) > 1:
        raise PluginError(
            f"descriptors have {enumeration([*map(str, lengths)])} channels in different images",
            expected="the same number",
        )
    if labels is None:
        matches = _match_pairs(images, pairs, {}, step)
        return TrackedViews(_link_keypoints(images, matches, known(images)), features, matches=matches)
    if len(labels) != sum(len(image.keypoints) for image in images):  # the detector has changed meanwhile
        return track_views(views, features, config, known)
    return TrackedViews(TrackedKeypoints(images, labels.long(), torch.arange(len(labels))), features)


def _match_pairs(
    images: Sequence[ImageKeypoints], pairs: Int[Tensor, "p 2"], matches: PosedMatches, step: Callable[[], None]
) -> PosedMatches:
    """Return the matches between the keypoints of the pairs of images, of which some ``matches`` are known."""
    listed = [(i, j) for i, j in pairs.tolist()]
    left = [pair for pair in listed if pair not in matches]
    for _ in range(len(listed) - len(left)):
        step()
    new = _counted(map_tasks(epipolar_matches, ((images[i], images[j]) for i, j in left)), step)
    poses = [images[j].T_ref_camera.inverse() @ images[i].T_ref_camera for i, j in left]
    matches = matches | dict(zip(left, zip(poses, new, strict=True), strict=True))
    return {pair: matches[pair] for pair in listed}


def _link_keypoints(
    images: Sequence[ImageKeypoints], matches: PosedMatches, known: Sequence[tuple[int, int, PairMatches]] = ()
) -> TrackedKeypoints:
    """Join the matches into tracks, starting with ``known`` ones of ambiguity 0."""
    matched = [(i, j, found) for (i, j), (_, found) in matches.items()]
    label = link_tracks([*known, *matched], [len(image.keypoints) for image in images])
    return TrackedKeypoints(images, label, torch.arange(len(label)))


def _samples(seen: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> Float[Tensor, "v s 3"]:
    """Return evenly spread ``points`` that each image sees, in its camera frame (metres), or NaN if it sees too few."""
    counts = torch.bincount(seen.image, minlength=len(seen.images))
    rank = torch.arange(SAMPLED_POINTS) * counts[:, None] // SAMPLED_POINTS + (counts.cumsum(0) - counts)[:, None]
    local = seen.sightings.in_camera(points)[seen.image.argsort(stable=True)]
    samples = torch.full((*rank.shape, 3), torch.nan, dtype=local.dtype)
    enough = counts >= SAMPLED_POINTS / 4
    samples[enough] = local[rank[enough]]
    return samples


def _settled(
    images: Sequence[ImageKeypoints],
    pairs: Int[Tensor, "p 2"],
    matches: PosedMatches,
    samples: Float[Tensor, "v s 3"],
) -> list[tuple[int, int]]:
    """Return the pairs of images whose current relative pose moves the second one's ``samples`` hardly from where they were matched."""
    both = [(i, j) for i, j in pairs.tolist() if (i, j) in matches]
    if not both:
        return []
    first, second = (SE3.stack([images[i].T_ref_camera for i in part]) for part in zip(*both, strict=True))
    local = samples[[j for _, j in both]]
    change = SE3.stack([matches[pair][0] for pair in both]) @ first.inverse() @ second
    earlier = SE3(change.rotation[:, None], change.translation[:, None]).apply(local)
    away = torch.linalg.vector_norm(pinhole(earlier)[0] - pinhole(local)[0], dim=-1).median(1).values
    pixels = away * torch.tensor([images[j].focal for _, j in both], dtype=away.dtype)
    return [pair for pair, moved in zip(both, pixels.tolist(), strict=True) if moved <= SETTLED_PIXELS]


def detect_keypoints(views: Sequence[View], features: Features) -> list[ImageKeypoints]:
    """Detect the keypoints of ``views`` without matching them."""
    return [*map_tasks(image_keypoints, ((view, features) for view in views))]


def _build(
    observations: TrackedKeypoints,
    config: LandmarkConfig,
    triangulation: Triangulation,
    exact_poses: bool,
) -> LandmarkMap:
    """Return the landmarks of triangulated points, followed by landmarks from the measured depth of the remaining keypoints."""
    scatter = None if exact_poses else update_scatter(triangulation.pose_updates)
    inliers, positions = triangulation.seen, triangulation.points
    pixel_noise = noise(inliers.sightings, positions)
    triangulated = fuse_landmarks(inliers, positions, pixel_noise**2 * triangulation.covariance, pixel_noise)
    relative = keypoint_depth_noise(inliers, positions)
    left = ~torch.isin(observations.number, inliers.number)
    rest = observations[left & (_is_tracked(observations) | config.singles)]
    rest, measured, covariance = back_project(rest, relative, pixel_noise)
    landmarks = concatenate([triangulated, fuse_landmarks(rest, measured, covariance, pixel_noise)])
    if exact_poses or not len(landmarks):
        return landmarks
    if scatter is None:  # unknown: a prior assumes that each pose is as accurate as a single keypoint
        depth = torch.cat([inliers.sightings.in_camera(positions)[:, 2], rest.sightings.in_camera(measured)[:, 2]])
        angle = pixel_noise / float(torch.cat([inliers.sightings.focal, rest.sightings.focal]).median())
        scatter = MotionPrior(angle * float(depth.median()), angle).deviations.square().diag()
    return replace(landmarks, pose_covariance=scatter)


def _is_tracked(observations: TrackedKeypoints) -> Bool[Tensor, "m"]:
    """Return a mask of the keypoints whose point is observed by at least one other keypoint."""
    return torch.bincount(observations.point)[observations.point] > 1


def _triangulate(
    observations: TrackedKeypoints, config: LandmarkConfig, known: Float[Tensor, "p 3"] | None = None
) -> Triangulation:
    """Return the points that the tracked keypoints show, with at least the minimum parallax.

    If ``known`` positions are given, by number, they are used instead of triangulated ones.
    """
    observations, former = observations[_is_tracked(observations)].compact()
    count = observations.count
    covariance = torch.zeros((count, 3, 3), dtype=torch.float64)
    points = triangulate(observations.sightings, count) if known is None else known[former]
    # Observations with larger reprojection errors (pixels) leave their tracks, round by round.
    for tolerance in (10.0, 4.0, 2.0) if known is None else (2.0,):
        scale, steps = tolerance / 2, 8 if known is None else 0
        points, covariance = refine_points(observations.sightings, points, scale, steps)
        # A point needs at least two keypoints that fit it; if it has only two, both must fit to within 1.5 pixels.
        # No name for the sightings, which take much memory and would outlive those that replace them
        fits, point = fits_points(observations.sightings, points, tolerance), observations.point
        views = torch.bincount(point[fits], minlength=len(points))[point]
        fits &= (views != 2) | fits_points(observations.sightings, points, min(tolerance, 1.5))
        observations = observations[fits & (torch.bincount(point[fits], minlength=len(points)) >= 2)[point]]
    wide = parallax(observations.sightings, points) >= radians(config.parallax)
    observations, numbers = observations[wide[observations.point]].compact()
    return Triangulation(observations, points[numbers], covariance[numbers])


def _counted(results: Generator[Result, None, None], step: Callable[[], None]) -> list[Result]:
    """Return the results of tasks, and call ``step`` after each. If it raises, the tasks that wait are cancelled."""
    counted = []
    with closing(results):
        for result in results:
            step()
            counted.append(result)
    return counted


def _counter(stage: str, unit: str, total: int) -> Callable[[], None]:
    """Return a function that reports to the current job that one more of ``total`` steps is done."""
    report, done = counter(stage, unit), iter(range(total + 1))
    report(next(done), total)
    return lambda: report(next(done), total)
