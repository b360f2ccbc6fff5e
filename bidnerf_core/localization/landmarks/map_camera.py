"""The cameras of a map's own images, as an alternative to a query's stated intrinsics.

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

from bidnerf_core.camera import Intrinsics, cameras_at_size, centre_crop_cameras, stretched_cameras
from bidnerf_core.localization.landmarks.chance import log_odds_of
from bidnerf_core.mapping import (
    CALIBRATED,
    CROPPED,
    CROPS,
    MISTAKEN,
    MISTAKES,
    STRETCH_TOLERANCE,
    STRETCHED,
    USUAL,
    USUALLY,
    CalibrationPrior,
)

MAX_CAMERAS = 9
"""Maximum number of a map's cameras, evenly chosen by focal length, that are compared with the query's."""
MAX_RESIDUAL = 0.002
"""Root mean square difference, as a fraction of the image's width, above which a correction does not describe a camera."""
GRID = 7
"""Number of rows and columns of pixels at which cameras are compared."""
MAX_DEVIATIONS = 2.0
"""Multiple of the standard deviations of a prior beyond which a difference of intrinsics does not agree with it."""
SHARE_SAME_CAMERA = 0.9
"""Fraction of queries with nearly the map's intrinsics that are from the map's camera."""
OTHER_CAMERA = CalibrationPrior(
    log_focal=0.08, shift=0.03, radial=0.1, stretch=STRETCH_TOLERANCE / MAX_DEVIATIONS
)
"""Standard deviations of the differences between the intrinsics of different cameras with images of the same shape."""
RESIZED = 0.05
"""Fraction of resized images among those with another pixel aspect ratio than the map's images at their size."""


@dataclass(frozen=True, eq=False)
class MapCamera:
    """The intrinsics of a map's images, relative to a query's stated ones."""

    correction: Float[Tensor, "5"]  # of the stated intrinsics, in the order of ``Calibration``
    deviations: Float[Tensor, "5"]  # of single images of the map, errors of a good calibration included
    intrinsics: Intrinsics  # at the resolution of the query

    @property
    def differs(self) -> Bool[Tensor, "5"]:
        """Mask of the parameters that differ."""
        return self.correction.abs() > MAX_DEVIATIONS * self.deviations

    @property
    def log_odds(self) -> float:
        """Prior log odds of the map's intrinsics against the stated ones.

        The query is either from the map's camera with misstated intrinsics, or from another camera with similar intrinsics. If
        the pixel aspect ratios differ, the image was resized, or is from another camera.
        """
        if not self.is_near(STRETCHED):
            return -math.inf
        if self.is_stretched:
            return log_odds_of(RESIZED)
        shares = ((USUAL, USUALLY), (MISTAKEN, MISTAKES), (CROPPED, CROPS))
        misstated = torch.stack([self._log_density(prior) + math.log(share) for prior, share in shares])
        return float(misstated.logsumexp(0) - self._log_density(OTHER_CAMERA)) + log_odds_of(
            SHARE_SAME_CAMERA
        )

    @property
    def is_stretched(self) -> bool:
        """Whether the pixel aspect ratios differ by more than those of different cameras."""
        return abs(float(self.correction[4])) > STRETCH_TOLERANCE

    def is_near(self, prior: CalibrationPrior) -> bool:
        """Return whether the intrinsics differ by no more than ``MAX_DEVIATIONS`` standard deviations of ``prior``."""
        return bool((self.correction.abs() <= MAX_DEVIATIONS * prior.deviations).all())

    def _log_density(self, prior: CalibrationPrior) -> Float[Tensor, ""]:
        """Return the log density of the parameters that differ, except the stretch, up to a constant."""
        deviations, differs = prior.deviations[:4], self.differs[:4]
        return (-0.5 * (self.correction[:4] / deviations).square() - deviations.log())[differs].sum()


def map_cameras(given: Intrinsics, cameras: tuple[Intrinsics, ...], crops: bool = False) -> list[MapCamera]:
    """Return the map's cameras that may have taken an image with the ``given`` intrinsics.

    Among the map's cameras with images of one shape, one that agrees with the given intrinsics is chosen or, if there is none,
    the one with the median focal length. Cameras with a lens too different for ``Calibration`` are
    left out.

    A camera with only landscape images is rotated to either side for a portrait image. An image with a shape that the map does
    not have is compared with the map's images resized to it and, with ``crops``, with their centre crops.
    """
    groups = cameras_at_size(cameras, given.width, given.height)
    if not groups:
        groups = stretched_cameras(cameras, given.width, given.height)
        groups += centre_crop_cameras(cameras, given.width, given.height) if crops else ()
    known = [_camera_among(given, group) for group in groups]
    return [camera for camera in known if camera is not None]


@lru_cache(maxsize=64)
def _camera_among(given: Intrinsics, cameras: tuple[Intrinsics, ...]) -> MapCamera | None:
    """Return the camera that ``map_cameras`` chooses among ``cameras``, which all have the same image size."""
    alike = list(cameras)
    agreeing = [camera for camera in alike if _agree(given, camera)]
    alike = agreeing[:1] or alike
    alike.sort(key=lambda camera: camera.fx)
    count = min(len(alike), MAX_CAMERAS)
    chosen = [alike[i] for i in torch.linspace(0, len(alike) - 1, count).round().int().tolist()]
    found = [(correction_between(given, camera), camera) for camera in chosen]
    described = [(correction, camera) for correction, camera in found if correction is not None]
    if not described:
        return None
    correction, camera = described[(len(described) - 1) // 2]
    spread = torch.stack([(other - correction).square() for other, _ in described]).mean(0)
    return MapCamera(correction, (CALIBRATED.deviations.square() + spread).sqrt(), camera)


def _agree(a: Intrinsics, b: Intrinsics) -> bool:
    """Return whether two intrinsics differ by no more than two good calibrations of the same camera."""
    known, size = CALIBRATED, max(len(a.distortion), len(b.distortion))
    parts = [
        (math.log(a.fx / b.fx), known.log_focal), (math.log(a.fy / b.fy), known.log_focal),
        ((a.cx - b.cx) / a.fx, known.shift), ((a.cy - b.cy) / a.fy, known.shift),
    ]  # fmt: skip
    bends = (camera.distortion + (0.0,) * (size - len(camera.distortion)) for camera in (a, b))
    parts += [(x - y, known.radial) for x, y in zip(*bends, strict=True)]
    return all(abs(difference) <= MAX_DEVIATIONS * deviation for difference, deviation in parts)


def correction_between(given: Intrinsics, true: Intrinsics) -> Float[Tensor, "5"] | None:
    """Return the correction of ``given`` intrinsics, in the order of ``Calibration``, that best matches ``true`` ones.

    It minimizes the squared differences in pixels. None if these remain large.
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
    # stated = factors real + shift + factors radial bend, as in ``Calibration.pixels``
    ratio = real.new_tensor([given.fy * true.fx / (given.fx * true.fy), 1.0])
    bend = bend * (ratio / ratio.prod().sqrt())
    rows = torch.stack(
        [*(real * step for step in steps), *(step.expand_as(real) for step in steps), bend], dim=-1
    )
    rows, target = torch.linalg.solve(slope, rows), torch.linalg.solve(slope, stated[..., None])
    # The default driver pivots, and its last bits differ from call to call.
    solved = torch.linalg.lstsq(rows.reshape(-1, 5), target.reshape(-1, 1), driver="gels").solution
    left = (rows @ solved - target)[..., 0].norm(dim=-1)
    across, down, shift_u, shift_v, bent = solved[:, 0]
    if not bool(left.square().mean().sqrt() <= MAX_RESIDUAL * given.width) or min(across, down) <= 0:
        return None
    factor = (across * down).sqrt()
    return torch.stack([factor.log(), shift_u, shift_v, bent / factor, (across / down).log()])
