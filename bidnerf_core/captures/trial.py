"""Validation of a map's landmarks: localize some of its own images with landmarks built without them.

The errors show how accurate poses from landmarks are in this map, and how many keypoints count as one
measurement: triangulated points, lenses, rolling shutters and the given poses all have errors that the
keypoints of an image share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, chi_squared_quantile
from bidnerf_core.localization import HEAVY_TAILS, LandmarkAnswer, LandmarkMatcher, Loop
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    HeldOutTrial,
    LandmarkConfig,
    LandmarkMap,
    TrackedViews,
    concatenate,
)

QUANTILE = 0.9
"""Quantile at which the error model is fitted: it covers the tails, and allows one image in ten to have a
wrong pose."""
MOST_CORRELATED = 300.0
"""Largest number of keypoints that count as one measurement."""


def tried_landmarks(
    tracked: TrackedViews,
    views: Sequence[View],
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    report: Callable[[str], None] = lambda sentence: None,
) -> LandmarkMap:
    """Return the landmarks of ``views``, whose keypoints were ``tracked``, after a trial on held-out images.

    The trial sets ``correlation``, ``usual_matches``, ``calibration_scatter`` and ``trial`` of the landmarks,
    and enlarges ``pose_covariance`` if errors are larger than any ``correlation`` can explain, for instance
    because many given poses are wrong. Raises ``InputError`` if there are no landmarks.
    """
    landmarks = tracked.landmarks(config, report)
    # One in eight images is held out, evenly spread, but 24 at most. Of a small number of images, one in three is held out, up to
    # eight, since fewer would leave the scatter unknown.
    wanted = max(min(len(views) // 8, 24), min(len(views) // 3, 8))
    held_out = [int((i + 0.5) * len(views) / wanted) for i in range(wanted)]
    answers, updates = _answers(tracked, views, held_out, config, landmarks)
    if not answers:
        return replace(landmarks, trial=HeldOutTrial(wanted))
    translation, rotation = (torch.linalg.vector_norm(part, dim=-1).quantile(0.5) for part in updates.split(3, dim=-1))
    trial = HeldOutTrial(wanted, len(answers), float(translation), float(rotation.rad2deg()))
    landmarks = replace(landmarks, trial=trial)
    if len(answers) < 6:  # too few to estimate the scatter from
        return landmarks
    matches = [len(answer.mode.matches) for answer in answers]
    landmarks = replace(landmarks, usual_matches=float(torch.tensor(matches).float().median()))
    landmarks = replace(landmarks, correlation=_correlation(answers, updates, matches, landmarks))
    if landmarks.correlation > 0.99 * MOST_CORRELATED:
        unexplained = updates.square().quantile(QUANTILE, dim=0) / chi_squared_quantile(QUANTILE, 1)
        landmarks = replace(landmarks, pose_covariance=landmarks.pose_covariance + torch.diag(unexplained))
    factors = _factors(matches, landmarks)
    return replace(landmarks, calibration_scatter=_calibration_scatter(answers, factors))


def _answers(
    tracked: TrackedViews,
    views: Sequence[View],
    held_out: Sequence[int],
    config: LandmarkConfig,
    landmarks: LandmarkMap,
) -> tuple[list[LandmarkAnswer], Float[Tensor, "n 6"]]:
    """Localize the held-out images with the landmarks of the others.

    Returns the accepted answers, and the right updates from the given poses to the answers. In a map of many images,
    ``landmarks`` that are not visible in the held-out images are not rebuilt.
    """
    answers, updates = list[LandmarkAnswer](), [torch.zeros((0, 6), dtype=torch.float64)]
    if not held_out:
        return answers, updates[0]
    try:
        # In larger maps, most landmarks are visible in none of the held-out images.
        if len(views) <= 200 or landmarks.tracks is None:
            landmarks = tracked.without(held_out).landmarks(config)
        else:
            seen = torch.isin(landmarks.tracks.image, torch.tensor(held_out))
            others = torch.ones(len(landmarks), dtype=torch.bool)
            others[landmarks.tracks.landmark[seen].long()] = False
            anew = tracked.of_points_in(held_out).without(held_out).landmarks(config)
            landmarks = concatenate([landmarks[others], anew])
    except InputError:  # the remaining images do not overlap
        return answers, updates[0]
    plain = replace(landmarks, correlation=1.0, pose_covariance=torch.zeros_like(landmarks.pose_covariance))
    matcher = LandmarkMatcher(plain)
    for number in held_out:
        T = views[number].T_ref_camera.to("cpu", torch.float64)
        view = View(views[number].frame, SE3.identity())
        # A given pose without a camera motion is compared with a pose found without one.
        features, moving = tracked.detector_of(view, number), views[number].motion is not None
        found = Loop([view], matcher, features=features, moving=moving)()
        if found is not None and found.verdict.accepted:
            answers.append(found)
            updates.append((T.inverse() @ found.T_world_rig).log()[None])
    return answers, torch.cat(updates)


def _correlation(
    answers: Sequence[LandmarkAnswer],
    updates: Float[Tensor, "n 6"],
    matches: Sequence[int],
    landmarks: LandmarkMap,
) -> float:
    """Return the ``correlation`` at which the errors match the covariances predicted by the fits."""
    covariances = torch.stack([answer.covariance / HEAVY_TAILS for answer in answers])

    def are_larger(correlation: Tensor) -> Tensor:
        factors = _factors(matches, replace(landmarks, correlation=float(correlation)))
        information = torch.linalg.inv(factors[:, None, None] * covariances + landmarks.pose_covariance)
        squared = torch.einsum("ni,nij,nj->n", updates, information, updates)
        return squared.quantile(QUANTILE) > chi_squared_quantile(QUANTILE, 6)

    ones = torch.ones((), dtype=torch.float64)
    return float(_bisected(ones, MOST_CORRELATED * ones, are_larger))


def _bisected(
    low: Float[Tensor, "*n"], high: Float[Tensor, "*n"], is_above: Callable[[Tensor], Tensor]
) -> Float[Tensor, "*n"]:
    """Return the point between ``low`` and ``high`` at which ``is_above`` becomes false, found by geometric bisection."""
    for _ in range(30):
        middle = (low * high).sqrt()
        above = is_above(middle)
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    return (low * high).sqrt()


def _factors(matches: Sequence[int], landmarks: LandmarkMap) -> Float[Tensor, "n"]:
    """Return the factors that correct the covariances of answers for treating keypoints as independent."""
    return torch.tensor([landmarks.correlation_of(count) for count in matches], dtype=torch.float64)


def _calibration_scatter(answers: Sequence[LandmarkAnswer], factors: Float[Tensor, "n"]) -> Float[Tensor, "4"]:
    """Return the standard deviations of the corrections estimated for intrinsics that are in fact correct.

    They refer to the logarithm of the focal length, the principal point (u, v; in focal lengths) and the radial
    distortion. The part explained by the uncertainty of each fit is subtracted.
    """
    widest = [found.posterior.camera_of(found.explanations.widest) for found in answers]
    apparent, noise = (torch.stack([camera[part][:4] for camera in widest]) for part in (0, 1))
    explained = factors[:, None] * noise.square()
    limit = chi_squared_quantile(QUANTILE, 1)

    def are_larger(scatter: Tensor) -> Tensor:
        return (apparent.square() / (explained + scatter.square())).quantile(QUANTILE, dim=0) > limit

    ones = torch.ones(4, dtype=torch.float64)
    return _bisected(1e-5 * ones, ones, are_larger)
