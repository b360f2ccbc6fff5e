"""Images under conditions of the camera, the image and the scene, as queries of a map: of points, and of the textured ground."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from bidnerf import SE3, Intrinsics, View
from bidnerf.evaluation import faulty
from bidnerf.testing import GROUND_CAMERA, MapWithLandmarks, textured_map
from bidnerf.testing import POSES as GROUND_POSES
from bidnerf.testing import textured_view as view_of_ground
from bidnerf_core.localization import settings_of
from bidnerf_core.mapping import Features, Keypoints, LandmarkMap, Sift, build_landmarks
from landmark_scene import PINHOLE, Points, looking_in, ring
from localizations import colour_only
from optional import require

POSES = (looking_in(0.43, 0.45, 3.6), looking_in(0.2, 0.6, 4.0), looking_in(0.8, -0.2, 4.4))
COPY = SE3.exp(torch.tensor([30.0, 5.0, -20.0, 0.2, -0.9, 0.4], dtype=torch.float64))
"""The pose of another room that holds the same things."""
QUICK = settings_of(
    "auto",
    {"points": 500, "hypotheses": 32, "rounds": 1, "refine_steps": 0, "fused_rays": 128}
    | {"fine_steps": 1, "fine_rays": 64},
)
NOT_RENDERED = replace(QUICK, fused_rays=0)


@dataclass(eq=False)
class CountedDetector:
    """A detector of keypoints that keeps the images in which it sought them."""

    detector: Features = Sift()
    images: list[Tensor] = field(default_factory=list)

    def __call__(self, rgb: Tensor) -> Keypoints:
        self.images.append(rgb)
        return self.detector(rgb)


def with_landmarks(landmarks: LandmarkMap | None, scene: MapWithLandmarks | None = None) -> MapWithLandmarks:
    """Return a map with these landmarks, by default of the ground."""
    return replace(scene or textured_map(surface=True), landmarks=landmarks)


# Points without an image: keypoints are exact but for their noise.


@functools.cache
def point_landmarks(flat: bool = False) -> LandmarkMap:
    """Return landmarks of the points, all of which lie on a small poster if they are ``flat``."""
    seen = points(flat)
    built = build_landmarks(ring(seen), seen)
    if flat:
        return built
    scatter = torch.full((4,), 3e-3, dtype=torch.float64)
    return replace(built, cameras=(PINHOLE,), correlation=4.0, calibration_scatter=scatter)


def points(flat: bool = False) -> Points:
    seen = Points(noise=0.3)
    if flat:
        seen.positions = seen.positions * torch.tensor([0.3, 0.3, 0.0], dtype=torch.float64)
    return seen


def point_view(
    seen: Points,
    T: SE3,
    *,
    true: Intrinsics = PINHOLE,
    stated: Intrinsics | None = None,
    approximate: bool = False,
    motion: Tensor | None = None,
    depth: float | None = None,
    wrong: float = 0.0,
    most: int | None = None,
    visible: float = 1.0,
    mirrored: bool = False,
    seed: int = 0,
) -> View:
    """Return an image of the points by a ``true`` camera, whose intrinsics are ``stated`` otherwise.

    ``wrong``: share of keypoints that show something else. ``most``: how many keypoints there are. ``visible``: share of the
    image that nothing hides.
    """
    seen.outliers = wrong
    view = seen.view(T, true, depth, seed=seed, motion=motion)
    found = seen.seen[-1]
    seen.seen[-1] = found[found.pixels[:, 0] <= visible * true.width][slice(0, most)]
    frame = replace(view.frame, intrinsics=stated or true, focal_is_approximate=approximate)
    return faulty(replace(view, frame=frame), "mirror", 0) if mirrored else replace(view, frame=frame)


def scaled(factor: float, camera: Intrinsics = PINHOLE) -> Intrinsics:
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def shifted(right: float, down: float) -> Intrinsics:
    return replace(PINHOLE, cx=PINHOLE.cx + right, cy=PINHOLE.cy + down)


def resized(across: float) -> Intrinsics:
    """Return the camera that the whole image would have if it had been stretched ``across``."""
    return replace(PINHOLE, fx=PINHOLE.fx / across)


def part(columns: int, rows: int, left: float = 0.5, top: float = 0.5) -> Intrinsics:
    """Return the camera of an image without some columns and rows, of which shares are missing on the left and at the top."""
    width, height = PINHOLE.width - columns, PINHOLE.height - rows
    cx, cy = PINHOLE.cx - columns * left, PINHOLE.cy - rows * top
    return replace(PINHOLE, width=width, height=height, cx=cx, cy=cy)


def centred(camera: Intrinsics, focal: float = 1.0) -> Intrinsics:
    """Return a camera with the principal point in the middle, as is assumed of images of unknown origin."""
    return replace(scaled(focal, camera), cx=camera.width / 2, cy=camera.height / 2)


def twice(landmarks: LandmarkMap, share: float = 1.0) -> LandmarkMap:
    """Return landmarks of which a share is seen in another room as well."""
    there, copied = len(landmarks), round(share * len(landmarks))
    noise = 20 * torch.randn((there + copied, 64), generator=torch.Generator().manual_seed(0))
    both = landmarks[torch.cat([torch.arange(there), torch.arange(copied)])]
    T = COPY.to(dtype=torch.float32)
    both.positions[there:] = T.apply(both.positions[there:])
    both.directions[there:] = T.rotate(both.directions[there:])
    return replace(both, descriptors=(both.descriptors + noise).round().clamp(0, 255).byte())


# The textured ground, which is rendered: keypoints are those of an image, and rays and depth are fused with them.


@functools.cache
def ground_landmarks(features: str = "sift", scatter: float = 0.01) -> LandmarkMap:
    """Return landmarks of a map whose images hardly show which focal length is right: their own estimates scatter."""
    landmarks = require(textured_map().landmarks)
    deviations = torch.full((4,), scatter, dtype=torch.float64)
    cameras = (GROUND_CAMERA,)
    return replace(landmarks, features=features, calibration_scatter=deviations, correlation=1.0, cameras=cameras)


@functools.cache
def ground_view(number: int, seed: int = 0) -> View:
    """Return an image of the ground, with depth and noisy colours; another ``seed`` is another ground."""
    view = view_of_ground(GROUND_POSES[number], f"{number}", seed)
    noise = torch.randn(view.frame.rgb.shape, generator=torch.Generator().manual_seed(number))
    return replace(view, frame=replace(view.frame, rgb=(view.frame.rgb + 0.02 * noise).clamp(0, 1)))


def ground_views(fault: str, numbers: Iterable[int] = (1,), depth: bool = False, seed: int = 0) -> list[View]:
    """Return images of the ground with a fault of the catalogue."""
    views = [faulty(ground_view(number, seed), fault, 0) for number in numbers]
    return views if depth else [colour_only(view) for view in views]


def restated(view: View, factor: float) -> list[View]:
    """Return a photo whose focal length is ``factor`` times the true one as it is stated."""
    frame = replace(view.frame, intrinsics=scaled(factor, view.frame.intrinsics), depth=None)
    return [replace(view, frame=frame)]


def collage(number: int, rows: slice, columns: slice) -> dict[str, Any]:
    """Return a photo of which a part shows another photo instead."""
    view, other = ground_views("none", (1, number))
    rgb = view.frame.rgb.clone()
    rgb[rows, columns] = other.frame.rgb[rows, columns]
    return {"views": [replace(view, frame=replace(view.frame, rgb=rgb))]}
