"""Pictures of a localization: the photo next to the map rendered from the pose found, as 8-bit images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.fields import render_picture
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.io import reduced, write_file
from bidnerf_core.localization import Localization, SceneMap, Start, checked_map, origin_of, start_pose

SIDE = 240
"""Pixels on the longer side of each of many pictures, since each rendered pixel takes time, and the width to which smaller
images are enlarged, so that captions fit."""


def overlay(
    scene: SceneMap, frame: Frame, found: Localization | Start, start: Start | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return one picture of a photo, the map rendered from a pose, and both blended with the edges of each.

    ``found`` is the answer for the photo, whose corrected intrinsics are used if it has any, or a pose
    ``T_world_camera``. With a ``start``, the picture also shows the rendering from there. The photo is
    downscaled to at most 640 pixels a side, since each rendered pixel takes time. Raises ``InputError`` for arguments
    that are not a map, a frame or a pose.
    """
    scene = checked_map(scene, "overlay")
    if not isinstance(frame, Frame):
        raise InputError(
            f"frame is a {type(frame).__name__}", where="overlay", expected="a Frame, such as that of a View"
        )
    frame = frame.over(scene.bounds.background)
    if isinstance(found, Localization):
        frame, found = found.frame_as_taken(frame), found.T_world_camera
    painter, pose = Painter(scene, frame, 640), start_pose(found, "found")
    if start is not None:
        return comparison(painter.observed, painter.rendered(start_pose(start)), painter.rendered(pose))
    return painter.row(painter.observed, "observed", pose, "rendered at the pose found")


class Painter:
    """Draws overlays of one photo, of at most ``side`` pixels a side, with renderings of a map."""

    def __init__(self, map: SceneMap, frame: Frame, side: int = SIDE) -> None:
        scale = side / max(frame.intrinsics.width, frame.intrinsics.height)
        self._map = map
        self._camera = frame.intrinsics if scale >= 1 else frame.intrinsics.scaled(scale)
        size = (self._camera.width, self._camera.height)
        self.observed: Float[Tensor, "h w 3"] = frame.rgb if scale >= 1 else reduced(frame.rgb, *size)

    def rendered(self, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
        """Render the map as the photo's camera would see it."""
        T = T_world_camera.translated(-origin_of(self._map))
        return render_picture(self._map.field, self._camera, T, self._map.bounds).rgb

    def blended(self, T_world_camera: SE3) -> UInt8[np.ndarray, "h w 3"]:
        """Return the photo blended with the rendering, with the edges of each."""
        return blend(self.observed, self.rendered(T_world_camera))

    def row(
        self, left: Float[Tensor, "h w 3"], left_caption: str, found: SE3, caption: str
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Return an image, the rendering at the pose found, and its blend with the photo, side by side."""
        rendered = self.rendered(found)
        blended = blend(self.observed, rendered)
        return _grid([(left, left_caption), (rendered, caption), (blended, "edges: photo green, map pink")])


def comparison(
    observed: ArrayLike | Tensor, start: ArrayLike | Tensor, found: ArrayLike | Tensor
) -> UInt8[np.ndarray, "H W 3"]:
    """Return one picture of the observed image, the rendering at the start and the rendering at the pose found.

    Below each image is its comparison with the observed one. Images (h w 3) of one size are as for ``as_picture``.
    """
    return _grid(
        [(observed, "observed"), (start, "rendered at the start"), (found, "rendered at the pose found")],
        [
            (chequered(observed, found), "observed / found, chequered"),
            (blend(observed, start), "edges: photo green, start pink"),
            (blend(observed, found), "edges: photo green, map pink"),
        ],
    )


def _grid(*rows: Sequence[tuple[ArrayLike | Tensor, str]]) -> UInt8[np.ndarray, "H W 3"]:
    """Return rows of images with their captions as one picture."""
    return np.concatenate([np.concatenate([tile(*image) for image in row], axis=1) for row in rows], axis=0)


def as_picture(image: ArrayLike | Tensor, what: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """Convert an image (h w 3) or (h w) of floats in [0, 1] to 8 bits, clipped; NaN becomes black."""
    array = as_array(image)
    if array.ndim == 2:
        array = np.repeat(array[..., None], 3, axis=-1)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise InputError(f"expected an image (height, width, 3), got shape {array.shape}", where=what)
    if array.dtype == np.uint8:
        return array
    finite = np.nan_to_num(array.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
    return (finite.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def blend(observed: ArrayLike | Tensor, rendered: ArrayLike | Tensor) -> UInt8[np.ndarray, "h w 3"]:
    """Return the pale mean of two images, with the edges of each in its own colour; they coincide at the true pose."""
    a, b = as_picture(observed, "observed"), as_picture(rendered, "rendered")
    mixed = 0.55 * (a / 2 + b / 2) + 0.45 * 255
    for image, colour in ((b, (235, 0, 140)), (a, (0, 190, 110))):
        strength = 0.9 * edges(image)[..., None]
        mixed = mixed * (1 - strength) + strength * np.array(colour)
    return mixed.clip(0, 255).astype(np.uint8)


def chequered(
    first: ArrayLike | Tensor, second: ArrayLike | Tensor, squares: int = 6
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a chequerboard of two images; contours continue across its squares at the true pose."""
    a, b = as_picture(first, "first"), as_picture(second, "second")
    side = max(1, math.ceil(max(a.shape[:2]) / squares))
    rows, columns = np.indices(a.shape[:2]) // side
    return np.where(((rows + columns) % 2 == 0)[..., None], a, b)


def edges(image: ArrayLike | Tensor) -> Float[np.ndarray, "h w"]:
    """Return the strength of edges, 0 to 1, scaled so that the strongest tenth stands out."""
    grey = as_picture(image).astype(np.float64).mean(-1) / 255
    padded = np.pad(grey, 1, mode="edge")
    across, down = padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]
    slope = np.hypot(across, down)
    bar = max(np.quantile(slope, 0.9), 0.05)
    return ((slope - 0.7 * bar) / (0.6 * bar)).clip(0, 1)


def tile(image: ArrayLike | Tensor, caption: str) -> UInt8[np.ndarray, "H W 3"]:
    """Return the image on white, enlarged if it is small, with its caption above it."""
    picture, top, gap = Image.fromarray(as_picture(image)), 22, 6
    scale = max(1, round(SIDE / picture.width))
    picture = picture.resize((picture.width * scale, picture.height * scale), Image.Resampling.NEAREST)
    canvas = Image.new("RGB", (picture.width + gap, picture.height + top + gap), (255, 255, 255))
    draw, corner = ImageDraw.Draw(canvas), (gap // 2 + picture.width, top + picture.height)
    draw.text((gap, 4), caption, fill=(30, 34, 42), font=ImageFont.load_default(13))
    canvas.paste(picture, (gap // 2, top))
    draw.rectangle((gap // 2 - 1, top - 1, *corner), outline=(214, 216, 220))
    return np.asarray(canvas)


def as_array(values: ArrayLike | Tensor) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def save_gif(path: str | Path, frames: Sequence[ArrayLike | Tensor], fps: float = 8.0) -> None:
    """Write a looping animation of images (h w 3) of the same size."""
    if not (math.isfinite(fps) and fps > 0):
        raise InputError(f"{fps} frames a second", where=path, expected="a positive number")
    pictures = [as_picture(frame, f"frame {i}") for i, frame in enumerate(frames)]
    if not pictures:
        raise InputError("the animation has no frames", where=path)
    for number, shape in enumerate(picture.shape for picture in pictures):
        if shape != pictures[0].shape:
            found, expected = (f"{width}x{height}" for height, width, _ in (shape, pictures[0].shape))
            raise InputError(
                f"frame {number} is {found} pixels", where=path, expected=f"{expected} like the first"
            )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    import imageio.v3 as iio  # imported here, since few commands draw

    content = iio.imwrite("<bytes>", np.stack(pictures), extension=".gif", duration=1000 / fps, loop=0)
    write_file(Path(path), bytes(content))
