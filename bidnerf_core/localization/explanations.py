"""What may be true of a query: its camera, the camera's motion, and where the photo was taken, each with a prior probability.

An explanation is a Gaussian prior on the nuisances of ``states``; a seed is a pose from which all explanations are refined.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.map_camera import map_cameras
from bidnerf_core.localization.query import Query
from bidnerf_core.localization.states import N, States
from bidnerf_core.mapping import LandmarkMap

# Standard deviations of: log focal, principal point, k1, log aspect, skew; the prior probability; whether a pose under it counts
# as right.
STATED = (
    (
        "exact",
        0.0005,
        0.0005,
        0.0005,
        0.0005,
        0.0,
        0.40,
        True,
    ),  # of this very camera, as for the map's own images
    ("right", 0.005, 0.005, 0.005, 0.001, 0.0, 0.25, True),  # well calibrated
    (
        "inexact",
        0.01,
        0.01,
        0.01,
        0.001,
        0.0,
        0.27,
        True,
    ),  # of another unit of the model, or at another focus
    ("wrong", 0.1, 0.02, 0.05, 0.001, 0.0, 0.05, True),
    ("cropped", 0.01, 0.1, 0.01, 0.001, 0.0, 0.02, True),
    ("bent", 0.01, 0.01, 0.3, 0.001, 0.0, 0.01, True),  # the lens was not stated
    ("resized", 0.3, 0.15, 0.05, 0.001, 0.0, 0.003, False),
    (
        "unlike",
        0.3,
        0.3,
        0.1,
        0.1,
        0.1,
        0.001,
        False,
    ),  # warped: a photo of a picture, a stretched or sheared image
)
APPROXIMATE = (
    ("nominal", 0.2, 0.01, 0.03, 0.001, 0.0, 0.96, True),
    ("cropped", 0.2, 0.1, 0.03, 0.001, 0.0, 0.03, True),
    ("unlike", 0.3, 0.3, 0.1, 0.1, 0.1, 0.01, False),
)
"""The same for a focal length that is stated to be approximate."""
OF_MAP = (
    ("map", 0.0005, 0.0005, 0.0005, 0.0005, 0.0, 0.6),
    ("map, about", 0.005, 0.005, 0.005, 0.001, 0.0, 0.4),
)
"""The same about the camera of the map's images, with shares of its odds."""
ODDS_OF_MAP, ODDS_OF_OTHER = 0.5, 0.05
"""Prior odds that the image is from the map's camera, if the stated one is similar but different, and if it differs much."""
NEARLY = (0.002, 0.002, 0.002, 0.002, 0.001, 0.001)
"""Differences of two good calibrations of one camera."""
SIMILAR = (0.16, 0.06, 0.06, 0.2, 0.02, 0.01)
TRUST_AS_MAP = 0.1
"""Factor of the probability of wrong intrinsics if they are those of the map's images."""
SHARE_MOVING, SHARE_AS_MAP = 1 / 30, 0.8
"""Prior probability of a motion during the readout, and the same if the map's images move."""
MOVE, TURN = 0.005, 0.01
"""Motion from the first row to the last: relative to the scene's distance, and radians."""
DEPTH_SCALE = 0.01


@dataclass(frozen=True, eq=False)
class Explanations:
    """Gaussian priors on the nuisances."""

    names: tuple[str, ...]
    mean: Float[Tensor, "k N"]
    deviation: Float[Tensor, "k N"]
    log_prior: Float[Tensor, "k"]
    credible: Bool[Tensor, "k"]  # whether a pose under it counts as right

    def __len__(self) -> int:
        return len(self.names)


def explanations(query: Query, landmarks: LandmarkMap, distance: float) -> Explanations:
    """Return all explanations of the images; ``distance`` (metres) is that of the scene, for the prior of a motion.

    Images of different cameras are only compared with their stated intrinsics.
    """
    rows = []
    if query.has_one_camera:
        known = cameras_of_map(query, landmarks)
        nearly = torch.tensor(NEARLY, dtype=torch.float64)
        as_map = any(bool((c.abs() < nearly).all()) for c in known) and not query.approximate
        for name, focal, centre, k1, aspect, skew, share, credible in (
            APPROXIMATE if query.approximate else STATED
        ):
            share *= TRUST_AS_MAP if as_map and name not in ("exact", "right", "inexact") else 1
            rows.append((name, [0.0] * 6, (focal, centre, centre, k1, aspect, skew), share, credible))
        for c in known:
            if bool((c.abs() > nearly).any()):
                similar = bool((c.abs() <= torch.tensor(SIMILAR)).all())
                odds = ODDS_OF_MAP if similar else ODDS_OF_OTHER
                for name, focal, centre, k1, aspect, skew, share in OF_MAP:
                    rows.append(
                        (name, c.tolist(), (focal, centre, centre, k1, aspect, skew), share * odds, True)
                    )
    else:
        rows.append(("exact", [0.0] * 6, (0.0,) * 6, 1.0, True))
    single = len(query.images) == 1
    moving = max(SHARE_MOVING, SHARE_AS_MAP * landmarks.moving) if single else 0.0
    names, means, deviations, shares, credible = [], [], [], [], []
    for moves, share in ((False, 1 - moving), (True, moving))[: 2 if single else 1]:
        motion = [MOVE * distance] * 3 + [TURN] * 3 if moves else [0.0] * 6
        for name, mean, deviation, odds, good in rows:
            names.append(name + (" moving" if moves else ""))
            means.append([*mean, *[0.0] * 7])
            deviations.append([*deviation, *motion, DEPTH_SCALE])
            shares.append(odds * share)
            credible.append(good)
    mean, deviation, share = (torch.tensor(x, dtype=torch.float64) for x in (means, deviations, shares))
    # Landmarks of this map suggest corrections of right intrinsics, too; see ``calibration_scatter``.
    if query.has_one_camera:
        deviation[:, :4] = torch.hypot(deviation[:, :4], landmarks.calibration_scatter.double())
    return Explanations(tuple(names), mean, deviation, share.log(), torch.tensor(credible))


def cameras_of_map(query: Query, landmarks: LandmarkMap) -> list[Float[Tensor, "6"]]:
    """Return the corrections of the stated camera that make it one of those of the map's images."""
    if not query.has_one_camera:
        return []
    found = map_cameras(query.camera, landmarks.cameras, crops=query.approximate)
    return [torch.cat([camera.correction, camera.correction.new_zeros(1)]) for camera in found]


@dataclass(frozen=True, eq=False)
class Seed:
    """A pose from which to refine, found with some camera."""

    name: str
    T: SE3  # T_world_rig
    camera: Float[Tensor, "6"]
    distance: float  # metres: of the scene


def rows(seed: Seed, given: Explanations, mode: int, noise: float) -> States:
    """Return a state for each explanation, from one seed.

    With another focal length or principal point, the camera is moved along its axis and turned so that it sees about the same.
    """
    k = len(given)
    z = torch.zeros((k, N), dtype=torch.float64)
    # A deviation of 0 holds a nuisance at its mean.
    off = (seed.camera - given.mean[:, :6]) / given.deviation[:, :6].clamp(min=1e-12)
    z[:, :6] = torch.where(off.abs() <= 3, off, 0)
    change = (given.mean + given.deviation * z)[:, :6] - seed.camera
    update = torch.zeros((k, 6), dtype=torch.float64)
    update[:, 2] = seed.distance * (1 - change[:, 0].exp())
    update[:, 3], update[:, 4] = -change[:, 2], change[:, 1]
    T = SE3(seed.T.rotation.expand(k, 3, 3), seed.T.translation.expand(k, 3))
    numbers = torch.full((k,), mode, dtype=torch.long), torch.arange(k)
    states = States(
        T,
        z,
        given.mean,
        given.deviation,
        given.log_prior,
        torch.full((k,), noise, dtype=torch.float64),
        *numbers,
    )
    return states.retract(torch.cat([update, 0 * z], -1))


def tilted(points: Float[Tensor, "m 3"], T_world_camera: SE3) -> SE3:
    """Return the pose from which, to first order, the plane of ``points`` looks the same (Schweighofer and Pinz 2006).

    In the camera's frame, the points are reflected in the plane through their middle perpendicular to the line of sight. For
    coplanar points, which are their own mirror image in their plane, this is a rigid motion.
    """
    middle = points.mean(0)
    normal = torch.linalg.svd(points - middle, full_matrices=False).Vh[-1]
    T = T_world_camera.inverse()
    seen = T.apply(middle)
    eye = torch.eye(3, dtype=points.dtype)
    across, along = (eye - 2 * torch.outer(v, v) / v.square().sum() for v in (seen, normal))
    rotation = across @ T.rotation @ along
    return SE3(rotation, seen - rotation @ middle).inverse()
