"""The picture of an answer in a notebook: the photo, the map rendered at the estimated pose, and a blend of both."""

from __future__ import annotations

import base64
import weakref
from collections.abc import Callable

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
from bidnerf_core.localization.result import Localization


def shown_in(scene: SceneMap, frame: Frame) -> Callable[[Localization], str]:
    """Return a function that renders an answer to a frame as an HTML element, and holds only a small copy of the photo.

    The function does not keep the map in memory. It returns "" once the map is gone, if the map does not support weak references, or
    if the map cannot be rendered from the pose.
    """
    # At most 240 pixels along the longer side, since each rendered pixel takes time.
    small = frame.replace(depth=None).at_most(240)
    stated = small.intrinsics
    photo = cv2.imencode(".png", np.ascontiguousarray(small.rgb_bytes.cpu().numpy()))[1]
    try:
        reference: Callable[[], SceneMap | None] = weakref.ref(scene)
    except TypeError:  # a class with slots
        return lambda found: ""

    def shown(found: Localization) -> str:
        scene, camera = reference(), stated
        if scene is None:
            return ""
        if found.intrinsics is not None:
            camera = found.intrinsics.resized(camera.width, camera.height)
        try:
            rendered = picture_at(scene, camera, found.T_world_camera.translated(-origin_of(scene)))
        except InputError:
            return ""
        rgb = torch.from_numpy(cv2.imdecode(photo, cv2.IMREAD_COLOR)) / 255
        both = torch.cat([rgb, rendered, (rgb + rendered) / 2], dim=1)
        pixels = (both.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        png = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()
        title = "the photo, the map at the pose found, and both blended"
        return f'<img alt="{title}" title="{title}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'

    return shown


def picture_at(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Return the image of a map from a camera (colours in [0, 1], on the CPU): the field or, without a field, the landmarks as dots.

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
        # Green dots stand for the rendering in a map without a field.
        image[rows[inside], columns[inside]] = torch.tensor((0.0, 0.75, 0.43))
    return image
