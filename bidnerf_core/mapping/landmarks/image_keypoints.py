"""The keypoints of an image whose camera has a pose: detection, rays, and measured depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera import AT_REST, Intrinsics, exposure_times
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.landmarks.features import Features, Keypoints, detected


@dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """The keypoints of a view, as undistorted rays, and the pose of its camera: in the world, or in the frame of a rig."""

    keypoints: Keypoints
    rays: Float[Tensor, "n 3"]  # on the plane z = 1 of the camera, float64
    depth: Float[Tensor, "n"]  # metres, 0 where none was measured
    intrinsics: Intrinsics
    T_ref_camera: SE3  # float64; of the middle row
    motion: Float[Tensor, "6"] = AT_REST  # during the readout; epipolar lines ignore it
    hidden: Bool[Tensor, "h w"] | None = None  # pixels of objects that are not in the map, see ``Frame``

    @property
    def focal(self) -> float:
        """The geometric mean of the two focal lengths, pixels."""
        return (self.intrinsics.fx * self.intrinsics.fy) ** 0.5

    @property
    def exposure_times(self) -> Float[Tensor, "n"]:
        """The exposure times of the keypoints, float64; see ``rolling_shutter``."""
        return exposure_times(self.keypoints.pixels, self.intrinsics)


def image_keypoints(view: View, features: Features) -> ImageKeypoints:
    """Detect the keypoints of ``view`` outside of its hidden pixels."""
    frame = view.frame
    hidden = None if frame.hidden is None else frame.hidden.cpu()
    keypoints = detected(features, frame.rgb)
    if hidden is not None and len(keypoints):
        # Keypoints stay if their neighbourhoods contain no hidden pixel.
        visible = np.ascontiguousarray((~hidden.numpy()).astype(np.uint8))
        away = torch.from_numpy(cv2.distanceTransform(visible, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
        columns, rows = keypoints.pixels.long().unbind(-1)
        reached = away[rows.clamp(0, hidden.shape[0] - 1), columns.clamp(0, hidden.shape[1] - 1)]
        keypoints = keypoints[reached > keypoints.sizes.to(reached) / 2]
    return ImageKeypoints(
        keypoints, frame.intrinsics.unproject(keypoints.pixels.double()), measured_depth(frame, keypoints.pixels),
        frame.intrinsics, view.T_ref_camera.to("cpu", torch.float64),
        AT_REST if view.motion is None else view.motion, hidden,
    )  # fmt: skip


def measured_depth(frame: Frame, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Return the median depth (metres) of the 3x3 pixels around each of ``pixels`` (u, v).

    It is 0 at depth edges, where depth changes by over 5 %, and where fewer than six of the pixels have measured depth.
    """
    if frame.depth is None or not len(pixels):
        return torch.zeros(len(pixels), dtype=torch.float64)
    depth = frame.depth.detach().cpu().double()
    height, width = depth.shape
    u, v = pixels.floor().long().unbind(-1)
    step = torch.tensor([-1, 0, 1])
    rows = (v[:, None, None] + step[:, None]).clamp(0, height - 1)
    columns = (u[:, None, None] + step).clamp(0, width - 1)
    around = depth[rows, columns].flatten(1)
    around = torch.where(around.isfinite() & (around > 0), around, torch.nan)
    median = around.nanmedian(dim=1).values
    known = around.isfinite()
    low = torch.where(known, around, torch.inf).amin(1)
    high = torch.where(known, around, 0).amax(1)
    smooth = (known.sum(1) >= 6) & (high - low <= 0.05 * median)
    return torch.where(smooth, median, 0)
