"""Pinhole cameras with lens distortion, and their adaptation to images of another size.

Camera axes are OpenCV's: x right, y down, z forward. Pixel (column u, row v) of an image has its centre at
(u + 0.5, v + 0.5); intrinsics are given for that convention.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Integral, Real
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor

from bidnerf_core.camera.exif import Orientation
from bidnerf_core.devices import constant
from bidnerf_core.errors import InputError
from bidnerf_core.settings import check_hfov

LIMITS: dict[str, tuple[type, float, float, str]] = {
    "focal length": (Real, 1e-6, 1e9, "a positive number, at least 1e-06 pixels and at most 1e+09 pixels"),
    "principal point": (Real, -1e9, 1e9, "pixels near the image"),
    "size": (Integral, 1, 1_000_000, "a whole number of pixels from 1 to 1000000"),
    "coefficient": (Real, -1e6, 1e6, "coefficients of a real lens"),
}
"""Type, limits and description of each number of a camera. Beyond these limits, float32 overflows; coefficients of
rational models reach several hundred."""


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths, principal point and size in pixels; distortion in OpenCV's order (k1, k2, p1, p2[, k3 ...])."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        given: Any = self.distortion
        if isinstance(given, np.ndarray | Tensor):
            object.__setattr__(self, "distortion", tuple(number_array("distortion", given).ravel().tolist()))
        for names, what in (
            ("fx fy", "focal length"),
            ("cx cy", "principal point"),
            ("width height", "size"),
        ):
            for name in names.split():
                check_number(name if what == "size" else f"{what} {name}", getattr(self, name), *LIMITS[what])
        if not isinstance(self.distortion, tuple | list):
            raise InputError(f"distortion is a {type(self.distortion).__name__}", expected="coefficients")
        for value in self.distortion:
            check_number("distortion", value, *LIMITS["coefficient"])
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            raise InputError(f"distortion has {len(self.distortion)} coefficients", expected="0, 4, 5, 8, 12 or 14")

    @staticmethod
    def from_focal(focal: float, width: int, height: int) -> Intrinsics:
        """Return an undistorted camera with focal length ``focal`` (pixels) and its principal point at the image centre.

        Raises ``InputError`` for a focal length that no lens has.
        """
        camera = Intrinsics(focal, focal, 0.0, 0.0, width, height)
        question_focal(focal, width, height)
        if focal > 1000 * max(width, height):  # a field of view of 0.06 degrees, as of a telescope
            raise InputError(
                f"focal length is {focal} px for an image of {width}x{height}",
                expected="at most 1000 times its longer side",
            )
        return replace(camera, cx=width / 2, cy=height / 2)

    @staticmethod
    def from_hfov(degrees: float, width: int, height: int) -> Intrinsics:
        """Return an undistorted camera with a horizontal field of view of ``degrees``; see ``from_focal``."""
        check_hfov(degrees)
        check_number("width", width, *LIMITS["size"])
        return Intrinsics.from_focal(focal_length(width, math.radians(degrees)), width, height)

    @staticmethod
    def from_opencv(K: Any, distortion: Any = None, size: tuple[int, int] | None = None) -> Intrinsics:
        """Return the camera that OpenCV and ROS describe by a matrix, distortion coefficients and the image size.

        ``K`` (3 x 3) and ``distortion`` (4, 5, 8, 12 or 14 coefficients in any shape; None for an ideal lens)
        are arrays, tensors or lists, and ``size`` is (width, height) in pixels. OpenCV's first pixel has its
        centre at (0, 0), ours at (0.5, 0.5), so half a pixel is added to the principal point. Raises
        ``InputError`` if these values do not describe a camera.
        """
        matrix = number_array("K", K)
        lens = () if distortion is None else number_array("distortion", distortion).ravel().tolist()
        if matrix.size != 9:
            raise InputError(f"K has shape {matrix.shape}", expected="the 3 x 3 matrix of a camera")
        (fx, skew, cx), (zero, fy, cy), last = matrix.reshape(3, 3).tolist()
        if abs(skew) > 1e-6 * abs(fx) or zero != 0 or last != [0, 0, 1]:
            raise InputError(
                f"K is {matrix.reshape(3, 3).tolist()}",
                expected="rows (fx 0 cx), (0 fy cy), (0 0 1) in pixels",
            )
        if size is None or len(size) != 2:
            raise InputError(f"size is {size!r:.60}", expected="(width, height) of the image in pixels")
        width, height = (int(side) if side.is_integer() else side for side in number_array("size", size).tolist())
        camera = Intrinsics(fx, fy, cx + 0.5, cy + 0.5, width, height, tuple(lens) if any(lens) else ())
        question_focal(fx, width, height)
        return camera

    @property
    def pinhole(self) -> Intrinsics:
        """The camera itself: its images are not resampled."""
        return self

    @property
    def sentence(self) -> str:
        """A short description of the camera, for messages."""
        return f"fx {self.fx:.0f} px at {self.width}x{self.height}"

    def matrix(self, dtype: torch.dtype = torch.float64) -> Float[Tensor, "3 3"]:
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=dtype)

    def unproject(self, pixels: Float[Tensor, "*p 2"]) -> Float[Tensor, "*p 3"]:
        """Return the points on the plane z = 1 that appear at ``pixels`` (u, v); they are not unit vectors."""
        if self.distortion:
            pixels = self._undistort(pixels.reshape(-1, 2).double()).to(pixels.dtype).reshape(pixels.shape)
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)

    def rays(self, pixels: Float[Tensor, "*p 2"]) -> tuple[Float[Tensor, "*p 3"], Float[Tensor, "*p"]]:
        """Return the unit directions (camera frame) of the rays through ``pixels``, and the distance along each to z = 1."""
        ray = self.unproject(pixels)
        length = torch.linalg.vector_norm(ray, dim=-1)
        return ray / length[..., None], length

    def cells(self, points: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Bool[Tensor, "n"]]:
        """Return the row and column of the pixels that contain the projected points (camera frame), and which
        points are in the image.

        Row and column are 0 for points outside.
        """
        column, row = self.project(points).nan_to_num(-1.0, -1.0, -1.0).floor().unbind(-1)
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return torch.where(inside, row, 0).long(), torch.where(inside, column, 0).long(), inside

    def project(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 2"]:
        """Project points (camera frame) to pixels (u, v), which are not finite for points with z <= 0."""
        z = torch.where(points[..., 2] > 0, points[..., 2], torch.nan)
        u = points[..., 0] / z * self.fx + self.cx
        v = points[..., 1] / z * self.fy + self.cy
        pixels = torch.stack([u, v], dim=-1)
        if self.distortion:
            exact = pixels.reshape(-1, 2).double()
            pixels = distort_points(exact, *self._distortion_at(exact)).to(pixels.dtype).reshape(pixels.shape)
        return pixels

    def pixel_centres(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "h w 2"]:
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=dtype) + 0.5,
            torch.arange(self.width, dtype=dtype) + 0.5,
            indexing="ij",
        )
        return torch.stack([u, v], dim=-1)

    def scaled(self, factor: float) -> Intrinsics:
        """Return the camera of an image scaled by ``factor``."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def at_most(self, largest: int) -> Intrinsics:
        """Return the camera of the image reduced to at most ``largest`` pixels along its longer side."""
        return self.resized(*reduced_size(self.width, self.height, largest))

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the camera of the same image resampled to another size."""
        x, y = width / self.width, height / self.height
        return replace(self, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y, width=width, height=height)

    def quarter_turns(self) -> tuple[Intrinsics, ...]:
        """Return two cameras: this one turned 90 degrees to either side. Returns none for a tilted sensor (14 coefficients)."""
        return () if any(self.distortion[12:]) else tuple(self.upright(Orientation.from_exif(code)) for code in (6, 8))

    def centre_crop(self, width: int, height: int) -> Intrinsics:
        """Return the camera of the largest centre crop that has the aspect ratio of the given size, resized to that size."""
        scale = max(width / self.width, height / self.height)
        return replace(
            self,
            fx=self.fx * scale,
            fy=self.fy * scale,
            cx=width / 2 + (self.cx - self.width / 2) * scale,
            cy=height / 2 + (self.cy - self.height / 2) * scale,
            width=width,
            height=height,
        )

    def upright(self, orientation: Orientation) -> Intrinsics:
        """Return the camera of the upright image, where this camera describes the image as stored.

        Raises ``InputError`` if an image with a tilted sensor (14 distortion coefficients) would be
        transposed.
        """
        if orientation.transposes and any(self.distortion[12:]):
            raise InputError("a camera with a tilted sensor cannot be rotated", expected="an upright image")
        # These coefficients depend on the axes: tangential p1 p2 (2 3), thin prism s1 to s4 (8 to 11), tilt tau_x tau_y (12 13).
        fx, fy, cx, cy, k = self.fx, self.fy, self.cx, self.cy, self.distortion
        width, height = self.width, self.height
        if orientation.mirrors_columns:
            cx, k = width - cx, _negate(k, 3, 8, 9, 13)
        if orientation.mirrors_rows:
            cy, k = height - cy, _negate(k, 2, 10, 11, 12)
        if orientation.transposes:
            order = (0, 1, 3, 2, 4, 5, 6, 7, 10, 11, 8, 9, 12, 13)[: len(k)]
            return Intrinsics(fy, fx, cy, cx, height, width, tuple(k[index] for index in order))
        return Intrinsics(fx, fy, cx, cy, width, height, k)

    def _undistort(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Return the pixels of the same points without distortion (float64)."""
        if not len(pixels) or pixels.device.type != "cpu" or pixels.requires_grad:
            return undistort_points(pixels, *self._distortion_at(pixels), num_iters=20)
        # The same iteration, several times as fast; both agree to rounding.
        criteria = (cv2.TERM_CRITERIA_COUNT, 20, 0.0)
        flat = cv2.undistortImagePoints(
            pixels.numpy()[:, None], self.matrix().numpy(), np.array(self.distortion), None, criteria
        )
        return torch.from_numpy(flat[:, 0])

    def _distortion_at(self, points: Float[Tensor, "n 2"]) -> tuple[Tensor, Tensor]:
        """Return the camera matrix (3 3) and the distortion coefficients on the device of ``points``."""
        rows = (self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
        return constant(rows, points).reshape(3, 3), constant(tuple(self.distortion), points)


@dataclass(frozen=True, eq=False)
class CameraBatch:
    """The intrinsics of several cameras as tensors."""

    matrices: Float[Tensor, "c 3 3"]  # float64, pixels
    distortion: Float[Tensor, "c d"]  # float64, in OpenCV's order; has no columns if no lens is distorted

    @staticmethod
    def of(cameras: Sequence[Intrinsics]) -> CameraBatch:
        """Build a batch from ``cameras``; shorter coefficient lists are padded with zeros."""
        longest = max((len(camera.distortion) for camera in cameras), default=0)
        rows = [[*camera.distortion, *[0.0] * (longest - len(camera.distortion))] for camera in cameras]
        return CameraBatch(
            torch.stack([camera.matrix() for camera in cameras]), torch.tensor(rows, dtype=torch.float64)
        )

    def unproject(self, pixels: Float[Tensor, "p 2"], camera: Int[Tensor, "p"]) -> Float[Tensor, "p 3"]:
        """Return the points on the plane z = 1 that appear at ``pixels`` (u, v); ``camera`` holds the index of each pixel's camera."""
        matrix, exact = self.matrices[camera], pixels.double()
        if self.distortion.shape[1]:
            exact = undistort_points(exact[:, None], matrix, self.distortion[camera], num_iters=20)[:, 0]
        focal, middle = matrix.diagonal(dim1=1, dim2=2)[:, :2], matrix[:, :2, 2]
        return torch.cat([(exact - middle) / focal, torch.ones_like(exact[:, :1])], dim=-1).to(pixels.dtype)


def question_focal(focal: float, width: int, height: int) -> None:
    """Raise ``InputError`` for a focal length that cannot be in pixels because no lens has such a wide view.

    A focal length below a tenth of the image's longer side means a field of view of over 157 degrees; such a value, if at
    least 1, is probably in millimetres: a phone's lens has about 4.2 mm. Images of less than 240 pixels are not checked.
    """
    side = max(width, height)
    if 1 <= focal < side / 10 and side >= 240:
        angle = 2 * math.degrees(math.atan(side / 2 / focal))
        raise InputError(
            f"focal length is {focal:g} px for an image of {width}x{height}, which would see {angle:.0f} degrees: is that"
            f" millimetres? Expected pixels, usually 0.5 to 2 times the width ({0.5 * width:.0f} to {2 * width:.0f})"
        )


def number_array(name: str, given: Any) -> np.ndarray:
    """Convert an array, a tensor or lists to floats. Raises ``InputError`` for anything else, and for NaN and infinity."""
    try:
        array = np.asarray(given.detach().cpu() if isinstance(given, Tensor) else given, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {given!r:.60}", expected="an array of numbers") from error
    if not np.isfinite(array).all():
        raise InputError(f"{name} has values that are NaN or infinite", expected="finite numbers")
    return array


def check_number(what: str, value: Any, kind: type, least: float, most: float, expected: str) -> None:
    """Raise ``InputError`` unless ``value`` is a number of type ``kind`` from ``least`` to ``most``."""
    if isinstance(value, bool) or not isinstance(value, kind) or not least <= value <= most:  # type: ignore[operator]
        raise InputError(f"{what} is {value!r:.60}", expected=expected)


def _negate(distortion: tuple[float, ...], *indices: int) -> tuple[float, ...]:
    return tuple(-value if index in indices else value for index, value in enumerate(distortion))


def focal_length(pixels: int, angle: float) -> float:
    """Return the focal length (pixels) with which ``pixels`` columns or rows span ``angle`` (radians)."""
    return pixels / 2 / math.tan(angle / 2)


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes (width, height) may belong to one image at two resolutions."""
    ratio = abs((size[0] * other[1] / (size[1] * other[0])) - 1)
    smallest = min(*size, *other)
    return ratio <= 0.005 or (smallest >= 64 and ratio * smallest < 1)  # sizes are rounded when an image is resized


def reduced_size(width: int, height: int, largest: int) -> tuple[int, int]:
    """Return the size (width, height) of an image reduced to at most ``largest`` pixels along its longer side."""
    factor = min(1.0, largest / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


CameraGroup = tuple[Intrinsics, ...]
"""Cameras, some of which may have been rotated, all to the same side."""


@lru_cache(maxsize=64)
def cameras_at_size(
    cameras: CameraGroup, width: int, height: int, fit: Literal["whole", "cropped", "stretched"] = "whole"
) -> tuple[CameraGroup, ...]:
    """Return ``cameras`` resized to an image of another size, grouped by the turn applied to them.

    By default, only cameras of that aspect ratio are returned. If there are none, cameras that match after a quarter turn are
    returned in two groups, one for each side; there may be none. With another ``fit``, all are returned, centre-cropped to
    the aspect ratio or resized regardless of it; landscape cameras are turned to both sides for a portrait size, and vice versa.
    """
    size = (width, height)
    if fit == "whole":
        resized = {c: c.resized(*size) for c in set(cameras) if same_aspect((c.width, c.height), size)}
        same = tuple(resized[c] for c in cameras if c in resized)  # most maps have few cameras for all their images
        if same:
            return (same,)
        cameras = tuple(c for c in cameras if same_aspect((c.height, c.width), size))
    ways = [(c,) if (c.width - c.height) * (width - height) >= 0 else c.quarter_turns() for c in cameras]
    ways = list(filter(None, ways))
    groups = [[way[side % len(way)] for way in ways] for side in range(max(map(len, ways), default=0))]
    if fit == "stretched":
        return tuple(tuple(dict.fromkeys(c.resized(*size) for c in group)) for group in groups)
    change = Intrinsics.centre_crop if fit == "cropped" else Intrinsics.resized
    return tuple(tuple(change(c, *size) for c in group) for group in groups)
