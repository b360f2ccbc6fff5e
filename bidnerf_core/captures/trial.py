"""Validation of a map's landmarks: localize some of its own images with landmarks built without them.

The errors show how accurate poses from landmarks are in this map, and how many keypoints count as one
measurement: triangulated points, lenses, rolling shutters and the given poses all have errors that the
keypoints of an image share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, chi_squared_quantile
from bidnerf_core.localization import HEAVY_TAILS, Answer, LandmarkMatcher, Loop
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    USUAL_FEATURES,
    Features,
    HeldOutTrial,
    LandmarkConfig,
    LandmarkMap,
    TrackedViews,
    concatenated,
    tracked_views,
)

HELD_OUT, MOST_HELD_OUT = 8, 24
"""One in ``HELD_OUT`` images is held out, ``MOST_HELD_OUT`` in all at most."""
MANY_IMAGES = 200
"""Number of images above which most landmarks are in none of the held-out ones, which are ``MOST_HELD_OUT``."""
ENOUGH_ANSWERS = 6
"""Smallest number of localized images from which scatter is estimated."""
LARGEST_SHARE = 3
"""One in ``LARGEST_SHARE`` of few images is held out, up to ``HELD_OUT``; fewer would leave the scatter unknown."""
QUANTILE = 0.9
"""Quantile at which the error model is fitted: it covers the tails, and allows one image in ten to have a
wrong pose."""
CORRELATIONS = (1.0, 300.0)
"""Range of the number of keypoints that count as one measurement."""


@dataclass(frozen=True, eq=False)
class _Answer:
    found: Answer
    update: Float[Tensor, "6"]  # right update from the given pose to the one found

    @property
    def matches(self) -> int:
        """The number of correspondences used to refine the pose."""
        return len(self.found.mode.matches)


def build_tried_landmarks(
    views: Sequence[View],
    features: str | Features = USUAL_FEATURES,
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    report: Callable[[str], None] = lambda sentence: None,
) -> LandmarkMap:
    """Build landmarks like ``mapping.landmarks.building.build_landmarks``, and validate them: see
    ``tried_landmarks``.
    """
    return tried_landmarks(tracked_views(views, features, config), views, config, report)


def tried_landmarks(
    tracked: TrackedViews,
    views: Sequence[View],
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    report: Callable[[str], None] = lambda sentence: None,
) -> LandmarkMap:
    """Return the landmarks of ``views``, whose keypoints were ``tracked``, after a trial on held-out images.

    The trial sets ``correlation``, ``usual_matches``, ``calibration_scatter`` and ``trial`` of the landmarks,
    and enlarges ``pose_covariance`` if errors are larger than any ``correlation`` explains, for instance
    because many given poses are wrong. Raises ``InputError`` if there are no landmarks.
    """
    landmarks = tracked.landmarks(config, report)
    held_out = _held_out(len(views))
    answers = _answers(tracked, views, held_out, config, landmarks)
    landmarks = replace(landmarks, trial=_trial(answers, len(held_out)))
    if len(answers) < ENOUGH_ANSWERS:
        return landmarks
    usual = float(torch.tensor([float(answer.matches) for answer in answers]).median())
    landmarks = replace(landmarks, usual_matches=usual)
    landmarks = replace(landmarks, correlation=_correlation(answers, landmarks))
    if landmarks.correlation > 0.99 * CORRELATIONS[1]:
        landmarks = replace(landmarks, pose_covariance=landmarks.pose_covariance + _unexplained(answers))
    return replace(landmarks, calibration_scatter=_calibration_scatter(answers, landmarks))


def _held_out(count: int) -> list[int]:
    """Return the indices of the held-out images, evenly spread."""
    wanted = max(min(count // HELD_OUT, MOST_HELD_OUT), min(count // LARGEST_SHARE, HELD_OUT))
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


def _answers(
    tracked: TrackedViews,
    views: Sequence[View],
    held_out: Sequence[int],
    config: LandmarkConfig,
    landmarks: LandmarkMap,
) -> list[_Answer]:
    """Localize the held-out images by the landmarks of the others, and return the accepted answers.

    In a map of many images, those of its ``landmarks`` that the held-out images do not show are not built anew.
    """
    if not held_out:
        return []
    try:
        if len(views) <= MANY_IMAGES or landmarks.tracks is None:
            landmarks = tracked.without(held_out).landmarks(config)
        else:
            seen = torch.isin(landmarks.tracks.image, torch.tensor(held_out))
            others = torch.ones(len(landmarks), dtype=torch.bool)
            others[landmarks.tracks.landmark[seen].long()] = False
            anew = tracked.of_points_in(held_out).without(held_out).landmarks(config)
            landmarks = concatenated([landmarks[others], anew])
    except InputError:  # the rest has no overlap
        return []
    plain = replace(landmarks, correlation=1.0, pose_covariance=torch.zeros_like(landmarks.pose_covariance))
    matcher, answers = LandmarkMatcher(plain), []
    for number in held_out:
        T = views[number].T_ref_camera.to("cpu", torch.float64)
        view = View(views[number].frame, SE3.identity())
        # Poses found without a motion are compared with such poses.
        features, moving = tracked.detector_of(view, number), views[number].motion is not None
        found = Loop([view], matcher, features=features, moving=moving)()
        if found is not None and found.verdict.accepted:
            answers.append(_Answer(found, (T.inverse() @ found.T_world_rig).log()))
    return answers


def _trial(answers: Sequence[_Answer], images: int) -> HeldOutTrial:
    if not answers:
        return HeldOutTrial(images)
    updates = torch.stack([answer.update for answer in answers])
    translation, rotation = (torch.linalg.vector_norm(part, dim=-1) for part in updates.split(3, dim=-1))
    return HeldOutTrial(
        images, len(answers), float(translation.quantile(0.5)), float(rotation.rad2deg().quantile(0.5))
    )


def _correlation(answers: Sequence[_Answer], landmarks: LandmarkMap) -> float:
    """Return the ``correlation`` for which the errors are as large as the covariances of the fits predict."""
    updates = torch.stack([answer.update for answer in answers])
    covariances = torch.stack([answer.found.covariance / HEAVY_TAILS for answer in answers])
    expected = chi_squared_quantile(QUANTILE, 6)
    low, high = CORRELATIONS
    for _ in range(30):  # bisection, geometrically
        middle = (low * high) ** 0.5
        factors = _factors(answers, replace(landmarks, correlation=middle))
        information = torch.linalg.inv(factors[:, None, None] * covariances + landmarks.pose_covariance)
        squared = torch.einsum("ni,nij,nj->n", updates, information, updates)
        low, high = (middle, high) if float(squared.quantile(QUANTILE)) > expected else (low, middle)
    return (low * high) ** 0.5


def _unexplained(answers: Sequence[_Answer]) -> Float[Tensor, "6 6"]:
    """Return a diagonal covariance that would explain the answers' errors along each axis."""
    squared = torch.stack([answer.update for answer in answers]).square()
    return torch.diag(squared.quantile(QUANTILE, dim=0) / chi_squared_quantile(QUANTILE, 1))


def _factors(answers: Sequence[_Answer], landmarks: LandmarkMap) -> Float[Tensor, "n"]:
    """Return the factors that scale the covariances of answers that treat keypoints as independent."""
    return torch.tensor([landmarks.correlation_of(answer.matches) for answer in answers], dtype=torch.float64)


def _calibration_scatter(answers: Sequence[_Answer], landmarks: LandmarkMap) -> Float[Tensor, "4"]:
    """Return the standard deviations of the corrections estimated for intrinsics that are in fact right.

    The part explained by the uncertainty of each fit is subtracted.
    """
    widest = [
        found.posterior.camera_of(found.explanations.widest) for found in (each.found for each in answers)
    ]
    apparent, noise = (torch.stack([camera[part][:4] for camera in widest]) for part in (0, 1))
    explained = _factors(answers, landmarks)[:, None] * noise.square()
    low, high = torch.full((4,), 1e-5, dtype=torch.float64), torch.ones(4, dtype=torch.float64)
    for _ in range(30):
        middle = (low * high).sqrt()
        squared = apparent.square() / (explained + middle.square())
        above = squared.quantile(QUANTILE, dim=0) > chi_squared_quantile(QUANTILE, 1)
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    return (low * high).sqrt()
