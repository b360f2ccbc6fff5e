"""Optical flow between consecutive images (Lucas and Kanade 1981; pyramids by Bouguet 2000), by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from bidnerf_core.mapping import FIRST_CENTRE

FLOW_WINDOW = (13, 13)
"""Size of the compared patches, pixels."""
FLOW_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)
"""Maximum number of iterations on each level, and the step (pixels) below which they end."""
LEAST_TEXTURE = 1e-3
"""Minimum eigenvalue of a patch's gradient matrix, as normalised by OpenCV; a blank wall with noise stays below it."""

PATCH = 4
"""Half size (pixels) of the patches that ``alike`` compares."""

Grey = UInt8[np.ndarray, "h w"]


def flow(
    before: Grey, now: Grey, pixels: Float[Tensor, "m 2"], guess: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], Bool[Tensor, "m"]]:
    """Track ``pixels`` (u, v) of one image to the next; return their new positions and a mask of those found.

    The search starts at ``guess``. A point counts as found if the backward flow returns to its old position.
    """
    if not len(pixels):
        return pixels, torch.zeros(0, dtype=torch.bool)
    before = _as_bright_as(now, before)
    start = _corner_based(pixels)
    there, seen, _ = cv2.calcOpticalFlowPyrLK(
        before, now, start, _corner_based(guess), winSize=FLOW_WINDOW,
        criteria=FLOW_STEPS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=LEAST_TEXTURE,
    )  # fmt: skip
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(
        now, before, there, start.copy(), winSize=FLOW_WINDOW, maxLevel=1,
        criteria=FLOW_STEPS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=LEAST_TEXTURE,
    )  # fmt: skip
    height, width = now.shape
    inside = ((there >= 0) & (there <= (width - 1, height - 1))).all(-1)
    # Maximum forward-backward error of a point, pixels
    returned = np.linalg.norm(back - start, axis=-1) <= 0.7
    found = inside & returned & (seen[:, 0] > 0) & (seen_back[:, 0] > 0)
    return torch.from_numpy(there + FIRST_CENTRE).to(pixels), torch.from_numpy(found)


def alike(
    before: Grey, now: Grey, pixels: Float[Tensor, "m 2"], there: Float[Tensor, "m 2"]
) -> Bool[Tensor, "m"]:
    """Return a mask of the patches around ``pixels`` of one image that resemble those around ``there`` in the next.

    The flow leaves patches of pure noise where its search started; these do not correlate.
    """
    one, two = (_patches(image, at) for image, at in ((before, pixels), (now, there)))
    spread = np.sqrt((one**2).sum(-1) * (two**2).sum(-1)).clip(min=1e-6)
    return torch.from_numpy((one * two).sum(-1) >= 0.6 * spread)


def _patches(image: Grey, pixels: Float[Tensor, "m 2"]) -> Float[np.ndarray, "m p"]:
    """Return the grey values around pixels, minus their mean."""
    steps = np.arange(-PATCH, PATCH + 1)
    column, row = np.moveaxis(pixels.floor().long().numpy(), -1, 0)
    rows = (row[:, None] + steps).clip(0, image.shape[0] - 1)
    columns = (column[:, None] + steps).clip(0, image.shape[1] - 1)
    found = image[rows[:, :, None], columns[:, None, :]].reshape(len(pixels), -1).astype(np.float32)
    return found - found.mean(-1, keepdims=True)


def corners(image: Grey, count: int, distance: float) -> Float[Tensor, "n 2"]:
    """Return up to ``count`` corners (u, v), at least ``distance`` pixels from each other (Shi and Tomasi 1994)."""
    found: np.ndarray | None = cv2.goodFeaturesToTrack(image, count, 0.01, distance)
    if found is None:
        return torch.zeros((0, 2))
    return torch.from_numpy(found.reshape(-1, 2) + FIRST_CENTRE)


def _corner_based(pixels: Float[Tensor, "m 2"]) -> Float[np.ndarray, "m 2"]:
    return np.ascontiguousarray(pixels.float().numpy() - np.float32(FIRST_CENTRE))


def _as_bright_as(model: Grey, image: Grey) -> Grey:
    """Return ``image`` with about the mean and standard deviation of ``model``; unchanged if the means hardly differ."""
    (mean, spread), (wanted, wanted_spread) = (np.ravel(cv2.meanStdDev(x)).tolist() for x in (image, model))
    # Relative change of an image's mean above which its brightness is matched first, since the flow assumes
    # constant brightness
    if abs(wanted - mean) <= 0.02 * mean or spread < 1:
        return image
    gain = min(4.0, max(0.25, wanted_spread / spread))
    levels = (gain * (np.arange(256) - mean) + wanted).round().clip(0, 255).astype(np.uint8)
    return levels[image]
