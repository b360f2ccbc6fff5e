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
"""Factor of the probability of other than the stated intrinsics if those are the intrinsics of the map's images."""
SHARE_MOVING, SHARE_AS_MAP = 1 / 30, 0.8
"""Prior probability of a motion during the readout, and the same if the map's images move."""
SIMILAR_TO_OTHERS = ("exact", "inexact", "map")
"""Explanations that are not tried by themselves at first."""
MOVE, TURN = 0.005, 0.01
"""Motion from the first row to the last: relative to the scene's distance, and radians."""


@dataclass(frozen=True, eq=False)
class Seed:
    """A pose from which to refine, found with some camera."""

    name: str
    T: SE3  # T_world_rig
    camera: Float[Tensor, "6"]
    distance: float  # metres: of the scene


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

    @property
    def prior_of_all(self) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Mean and deviation of a prior that fixes nothing which any explanation frees."""
        return torch.zeros(N, dtype=torch.float64), self.deviation.amax(0)

    def first(self, seed: Seed, mode: int, noise: float) -> States:
        """Return the states with which the search begins: one of each kind of camera, and the stated one in motion.

        With another focal length or principal point, the camera is moved along its axis and turned so that it sees about the same.
        """
        names = [name for name in self.names if name not in SIMILAR_TO_OTHERS and "moving" not in name]
        row = torch.tensor(
            [self.names.index(name) for name in [*names, *(n for n in self.names if n == "right moving")]]
        )
        k, mean, deviation = len(row), self.mean[row], self.deviation[row]
        z = torch.zeros((k, N), dtype=torch.float64)
        # A deviation of 0 holds a nuisance at its mean.
        off = (seed.camera - mean[:, :6]) / deviation[:, :6].clamp(min=1e-12)
        z[:, :6] = torch.where(off.abs() <= 3, off, 0)
        change = (mean + deviation * z)[:, :6] - seed.camera
        update = torch.zeros((k, 6), dtype=torch.float64)
        update[:, 2] = seed.distance * (1 - change[:, 0].exp())
        update[:, 3], update[:, 4] = -change[:, 2], change[:, 1]
        T = SE3(seed.T.rotation.expand(k, 3, 3), seed.T.translation.expand(k, 3)).retract(update)
        number = torch.full((k,), mode, dtype=torch.long)
        noises = torch.full((k,), noise, dtype=torch.float64)
        return States(T, z, mean, deviation, self.log_prior[row], noises, number, row)

    def about(self, free: States) -> States:
        """Return a state for each explanation of each mode: the poses of ``free`` (g), with the nuisances at their means."""
        k, g = len(self), len(free)
        index = torch.arange(g).repeat_interleave(k)
        row = torch.arange(k).repeat(g)
        z = torch.zeros((g * k, N), dtype=torch.float64)
        parts = self.mean[row], self.deviation[row], self.log_prior[row]
        return States(free.T[index], z, *parts, free.noise[index], free.mode[index], row)


def explanations(query: Query, landmarks: LandmarkMap, distance: float, depth_scale: float) -> Explanations:
    """Return all explanations of the images; ``distance`` (metres) is that of the scene, for the prior of a motion, and
    ``depth_scale`` the relative deviation of measured depth.

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
            share *= TRUST_AS_MAP if as_map and name != "exact" else 1
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
            deviations.append([*deviation, *motion, depth_scale])
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
