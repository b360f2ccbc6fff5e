"""Sharpness and exposure of the photos of a capture, relative to one another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera import reduced_size
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import mad_deviation
from bidnerf_core.mapping import TrackedKeypoints, likely_pairs

LARGEST = 800
"""Longer side (pixels) to which photos are downscaled to measure sharpness: finer detail is of no use to a map."""
BLURRED = 0.5
"""Smallest lack of fine detail (octaves of energy), compared with nearby photos, of a blurred photo."""
COARSE = 4
"""Standard deviation (pixels) of the Gaussian at the coarser of the two scales whose energies are compared. At the finer scale
it is one pixel, which suppresses noise that would be mistaken for detail.
"""


def photo_measures(views: Sequence[View]) -> Float[Tensor, "3 v"]:
    """Measure the sharpness and exposure of each photo, independently of the other photos.

    The rows are the sharpness (see ``sharpness``) and the fractions of overexposed and underexposed pixels, whose brightest
    channel is at the upper or lower end of its range.
    """
    rows = []
    for frame in (view.frame for view in views):
        image, inside = frame.rgb_bytes.cpu(), torch.ones(frame.rgb_bytes.shape[:2], dtype=torch.bool)
        inside &= True if frame.alpha is None else frame.alpha.cpu() > 0.5
        inside &= True if frame.hidden is None else ~frame.hidden.cpu()
        brightest = (image[inside] if inside.any() else image).amax(-1)
        clipped = [float(which.double().mean()) for which in (brightest >= 254, brightest <= 4)]
        rows.append([sharpness(_grey(frame), frame.hidden), *clipped])
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3).mT


def relative_detail(views: Sequence[View]) -> Float[Tensor, "v"]:
    """Return the energy of each photo's fine detail relative to that of nearby photos.

    The value is 1 for all photos except blurred outliers.
    """
    sharp = torch.tensor([sharpness(_grey(v.frame), v.frame.hidden) for v in views])
    lacking = -excess(sharp, nearby_photos(views))
    return torch.where(are_outliers(lacking, BLURRED), torch.exp2(-lacking), 1.0)


def are_outliers(values: Float[Tensor, "v"], least: float) -> Bool[Tensor, "v"]:
    """Return which values exceed both ``least`` and four times the robust standard deviation (about zero) of all values."""
    return values > max(least, 4 * mad_deviation(values))


def sharpness(grey: np.ndarray, hidden: Bool[Tensor, "h w"] | None = None) -> float:
    """Return log2 of the ratio of fine-scale to coarse-scale energy, which does not depend on contrast.

    The minimum over four directions is returned, since motion blur affects mainly one of them. Pixels affected by ``hidden``
    pixels are ignored, unless hardly any others remain.
    """
    size = reduced_size(grey.shape[1], grey.shape[0], LARGEST)
    if size != grey.shape[::-1]:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    counted = None
    if hidden is not None:
        shown = cv2.resize((~hidden.cpu().numpy()).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        reach = np.ones((6 * COARSE + 1,) * 2, np.uint8)  # of the blur and the differences, to both sides
        away = cv2.erode((shown >= 1).astype(np.uint8), reach) > 0
        counted = away if away.mean() >= 0.02 else None
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1.0, COARSE))
    ratios = [
        _energy(fine, rows, columns, 1, counted) / max(_energy(coarse, rows, columns, COARSE, counted), 1e-12)
        for rows, columns in ((0, 1), (1, 0), (1, 1), (1, -1))
    ]
    return float(np.log2(max(min(ratios), 1e-12)))


def _energy(image: np.ndarray, rows: int, columns: int, step: int, counted: np.ndarray | None) -> float:
    """Return the mean squared second difference along (``rows``, ``columns``) over the ``counted`` pixels (None for all)."""
    ahead = np.roll(image, (-rows * step, -columns * step), (0, 1))
    behind = np.roll(image, (rows * step, columns * step), (0, 1))
    inner = (ahead + behind - 2 * image)[step:-step, step:-step]
    if counted is not None and (some := counted[step:-step, step:-step]).any():
        inner = inner[some]
    return float(np.square(inner).mean()) if inner.size else 0.0


def _grey(frame: Frame) -> np.ndarray:
    """Return the mean of the colour channels, in [0, 1]."""
    return np.asarray(frame.rgb.detach().cpu().numpy().mean(-1))


Nearby: TypeAlias = Int[Tensor, "p 2"]
"""Pairs (photo, other photo), by index, of photos taken from nearby positions in similar directions."""


def nearby_photos(views: Sequence[View], group: Int[Tensor, "v"] | None = None) -> Nearby:
    """Return, for each photo, about eight others taken from nearby positions in similar directions, as pairs of indices.

    If any of these are in the photo's own ``group``, only those are returned.
    """
    pairs = likely_pairs([view.T_ref_camera for view in views], 8)
    pairs = torch.cat([pairs, pairs.flip(1)])
    if group is None:
        return pairs
    same = group[pairs[:, 0]] == group[pairs[:, 1]]
    is_alone = torch.bincount(pairs[same, 0], minlength=len(views)) == 0
    return pairs[same | is_alone[pairs[:, 0]]]


def excess(values: Float[Tensor, "v"], near: Nearby) -> Float[Tensor, "v"]:
    """Return how much each photo's value exceeds the median of the photos near it; 0 if there are no such photos."""
    photo, other = near.unbind(1)
    known = torch.bincount(photo, minlength=len(values)) > 0
    return torch.where(known, values - _medians(values[other], photo, len(values)), 0.0)


def exposures(views: Sequence[View], seen: TrackedKeypoints) -> Float[Tensor, "v"]:
    """Return the exposure of each photo (stops) relative to the median of all; NaN if it shows fewer than ten landmarks.

    The brightness of a landmark in a photo is modelled as the landmark's intrinsic brightness times the photo's exposure.
    The two are estimated alternately, as medians.
    """
    image, point, count = seen.image, seen.point, len(views)
    pixels = seen.pixels
    light = torch.zeros(len(image), dtype=torch.float64)  # log2 of the linear light around each keypoint
    for index in image.unique().tolist():
        own = image == index
        smooth = cv2.blur(_grey(views[index].frame), (5, 5))
        u, v = pixels[own].floor().long().unbind(-1)
        rows, columns = v.clamp(0, smooth.shape[0] - 1).numpy(), u.clamp(0, smooth.shape[1] - 1).numpy()
        # The exponent is approximately that of sRGB. Quantization makes the darkest pixels incomparable, so they count as equal.
        linear = 2.2 * np.log2(np.maximum(smooth[rows, columns], 2 / 255))
        light[own] = torch.from_numpy(linear).double()
    enough = torch.bincount(image, minlength=count) >= 10
    exposure = torch.zeros(count, dtype=torch.float64)
    for _ in range(20 if bool(enough.any()) else 0):  # alternations
        of_points = _medians(light - exposure[image], point, seen.count)
        own = _medians(light - of_points[point], image, count)
        exposure = own - own[enough].median()
    return torch.where(enough, exposure, torch.nan)


def _medians(values: Float[Tensor, "m"], index: Int[Tensor, "m"], count: int) -> Float[Tensor, "n"]:
    """Return the lower median of the values with each index; 0 for an index without values."""
    if not len(values):
        return torch.zeros(count, dtype=torch.float64)
    order = torch.from_numpy(np.lexsort((values.numpy(), index.numpy())))
    number = torch.bincount(index, minlength=count)
    middle = number.cumsum(0) - number + (number - 1).clamp(min=0) // 2
    return torch.where(number > 0, values[order][middle.clamp(max=len(values) - 1)], 0.0)
