"""Hypotheses about a query's camera and the camera's motion, each with a prior probability.

An explanation is a Gaussian prior on the nuisances of ``states``; a proposal is a pose from which all explanations are refined. Other
places and the mirror image are in ``modes``, each with all explanations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics, cameras_at_size
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.matching import QueryKeypoints
from bidnerf_core.mapping import MOTION, LandmarkMap, N, States

# fmt: off
STATED = (
    # log focal, centre (u and v), k1, log aspect, skew, probability, whether a pose under it counts as right
    ("exact", 0.0005, 0.0005, 0.0005, 0.0005, 0.0005, 0.0, 0.40, True),  # calibration of this very camera, as for the map's own images
    ("right", 0.005, 0.005, 0.005, 0.005, 0.001, 0.0, 0.25, True),  # well calibrated
    ("inexact", 0.01, 0.01, 0.01, 0.01, 0.001, 0.0, 0.27, True),  # calibration of another unit of the model, or at another focus
    ("wrong", 0.1, 0.02, 0.02, 0.05, 0.001, 0.0, 0.05, True),
    ("cropped", 0.01, 0.1, 0.1, 0.01, 0.001, 0.0, 0.02, True),
    ("bent", 0.01, 0.01, 0.01, 0.3, 0.001, 0.0, 0.01, True),  # the lens was not stated
    ("resized", 0.3, 0.15, 0.15, 0.05, 0.001, 0.0, 0.003, False),
    ("unlike", 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.001, False),  # a photo of a picture, a stretched or a sheared image
)
"""Hypotheses about a stated camera: standard deviations of its corrections (see ``NUISANCES``), and prior probabilities.

The more freedom an explanation gives the camera, the lower its prior. A pose is not trusted if only a camera that can explain almost any
warp of the image fits.
"""
APPROXIMATE = (
    ("nominal", 0.2, 0.01, 0.01, 0.03, 0.001, 0.0, 0.96, True),
    ("cropped", 0.2, 0.1, 0.1, 0.03, 0.001, 0.0, 0.03, True),
    ("unlike", 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.01, False),
)
"""Hypotheses about a camera whose focal length is stated to be approximate, in the columns of ``STATED``."""
# fmt: on
OF_MAP = (("map", 0.6), ("map, about", 0.4))
"""Hypotheses that the camera is one of the map's, with the deviations of the first two rows of ``STATED``, and shares of its odds."""
NEARLY = (0.002, 0.002, 0.002, 0.002, 0.001, 0.001)
"""Differences to be expected between two good calibrations of one camera, in the order of ``NUISANCES``."""
SPURIOUS_MOTION = 0.002
"""Standard deviation of the motions that landmarks suggest even of cameras at rest: translations relative to the distance of the scene,
and rotations in radians.

Photos of the doll, most of which were taken at rest, have apparent motions of 0.003, about as much as these fits are uncertain.
"""
CAMERAS = {
    "exact": "the given camera",
    "right": "the given camera (well calibrated)",
    "inexact": "the given camera (slightly off)",
    "wrong": "a differently calibrated camera",
    "cropped": "the camera of a cropped image",
    "bent": "a camera of another lens distortion",
    "resized": "the camera of a cropped and resized image",
    "unlike": "the camera of a warped image, such as a photo of a picture",
    "nominal": "a camera whose focal length is estimated",
    "map": "the map's camera",
    "map, about": "nearly the map's camera",
}
"""Descriptions of the explanations of the camera."""
USUAL = ("exact", "right", "inexact", "nominal", "map", "map, about")
"""Cameras of which the stated one, or one of the map's, is at least approximately right."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A pose from which refinement starts, and the camera with which the pose was found."""

    name: str
    T: SE3  # T_world_rig
    camera: Float[Tensor, "6"]
    distance: float  # metres, to the scene


@dataclass(frozen=True, eq=False)
class Explanations:
    """The explanations (k) of a query, as Gaussian priors on the nuisances."""

    cameras: tuple[str, ...]  # keys of ``CAMERAS``
    moves: Bool[Tensor, "k"]  # whether the camera moves during the readout
    mean: Float[Tensor, "k N"]
    deviation: Float[Tensor, "k N"]
    log_prior: Float[Tensor, "k"]
    credible: Bool[Tensor, "k"]  # whether a pose under it counts as right
    scatter: Float[Tensor, "N"]  # standard deviations of the spurious part of the nuisances

    @property
    def usual(self) -> Bool[Tensor, "k"]:
        """Mask of the explanations under which the stated camera, or one of the map's, is at least approximately right."""
        return torch.tensor([camera in USUAL for camera in self.cameras])

    @property
    def distinct(self) -> Bool[Tensor, "k"]:
        """Mask of the explanations that differ clearly from all others; if there are none, of all."""
        similar = torch.tensor([camera in ("exact", "inexact", "map") for camera in self.cameras])
        return ~similar | similar.all()

    @property
    def widest(self) -> int:
        """The index of the static explanation that leaves the camera the most freedom."""
        return int((self.deviation[:, :6].sum(-1) - self.deviation[:, 6:12].sum(-1)).argmax())

    def about(self, free: States) -> States:
        """Return one state for each explanation of each mode, with the poses of ``free`` (g) and the nuisances at their prior means."""
        k, g = len(self.cameras), len(free)
        index = torch.arange(g, device=free.z.device).repeat_interleave(k)
        row = torch.arange(k, device=free.z.device).repeat(g)
        z = free.z.new_zeros((g * k, N))
        parts = self.mean[row], self.deviation[row], self.log_prior[row]
        return States(free.T[index], z, *parts, free.noise[index], free.mode[index], row)


def explanations(
    query: QueryKeypoints, landmarks: LandmarkMap, distance: float, depth_scale: float, moving: bool = True
) -> Explanations:
    """Return all explanations of the images.

    ``distance`` (metres) is the distance of the scene, for the prior on motion; ``depth_scale`` is the relative standard deviation of the
    scale of measured depth. Images from different cameras are explained only by their stated intrinsics.
    """
    # For each explanation: its name, the mean corrections of the camera and their deviations, its probability, and whether it is credible.
    rows: list[tuple[str, list[float], list[float], float, bool]] = [("exact", [0.0] * 6, [0.0] * 6, 1.0, True)]
    if query.has_one_camera:
        known = cameras_of_map(query, landmarks)
        nearly = torch.tensor(NEARLY, dtype=torch.float64)
        as_map = any(bool((c.abs() < nearly).all()) for c in known) and not query.approximate
        # If the stated intrinsics are those of the map's images, others are a tenth as probable.
        rows = [
            (name, [0.0] * 6, deviation, share * (0.1 if as_map and name != "exact" else 1), credible)
            for name, *deviation, share, credible in (APPROXIMATE if query.approximate else STATED)
        ]
        for c in known:
            if query.approximate or bool((c.abs() > nearly).any()):
                similar = bool((c.abs() <= torch.tensor((0.16, 0.06, 0.06, 0.2, 0.02, 0.01))).all())
                # The prior odds that the image is from the map's camera depend on how much the stated one differs from it.
                odds = 0.5 if similar else 0.05
                rows += [
                    (name, c.tolist(), deviation, share * odds, True)
                    for (name, share), (_, *deviation, _, _) in zip(OF_MAP, STATED, strict=False)
                ]
    single = moving and len(query.images) == 1  # views of a rig may be from different times
    share_moving, motion = motion_prior(landmarks, distance)
    kinds = [(False, [0.0] * 6, 1 - share_moving * single), (True, motion, share_moving)]
    every = [
        (name, moves, [*c, *[0.0] * 7], [*deviation, *motion, depth_scale], share * of_kind, credible)
        for moves, motion, of_kind in kinds[: 1 + single]
        for name, c, deviation, share, credible in rows
    ]
    names, moves, means, deviations, shares, right = zip(*every, strict=True)
    mean, deviation, prior = (torch.tensor(values, dtype=torch.float64) for values in (means, deviations, shares))
    # Landmarks of this map suggest corrections even of right intrinsics, and motions even of cameras at rest.
    scatter = torch.zeros(N, dtype=torch.float64)
    if query.has_one_camera:
        scatter[:4] = landmarks.calibration_scatter
    if single:
        scatter[MOTION] = SPURIOUS_MOTION * torch.tensor([distance] * 3 + [1.0] * 3, dtype=torch.float64)
    deviation = torch.hypot(deviation, scatter)
    return Explanations(names, torch.tensor(moves), mean, deviation, prior.log(), torch.tensor(right), scatter)


def motion_prior(landmarks: LandmarkMap, distance: float) -> tuple[float, list[float]]:
    """Return the prior probability that the camera moved during the readout, and the standard deviations of that motion.

    The standard deviations are those of a motion from the first row to the last: three of translation (metres), proportional to the
    ``distance`` (metres) of the scene, and three of rotation (radians).
    """
    return max(1 / 30, 0.8 * landmarks.moving), [0.005 * distance] * 3 + [0.01] * 3


def cameras_of_map(query: QueryKeypoints, landmarks: LandmarkMap) -> list[Float[Tensor, "6"]]:
    """Return the corrections that turn the stated camera into cameras of the map's images; empty for images from several cameras.

    Among the map's cameras with images of one shape, a camera that agrees with the stated intrinsics is chosen or, if none does, the
    camera with the median focal length. A camera with only landscape images is turned to either side for a portrait image. An image of a
    shape that the map does not have is compared with the map's images resized to it and, if its focal length is approximate,
    with their centre crops.
    """
    if not query.has_one_camera:
        return []
    stated, found = query.camera, list[Float[Tensor, "6"]]()
    size = stated.width, stated.height
    groups = cameras_at_size(landmarks.cameras, *size)
    if not groups:
        groups = cameras_at_size(landmarks.cameras, *size, "stretched")
        groups += cameras_at_size(landmarks.cameras, *size, "cropped") if query.approximate else ()
    nearly = 2 * torch.tensor(NEARLY, dtype=torch.float64)
    for group in groups:
        cameras = sorted(group, key=lambda camera: camera.fx)
        # At most nine cameras, evenly chosen by focal length, are compared with the stated one.
        chosen = torch.linspace(0, len(cameras) - 1, min(len(cameras), 9)).round().int().unique().tolist()
        known = [c for i in chosen if (c := correction_between(stated, cameras[i])) is not None]
        if known:
            middle = known[(len(known) - 1) // 2]
            found.append(next((c for c in known if bool((c.abs() <= nearly).all())), middle))
    return found


@lru_cache(maxsize=256)
def correction_between(given: Intrinsics, true: Intrinsics) -> Float[Tensor, "6"] | None:
    """Return the correction of ``given`` intrinsics, in the order of ``NUISANCES``, that best reproduces the ``true`` ones.

    The correction minimizes the squared differences in pixels. Returns None if the differences remain large.
    """
    true = true.resized(given.width, given.height)
    # The cameras are compared at seven rows and columns of pixels.
    u, v = (torch.linspace(0, size, 7, dtype=torch.float64) for size in (given.width, given.height))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="ij"), dim=-1).reshape(-1, 2)
    stated, real = (camera.unproject(pixels)[:, :2] for camera in (given, true))
    steps = torch.eye(2, dtype=torch.float64)
    # Derivative of points on the plane z = 1 with respect to the given camera's pixels; its inverse converts differences
    # between such points to pixels.
    slope = torch.stack([given.unproject(pixels + step)[:, :2] - stated for step in steps], dim=-1)
    bend = real * real.square().sum(-1, keepdim=True)
    # stated = factors real + shift + factors radial bend
    ratio = real.new_tensor([given.fy * true.fx / (given.fx * true.fy), 1.0])
    bend = bend * (ratio / ratio.prod().sqrt())
    rows = torch.stack([*(real * step for step in steps), *(step.expand_as(real) for step in steps), bend], dim=-1)
    rows, target = torch.linalg.solve(slope, rows), torch.linalg.solve(slope, stated[..., None])
    # The default driver pivots, and its last bits differ from call to call.
    solved = torch.linalg.lstsq(rows.reshape(-1, 5), target.reshape(-1, 1), driver="gels").solution
    left = (rows @ solved - target)[..., 0].norm(dim=-1)
    across, down, shift_u, shift_v, bent = solved[:, 0]
    # A correction does not describe the camera if the root mean square difference exceeds this fraction of the image's width.
    if not bool(left.square().mean().sqrt() <= 0.002 * given.width) or min(across, down) <= 0:
        return None
    factor = (across * down).sqrt()
    return torch.stack([factor.log(), shift_u, shift_v, bent / factor, (across / down).log(), 0 * bent])
