"""Proposals: poses from which refinement starts, found by sample consensus with minimal solvers under several cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.explanations import Proposal, cameras_of_map
from bidnerf_core.localization.matching import (
    OBLIQUE,
    SAMPLE,
    STRONGEST,
    LandmarkMatcher,
    Matches,
    Nearest,
    QueryKeypoints,
    log10_nfa,
)
from bidnerf_core.localization.problem import start_covariance
from bidnerf_core.mapping import LandmarkMap, States, project, rays_through

CONVINCING = -20.0
"""Log10 of the number of false alarms below which no other camera is tried."""
LEAST_AGREEING = 6
"""Minimum number of matches that must agree on a pose."""


def best_consensus(query: QueryKeypoints, landmarks: LandmarkMap, matches: Matches) -> tuple[Proposal, float] | None:
    """Return the proposal with the fewest false alarms, and log10 of their number; None without a consensus.

    The stated camera, the map's cameras and a ladder of focal lengths are tried in turn, until a proposal is convincing.
    """
    best = None
    for camera in cameras(query, landmarks):
        found = consensus(query, landmarks, matches, camera)
        if found is not None and (best is None or found[1] < best[1]):
            best = found
        if best is not None and best[1] < CONVINCING:
            break
    return best


def cameras(query: QueryKeypoints, landmarks: LandmarkMap) -> Iterator[Float[Tensor, "6"]]:
    """Yield the cameras to try, as corrections of the stated camera (see ``NUISANCES``).

    The stated camera comes first, then those of the map, then other focal lengths with the principal point in the middle.
    """
    yield torch.zeros(6, dtype=torch.float64)
    yield from cameras_of_map(query, landmarks)
    if not query.has_one_camera:
        return
    c = query.camera
    # If no consensus is convincing so far, 0.5, 0.7, 1.4 and 2 times the stated focal length are tried.
    for log_focal in (-0.35, 0.35, -0.7, 0.7):
        middle = [log_focal, (c.width / 2 - c.cx) / c.fx, (c.height / 2 - c.cy) / c.fy]
        yield torch.tensor([*middle, 0.0, 0.0, 0.0], dtype=torch.float64)


def consensus(
    query: QueryKeypoints,
    landmarks: LandmarkMap,
    matches: Matches,
    camera: Float[Tensor, "6"],
    name: str = "landmarks",
) -> tuple[Proposal, float] | None:
    """Return the pose with the most inliers under a given camera, and log10 of its number of false alarms; None if too few matches agree.

    The solvers are those of poselib, in LO-RANSAC with progressive sampling: P3P for each image (Persson and Nordberg 2018) and, for a rig,
    also the generalized P3P (Kukelova et al. 2016), which alone is unstable if the camera centres almost coincide.
    """
    still = States.known(SE3.identity(), camera)
    flat = query.sights.image[matches.keypoint]
    flat = rays_through(still, flat)[0, :, :2] if bool(camera.any()) else flat
    focal = query.focal[matches.keypoint] * math.exp(float(camera[0]))
    points, view = landmarks.positions[matches.landmark].double(), query.view[matches.keypoint]
    parts = [part for part in ((view == v).nonzero()[:, 0] for v in range(len(query.images))) if len(part) > SAMPLE]
    options = {
        "max_reproj_error": query.threshold,
        "seed": 0,
        "progressive_sampling": True,
        "min_iterations": 50,
        "max_iterations": 5_000,
        "max_prosac_iterations": 5_000,
    }
    found: list[SE3] = []
    of_view = [image.T_ref_camera for image in query.images]
    data = [
        ((flat[p] * focal[p, None]).numpy(), points[p].numpy(), poselib_camera(float(focal[p[0]]))) for p in parts
    ]  # host
    for part, (pixels, there, model) in zip(parts, data, strict=True):
        pose, _ = poselib.estimate_absolute_pose(pixels, there, model, options, {})
        found.append(from_poselib(pose).inverse() @ of_view[int(view[part[0]])].inverse())
    if len(parts) > 1:
        poses = [to_poselib(of_view[int(view[part[0]])].inverse()) for part in parts]
        all_pixels, all_points, models = (list(x) for x in zip(*data, strict=True))
        generalized = options | {"progressive_sampling": False}
        pose, _ = poselib.estimate_generalized_absolute_pose(all_pixels, all_points, poses, models, generalized, {})
        found.append(from_poselib(pose).inverse())
    scored = [(T, inliers(query, landmarks, matches, States.known(T, camera))) for T in found if bool(T.is_rigid())]
    if not scored:
        return None
    T, agreeing = max(scored, key=lambda pair: int(pair[1].sum()))
    if int(agreeing.sum()) < LEAST_AGREEING:
        return None
    distance = float(T.inverse().apply(points[agreeing]).norm(dim=-1).median())
    nfa = log10_nfa(len(matches), int(agreeing.sum()), query.by_chance)
    return Proposal(name, T, camera, distance), nfa


def landmarks_near(query: QueryKeypoints, landmarks: LandmarkMap, T: SE3, radius: float) -> Int[Tensor, "n"]:
    """Return the landmarks in view from ``T`` up to ``radius`` pixels beyond the image: at most 4,000, those that most images show."""
    views = []
    for image in query.images:
        camera = image.intrinsics
        # Slopes of 0.5 times the size would have no margin, for a principal point off the centre.
        slopes = 0.6 * torch.tensor([camera.width / camera.fx, camera.height / camera.fy]) + radius / image.focal
        views.append(landmarks.in_view(T @ image.T_ref_camera, slopes, OBLIQUE)[0])
    number = torch.cat(views).unique()
    return number[landmarks.views[number].argsort(descending=True, stable=True)[:4_000].sort().values]


def consensus_near(
    query: QueryKeypoints, landmarks: LandmarkMap, T: SE3, radius: float
) -> tuple[Proposal, Nearest, float] | None:
    """Return the best pose by matches within ``radius`` pixels of where landmarks project from ``T``, as ``consensus`` does.

    Only landmarks in view are compared, so that similar ones elsewhere make no match ambiguous. The second value is the landmarks nearest
    to each keypoint.
    """
    number = landmarks_near(query, landmarks, T, radius)
    if len(number) < 2 or len(query.view) <= SAMPLE:
        return None
    nearest = Nearest.of(query, LandmarkMatcher(landmarks[number]), STRONGEST)
    nearest = replace(nearest, landmark=number[nearest.landmark])
    camera, matches = torch.zeros(6, dtype=torch.float64), nearest.best
    near = inliers(query, landmarks, matches, States.known(T, camera), radius / query.threshold)
    proposed = consensus(query, landmarks, matches[near.nonzero()[:, 0]], camera, "start")
    return None if proposed is None else (proposed[0], nearest, proposed[1])


def proposal_at(name: str, T: SE3, landmarks: LandmarkMap) -> Proposal:
    """Return a pose found by other means: its distance is that of the landmarks in front of it, or of all if none is in front."""
    local = T.inverse().apply(landmarks.positions.double())
    front = local[local[:, 2] > 0]
    distance = float((front if len(front) else local).norm(dim=-1).median())
    return Proposal(name, T, torch.zeros(6, dtype=torch.float64), distance)


def proposals_at(
    query: QueryKeypoints, landmarks: LandmarkMap, T: SE3, extent: float, nearest: Nearest
) -> Iterator[tuple[Proposal, Nearest, float]]:
    """Yield the best pose within the errors of a start (``extent``, in metres, is the size of the scene), and the start itself."""
    start = proposal_at("start", T, landmarks)
    radius = search_radius(query.camera, start_covariance(extent), start.distance)
    proposed = None if radius is None else consensus_near(query, landmarks, T, radius)
    if proposed is not None:
        yield proposed
    yield start, nearest, 0.0


def pixel_radius(covariance: Float[Tensor, "6 6"], focal: float, distance: float) -> float:
    """Return the standard deviation (pixels) of the projection of a point at ``distance`` (metres), given the pose's ``covariance``."""
    translation, rotation = covariance.diagonal().split(3)
    return focal * math.sqrt(float(translation.mean()) / distance**2 + float(rotation.mean()))


def search_radius(camera: Intrinsics, covariance: Float[Tensor, "6 6"], distance: float) -> float | None:
    """Return the radius (pixels) of the search for landmarks at ``distance`` (metres): three standard deviations of their projections.

    Returns None if it would cover most of the image.
    """
    radius = 3.0 * pixel_radius(covariance, camera.fx, distance)
    # A radius of more than 0.4 of the diagonal would cover most of the image.
    return radius if radius <= 0.4 * math.hypot(camera.width, camera.height) else None


def inliers(
    query: QueryKeypoints, landmarks: LandmarkMap, matches: Matches, state: States, radius: float = 1.0
) -> Bool[Tensor, "m"]:
    """Return a mask of the matches that agree with a state; ``radius`` is in units of the inlier threshold."""
    keypoint = matches.keypoint
    seen = project(state, landmarks.positions[matches.landmark].double()[None], query.sights[keypoint])
    off = ((seen.image[0] - query.sights.image[keypoint]) * query.focal[keypoint, None]).norm(dim=-1)
    return (off <= radius * query.threshold) & seen.front[0]


def poselib_camera(focal: float) -> dict[str, object]:
    """Return poselib's description of a pinhole camera with its principal point at the origin."""
    return {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal, 0.0, 0.0]}


def to_poselib(T: SE3) -> poselib.CameraPose:
    """Convert a pose T_camera_world, on the CPU, to poselib's type."""
    pose = poselib.CameraPose()
    pose.R, pose.t = T.rotation.numpy(), T.translation.numpy()
    return pose


def from_poselib(pose: poselib.CameraPose) -> SE3:
    """Convert poselib's pose to T_camera_world."""
    rotation = torch.from_numpy(np.array(pose.R, dtype=np.float64))
    return SE3(rotation, torch.from_numpy(np.array(pose.t, dtype=np.float64).reshape(3)))
