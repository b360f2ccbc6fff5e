"""Pictures of a localization: the photo next to the map as rendered from the pose found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from bidnerf_core.evaluation.figures import blend, overlay, tile
from bidnerf_core.fields.rendering import render_image
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.images import reduced
from bidnerf_core.localization.problem import SceneMap

PICTURE_SIDE = 240
"""Maximum pixels on the longer side; larger photos are reduced, since each rendered pixel takes time."""


class Painter:
    """Draws overlays of one photo with renderings of a map."""

    def __init__(self, map: SceneMap, frame: Frame) -> None:
        scale = PICTURE_SIDE / max(frame.intrinsics.width, frame.intrinsics.height)
        self._map = map
        self._camera = frame.intrinsics if scale >= 1 else frame.intrinsics.scaled(scale)
        size = (self._camera.width, self._camera.height)
        self.observed: Float[Tensor, "h w 3"] = frame.rgb if scale >= 1 else reduced(frame.rgb, *size)

    def rendered(self, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
        """Render the map as the photo's camera would see it."""
        return render_image(self._map.field, self._camera, T_world_camera, self._map.bounds).rgb

    def blended(self, T_world_camera: SE3) -> UInt8[np.ndarray, "h w 3"]:
        """Return the photo blended with the rendering, with the edges of each."""
        return blend(self.observed, self.rendered(T_world_camera))

    def overlay(self, start: SE3 | None, found: SE3) -> UInt8[np.ndarray, "H W 3"]:
        """Return the photo and renderings as one picture: ``figures.overlay`` if there is a start, otherwise ``row``."""
        if start is not None:
            return overlay(self.observed, self.rendered(start), self.rendered(found))
        return self.row(self.observed, "observed", found, "rendered at the pose found")

    def row(
        self, left: Float[Tensor, "h w 3"], left_caption: str, found: SE3, caption: str
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Return an image, the rendering at the pose found, and its blend with the photo, side by side."""
        rendered = self.rendered(found)
        tiles: Sequence[tuple[object, str]] = (
            (left, left_caption),
            (rendered, caption),
            (blend(self.observed, rendered), "edges: photo green, map pink"),
        )
        return np.concatenate([tile(image, text) for image, text in tiles], axis=1)  # type: ignore[arg-type]
