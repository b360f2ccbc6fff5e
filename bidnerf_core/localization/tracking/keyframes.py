"""The points that are tracked from image to image: recognised landmarks, and corners with measured depth.

Landmarks give the camera's pose in the map; corners give the motion between frames with depth (odometry).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import poselib
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics, exposure_times
from bidnerf_core.depth import DepthNoise
from bidnerf_core.frames import Frame, View, visible_at
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.matching import OBLIQUE, LandmarkMatcher, Matches, Nearest, Projected
from bidnerf_core.localization.propose import consensus
from bidnerf_core.localization.query import THRESHOLD, Query
from bidnerf_core.localization.tracking.flow import Grey, alike, corners, flow
from bidnerf_core.mapping import (
    Features,
    LandmarkMap,
    Landmarks,
    Sights,
    States,
    measured_depth,
    point_variance,
)

FRESH = -1
"""Landmark number of points that are not landmarks."""
CELLS = 10
"""Number of rows and columns of cells by which the spread of points over an image is measured."""
MOST_IN_VIEW = 4_000
"""Number of landmarks in view, those in most images, that are compared with keypoints regardless of where they project."""


def threshold_of(camera: Intrinsics) -> float:
    """Return the largest reprojection error of an inlier, pixels."""
    return max(2.0, THRESHOLD * math.hypot(camera.width, camera.height))


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
    def measured(frame: Frame, image: Grey, T_world_camera: SE3, count: int, noise: DepthNoise) -> Points:
        """Return up to ``count`` corners of a frame with depth of the given ``noise``, taken at a known pose."""
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

    def followed(self, before: Grey, now: Grey, frame: Frame, predicted: SE3) -> Points:
        """Return the points that are found in the next image, by optical flow from where a predicted pose projects them."""
        guess = frame.intrinsics.project(predicted.inverse().apply(self.positions)).float()
        guess = torch.where(guess.isfinite().all(-1, keepdim=True), guess, self.pixels)
        pixels, found = flow(before, now, self.pixels, guess)
        if float(found.float().mean()) < 0.5:  # the prediction may be wrong
            again, found_again = flow(before, now, self.pixels, self.pixels)
            if int(found_again.sum()) > int(found.sum()):
                pixels, found = again, found_again
        fresh = (self.landmark == FRESH) & found
        if bool(fresh.any()):  # unlike corners, landmarks are known to be distinctive
            found[fresh.clone()] = alike(before, now, self.pixels[fresh], pixels[fresh])
        found &= visible_at(frame, pixels)
        return replace(self, pixels=pixels)[found]

    def nearby(self, camera: Intrinsics, start: SE3) -> SE3:
        """Return the pose near ``start`` with the smallest robust reprojection error, by poselib, as a start."""
        focal, inverse = (camera.fx * camera.fy) ** 0.5, start.inverse()
        pose = poselib.CameraPose()
        pose.R, pose.t = inverse.rotation.numpy(), inverse.translation.numpy()
        model = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal, 0.0, 0.0]}
        options = {"loss_type": "CAUCHY", "loss_scale": 0.5 * threshold_of(camera)}
        flat = camera.unproject(self.pixels.double())[:, :2] * focal
        found, _ = poselib.refine_absolute_pose(flat.numpy(), self.positions.numpy(), pose, model, options)
        T = SE3(torch.from_numpy(np.array(found.R)), torch.from_numpy(np.array(found.t)).flatten()).inverse()
        return T.polished() if bool(T.is_rigid()) else start

    def term(self, camera: Intrinsics, states: States, correlation: float) -> Landmarks:
        """Return their reprojection errors, of which ``correlation`` count as one, as a term near ``states``."""
        count = len(self)
        focal = torch.full((count,), (camera.fx * camera.fy) ** 0.5, dtype=torch.float64)
        rotation = torch.eye(3, dtype=torch.float64).expand(1, count, 3, 3)
        sights = Sights(
            camera.unproject(self.pixels.double())[None, :, :2], exposure_times(self.pixels, camera)[None],
            rotation, torch.zeros((1, count, 3), dtype=torch.float64),
        )  # fmt: skip
        variance = point_variance(self, torch.arange(count), states, focal)
        correlated = torch.tensor([correlation], dtype=torch.float64)
        return Landmarks(
            self.positions[None], sights, torch.ones_like(focal)[None], variance[None], focal[None],
            correlated, 1 / correlated, float(camera.width * camera.height), threshold_of(camera),
        )  # fmt: skip

    def spread(self, camera: Intrinsics) -> float:
        """Return the fraction of the image's cells that contain a point."""
        return len(_cells(self.pixels, camera).unique()) / CELLS**2

    def well_spread(self, camera: Intrinsics, most: int) -> Points:
        """Return up to ``most`` points, taken in turn from the cells of the image, of points that are sorted best first."""
        if len(self) <= most:
            return self
        cell = _cells(self.pixels, camera)
        order = cell.argsort(stable=True)
        rank = torch.empty_like(cell)
        rank[order] = torch.arange(len(cell)) - torch.searchsorted(cell[order], cell[order])
        return self[rank.argsort(stable=True)[:most].sort().values]


def _cells(pixels: Float[Tensor, "m 2"], camera: Intrinsics) -> Int[Tensor, "m"]:
    size = torch.tensor([camera.width, camera.height])
    column, row = (pixels / size * CELLS).long().clamp(0, CELLS - 1).unbind(-1)
    return row * CELLS + column


@dataclass(frozen=True, eq=False)
class Recognition:
    """An image whose keypoints are compared with the landmarks around a pose, without a search over the map."""

    query: Query
    landmarks: LandmarkMap  # up to ``MOST_IN_VIEW`` of those in view, seen by most images of the map
    number: Int[Tensor, "n"]  # of each in the whole map

    @staticmethod
    def of(frame: Frame, features: Features, landmarks: LandmarkMap, T_world_camera: SE3) -> Recognition:
        """Detect the keypoints of a frame, and select landmarks around its predicted pose."""
        camera = frame.intrinsics
        size = torch.tensor([camera.width / camera.fx, camera.height / camera.fy])
        number, _ = landmarks.in_view(T_world_camera, 0.6 * size, OBLIQUE)  # 0.5 without a margin
        if len(number) > MOST_IN_VIEW:
            order = landmarks.views[number].argsort(descending=True, stable=True)
            number = number[order[:MOST_IN_VIEW].sort().values]
        return Recognition(Query.of([View(frame, SE3.identity())], features), landmarks[number], number)

    def near(self, state: States, radius: float) -> tuple[Points, int]:
        """Return the landmarks that one state projects within ``radius`` pixels of a similar keypoint, and how many would be so by
        chance: at keypoints that are displaced.
        """
        seen = Projected(self.query, self.landmarks, state, radius)
        found = seen.matches(radius)
        return self._points(found), len(seen.matches(radius, 4 * radius))

    def proposal(self, state: States, radius: float) -> SE3 | None:
        """Return the pose on which most matches by descriptors agree whose landmarks project within ``radius`` pixels.

        This is for vague predictions: matching by projection compares a keypoint with the few landmarks nearest to it.
        """
        count = len(self.query.view)
        if len(self.landmarks) < 2 or count < 4:
            return None
        matches = Nearest.of(self.query, LandmarkMatcher(self.landmarks), count).best
        points = self._points(matches)
        expected = self.query.camera.project(state.T[0].inverse().apply(points.positions))
        near = (expected - points.pixels).norm(dim=-1) <= radius  # false for NaN, behind the camera
        stated = torch.zeros(6, dtype=torch.float64)
        found = consensus(self.query, self.landmarks, matches[near.nonzero()[:, 0]], stated)
        return None if found is None else found[0].T

    def _points(self, matches: Matches) -> Points:
        found = self.landmarks
        positions, deviations, directions = (
            part[matches.landmark].double() for part in (found.positions, found.deviations, found.directions)
        )
        pixels, number = self.query.keypoints.pixels[matches.keypoint], self.number[matches.landmark]
        return Points(pixels, positions, deviations, directions, number)
