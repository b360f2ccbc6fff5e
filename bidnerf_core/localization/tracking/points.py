"""The points that are tracked from image to image: recognised landmarks, and corners with measured depth.

Landmarks give the camera's pose in the map; corners give the motion between frames with depth (odometry).
Both are tracked with OpenCV's optical flow (Lucas and Kanade 1981; pyramids by Bouguet 2000).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from bidnerf_core.camera import Intrinsics, exposure_times
from bidnerf_core.depth import DepthNoise
from bidnerf_core.frames import Frame, visible_at
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.matching import cells, inlier_threshold, log10_nfa
from bidnerf_core.localization.propose import from_poselib, poselib_camera, to_poselib
from bidnerf_core.localization.terms.rays import OUTLIER
from bidnerf_core.mapping import FIRST_CENTRE, LandmarkMap, Landmarks, Sights, States, measured_depth, point_variance

POINTS = 400
"""Maximum number of landmarks, corners or measured pixels that are tracked or aligned."""
FRESH = -1
"""Landmark number of points that are not landmarks."""
FLOW: dict[str, Any] = {
    "winSize": (13, 13),  # pixels: of the compared patches
    "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    # on each level, the largest number of iterations, and the step (pixels) below which they end
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02),
    # of a patch's gradient matrix, as normalised by OpenCV; a blank wall with noise stays below it
    "minEigThreshold": 1e-3,
}
"""Options of the optical flow."""

Grey = UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Points:
    """Points in an image and their positions in the world; all tensors are on the CPU."""

    pixels: Float[Tensor, "m 2"]  # (u, v) in the last image
    positions: Float[Tensor, "m 3"]  # metres, world; float64
    deviations: Float[Tensor, "m 2"]  # metres, across and along ``directions``; float64
    directions: Float[Tensor, "m 3"]  # unit, world; float64
    landmark: Int[Tensor, "m"]  # its number in the map; FRESH for points measured in an image

    @staticmethod
    def none() -> Points:
        wide = torch.zeros((0, 3), dtype=torch.float64)
        return Points(torch.zeros((0, 2)), wide, wide[:, :2], wide, torch.zeros(0, dtype=torch.long))

    @staticmethod
    def of_landmarks(landmarks: LandmarkMap, number: Int[Tensor, "m"], pixels: Float[Tensor, "m 2"]) -> Points:
        """Return the landmarks with these numbers, as seen at ``pixels``."""
        some = landmarks[number]
        return Points(pixels, some.positions.double(), some.deviations.double(), some.directions.double(), number)

    @staticmethod
    def detect(frame: Frame, image: Grey, T_world_camera: SE3, count: int, noise: DepthNoise) -> Points:
        """Detect up to ``count`` corners in the grey ``image`` of a frame with a known pose, and back-project those with measured depth.

        ``noise`` is the noise model of the depth.
        """
        pixels = corners(image, count, 0.7 * (image.shape[0] * image.shape[1] / count) ** 0.5)
        pixels = pixels[visible_at(frame, pixels)]
        depth = measured_depth(frame, pixels)
        pixels, depth = pixels[depth > 0], depth[depth > 0]
        ray = frame.intrinsics.unproject(pixels.double())
        return Points(
            pixels,
            T_world_camera.apply(ray * depth[:, None]),
            torch.stack([0.5 * depth / frame.intrinsics.fx, noise.deviation(depth)], dim=-1),
            -T_world_camera.rotate(torch.nn.functional.normalize(ray, dim=-1)),
            torch.full((len(pixels),), FRESH),
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, index: Tensor) -> Points:
        return Points(*(getattr(self, field.name)[index] for field in fields(self)))

    @property
    def landmarks(self) -> Points:
        return self[self.landmark != FRESH]

    @property
    def fresh(self) -> Points:
        return self[self.landmark == FRESH]

    def follow(self, before: Grey, now: Grey, frame: Frame, predicted: SE3) -> Points:
        """Track the points to the next image by optical flow, starting from their projections at a predicted pose; some are lost."""
        guess = frame.intrinsics.project(predicted.inverse().apply(self.positions)).float()
        guess = torch.where(guess.isfinite().all(-1, keepdim=True), guess, self.pixels)
        pixels, found = flow(before, now, self.pixels, guess)
        if 2 * int(found.sum()) < len(found):  # the prediction may be wrong
            again, found_again = flow(before, now, self.pixels, self.pixels)
            if int(found_again.sum()) > int(found.sum()):
                pixels, found = again, found_again
        fresh = (self.landmark == FRESH) & found
        if bool(fresh.any()):  # unlike corners, landmarks are known to be distinctive
            found[fresh.clone()] = correlate(before, now, self.pixels[fresh], pixels[fresh])
        found &= visible_at(frame, pixels)
        return replace(self, pixels=pixels)[found]

    def spread(self, camera: Intrinsics, most: int) -> Points:
        """Return up to ``most`` of the points, which are sorted best first, taken in turn from the cells of the image."""
        if len(self) <= most:
            return self
        cell = cells(self.pixels, camera)
        order = cell.argsort(stable=True)
        rank = torch.empty_like(cell)
        rank[order] = torch.arange(len(cell)) - torch.searchsorted(cell[order], cell[order])
        return self[rank.argsort(stable=True)[:most].sort().values]


@dataclass(frozen=True, eq=False)
class Fit:
    """The pose of a static camera, fitted to points that it observes."""

    points: Points
    camera: Intrinsics
    states: States  # (1)
    term: Landmarks
    keypoints: int = 0  # in the image, if the points were recognised in it
    by_chance: int | None = None  # number of points that would be recognised at a wrong pose; None if tracked

    @staticmethod
    def of(points: Points, camera: Intrinsics, start: SE3, correlation: float) -> Fit:
        """Fit a pose near ``start`` to points; ``correlation`` is the number of points that count as one because of correlated errors."""
        focal, count = (camera.fx * camera.fy) ** 0.5, len(points)
        threshold = inlier_threshold(camera)
        image = camera.unproject(points.pixels.double())[:, :2]
        options = {"loss_type": "CAUCHY", "loss_scale": threshold / 2}
        known = points.positions.numpy(), to_poselib(start.inverse()), poselib_camera(focal)
        pose, _ = poselib.refine_absolute_pose((image * focal).numpy(), *known, options)
        T = from_poselib(pose).inverse()
        T = T.polished() if bool(T.is_rigid()) else start
        states = States.known(T, torch.zeros(6, dtype=torch.float64))
        zero, one = torch.zeros((1, count, 3), dtype=torch.float64), torch.ones(count, dtype=torch.float64)
        sights = Sights(
            image[None],
            exposure_times(points.pixels, camera)[None],
            torch.eye(3, dtype=torch.float64).expand(1, count, 3, 3),
            zero,
            single=True,
        )
        variance = point_variance(points, torch.arange(count), states, focal * one)
        correlated = torch.tensor([correlation], dtype=torch.float64)
        term = Landmarks(
            points.positions[None],
            sights,
            one[None],
            variance[None],
            focal * one[None],
            correlated,
            1 / correlated,
            float(camera.width * camera.height),
            threshold,
        )
        return Fit(points, camera, term.with_noise(states), term)

    @cached_property
    def _residuals(self) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """The reprojection errors in standard deviations and in pixels."""
        squared, residuals, _ = self.term.residuals(self.states)
        return squared[0].sqrt(), residuals[0].norm(dim=-1)

    @property
    def is_recognised(self) -> bool:
        """Whether the points were recognised in this image, rather than tracked to it."""
        return self.by_chance is not None

    @property
    def is_inlier(self) -> Bool[Tensor, "m"]:
        return self._residuals[0] <= OUTLIER

    @property
    def agreeing(self) -> int:
        """The number of points within the largest reprojection error of an inlier."""
        return int((self._residuals[1] <= self.term.most_noise).sum())

    @property
    def log10_nfa(self) -> float:
        """Log10 of the number of false alarms, if a wrong match may lie anywhere in the image."""
        by_chance = min(0.5, math.pi * self.term.most_noise**2 / self.term.area)
        return log10_nfa(len(self.points), self.agreeing, by_chance)

    @property
    def is_accurate(self) -> bool:
        """Whether the points fit better than points spread evenly over the inlier disc, as after failed flow.

        Evenly spread points have a standard deviation of half the disc's radius along each axis.
        """
        return float(self.states.noise) <= self.term.most_noise / 2


# Optical flow between consecutive images.


def flow(
    before: Grey, now: Grey, pixels: Float[Tensor, "m 2"], guess: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], Bool[Tensor, "m"]]:
    """Track ``pixels`` (u, v) of one image to the next; return their new positions and a mask of those found.

    The search starts at ``guess``. A point counts as found if the backward flow returns to its original position.
    """
    if not len(pixels):
        return pixels, torch.zeros(0, dtype=torch.bool)
    before = _match_brightness(now, before)
    start = _corner_based(pixels)
    there, seen, _ = cv2.calcOpticalFlowPyrLK(before, now, start, _corner_based(guess), **FLOW)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, start.copy(), maxLevel=1, **FLOW)
    height, width = now.shape
    inside = ((there >= 0) & (there <= (width - 1, height - 1))).all(-1)
    # The forward-backward error is at most 0.7 pixels.
    returned = np.linalg.norm(back - start, axis=-1) <= 0.7
    found = inside & returned & (seen[:, 0] > 0) & (seen_back[:, 0] > 0)
    return torch.from_numpy(there + FIRST_CENTRE).to(pixels), torch.from_numpy(found)


def correlate(before: Grey, now: Grey, pixels: Float[Tensor, "m 2"], there: Float[Tensor, "m 2"]) -> Bool[Tensor, "m"]:
    """Return a mask of the patches around ``pixels`` of one image that resemble those around ``there`` in the next.

    In pure noise, the flow stays where its search started, and the patches do not correlate.
    """
    one, two = (_patches(image, at) for image, at in ((before, pixels), (now, there)))
    spread = np.sqrt((one**2).sum(-1) * (two**2).sum(-1)).clip(min=1e-6)
    return torch.from_numpy((one * two).sum(-1) >= 0.6 * spread)


def _patches(image: Grey, pixels: Float[Tensor, "m 2"]) -> Float[np.ndarray, "m p"]:
    """Return the grey values around pixels, in patches of 9 pixels a side, minus their mean."""
    steps = np.arange(-4, 5)
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


def _match_brightness(model: Grey, image: Grey) -> Grey:
    """Return ``image`` with about the mean and standard deviation of ``model``; unchanged if the means hardly differ."""
    (mean, spread), (wanted, wanted_spread) = (np.ravel(cv2.meanStdDev(x)).tolist() for x in (image, model))
    # The flow assumes constant brightness, so larger changes of the mean than 2 % are compensated.
    if abs(wanted - mean) <= 0.02 * mean or spread < 1:
        return image
    gain = min(4.0, max(0.25, wanted_spread / spread))
    levels = (gain * (np.arange(256) - mean) + wanted).round().clip(0, 255).astype(np.uint8)
    return levels[image]
