"""The cameras of a map's own images, as an alternative to the intrinsics that a query states.

A query from the camera that made the map may state slightly different intrinsics, from another calibration or from the
manufacturer. The map was fitted to the intrinsics of its own images, so these are right for such a query.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics, cameras_at_size, centre_crop_cameras, stretched_cameras
from bidnerf_core.mapping.geometry.calibration import (
    CALIBRATED,
    GIVEN,
    MISTAKEN,
    MISTAKES,
    USUAL,
    USUALLY,
    Calibration,
    CalibrationPrior,
)

MOST_CAMERAS = 9
"""Largest number of a map's cameras, evenly chosen by focal length, that are compared with the query's."""
MOST_RESIDUAL = 0.002
"""Root mean square difference, as a share of the image's width, above which a correction does not describe another camera."""
UNUSUAL = 0.03
"""Share of the map's images up to which an agreeing camera is taken for an extreme of one that focuses, not for another one."""
GRID = 7
"""Rows and columns of pixels at which cameras are compared."""
DISTINGUISHABLE_DEVIATIONS = 2.0
"""Standard deviations of a good calibration by which cameras must differ to be told apart."""
SAME_CAMERA = 0.9
"""Share of queries with nearly the map's intrinsics that are from the map's camera."""
SAME_LOG_ODDS = math.log(SAME_CAMERA / (1 - SAME_CAMERA))
OTHER_CAMERA = CalibrationPrior(log_focal=0.08, shift=0.03, radial=0.1)
"""Standard deviations of the differences between the intrinsics of different cameras with images of the same shape."""
ALIKE, ALIKE_SHAPES = CalibrationPrior(log_focal=0.04, shift=0.04), 0.02
"""Largest differences between intrinsics that were estimated from an image and those of the map's camera, if it took the image."""
MOST_DEVIATIONS = 1.5
"""Intrinsics that differ by more than this multiple of ``OTHER_CAMERA``, or of ``NOMINAL`` where the focal length is
approximate, are certainly those of another camera.
"""


@dataclass(frozen=True, eq=False)
class MapCamera:
    """The intrinsics of a map's images, relative to those that a query states."""

    correction: Float[Tensor, "4"]  # of the stated intrinsics, in the order of ``Calibration``
    deviations: Float[Tensor, "4"]  # of single images of the map, errors of a good calibration included
    intrinsics: Intrinsics  # at the resolution of the query

    @property
    def differs(self) -> Bool[Tensor, "4"]:
        """Which parameters of the intrinsics differ."""
        return self.correction.abs() > DISTINGUISHABLE_DEVIATIONS * self.deviations

    @property
    def calibration(self) -> Calibration:
        """The correction of the stated intrinsics."""
        return Calibration(*self.correction.tolist())

    @property
    def log_odds(self) -> float:
        """Prior log odds that the map's intrinsics are right rather than the stated ones.

        Either the query is from the map's camera and misstates it, or it is from another camera with similar intrinsics.
        """
        if not self.is_near(OTHER_CAMERA):
            return -math.inf
        misstated = torch.logaddexp(
            self._log_density(USUAL) + math.log(USUALLY), self._log_density(MISTAKEN) + math.log(MISTAKES)
        )
        return float(misstated - self._log_density(OTHER_CAMERA)) + SAME_LOG_ODDS

    def is_near(self, prior: CalibrationPrior) -> bool:
        """Return whether the intrinsics differ by no more than ``MOST_DEVIATIONS`` standard deviations of ``prior``."""
        return bool((self.correction.abs() <= MOST_DEVIATIONS * prior.deviations).all())

    def _log_density(self, prior: CalibrationPrior) -> Float[Tensor, ""]:
        """Return the logarithm of the density of the parameters that differ, up to a constant."""
        deviations = prior.deviations
        return (-0.5 * (self.correction / deviations).square() - deviations.log())[self.differs].sum()


def map_camera(
    given: Intrinsics, cameras: tuple[Intrinsics, ...], crops: bool = False, near: Calibration = GIVEN
) -> MapCamera | None:
    """Return the camera of a map's images of the same shape as those with the ``given`` intrinsics; None if there are none.

    It is the one that the given intrinsics agree with or, if that took hardly any of the images, that with the median focal
    length. None as well if its lens is so different that ``Calibration`` cannot describe the difference.

    A camera that took landscape images alone is turned for a portrait one, to the side that puts its principal point nearest to
    that of the correction ``near``. With ``crops``, an image of a shape that the map does not have is compared with centre
    crops of the map's images.
    """
    groups = cameras_at_size(cameras, given.width, given.height)
    if crops and not groups:
        groups = centre_crop_cameras(cameras, given.width, given.height)
    known = [_camera_among(given, group) for group in groups]
    shift = torch.tensor([near.shift_u, near.shift_v], dtype=torch.float64)
    found = [camera for camera in known if camera is not None]
    return min(found, key=lambda camera: float((camera.correction[1:3] - shift).norm()), default=None)


@lru_cache(maxsize=64)
def _camera_among(given: Intrinsics, cameras: tuple[Intrinsics, ...]) -> MapCamera | None:
    """Return the one of ``cameras``, all of images of one size, that ``map_camera`` describes."""
    alike = list(cameras)
    agreeing = [camera for camera in alike if _agree(given, camera)]
    if len(agreeing) > UNUSUAL * len(alike):
        alike = agreeing[:1]
    alike.sort(key=lambda camera: camera.fx)
    count = min(len(alike), MOST_CAMERAS)
    chosen = [alike[i] for i in torch.linspace(0, len(alike) - 1, count).round().int().tolist()]
    found = [(correction_between(given, camera), camera) for camera in chosen]
    described = [(correction, camera) for correction, camera in found if correction is not None]
    if not described:
        return None
    correction, camera = described[(len(described) - 1) // 2]
    spread = torch.stack([(other - correction).square() for other, _ in described]).mean(0)
    return MapCamera(correction, (CALIBRATED.deviations.square() + spread).sqrt(), camera)


def camera_like(
    fitted: Intrinsics, cameras: tuple[Intrinsics, ...], log_focal_deviation: float = 0.0
) -> Intrinsics | None:
    """Return the camera of a map's images that resembles ``fitted`` intrinsics once resized to their image; None if none does.

    ``log_focal_deviation``: standard deviation of the logarithm of their focal length, which was estimated from a single image.
    """

    def differences(camera: Intrinsics) -> tuple[float, float, float]:
        across, down = math.log(camera.fx / fitted.fx), math.log(camera.fy / fitted.fy)
        shift = max(abs(camera.cx - fitted.cx) / fitted.fx, abs(camera.cy - fitted.cy) / fitted.fy)
        return abs(across + down) / 2, abs(across - down), shift

    limits = (max(ALIKE.log_focal, 2 * log_focal_deviation), ALIKE_SHAPES, ALIKE.shift)
    resized = [c for group in stretched_cameras(cameras, fitted.width, fitted.height) for c in group]
    alike = [c for c in resized if all(x <= y for x, y in zip(differences(c), limits, strict=True))]
    return min(alike, key=differences, default=None)


def _agree(a: Intrinsics, b: Intrinsics) -> bool:
    """Return whether two intrinsics differ by no more than two good calibrations of the same camera may."""
    known, size = CALIBRATED, max(len(a.distortion), len(b.distortion))
    parts = [
        (math.log(a.fx / b.fx), known.log_focal), (math.log(a.fy / b.fy), known.log_focal),
        ((a.cx - b.cx) / a.fx, known.shift), ((a.cy - b.cy) / a.fy, known.shift),
    ]  # fmt: skip
    bends = (camera.distortion + (0.0,) * (size - len(camera.distortion)) for camera in (a, b))
    parts += [(x - y, known.radial) for x, y in zip(*bends, strict=True)]
    return all(abs(difference) <= DISTINGUISHABLE_DEVIATIONS * deviation for difference, deviation in parts)


def correction_between(given: Intrinsics, true: Intrinsics) -> Float[Tensor, "4"] | None:
    """Return the correction of ``given`` intrinsics, in the order of ``Calibration``, that comes closest to ``true`` ones.

    It minimizes the squared differences in pixels. None if these remain considerable.
    """
    true = true.resized(given.width, given.height)
    u, v = (torch.linspace(0, size, GRID, dtype=torch.float64) for size in (given.width, given.height))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="ij"), dim=-1).reshape(-1, 2)
    stated, real = (camera.unproject(pixels)[:, :2] for camera in (given, true))
    steps = torch.eye(2, dtype=torch.float64)
    # Derivative of points on the plane z = 1 with respect to the given camera's pixels; its inverse converts differences
    # between such points to pixels.
    slope = torch.stack([given.unproject(pixels + step)[:, :2] - stated for step in steps], dim=-1)
    bend = real * real.square().sum(-1, keepdim=True)
    # stated = factor real + shift + factor radial bend, as in ``Calibration.pixels``
    rows = torch.stack([real, *(step.expand_as(real) for step in steps), bend], dim=-1)
    rows, target = torch.linalg.solve(slope, rows), torch.linalg.solve(slope, stated[..., None])
    solved = torch.linalg.lstsq(rows.reshape(-1, 4), target.reshape(-1, 1)).solution
    left = (rows @ solved - target)[..., 0].norm(dim=-1)
    factor, shift_u, shift_v, bent = solved[:, 0]
    if not bool(left.square().mean().sqrt() <= MOST_RESIDUAL * given.width) or float(factor) <= 0:
        return None
    return torch.stack([factor.log(), shift_u, shift_v, bent / factor])
