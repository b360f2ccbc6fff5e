"""Registration of point clouds by Open3D, small_gicp and KISS-Matcher, as in their tutorials and on one thread.

The clouds are the surfels of a baked map and the pixels of a frame that have a depth. What can be computed from the map
beforehand is computed once and not timed: its points, features and trees. Settings are those with which a library does best on
the frames reserved for tuning.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import median
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from bidnerf import SE3, Frame, View
from bidnerf.results import CRITERIA, pose_error
from bidnerf_core.frames import observe
from bidnerf_core.mapping import SurfaceMap, trace

WITNESSES = 24
"""Number of keyframes that vote on the outward side of surfels."""


@dataclass(frozen=True, eq=False)
class Points:
    """Points in one frame of reference, float64 as the libraries require."""

    positions: NDArray[np.float64]  # (n, 3), metres
    rgb: NDArray[np.float64]  # (n, 3), 0 to 1
    normals: NDArray[np.float64] | None = None  # (n, 3), unit, outwards


def map_points(surface: SurfaceMap) -> Points:
    """Return the surfels, with normals towards the side they were seen from: feature histograms depend on that."""
    surfels = surface.surfels
    normals = surfels.normals * _outwards(surface)[:, None]
    return Points(*(part.double().numpy() for part in (surfels.positions, surfels.rgb, normals)))


def measured_points(frame: Frame) -> Points:
    """Return the points of all pixels that have a depth, in the frame of the camera."""
    assert frame.depth is not None
    rows, columns = (frame.depth > 0).nonzero().unbind(-1)
    seen = observe(View(frame, SE3.identity()), torch.stack([columns, rows], dim=-1), torch.float64)
    return Points((seen.distance[:, None] * seen.directions).numpy(), seen.rgb.numpy())


def _outwards(surface: SurfaceMap) -> torch.Tensor:
    """Return 1 or -1 for each surfel: the side of most keyframes that see it or, if none sees it, of most keyframes."""
    keyframes = surface.keyframes[:: max(1, len(surface.keyframes) // WITNESSES)]
    votes = torch.zeros((2, len(surface.surfels)))
    for centre in keyframes[:, :3, 3].to(surface.surfels.positions):
        way = surface.surfels.positions - centre
        length = torch.linalg.vector_norm(way, dim=-1)
        directions = way / length[:, None]
        met = trace(surface, centre.expand_as(directions), directions)
        side = -(directions * surface.surfels.normals).sum(-1).sign()
        votes += torch.stack([side * (met > length - 2 * surface.cell), side])
    decided = torch.where(votes[0] != 0, votes[0], votes[1])
    return torch.where(decided < 0, -1.0, 1.0)


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
        source, source_features = self._describe(self._seen(measured, config.voxel), config.voxel)
        reach = config.distance * config.voxel
        found = registration.registration_ransac_based_on_feature_matching(
            source,
            target,
            source_features,
            target_features,
            config.mutual,
            reach,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(reach),
            ],
            registration.RANSACConvergenceCriteria(config.iterations, config.confidence),
        )
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
                T = np.asarray(run(source, self.at(voxel), distance * voxel, T, estimate, criteria).transformation)
            except RuntimeError:  # raised by coloured ICP if no points match
                return T
        return T

    def _features(self, voxel: float) -> tuple[Any, Any]:
        return self._describe(self.at(voxel), voxel)

    def _describe(self, cloud: Any, voxel: float) -> tuple[Any, Any]:
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


FEWEST_INLIERS = 5
"""Number of inliers from which the library's own example considers a registration successful."""


class KissMatcher:
    """Registration of frames to a map. The library computes the map's descriptors anew for each frame."""

    def __init__(self, points: Points) -> None:
        import kiss_matcher

        self.library: Any = kiss_matcher
        self.positions = points.positions.astype(np.float32)

    def search(self, measured: Points, voxel: float) -> tuple[Matrix, bool]:
        """Return T_world_camera and whether enough matches agree with it. ``voxel`` is in metres."""
        matcher = self.library.KISSMatcher(self.library.KISSMatcherConfig(voxel))
        found = matcher.estimate(measured.positions.astype(np.float32), self.positions)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
        return T, matcher.get_num_final_inliers() >= FEWEST_INLIERS


LEAST = 4
"""Minimum number of cases to tune on; if there are fewer frames, each is tried with several seeds."""

Setting = TypeVar("Setting")


@dataclass(frozen=True, eq=False)
class Case:
    """A frame to tune on."""

    measured: Points
    truth: SE3
    seed: int


@dataclass(frozen=True)
class Score:
    """The performance of a setting."""

    successes: int  # number within 5 degrees and 0.05, plus number within 1 degree and 0.02
    error: float  # median sum of both errors, in units of the strict limits
    seconds: float  # median


def as_pose(T: Matrix) -> SE3:
    return SE3.from_matrix(torch.tensor(T, dtype=torch.float64))


def cases(frames: Sequence[tuple[Points, SE3]]) -> list[Case]:
    rounds = -(-LEAST // len(frames))
    return [Case(measured, truth, seed) for seed in range(rounds) for measured, truth in frames]


def tuned_open3d(library: Open3d, tries: Sequence[Case], voxel: float) -> tuple[Ransac, Refine, Refine]:
    """Return the best settings of the search and, from its answers, of point-to-plane and of coloured ICP."""
    rough = Refine(False, (voxel, voxel / 2), (1.5, 1.5))

    def search(setting: Ransac) -> tuple[Score, list[Matrix]]:
        library.features(setting.voxel)
        found, seconds = measure_time(tries, lambda i, case: _search(library, case, setting))
        refined = [library.refine(case.measured, T, rough) for case, T in zip(tries, found, strict=True)]
        return score_poses(tries, refined, seconds), found

    results = {setting: search(setting) for setting in ransac_choices(voxel)}
    results |= {s: search(s) for s in ransac_neighbours(_quickest(results))}
    best = _quickest(results)
    starts = results[best][1]
    refines = [_nearest(tries, starts, library.refine, refine_choices(voxel, colour)) for colour in (False, True)]
    return best, refines[0], refines[1]


def tuned_gicp(library: SmallGicp, tries: Sequence[Case], starts: Sequence[Matrix], voxel: float, near: bool) -> Gicp:
    return _nearest(tries, starts, library.refine, gicp_choices(voxel, near))


def measure_time(tries: Sequence[Case], run: Callable[[int, Case], Matrix]) -> tuple[list[Matrix], list[float]]:
    """Return the answers, and the CPU seconds of each."""
    found, seconds = [], []
    for i, case in enumerate(tries):
        began = time.process_time()
        found.append(run(i, case))
        seconds.append(time.process_time() - began)
    return found, seconds


def score_poses(tries: Sequence[Case], found: Sequence[Matrix], seconds: Sequence[float]) -> Score:
    errors = pose_error(SE3.stack([as_pose(T) for T in found]), SE3.stack([case.truth for case in tries]))
    good = [int(CRITERIA[name](errors, errors).sum()) for name in ("5deg 0.05", "1deg 0.02")]
    shares = errors.translation / 0.02 + errors.rotation_deg
    return Score(sum(good), float(shares.nan_to_num(torch.inf).median()), median(seconds))


def _search(library: Open3d, case: Case, setting: Ransac) -> Matrix:
    library.seed(case.seed)
    return library.search(case.measured, setting)


def _quickest(results: dict[Ransac, tuple[Score, list[Matrix]]]) -> Ransac:
    """Return the fastest of the settings that succeed most often; ICP does the fine alignment."""
    return max(results, key=lambda setting: (results[setting][0].successes, -results[setting][0].seconds))


def _nearest(
    tries: Sequence[Case],
    starts: Sequence[Matrix],
    refine: Callable[[Points, Matrix, Any], Matrix],
    choices: Iterable[Setting],
) -> Setting:
    """Return the settings that succeed most often and, among these, have the smallest errors."""

    def score(setting: Setting) -> tuple[int, float]:
        found, seconds = measure_time(tries, lambda i, case: refine(case.measured, starts[i], setting))
        result = score_poses(tries, found, seconds)
        return result.successes, -result.error

    return max(choices, key=score)


def tuned_kiss(
    library: KissMatcher, gicp: SmallGicp, tries: Sequence[Case], voxel: float
) -> tuple[float, list[Matrix]]:
    """Return the voxel size with which most frames are localized after refinement by GICP, and the poses before it."""
    rough = Gicp(voxel / 2, (2 * voxel, voxel))

    def search(size: float) -> tuple[Score, list[Matrix]]:
        found, seconds = measure_time(tries, lambda i, case: library.search(case.measured, size)[0])
        refined = [gicp.refine(case.measured, T, rough) for case, T in zip(tries, found, strict=True)]
        return score_poses(tries, refined, seconds), found

    results = {size: search(size) for size in (0.6 * voxel, voxel, 1.6 * voxel)}
    best = max(results, key=lambda size: (results[size][0].successes, -results[size][0].seconds))
    return best, results[best][1]
