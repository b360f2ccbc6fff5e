"""The picture of an answer in a notebook: the photo, the map at the pose found, and both blended."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import has_field, render_picture
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.problem import SceneMap, origin_of

SIDE = 240
"""Longer side (pixels) of the photo and the rendering: each rendered pixel takes time."""
DOT = (0.0, 0.75, 0.43)
"""Colour of landmarks, which stand for the rendering in a map without a field."""


class Shown:
    """A map and a small copy of the photo that was localized in it."""

    def __init__(self, scene: SceneMap, frame: Frame) -> None:
        self.scene, self.frame = scene, frame.replace(depth=None).at_most(SIDE)

    def html(self, T_world_camera: SE3, intrinsics: Intrinsics | None) -> str | None:
        """Return the picture as an element of a page; None if the map cannot be rendered from the pose.

        ``intrinsics`` are those of the photo with which the pose was found, if other than the given ones.
        """
        camera = self.frame.intrinsics
        if intrinsics is not None:
            camera = intrinsics.resized(camera.width, camera.height)
        try:
            rendered = picture_at(self.scene, camera, T_world_camera.translated(-origin_of(self.scene)))
        except InputError:
            return None
        photo = self.frame.rgb.cpu()
        both = torch.cat([photo, rendered, (photo + rendered) / 2], dim=1)
        pixels = (both.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        png = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()
        title = "the photo, the map at the pose found, and both blended"
        return f'<img alt="{title}" title="{title}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def picture_at(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Return what a camera sees of a map (colours in [0, 1], on the CPU): the field or, without one, the landmarks as dots.

    The pose is in the map's own coordinates.
    """
    if has_field(scene.field):
        return render_picture(scene.field, camera, T_world_camera, scene.bounds).rgb.cpu()
    image = torch.ones((camera.height, camera.width, 3))
    if scene.landmarks is not None:
        local = (
            T_world_camera.to("cpu", torch.float64).inverse().apply(scene.landmarks.positions.cpu().double())
        )
        rows, columns, inside = camera.cells(local)
        image[rows[inside], columns[inside]] = torch.tensor(DOT)
    return image
