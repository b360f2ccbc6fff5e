"""Camera poses from SIFT matches with points that COLMAP triangulates from images with known poses, as in hloc.

All settings of the points are pycolmap's defaults (its SIFT is root-normalised), except that tracks of two images, which
pycolmap drops by default, are kept: on the frames for tuning, they help. Each keypoint of a query is compared with all
descriptors of all points, and the nearest point is taken where it passes Lowe's ratio test against the second nearest point.
Poses come from RANSAC and a refinement on its inliers, by pycolmap or by OpenCV.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bidnerf import Frame, Intrinsics, View
from bidnerf.evaluation import views_digest
from bidnerf_core.errors import InputError
from bidnerf_core.io import write_file
from bidnerf_core.mapping import likely_pairs

NEIGHBOURS = 20
"""Number of nearby images with which each image is matched, as in hloc's examples."""


@dataclass(frozen=True, eq=False)
class SiftPoints:
    """Triangulated points, and the descriptors of all their keypoints, in the order of the points."""

    positions: NDArray[np.float64]  # (n, 3), world frame, metres
    descriptors: NDArray[np.uint8]  # (m, 128), of norm 512
    first: NDArray[np.int64]  # (n,), index of each point's first descriptor

    def __len__(self) -> int:
        return len(self.positions)


class SiftDetector:
    """COLMAP's SIFT with default settings."""

    def __init__(self) -> None:
        import pycolmap

        pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
        options = pycolmap.FeatureExtractionOptions(num_threads=1)
        self.library: Any = pycolmap
        self.extractor: Any = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)

    def __call__(self, frame: Frame) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return keypoints (n, 4), whose first columns are u and v, and descriptors (n, 128) of norm 512."""
        pixels = (frame.rgb * 255).round().byte().contiguous().numpy()
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        keypoints, descriptors = self.extractor.extract_from_uint8_array(grey)
        return self.library.keypoints_to_matrix(keypoints), descriptors.data


def colmap_camera(intrinsics: Intrinsics, number: int = 1) -> Any:
    """Return a camera for pycolmap, whose pixel coordinates follow the same convention as ``Intrinsics``."""
    import pycolmap

    model, parameters = "PINHOLE", [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    if any(intrinsics.distortion):
        k1, k2, p1, p2, k3, *rational = [*intrinsics.distortion, *[0.0] * 8][:8]
        model = "FULL_OPENCV"
        parameters += [k1, k2, p1, p2, k3, *rational]
    if any(intrinsics.distortion[8:]):
        raise InputError(
            "a camera with thin prism distortion or a tilted sensor, expected one that a COLMAP model describes"
        )
    return pycolmap.Camera(
        camera_id=number, model=model, width=intrinsics.width, height=intrinsics.height, params=parameters
    )


def sift_points(views: Sequence[View], cache: Path) -> SiftPoints:
    """Return the points of ``views``, whose poses are T_world_camera; ``cache`` keeps them by the views' content."""
    import pycolmap

    path = cache / f"sift-{views_digest(views)}-{pycolmap.__version__}-{NEIGHBOURS}.npz"
    if not path.is_file():
        found = triangulate(views)
        content = io.BytesIO()
        np.savez(content, **vars(found))
        cache.mkdir(parents=True, exist_ok=True)
        write_file(path, content.getvalue())
    with np.load(path) as stored:
        return SiftPoints(**stored)


def triangulate(views: Sequence[View]) -> SiftPoints:
    """Triangulate the SIFT keypoints of ``views``, whose poses are T_world_camera."""
    detector = SiftDetector()
    pycolmap = detector.library
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        described = _write_views(views, detector, folder / "database.db")
        model = _posed(views, pycolmap)
        _match(views, model, folder, pycolmap)
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, extract_colors=False)
        options.triangulation.ignore_two_view_tracks = False
        found = pycolmap.triangulate_points(model, folder / "database.db", folder, folder, options=options)
    points = list(found.points3D.values())
    if not points:
        raise InputError(f"no point was triangulated from {len(views)} images")
    tracks = [point.track.elements for point in points]
    descriptors = [described[seen.image_id][seen.point2D_idx] for track in tracks for seen in track]
    first = np.cumsum([0, *map(len, tracks)])[:-1]
    return SiftPoints(np.stack([point.xyz for point in points]), np.stack(descriptors), first)


def _write_views(views: Sequence[View], detector: SiftDetector, path: Path) -> dict[int, NDArray[np.uint8]]:
    """Write cameras and keypoints to a COLMAP database, and return the descriptors by image number, from 1."""
    pycolmap, described = detector.library, {}
    with pycolmap.Database.open(path) as database:
        for number, view in enumerate(views, start=1):
            camera = colmap_camera(view.frame.intrinsics, number)
            camera.has_prior_focal_length = True
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(_rig(camera, pycolmap), use_rig_id=True)
            image = pycolmap.Image(name=str(number), camera_id=number, image_id=number)
            database.write_image(image, use_image_id=True)
            database.write_frame(_frame(image, camera, pycolmap), use_frame_id=True)
            keypoints, described[number] = detector(view.frame)
            database.write_keypoints(number, keypoints)
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, described[number]))
    return described


def _rig(camera: Any, pycolmap: Any) -> Any:
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    return rig


def _frame(image: Any, camera: Any, pycolmap: Any) -> Any:
    frame = pycolmap.Frame(frame_id=image.image_id, rig_id=camera.camera_id)
    frame.add_data_id(image.data_id)
    return frame


def _posed(views: Sequence[View], pycolmap: Any) -> Any:
    """Return a COLMAP model that has poses but no points."""
    model = pycolmap.Reconstruction()
    for number, view in enumerate(views, start=1):
        T_camera_world = view.T_ref_camera.inverse().matrix().double().numpy()
        model.add_camera_with_trivial_rig(colmap_camera(view.frame.intrinsics, number))
        image = pycolmap.Image(name=str(number), camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T_camera_world[:3]))
    return model


def _match(views: Sequence[View], model: Any, folder: Path, pycolmap: Any) -> None:
    """Match the descriptors of neighbouring images, and keep the matches that the known poses allow."""
    pairs = (likely_pairs([view.T_ref_camera for view in views], NEIGHBOURS) + 1).tolist()
    (folder / "pairs.txt").write_text("".join(f"{i} {j}\n" for i, j in pairs))
    pycolmap.match_image_pairs(
        folder / "database.db",
        pycolmap.FeatureMatchingOptions(num_threads=1, skip_geometric_verification=True),
        pycolmap.ImportedPairingOptions(match_list_path=folder / "pairs.txt"),
        device=pycolmap.Device.cpu,
    )
    pycolmap.guided_geometric_verification(model, folder / "database.db", num_threads=1)


RATIO = 0.8
"""Largest ratio of the distances to the nearest and to the second nearest descriptor."""
CANDIDATES = 30
"""Number of nearest descriptors that are searched for the second nearest point."""
FEWEST_INLIERS = 15
"""Minimum number of inliers of a pose that counts as found."""
OPENCV_TRIALS, OPENCV_CONFIDENCE = 10_000, 0.9999
"""OpenCV's defaults of 100 trials and 99 % are too low for matches with many outliers; pycolmap's are about as here."""
OPENCV_ERROR = 2.0
"""Largest reprojection error (pixels) of an inlier; of 2, 4 and OpenCV's default 8, the best on the frames for tuning."""


@dataclass(frozen=True, eq=False)
class PnpResult:
    """A pose and the number of its inliers."""

    T_world_camera: NDArray[np.float64]  # 4x4
    inliers: int


class SiftMatcher:
    """Matches images with points by brute force."""

    def __init__(self, points: SiftPoints) -> None:
        self.points, self.detector = points, SiftDetector()
        self.descriptors = _unit(points.descriptors)
        lengths = np.diff(points.first, append=len(points.descriptors))
        self.owner = torch.from_numpy(np.repeat(np.arange(len(points)), lengths))

    def __call__(self, frame: Frame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pixels (m, 2) of the keypoints that match and the points (m, 3) that they show."""
        keypoints, found = self.detector(frame)
        if not len(keypoints) or len(self.points) < 2:
            return np.zeros((0, 2)), np.zeros((0, 3))
        cosines = _unit(found) @ self.descriptors.T
        nearest = cosines.topk(min(CANDIDATES, len(self.owner)), dim=1)
        squared = (2 - 2 * nearest.values).clamp(min=0)  # distances of unit vectors
        point = self.owner[nearest.indices]
        other = squared.masked_fill(point == point[:, :1], torch.inf).amin(dim=1)
        # If all descriptors belong to one point, other points are farther away than the last of them.
        second = torch.minimum(other, squared[:, -1])
        good = (squared[:, 0] < RATIO**2 * second).numpy()
        number = point[:, 0].numpy()[good]
        return keypoints[good, :2].astype(np.float64), self.points.positions[number]


def _unit(descriptors: NDArray[np.uint8]) -> torch.Tensor:
    """Return descriptors (n, d) as floats of unit length."""
    return torch.nn.functional.normalize(torch.tensor(descriptors).float(), dim=1)


def colmap_pnp(
    pixels: NDArray[np.float64], points: NDArray[np.float64], intrinsics: Intrinsics, seed: int
) -> PnpResult | None:
    """Estimate T_world_camera with pycolmap's LO-RANSAC and refinement, with default options."""
    import pycolmap

    pycolmap.set_random_seed(seed)
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, colmap_camera(intrinsics))
    if found is None:
        return None
    return PnpResult(_inverse(found["cam_from_world"].matrix()), int(found["num_inliers"]))


def opencv_pnp(
    pixels: NDArray[np.float64], points: NDArray[np.float64], intrinsics: Intrinsics, seed: int
) -> PnpResult | None:
    """Estimate T_world_camera with OpenCV's P3P in RANSAC, and refine it on the inliers."""
    if len(pixels) < 4:
        return None
    cv2.setRNGSeed(seed)
    camera = (intrinsics.matrix().numpy(), np.array(intrinsics.distortion) if intrinsics.distortion else None)
    good, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        *camera,
        iterationsCount=OPENCV_TRIALS,
        reprojectionError=OPENCV_ERROR,
        confidence=OPENCV_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not good or inliers is None:
        return None
    kept = inliers[:, 0]
    if len(kept) >= 4:
        turn, shift = cv2.solvePnPRefineLM(points[kept], pixels[kept], *camera, turn, shift)
    rotation: Any = cv2.Rodrigues(turn)[0]
    return PnpResult(_inverse(np.hstack([rotation, shift.reshape(3, 1)])), len(kept))


def _inverse(T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse (4x4) of a rigid transform (3x4)."""
    T = np.eye(4)
    T[:3, :3] = T_camera_world[:, :3].T
    T[:3, 3] = -T[:3, :3] @ T_camera_world[:, 3]
    return T
