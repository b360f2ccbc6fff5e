"""Data baked from a field and its images: the surface (surfels in a grid) and landmarks (points with descriptors).

``surface`` and ``landmarks`` build and read them; ``geometry`` has the least-squares problems over points seen in images.
"""

from bidnerf_core.mapping.geometry.bundle_adjustment import Adjustment, PosePrior, adjusted
from bidnerf_core.mapping.geometry.calibration import Calibration, CalibrationPrior
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import ReprojectionFit, resect
from bidnerf_core.mapping.landmarks.building import (
    DEFAULT_LANDMARKS,
    LandmarkConfig,
    TrackedViews,
    build_landmarks,
    tracked_views,
)
from bidnerf_core.mapping.landmarks.features import Features, Keypoints, Sift, find_features
from bidnerf_core.mapping.landmarks.image_keypoints import ImageKeypoints
from bidnerf_core.mapping.landmarks.landmark_map import HeldOutTrial, LandmarkMap
from bidnerf_core.mapping.landmarks.tracks import TrackedKeypoints
from bidnerf_core.mapping.surface.baking import (
    BakeConfig,
    bake,
    colour_noise,
    rendered_views,
    surface_of_points,
)
from bidnerf_core.mapping.surface.casting import cast, trace
from bidnerf_core.mapping.surface.surface_map import SurfaceMap, Surfels
from bidnerf_core.mapping.surface.surfel_index import SurfelIndex
from bidnerf_core.mapping.tensors import (
    landmark_tensors,
    landmarks_from_tensors,
    surface_from_tensors,
    surface_tensors,
)

__all__ = [
    "DEFAULT_LANDMARKS",
    "Adjustment",
    "BakeConfig",
    "Calibration",
    "CalibrationPrior",
    "Features",
    "HeldOutTrial",
    "ImageKeypoints",
    "Keypoints",
    "LandmarkConfig",
    "LandmarkMap",
    "ObservedPoints",
    "PosePrior",
    "ReprojectionFit",
    "Sift",
    "SurfaceMap",
    "SurfelIndex",
    "Surfels",
    "TrackedKeypoints",
    "TrackedViews",
    "adjusted",
    "bake",
    "build_landmarks",
    "cast",
    "colour_noise",
    "find_features",
    "landmark_tensors",
    "landmarks_from_tensors",
    "rendered_views",
    "resect",
    "surface_from_tensors",
    "surface_of_points",
    "surface_tensors",
    "trace",
    "tracked_views",
]
