"""COLMAP's camera models (https://colmap.github.io/cameras.html), whose pixel centres are at +0.5, like ours.

Perspective models are ``Intrinsics``. Images of the other models are resampled to pinhole cameras on reading: fisheye and
division lenses become one pinhole camera each, panoramas (equirectangular images) six, see ``PANORAMA_FACES``. The
four-coefficient fisheye model is OpenCV's (Kannala and Brandt 2006).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, TypeAlias

import cv2
import numpy as np
import torch
from jaxtyping import Float

from bidnerf_core.camera.exif import UPRIGHT, Orientation
from bidnerf_core.camera.intrinsics import LIMITS, Intrinsics, check_number, same_aspect
from bidnerf_core.errors import InputError, errors_in

WIDEST = math.radians(60)
"""Largest angle (radians) between the optical axis and the middle of a side of an undistorted image: beyond this
angle, pixels are stretched too much."""
PERSPECTIVE, FISHEYE, DIVISION, PANORAMA = "PERSPECTIVE", "OPENCV_FISHEYE", "DIVISION", "EQUIRECTANGULAR"
MODELS: dict[str, tuple[int, str, tuple[int, ...]]] = {
    # The id in ``cameras.bin``, our kind of model, and the indices of fx, fy, cx, cy and the coefficients (in OpenCV's
    # order) among the parameters; -1 means a coefficient of 0.
    "SIMPLE_PINHOLE": (0, PERSPECTIVE, (0, 0, 1, 2)),
    "PINHOLE": (1, PERSPECTIVE, (0, 1, 2, 3)),
    "SIMPLE_RADIAL": (2, PERSPECTIVE, (0, 0, 1, 2, 3, -1, -1, -1)),
    "RADIAL": (3, PERSPECTIVE, (0, 0, 1, 2, 3, 4, -1, -1)),
    "OPENCV": (4, PERSPECTIVE, (0, 1, 2, 3, 4, 5, 6, 7)),
    "FULL_OPENCV": (6, PERSPECTIVE, (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11)),
    "OPENCV_FISHEYE": (5, FISHEYE, (0, 1, 2, 3, 4, 5, 6, 7)),
    "SIMPLE_RADIAL_FISHEYE": (8, FISHEYE, (0, 0, 1, 2, 3, -1, -1, -1)),
    "RADIAL_FISHEYE": (9, FISHEYE, (0, 0, 1, 2, 3, 4, -1, -1)),
    "SIMPLE_FISHEYE": (14, FISHEYE, (0, 0, 1, 2, -1, -1, -1, -1)),
    "FISHEYE": (15, FISHEYE, (0, 1, 2, 3, -1, -1, -1, -1)),
    "SIMPLE_DIVISION": (12, DIVISION, (0, 0, 1, 2, 3)),
    "DIVISION": (13, DIVISION, (0, 1, 2, 3, 4)),
    PANORAMA: (17, PANORAMA, (0, 1)),
}
"""COLMAP's models by name; a panorama has its size as parameters."""
PANORAMA_FACES = {  # name: yaw to the right and pitch upwards, degrees
    "front": (0, 0),
    "right": (90, 0),
    "back": (180, 0),
    "left": (270, 0),
    "up": (0, 90),
    "down": (0, -90),
}
"""The pinhole views, of 90 degrees each, into which a panorama is divided: the faces of a cube."""


class Lens(ABC):
    """A camera whose images are resampled on reading to a ``pinhole`` camera at the same position, which may be rotated.

    Images are upright by the time they are resampled. The lens parameters refer to the stored image, which
    ``orientation`` turns upright.
    """

    stored_size: tuple[int, int]  # width and height of the stored image in pixels
    orientation: Orientation
    wraps: ClassVar[bool] = False  # whether the left and right edges of the image are joined

    @property
    def width(self) -> int:
        """Width of the upright image in pixels."""
        return self.orientation.upright_size(*self.stored_size)[0]

    @property
    def height(self) -> int:
        """Height of the upright image in pixels."""
        return self.orientation.upright_size(*self.stored_size)[1]

    @abstractmethod
    def resized(self, width: int, height: int) -> Lens:
        """Return the lens of the same upright image resampled to another size."""

    @abstractmethod
    def upright(self, orientation: Orientation) -> Lens:
        """Return the lens of the upright image, where this lens describes the image as stored."""

    @property
    @abstractmethod
    def flat(self) -> Intrinsics:
        """The pinhole camera of the resampled image before it is turned upright."""

    @property
    def pinhole(self) -> Intrinsics:
        """The pinhole camera of the resampled upright image."""
        return self.flat.upright(self.orientation)

    @abstractmethod
    def project(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Return the pixels (u, v) of the stored image that show points of the plane z = 1 of the pinhole camera."""

    def resample(self, image: np.ndarray, nearest: bool = False) -> np.ndarray:
        """Resample an upright image (h, w) or (h, w, c) to the ``pinhole`` camera.

        Values are interpolated, and replicated beyond the borders. With ``nearest``, the nearest pixel's value
        is taken, and 0 beyond the borders, if the lens has any.
        """
        u, v = _lookup(self)
        method = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        border = cv2.BORDER_CONSTANT if nearest and not self.wraps else cv2.BORDER_REPLICATE
        if self.wraps:
            image, u = cv2.copyMakeBorder(image, 0, 0, 1, 1, cv2.BORDER_WRAP), u + 1
        resampled: np.ndarray = cv2.remap(image, u, v, method, borderMode=border)
        return resampled

    def unseen(self) -> np.ndarray:
        """Return a mask of the pixels of the resampled image that the lens did not see."""
        u, v = _lookup(self)
        return ~((u >= -0.5) & (u <= self.width - 0.5) & (v >= -0.5) & (v <= self.height - 0.5))

    @property
    @abstractmethod
    def sentence(self) -> str:
        """A description, for messages, of what is done with the image."""


Camera: TypeAlias = Intrinsics | Lens


@dataclass(frozen=True)
class CentralLens(Lens):
    """A fisheye or division lens."""

    model: str  # its name among ``MODELS``
    stored: Intrinsics  # focal lengths, principal point and size of the image as stored
    coefficients: tuple[float, ...]
    orientation: Orientation = UPRIGHT

    def __post_init__(self) -> None:
        for value in self.coefficients:
            check_number(f"a coefficient of {self.model}", value, *LIMITS["coefficient"])
        if not all(map(math.isfinite, self._angles)):
            raise InputError(
                f"{self.model} with coefficients {self.coefficients} maps no ray to a side of its image",
                expected="coefficients of a real lens",
            )

    @property
    def stored_size(self) -> tuple[int, int]:  # type: ignore[override]
        return self.stored.width, self.stored.height

    def resized(self, width: int, height: int) -> CentralLens:
        # A transposition is its own inverse.
        return replace(self, stored=self.stored.resized(*self.orientation.upright_size(width, height)))

    def upright(self, orientation: Orientation) -> CentralLens:
        return replace(self, orientation=orientation)

    @property
    def flat(self) -> Intrinsics:
        """A pinhole camera of the same focal length.

        Its view extends to each side as far as that of the lens in the middle of that side, but at most 60 degrees from the axis.
        """
        left, right, top, bottom = (math.tan(min(angle, WIDEST)) for angle in self._angles)
        fx, fy = self.stored.fx, self.stored.fy
        size = math.ceil(fx * (left + right)), math.ceil(fy * (top + bottom))
        return Intrinsics(fx, fy, fx * left, fy * top, *size)

    @property
    def _angles(self) -> tuple[float, ...]:
        """Angles (radians) from the axis to the left, right, top and bottom sides; NaN if no ray meets a side."""
        c = self.stored
        sides = (c.cx / c.fx, (c.width - c.cx) / c.fx, c.cy / c.fy, (c.height - c.cy) / c.fy)
        return tuple(self._angle(radius) for radius in sides)

    def _angle(self, radius: float) -> float:
        """Return the angle of the rays that meet the image at ``radius`` (in focal lengths) from the principal point."""
        if radius <= 0:
            return math.nan
        if MODELS[self.model][1] == DIVISION:
            stretch = 1 + self.coefficients[0] * radius**2
            return math.atan(radius / stretch) if stretch > 0 else WIDEST
        angles = np.linspace(0, math.pi, 2049)
        radii = self._fisheye_radius(angles)
        falling = np.diff(radii) <= 0
        rising = int(falling.argmax()) if falling.any() else len(radii) - 1
        return float(np.interp(radius, radii[: rising + 1], angles[: rising + 1])) if rising else math.nan

    def _fisheye_radius(self, angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        k1, k2, k3, k4 = self.coefficients
        squared = angle * angle
        return angle * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))

    def project(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        radius = np.linalg.norm(points, axis=-1)
        if MODELS[self.model][1] == DIVISION:
            # The smaller root of k r d^2 - d + r = 0, where d is the distorted radius
            inside = 1 - 4 * self.coefficients[0] * radius * radius
            ratio = np.where(inside >= 0, 2 / (1 + np.sqrt(np.maximum(inside, 0))), np.nan)
        else:
            ratio = self._fisheye_radius(np.arctan(radius)) / np.maximum(radius, 1e-12)
            ratio = np.where(radius > 1e-9, ratio, 1.0)
        c = self.stored
        pixels: np.ndarray = points * ratio[..., None] * (c.fx, c.fy) + (c.cx, c.cy)
        return pixels

    @property
    def sentence(self) -> str:
        flat = self.pinhole
        return f"{self.model} undistorted to a pinhole camera of {flat.width}x{flat.height}, fx {flat.fx:.0f} px"


@dataclass(frozen=True)
class PanoramaFace(Lens):
    """One of the ``PANORAMA_FACES`` of an equirectangular image, whose middle is straight ahead of the panorama's camera."""

    face: str
    stored_size: tuple[int, int]
    orientation: Orientation = UPRIGHT
    wraps: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not same_aspect(self.stored_size, (2, 1)):
            raise InputError(
                f"an equirectangular image is {'x'.join(map(str, self.stored_size))}",
                expected="twice as many columns as rows",
            )

    def resized(self, width: int, height: int) -> PanoramaFace:
        return replace(self, stored_size=(width, height))

    def upright(self, orientation: Orientation) -> PanoramaFace:
        if orientation != UPRIGHT:
            raise InputError("an equirectangular image cannot be rotated", expected="an upright one")
        return self

    @property
    def flat(self) -> Intrinsics:
        """A camera with a 90 degree field of view and the panorama's resolution at the horizon."""
        focal = self.stored_size[0] / (2 * math.pi)
        side = max(1, round(2 * focal))
        return Intrinsics(side / 2, side / 2, side / 2, side / 2, side, side)

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The axes of the face in the frame of the panorama's camera: R_panorama_face, OpenCV axes."""
        yaw, pitch = map(math.radians, PANORAMA_FACES[self.face])
        turn = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
        tilt = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
        return turn @ tilt

    def project(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        x, y, z = np.moveaxis(np.concatenate([points, np.ones_like(points[..., :1])], axis=-1) @ self.rotation.T, -1, 0)
        longitude, latitude = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))  # downwards
        return np.stack([longitude / (2 * math.pi) + 0.5, latitude / math.pi + 0.5], axis=-1) * self.stored_size

    @property
    def sentence(self) -> str:
        flat = self.pinhole
        return (
            f"the {self.face} face of an equirectangular image, as a pinhole camera of"
            f" {flat.width}x{flat.height}, 90 degrees"
        )


@lru_cache(maxsize=2)
def _lookup(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Return the column and row (OpenCV pixel convention) of the upright image that each resampled pixel shows."""
    flat, turn = lens.flat, lens.orientation
    columns, rows = (np.arange(size) + 0.5 for size in (flat.width, flat.height))
    points = np.stack(np.meshgrid((columns - flat.cx) / flat.fx, (rows - flat.cy) / flat.fy), axis=-1)
    u, v = np.moveaxis(lens.project(points), -1, 0)
    u = lens.stored_size[0] - u if turn.mirrors_columns else u
    v = lens.stored_size[1] - v if turn.mirrors_rows else v
    u, v = (turn.upright(torch.from_numpy(np.ascontiguousarray(part))).numpy() for part in (u, v))
    if turn.transposes:
        u, v = v, u
    maps = [np.ascontiguousarray(np.nan_to_num(part - 0.5, nan=-9.0), dtype=np.float32) for part in (u, v)]
    return maps[0], maps[1]


def colmap_camera(where: str, model: str, width: int, height: int, parameters: Sequence[float]) -> Camera:
    """Build a camera from one of ``MODELS``, its size (pixels) and its parameters in COLMAP's order.

    A panorama becomes its front face. Raises ``InputError``, whose message begins with ``where``, if the number of
    parameters is wrong or a value is invalid.
    """
    _, kind, indices = MODELS[model]
    with errors_in(where):
        if len(parameters) != max(indices) + 1:
            raise InputError(f"{model} has {len(parameters)} parameters", expected=max(indices) + 1)
        if kind == PANORAMA:
            return PanoramaFace("front", (width, height))
        fx, fy, cx, cy, *rest = (0.0 if index < 0 else float(parameters[index]) for index in indices)
        if kind == PERSPECTIVE:
            return Intrinsics(fx, fy, cx, cy, width, height, tuple(rest) if any(rest) else ())
        return CentralLens(model, Intrinsics(fx, fy, cx, cy, width, height), tuple(rest))


def colmap_model(camera: Camera) -> tuple[str, list[float]]:
    """Return the name and parameters of the simplest COLMAP model that describes a camera.

    Raises ``InputError`` for thin prism distortion or a tilted sensor, which no COLMAP model has, and for a panorama.
    """
    if isinstance(camera, CentralLens):
        c, kind = camera.stored, MODELS[camera.model][1]
        return kind, [c.fx, c.fy, c.cx, c.cy, *camera.coefficients]
    if not isinstance(camera, Intrinsics):
        raise InputError("the camera is that of a panorama", expected="pinhole views cut from it, and their camera")
    k = camera.distortion
    if any(k[8:]):
        raise InputError(
            "a camera with thin prism distortion or a tilted sensor", expected="one that a COLMAP model describes"
        )
    model, count = ("PINHOLE", 0) if not any(k) else ("OPENCV", 4) if not any(k[4:]) else ("FULL_OPENCV", 8)
    return model, [camera.fx, camera.fy, camera.cx, camera.cy, *(*k, *[0.0] * 8)[:count]]
