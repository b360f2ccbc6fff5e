"""Registration of point clouds by Open3D and small_gicp as in their tutorials, on one thread.

What can be computed from the map beforehand is computed once and not timed: its points, features and trees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from registration_clouds import Points

Matrix = NDArray[np.float64]
"""T_world_camera, 4x4."""


@dataclass(frozen=True)
class Ransac:
    """FPFH features (Rusu et al. 2009) and RANSAC. Lengths in metres."""

    voxel: float
    distance: float = 1.5  # largest distance of matched points that agree, in voxels
    mutual: bool = False  # take only matches that are each other's nearest
    iterations: int = 100_000
    confidence: float = 0.999


@dataclass(frozen=True)
class Refine:
    """ICP after RANSAC, in one stage or from coarse to fine."""

    colour: bool
    voxels: tuple[float, ...]  # metres: voxel size of both clouds, for each stage
    distances: tuple[float, ...]  # largest distance of matched points, in voxels, for each stage
    iterations: int = 50


@dataclass(frozen=True)
class Gicp:
    """small_gicp's generalised ICP (Segal et al. 2009), in one stage or from coarse to fine."""

    voxel: float  # metres
    distances: tuple[float, ...]  # metres: largest distance of matched points, for each stage
    iterations: int = 50


def ransac_choices(voxel: float) -> Iterator[Ransac]:
    """Yield settings of RANSAC for voxel sizes around a likely one."""
    for share in (1.0, 1.6):
        for mutual in (False, True):
            yield Ransac(round(share * voxel, 4), mutual=mutual)


def ransac_neighbours(best: Ransac) -> Iterator[Ransac]:
    """Yield further settings to try once voxel size and matching are chosen."""
    for distance in (0.8, 3.0):
        yield replace(best, distance=distance)
    yield replace(best, iterations=300_000)


def refine_choices(voxel: float, colour: bool) -> Iterator[Refine]:
    for voxels in ((voxel, voxel / 2), (voxel, voxel / 2, voxel / 4)):
        for distance in (0.4, 1.5):
            yield Refine(colour, voxels, (distance,) * len(voxels))


def gicp_choices(voxel: float, near: bool) -> Iterator[Gicp]:
    """Yield settings of GICP for starts that are near the answer, or far from it."""
    for size in (voxel / 2, voxel):
        far = ((20,), (10,), (5,), (20, 4), (20, 8, 2), (10, 2))
        for steps in ((1,), (2,), (4,), (2, 1)) if near else far:
            yield Gicp(size, tuple(step * voxel for step in steps))


class Open3d:
    """Registration of frames to a map by Open3D."""

    def __init__(self, points: Points) -> None:
        import open3d

        self.library: Any = open3d
        self.points = self._cloud(points)
        self.features = lru_cache(maxsize=None)(self._features)
        self.at = lru_cache(maxsize=None)(self.points.voxel_down_sample)

    def seed(self, seed: int) -> None:
        self.library.utility.random.seed(seed)

    def search(self, measured: Points, config: Ransac) -> Matrix:
        """Register a frame to the map without a start."""
        registration = self.library.pipelines.registration
        target, target_features = self.features(config.voxel)
        source, source_features = self._described(self._seen(measured, config.voxel), config.voxel)
        reach = config.distance * config.voxel
        found = registration.registration_ransac_based_on_feature_matching(
            source, target, source_features, target_features, config.mutual, reach,
            registration.TransformationEstimationPointToPoint(False), 3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(reach),
            ],
            registration.RANSACConvergenceCriteria(config.iterations, config.confidence),
        )  # fmt: skip
        return np.asarray(found.transformation)

    def refine(self, measured: Points, start: Matrix, config: Refine) -> Matrix:
        """Refine a pose with point-to-plane (Chen and Medioni 1992) or coloured ICP (Park et al. 2017)."""
        registration = self.library.pipelines.registration
        criteria = registration.ICPConvergenceCriteria(1e-6, 1e-6, config.iterations)
        if config.colour:
            run, estimate = (
                registration.registration_colored_icp,
                registration.TransformationEstimationForColoredICP(),
            )
        else:
            run, estimate = (
                registration.registration_icp,
                registration.TransformationEstimationPointToPlane(),
            )
        T = start
        for voxel, distance in zip(config.voxels, config.distances, strict=True):
            source = self._seen(measured, voxel)
            try:
                T = np.asarray(
                    run(source, self.at(voxel), distance * voxel, T, estimate, criteria).transformation
                )
            except RuntimeError:  # raised by coloured ICP if no points match
                return T
        return T

    def _features(self, voxel: float) -> tuple[Any, Any]:
        return self._described(self.at(voxel), voxel)

    def _described(self, cloud: Any, voxel: float) -> tuple[Any, Any]:
        """Return a cloud and its FPFH features, with radii as in the library's tutorial on global registration."""
        around = self.library.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
        return cloud, self.library.pipelines.registration.compute_fpfh_feature(cloud, around)

    def _seen(self, measured: Points, voxel: float) -> Any:
        cloud = self._cloud(measured).voxel_down_sample(voxel)
        cloud.estimate_normals(self.library.geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        return cloud

    def _cloud(self, points: Points) -> Any:
        geometry, utility = self.library.geometry, self.library.utility
        cloud = geometry.PointCloud(utility.Vector3dVector(points.positions))
        cloud.colors = utility.Vector3dVector(points.rgb)
        if points.normals is not None:
            cloud.normals = utility.Vector3dVector(points.normals)
        return cloud


class SmallGicp:
    """Registration of frames to a map from a start, by small_gicp."""

    def __init__(self, points: Points) -> None:
        import small_gicp

        self.library: Any = small_gicp
        self.points = points
        self.at = lru_cache(maxsize=None)(self._at)

    def refine(self, measured: Points, start: Matrix, config: Gicp) -> Matrix:
        target, tree = self.at(config.voxel)
        source, _ = self.library.preprocess_points(measured.positions, config.voxel, num_threads=1)
        T = start
        for distance in config.distances:
            found = self.library.align(
                target, source, tree, T, "GICP", distance, num_threads=1, max_iterations=config.iterations
            )
            T = found.T_target_source
        return np.asarray(T)

    def _at(self, voxel: float) -> tuple[Any, Any]:
        return self.library.preprocess_points(self.points.positions, voxel, num_threads=1)
