"""Sharpness and exposure of the photos of a capture, relative to one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
"""Pixels along the longer side to which photos are downscaled: finer detail is of no use to a map."""
FINE, COARSE = 1.0, 4.0
"""Standard deviations (pixels) of the Gaussians for the two scales whose energies are compared. The finer one
suppresses noise, which would be mistaken for detail.
"""
SHARPNESS_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Directions (rows, columns) of the second differences; motion blur affects only one of them."""
DARKEST = 2 / 255
"""Brightness below which pixels count as equally dark, since quantization leaves nothing to compare."""
OVEREXPOSED, UNDEREXPOSED = 254 / 255, 4 / 255
"""Brightness of the brightest channel from which up, or from which down, a pixel is clipped."""
GAMMA = 2.2
"""Exponent that converts image values to linear light, approximately that of sRGB."""
ENOUGH_SHARED = 10
"""Smallest number of landmarks from which a photo's exposure is estimated; with fewer, whole images are
compared."""
BRIGHTNESS_ROUNDS = 20
"""Number of alternations between the brightness of landmarks and the exposure of photos."""
NEIGHBOURS = 8
"""Number of nearby photos with which a photo is compared."""
LEAST_SHOWN = 0.02
"""Smallest fraction of a photo's pixels, away from masked ones, that suffices to measure its sharpness."""
LEAST_BLUR = 0.5
"""Smallest lack of fine detail, in octaves of its energy, at which a photo counts as blurred."""
OUTLYING = 4.0
"""Robust standard deviations from the other photos of the capture beyond which a photo is an outlier."""


@dataclass(frozen=True, eq=False)
class PhotoMeasures:
    """Measurements of photos, one of each kind per photo."""

    sharpness: Float[Tensor, "v"]  # log2 of fine over coarse energy, in the direction where it is smallest
    brightness: Float[Tensor, "v"]  # log2 of the median linear brightness
    overexposed: Float[Tensor, "v"]  # fraction of the pixels
    underexposed: Float[Tensor, "v"]


def photo_measures(views: Sequence[View]) -> PhotoMeasures:
    """Measure each photo on its own."""
    rows = torch.tensor([_measured(view.frame) for view in views], dtype=torch.float64).reshape(-1, 4)
    return PhotoMeasures(*rows.unbind(-1))


def detail_kept(views: Sequence[View]) -> Float[Tensor, "v"]:
    """Return the energy of each photo's fine detail relative to nearby photos.

    It is 1 for all photos except outliers that are blurred.
    """
    found = torch.tensor([sharpness(_clean(v.frame.rgb).mean(-1), v.frame.hidden) for v in views])
    lacking = -above_neighbours(found, nearby(views))
    return torch.where(standing_out(lacking, LEAST_BLUR), torch.exp2(-lacking), 1.0)


def standing_out(values: Float[Tensor, "v"], least: float) -> Bool[Tensor, "v"]:
    """Return which values exceed both ``least`` and ``OUTLYING`` robust standard deviations (about zero) of
    all values.
    """
    return values > max(least, OUTLYING * mad_deviation(values))


def _measured(frame: Frame) -> tuple[float, float, float, float]:
    image = _clean(frame.rgb)
    inside = np.ones(image.shape[:2], bool) if frame.alpha is None else frame.alpha.cpu().numpy() > 0.5
    inside &= True if frame.hidden is None else ~frame.hidden.cpu().numpy()
    shown = image[inside] if inside.any() else image.reshape(-1, 3)
    brightest = shown.max(-1)
    light = float(np.median(log_light(shown.mean(-1))))
    return sharpness(image.mean(-1), frame.hidden), light, float((brightest >= OVEREXPOSED).mean()), float(
        (brightest <= UNDEREXPOSED).mean()
    )  # fmt: skip


def log_light(values: np.ndarray) -> np.ndarray:
    """Return log2 of the linear light of image values in [0, 1]."""
    return GAMMA * np.log2(np.maximum(values, DARKEST))


def sharpness(grey: np.ndarray, hidden: Bool[Tensor, "h w"] | None = None) -> float:
    """Return log2 of the ratio of fine to coarse energy, in which contrast cancels; the smallest of four
    directions.

    Pixels affected by ``hidden`` ones are ignored, unless no others are left.
    """
    shown: np.ndarray | None = None if hidden is None else (~hidden.cpu().numpy()).astype(np.float32)
    size = reduced_size(grey.shape[1], grey.shape[0], LARGEST)
    if size != grey.shape[::-1]:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        shown = None if shown is None else cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    counted = None if shown is None else _away_from_hidden(shown)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (FINE, COARSE))
    ratios = [
        _energy(fine, step, 1, counted) / max(_energy(coarse, step, int(COARSE), counted), 1e-12)
        for step in SHARPNESS_STEPS
    ]
    return float(np.log2(max(min(ratios), 1e-12)))


def _away_from_hidden(shown: np.ndarray) -> np.ndarray | None:
    """Return which pixels are unaffected by hidden ones, given how visible each is; None if these are too
    few.
    """
    reach = 2 * int(2 * COARSE + COARSE) + 1  # of the blur, to both sides, plus the differences
    away: np.ndarray = cv2.erode((shown >= 1).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    return away if away.mean() >= LEAST_SHOWN else None


def _energy(image: np.ndarray, direction: tuple[int, int], step: int, counted: np.ndarray | None) -> float:
    """Return the mean squared second difference along a direction, over the ``counted`` pixels (None for
    all).
    """
    rows, columns = direction[0] * step, direction[1] * step
    ahead = np.roll(image, (-rows, -columns), (0, 1))
    behind = np.roll(image, (rows, columns), (0, 1))
    inner = (ahead + behind - 2 * image)[step:-step, step:-step]
    if not inner.size:
        return 0.0
    if counted is not None and (some := counted[step:-step, step:-step]).any():
        inner = inner[some]
    return float(np.square(inner).mean())


def _clean(rgb: Float[Tensor, "h w 3"]) -> np.ndarray:
    image: np.ndarray = rgb.detach().cpu().float().nan_to_num(0.0).clamp(0, 1).numpy()
    return image


@dataclass(frozen=True, eq=False)
class Nearby:
    """Which photos were taken from nearby places in similar directions: pairs in both directions, each once."""

    count: int  # of photos
    photo: Int[Tensor, "p"]
    other: Int[Tensor, "p"]

    def __getitem__(self, kept: Bool[Tensor, "p"]) -> Nearby:
        return Nearby(self.count, self.photo[kept], self.other[kept])

    def within(self, group: Int[Tensor, "v"]) -> Nearby:
        """Return the pairs within the same group; photos without a group keep all of their pairs."""
        same = group[self.photo] == group[self.other]
        alone = torch.bincount(self.photo[same], minlength=self.count) == 0
        return self[same | alone[self.photo]]

    def medians(self, values: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
        """Return the lower median of the values of the photos near each photo; NaN if there are none."""
        there = torch.bincount(self.photo, minlength=self.count) > 0
        return torch.where(there, _medians(values[self.other], self.photo, self.count), torch.nan)


def nearby(views: Sequence[View]) -> Nearby:
    """Return which photos were taken from nearby places in similar directions."""
    i, j = likely_pairs(views, NEIGHBOURS).unbind(-1) if len(views) > 1 else torch.zeros(2, 0).long()
    return Nearby(len(views), torch.cat([i, j]), torch.cat([j, i]))


def above_neighbours(values: Float[Tensor, "v"], near: Nearby) -> Float[Tensor, "v"]:
    """Return how much each value exceeds the median of its neighbours; 0 if there are none."""
    return (values - near.medians(values)).nan_to_num(0.0)


def exposures(
    views: Sequence[View], seen: TrackedKeypoints, brightness: Float[Tensor, "v"], near: Nearby
) -> Float[Tensor, "v"]:
    """Return the exposure of each photo (stops) relative to the median of all.

    The brightness of a landmark in a photo is the landmark's own brightness times the photo's exposure. Both
    are estimated alternately, as medians. Photos that show too few landmarks are compared with their
    neighbours as a whole.
    """
    image, point = seen.image, seen.point
    light = _light_of_keypoints(views, seen)
    enough = torch.bincount(image, minlength=len(views)) >= ENOUGH_SHARED
    found = torch.zeros(len(views), dtype=torch.float64)
    for _ in range(BRIGHTNESS_ROUNDS):
        of_points = _medians(light - found[image], point, seen.count)
        of_images = _medians(light - of_points[point], image, len(views))
        found = torch.where(enough, of_images, 0.0)
        found = found - found[enough].median() if bool(enough.any()) else found
    own = brightness - found
    compared = near[enough[near.other]] if bool(enough.any()) else near
    around = compared.medians(own)
    everywhere = own[enough].median() if bool(enough.any()) else brightness.median()
    whole = brightness - around.nan_to_num(float(everywhere))
    return torch.where(enough, found, whole)


def _light_of_keypoints(views: Sequence[View], seen: TrackedKeypoints) -> Float[Tensor, "m"]:
    """Return log2 of the linear light around each keypoint."""
    image, number = seen.image, seen.number
    pixels = torch.cat([p.keypoints.pixels for p in seen.images])[number]
    found = torch.zeros(len(image), dtype=torch.float64)
    for index in image.unique().tolist():
        own = image == index
        smooth = cv2.blur(_clean(views[index].frame.rgb).mean(-1), (5, 5))
        u, v = pixels[own].floor().long().unbind(-1)
        rows, columns = v.clamp(0, smooth.shape[0] - 1).numpy(), u.clamp(0, smooth.shape[1] - 1).numpy()
        found[own] = torch.from_numpy(log_light(smooth[rows, columns])).double()
    return found


def _medians(values: Float[Tensor, "m"], index: Int[Tensor, "m"], count: int) -> Float[Tensor, "n"]:
    """Return the lower median of the values with each index; 0 if there are none."""
    order = torch.from_numpy(np.lexsort((values.numpy(), index.numpy())))
    number = torch.bincount(index, minlength=count)
    first = number.cumsum(0) - number
    middle = (first + (number - 1).clamp(min=0) // 2).clamp(max=max(0, len(values) - 1))
    if not len(values):
        return torch.zeros(count, dtype=torch.float64)
    return torch.where(number > 0, values[order][middle], 0.0)
