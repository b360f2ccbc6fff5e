"""Validation of a map's landmarks: localize some of its own images with landmarks built without them.

The errors show how accurate poses from landmarks are in this map, and how many keypoints count as one
measurement: triangulated points, lenses, rolling shutters and the given poses all have errors that the
keypoints of an image share.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.fields import has_field
from bidnerf_core.frames import View
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3, chi_squared_quantile
from bidnerf_core.localization import (
    LANDMARK_BOUNDS,
    LandmarkAnswer,
    LandmarkMatcher,
    Loop,
    RenderedRays,
    SceneMap,
    Surface,
    rig,
    states_at,
)
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    CostTerm,
    HeldOutTrial,
    LandmarkConfig,
    LandmarkMap,
    TrackedViews,
    concatenate,
)

FREEDOM = 30.0
"""Degrees of freedom of the Student-t distribution of errors in units of their covariance: a few poses are wrong."""
ERROR_FREEDOM = 4.0
"""Degrees of freedom of the errors of poses in units of their predicted covariance.

With a factor on the covariance for each map, those of the answers on record (``answers_unchanged``) are likeliest with 3 to 4 degrees.
"""
TAILS = (HeldOutTrial.tails, 0.4)
"""Prior, as below, of the factor after which a Gaussian's 95 % ellipsoid holds 95 % of the errors."""
CORRELATION = (3.0, 1.5)
"""Prior of the number of keypoints that count as one: median over maps, and standard deviation of the logarithm.

Three maps of rendered images gave 0.3 (the errors of their landmarks are overestimated), three of photos 1 to 5.
"""
SCATTER = (0.004, 0.7)
"""Median and width, as above, of the prior of the standard deviations of spurious corrections of a camera."""
EXCESS, LEAST_EXCESS = (1.0, 1.0), 0.3
"""Prior, as above, of the factors by which the information of points and rays is overstated, and the least factor.

Images with poses to which a field was trained show smaller errors than others.
"""


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
    held_out = held_out_images(len(views))
    wanted = len(held_out)
    answers, updates = _answers(tracked, views, held_out, config, landmarks)
    if not answers:
        return replace(landmarks, trial=HeldOutTrial(wanted), correlation=CORRELATION[0])
    translation, rotation = (torch.linalg.vector_norm(part, dim=-1).quantile(0.5) for part in updates.split(3, dim=-1))
    trial = HeldOutTrial(wanted, len(answers), float(translation), float(rotation.rad2deg()))
    landmarks = replace(landmarks, trial=trial)
    matches = [len(answer.mode.matches) for answer in answers]
    if len(answers) >= 6:  # fewer do not show what is usual
        landmarks = replace(landmarks, usual_matches=float(torch.tensor(matches).float().median()))

    correlation = _most_probable(
        CORRELATION,
        lambda c: _student(updates, predicted_covariances(answers, matches, replace(landmarks, correlation=c))),
    )
    landmarks = replace(landmarks, correlation=max(correlation, 1.0))
    # Errors may be smaller than even independent keypoints explain, if the given poses are better than resection shows.
    if correlation < 1:
        errors = landmarks.pose_covariance
        share = _most_probable(
            EXCESS,
            lambda s: _student(
                updates, predicted_covariances(answers, matches, replace(landmarks, pose_covariance=s * errors))
            ),
        )
        landmarks = replace(landmarks, pose_covariance=min(share, 1.0) * errors)
    tails = factor_of_tails(updates, predicted_covariances(answers, matches, landmarks))
    factors = _factors(matches, landmarks)
    return replace(
        landmarks, trial=replace(trial, tails=tails), calibration_scatter=_calibration_scatter(answers, factors)
    )


def factor_of_tails(errors: Float[Tensor, "n 6"], covariances: Float[Tensor, "n 6 6"]) -> float:
    """Return the factor on predicted covariances after which a Gaussian's 95 % ellipsoid holds 95 % of the errors of poses."""
    from scipy.special import fdtri  # scipy.stats takes a tenth of the total import time

    # The 95 % ellipsoid of the Student-t distribution, relative to that of a Gaussian with the same matrix.
    wider = 6 * fdtri(6, ERROR_FREEDOM, 0.95) / chi_squared_quantile(0.95, 6)
    return _most_probable(TAILS, lambda factor: _student(errors, factor / wider * covariances, ERROR_FREEDOM))


def held_out_images(count: int) -> list[int]:
    """Return the numbers of the images, of ``count``, on which a map is tried.

    One image in eight is held out, evenly spread, but 24 at most. Of a small number of images, one in three is held out, up to
    eight, since fewer would leave the scatter unknown.
    """
    wanted = max(min(count // 8, 24), min(count // 3, 8))
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


def tried_field(scene: SceneMap, views: Sequence[View], trial: HeldOutTrial) -> HeldOutTrial:
    """Return the ``trial`` with what the map's field and surface show of the held-out images at their given poses.

    At a right pose, the gradient g and the Hessian H of a term that counts its independent measurements give g^T H^-1 g with a
    chi-squared distribution of six degrees of freedom; the factor by which it is larger is the excess of the term's information.
    """
    scores: dict[str, list[Tensor]] = {"points": [], "rays": []}
    differences = list[float]()
    for number in held_out_images(len(views)):
        problem = rig(scene, [View(views[number].frame, SE3.identity())], None)
        here = states_at(views[number].T_ref_camera[None])
        terms = dict[str, CostTerm]()
        if scene.surface is not None and problem.has_depth:
            points = Surface.of(problem.views, None, scene.surface, number)
            if points is not None:
                terms["points"] = points.fitted_noise(here)
        if has_field(scene.field):
            rays = RenderedRays.of(problem.views, problem.field, problem.bounds, 1024, number, steep=True)
            terms["rays"] = rays = rays.fitted(here)
            differences.append(float(rays.loss_at(here)))
        for name, term in terms.items():
            normal = term(here)
            factor, info = torch.linalg.cholesky_ex(normal.hessian[0, :6, :6])
            if not int(info):
                gradient = normal.gradient[0, :6, None]
                scores[name].append(torch.linalg.solve_triangular(factor, gradient, upper=False)[:, 0])

    def excess(name: str, usual: float) -> float:
        """Return the most probable factor; ``usual`` without images that show it."""
        some = scores[name]
        if not some:
            return usual
        eye = torch.eye(6, dtype=torch.float64).expand(len(some), 6, 6)
        factor = _most_probable(EXCESS, lambda factor: _student(torch.stack(some), factor * eye))
        return max(factor, LEAST_EXCESS)

    difference = float(torch.tensor(differences).median()) if differences else trial.difference
    return replace(trial, points=excess("points", trial.points), rays=excess("rays", trial.rays), difference=difference)


def _answers(
    tracked: TrackedViews,
    views: Sequence[View],
    held_out: Sequence[int],
    config: LandmarkConfig,
    landmarks: LandmarkMap,
) -> tuple[list[LandmarkAnswer], Float[Tensor, "n 6"]]:
    """Localize the held-out images with the landmarks of the others.

    Returns the answers that are no false alarms, and the right updates from the given poses to them. None is left out for being
    uncertain, since its error is what the trial measures. In a map of many images, ``landmarks`` that are not visible in the
    held-out images are not rebuilt.
    """
    answers, updates = list[LandmarkAnswer](), [torch.zeros((0, 6), dtype=torch.float64)]
    if not held_out:
        return answers, updates[0]
    try:
        # In larger maps, most landmarks are visible in none of the held-out images.
        if len(views) <= 200 or landmarks.tracks is None:
            landmarks = tracked.without(held_out).landmarks(config, exact_poses=True)
        else:
            seen = torch.isin(landmarks.tracks.image, torch.tensor(held_out))
            others = torch.ones(len(landmarks), dtype=torch.bool)
            others[landmarks.tracks.landmark[seen].long()] = False
            anew = tracked.of_points_in(held_out).without(held_out).landmarks(config, exact_poses=True)
            landmarks = concatenate([landmarks[others], anew])
    except InputError:  # the remaining images do not overlap
        return answers, updates[0]
    plain = replace(
        landmarks, correlation=KEYPOINTS_PER_INDEPENDENT, pose_covariance=torch.zeros_like(landmarks.pose_covariance)
    )
    matcher = LandmarkMatcher(plain)
    for number in held_out:
        T = views[number].T_ref_camera.to("cpu", torch.float64)
        view = View(views[number].frame, SE3.identity())
        # A given pose without a camera motion is compared with a pose found without one.
        features, moving = tracked.detector_of(view, number), views[number].motion is not None
        found = Loop([view], matcher, features=features, moving=moving)()
        if found is not None and LANDMARK_BOUNDS[0].keeps(found.evidence.log10_nfa):
            answers.append(found)
            updates.append((T.inverse() @ found.T_world_rig).log()[None])
    return answers, torch.cat(updates)


def _most_probable(prior: tuple[float, float], log_likelihood: Callable[[float], float]) -> float:
    """Return the most probable value of a positive number whose logarithm has a normal ``prior`` (median, standard deviation)."""
    median, width = prior
    steps = torch.linspace(-4.0, 4.0, 161, dtype=torch.float64).tolist()
    return max(
        (-0.5 * x * x + log_likelihood(median * math.exp(width * x)), median * math.exp(width * x)) for x in steps
    )[1]


def _student(errors: Float[Tensor, "n d"], covariances: Float[Tensor, "n d d"], freedom: float = FREEDOM) -> float:
    """Return the log likelihood of errors with a multivariate Student-t distribution, up to a constant."""
    factor = torch.linalg.cholesky(covariances)
    squared = torch.linalg.solve_triangular(factor, errors[..., None], upper=False).square().sum((1, 2))
    log = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -float((log + (freedom + errors.shape[1]) / 2 * (squared / freedom).log1p()).sum())


def predicted_covariances(
    answers: Sequence[LandmarkAnswer], matches: Sequence[int], landmarks: LandmarkMap
) -> Float[Tensor, "n 6 6"]:
    """Return the covariances of the answers as ``landmarks`` predict them."""
    fits = torch.stack([answer.covariance / HeldOutTrial.tails for answer in answers])
    return _factors(matches, landmarks)[:, None, None] * fits + landmarks.pose_covariance


def _factors(matches: Sequence[int], landmarks: LandmarkMap) -> Float[Tensor, "n"]:
    """Return the factors that correct the covariances of answers for the number of keypoints that count as one."""
    counts = [landmarks.correlation_of(count) / KEYPOINTS_PER_INDEPENDENT for count in matches]
    return torch.tensor(counts, dtype=torch.float64)


def _calibration_scatter(answers: Sequence[LandmarkAnswer], factors: Float[Tensor, "n"]) -> Float[Tensor, "4"]:
    """Return the standard deviations of the corrections estimated for intrinsics that are in fact correct.

    They refer to the logarithm of the focal length, the principal point (u, v; in focal lengths) and the radial
    distortion. The part explained by the uncertainty of each fit is subtracted.
    """
    widest = [found.posterior.camera_of(found.explanations.widest) for found in answers]
    apparent, noise = (torch.stack([camera[part][:4] for camera in widest]) for part in (0, 1))
    explained = factors[:, None] * noise.square()

    def scatter(number: int) -> float:
        own, known = apparent[:, number, None], explained[:, number]
        return _most_probable(SCATTER, lambda s: _student(own, (known + s * s)[:, None, None]))

    return torch.tensor([scatter(number) for number in range(4)], dtype=torch.float64)
