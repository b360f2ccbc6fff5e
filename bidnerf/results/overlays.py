"""Pictures of localizations, as 8-bit images: a photo next to the map rendered at the estimated pose."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.fields import render_picture
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.io import reduce_image
from bidnerf_core.localization import Localization, SceneMap
from bidnerf_core.maps import Start, origin_of, scene_of, start_pose

PICTURE_SIDE = 240
"""Pixels along the longer side of pictures drawn in large numbers, since each rendered pixel takes time; also the width
to which smaller images are enlarged, so that captions fit."""


def overlay(
    scene: SceneMap, frame: Frame, pose: Localization | Start, start: Start | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return one picture of a photo, the map rendered from a pose, and both blended with the edges of each.

    ``pose`` is a pose ``T_world_camera``, or the localization of the photo, whose corrected intrinsics are used if
    it has any. If ``start`` is given, a second row shows the map rendered from that pose. The photo is
    downscaled to at most 640 pixels a side, since each rendered pixel takes time. Raises ``InputError`` for arguments
    that are not a map, a frame or a pose.
    """
    scene = scene_of(scene, "overlay")
    if not isinstance(frame, Frame):
        raise InputError(
            f"frame is a {type(frame).__name__}", where="overlay", expected="a Frame, such as that of a View"
        )
    frame, caption = frame.over(scene.bounds.background), "rendered at the pose found"
    if isinstance(pose, Localization):
        caption = caption if pose.converged else f"refused: {pose.outcome.value}"
        frame, pose = pose.frame_as_taken(frame), pose.T_world_camera
    painter = Painter(scene, frame, 640)
    T = start_pose(pose, "pose")
    rows = [painter.row(painter.observed, "observed", T, caption if T.is_finite else "no pose was found")]
    if start is not None:
        rows.append(painter.row(painter.observed, "observed", start_pose(start), "rendered at the start"))
    return np.concatenate(rows, axis=0)


class Painter:
    """Draws overlays of one photo, downscaled to at most ``side`` pixels a side, with renderings of a map."""

    def __init__(self, map: SceneMap, frame: Frame, side: int = PICTURE_SIDE) -> None:
        scale = side / max(frame.intrinsics.width, frame.intrinsics.height)
        self._map = map
        self._camera = frame.intrinsics if scale >= 1 else frame.intrinsics.scaled(scale)
        size = (self._camera.width, self._camera.height)
        self.observed: Float[Tensor, "h w 3"] = frame.rgb if scale >= 1 else reduce_image(frame.rgb, *size)

    def render(self, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
        """Render the map with the photo's camera at a pose; the picture is white if the pose is unknown."""
        if not T_world_camera.is_finite:
            return torch.ones_like(self.observed)
        T = T_world_camera.translated(-origin_of(self._map))
        return render_picture(self._map.field, self._camera, T, self._map.bounds).rgb

    def row(
        self, left: Float[Tensor, "h w 3"], left_caption: str, T_world_camera: SE3, caption: str
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Return ``left``, the rendering at a pose, and the blend of photo and rendering, side by side."""
        rendered = self.render(T_world_camera)
        blended = blend(self.observed, rendered)
        tiles = ((left, left_caption), (rendered, caption), (blended, "edges: photo green, map pink"))
        return np.concatenate([tile(*each) for each in tiles], axis=1)


def as_picture(image: ArrayLike | Tensor, what: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """Convert an image (h w 3) or (h w) of floats in [0, 1] to 8 bits, clipped; NaN becomes black."""
    array = image.detach().cpu().numpy() if isinstance(image, Tensor) else np.asarray(image)
    if array.ndim == 2:
        array = np.repeat(array[..., None], 3, axis=-1)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise InputError(f"expected an image (height, width, 3), got shape {array.shape}", where=what)
    if array.dtype == np.uint8:
        return array
    finite = np.nan_to_num(array.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
    return (finite.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def blend(observed: ArrayLike | Tensor, rendered: ArrayLike | Tensor) -> UInt8[np.ndarray, "h w 3"]:
    """Return a pale blend of two images, with the edges of each in a separate colour; at the true pose, the edges coincide."""
    a, b = as_picture(observed, "observed"), as_picture(rendered, "rendered")
    mixed = 0.55 * (a / 2 + b / 2) + 0.45 * 255
    for image, colour in ((b, (235, 0, 140)), (a, (0, 190, 110))):
        strength = 0.9 * edges(image)[..., None]
        mixed = mixed * (1 - strength) + strength * np.array(colour)
    return mixed.clip(0, 255).astype(np.uint8)


def edges(image: ArrayLike | Tensor) -> Float[np.ndarray, "h w"]:
    """Return the edge strength of each pixel, 0 to 1, scaled so that the strongest tenth stands out."""
    grey = as_picture(image).astype(np.float64).mean(-1) / 255
    padded = np.pad(grey, 1, mode="edge")
    slope = np.hypot(padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1])
    bar = max(np.quantile(slope, 0.9), 0.05)
    return ((slope - 0.7 * bar) / (0.6 * bar)).clip(0, 1)


def tile(image: ArrayLike | Tensor, caption: str) -> UInt8[np.ndarray, "H W 3"]:
    """Return the image on white, enlarged if it is small, with its caption above it."""
    picture, top, gap = Image.fromarray(as_picture(image)), 22, 6
    scale = max(1, round(PICTURE_SIDE / picture.width))
    picture = picture.resize((picture.width * scale, picture.height * scale), Image.Resampling.NEAREST)
    canvas = Image.new("RGB", (picture.width + gap, picture.height + top + gap), (255, 255, 255))
    draw, corner = ImageDraw.Draw(canvas), (gap // 2 + picture.width, top + picture.height)
    draw.text((gap, 4), caption, fill=(30, 34, 42), font=ImageFont.load_default(13))
    canvas.paste(picture, (gap // 2, top))
    draw.rectangle((gap // 2 - 1, top - 1, *corner), outline=(214, 216, 220))
    return np.asarray(canvas)
