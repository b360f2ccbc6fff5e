"""A pose found by landmarks, with its covariance and the evidence for it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.search.camera_fit import UNSUSPECTED, CameraFit, better_camera
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.miscalibration import Miscalibration
from bidnerf_core.mapping.geometry.calibration import GIVEN, UNSTRETCHED, Calibration, Stretch
from bidnerf_core.mapping.geometry.observations import ObservedPoints

ESTIMATED_INFLATION = 3.0
"""Factor on the covariance of poses whose intrinsics were estimated too.

Errors of landmarks and of lenses, which matter less where the intrinsics are known, shift the estimate. With this factor, 146
of 153 such poses lie inside their 95 % bound in the record ``faults_camera``.
"""


@dataclass(frozen=True, eq=False)
class Unguided:
    """Matches by descriptors alone, before there was a pose."""

    matches: ObservedPoints  # with the given intrinsics
    limit: float  # pixels: largest residual of one that agrees with a pose


@dataclass(frozen=True, eq=False)
class Twin:
    """Another pose with which about as many landmarks agree."""

    T_world_rig: SE3
    share: float  # ratio of its correspondences to those of the pose itself, those by chance left out of both


@dataclass(frozen=True, eq=False)
class LandmarkPose:
    """A pose found by landmarks, its covariance, and the evidence for it."""

    T_world_camera: SE3  # of the last view, float64
    # Of the right update, translation (metres) first: due to the errors of keypoints, landmarks and calibration, and of the
    # poses of the map's own images.
    covariance: Float[Tensor, "6 6"]
    map_covariance: Float[Tensor, "6 6"]  # the part of it due to the poses of the map's own images
    noise: float  # pixels: robust standard deviation of the reprojection errors along each axis
    correspondences: LandmarkMatches  # those that the pose was refined on
    residuals: Float[Tensor, "m 2"]  # pixels, of the correspondences
    normalized_residuals: Float[Tensor, "m 2"]  # the same in standard deviations, those of landmarks included
    pixels: Float[Tensor, "m 2"]  # where the correspondences were observed, in pixels of their images
    matches: int  # by descriptors alone, before there was a pose
    agreeing: int  # of those, how many agree with the pose
    # Logarithm of the number of as good agreements expected by chance (Moisan and Stival 2004).
    log10_nfa: float
    chance: float  # correspondences that guided matching would find at a wrong pose
    visible: int  # landmarks that should be visible from the pose
    keypoints: int  # in the images
    spread: float  # 0 to 1: share of the image that the correspondences lie in
    noise_ratio: float  # ``noise`` over that of the map's own images
    distance: float  # metres: median distance of the correspondences' landmarks
    calibration: (
        Calibration  # of the camera: estimated, or that of the map's images if their intrinsics were taken
    )
    calibration_deviations: Float[Tensor, "4"]  # standard deviations, in the order of ``Calibration``
    slope: Float[Tensor, "6 4"]  # derivative of the pose (right update) with respect to each of them
    # Of the camera while its rows were exposed, see ``rolling_shutter``; 0 if none is evident.
    motion: Float[Tensor, "6"]
    motion_covariance: Float[Tensor, "6 6"]  # the part of the pose's covariance due to the motion
    miscalibration: Miscalibration
    calibration_scatter: Float[Tensor, "4"]  # standard deviations of such estimates in this map
    intrinsics: Intrinsics | None  # of the map's images, if these were taken in place of the given ones
    depth_scale: float | None  # factor that corrects measured depth; None if too little was measured
    unguided: Unguided | None = None  # what reveals another camera; None for landmarks that were followed
    has_other_camera: bool = False  # whether far more matches agree with this camera than with the given one
    twin: Twin | None = None  # if sought and found: another pose with which about as many landmarks agree
    stretch: Stretch = UNSTRETCHED  # of the given intrinsics; ``calibration`` corrects the stretched ones
    seconds: dict[str, float] = field(default_factory=dict)  # by stage

    @cached_property
    def better_camera(self) -> CameraFit | None:
        """The camera with which far more matches agree; None if there is none, or if it was taken."""
        if self.has_other_camera or self.unguided is None:
            return None
        least = 1.0 if self.estimates_calibration else UNSUSPECTED
        matches = self.unguided.matches.without_motion(self.T_world_camera, self.motion)
        return better_camera(matches, self.T_world_camera, self.calibration, self.unguided.limit, least)

    def with_twin(self, twin: Twin | None) -> LandmarkPose:
        """Return the pose with its twin. What was fitted for ``better_camera`` does not depend on the twin, and is kept."""
        found = replace(self, twin=twin)
        if "better_camera" in vars(self):  # a fifth of the time of a query
            vars(found)["better_camera"] = self.better_camera
        return found

    @property
    def focal_factor(self) -> float:
        """Ratio of the estimated to the given focal length; of a stretched image, the geometric mean across and down."""
        return self.calibration.focal_factor * math.sqrt(self.stretch.across * self.stretch.down)

    def intrinsics_of(self, given: Intrinsics) -> Intrinsics | None:
        """Return the intrinsics that were taken or estimated for images with the ``given`` ones; None if these were kept."""
        if self.intrinsics is not None:
            return self.intrinsics
        if self.calibration == GIVEN and self.stretch == UNSTRETCHED:
            return None
        return self.calibration.applied(self.stretch.applied(given))

    @property
    def camera_sentence(self) -> str:
        """How the camera differs from the given one, in words."""
        return self.stretch.sentence(self.calibration)

    @property
    def changes_camera(self) -> bool:
        """Whether the camera differs from the given one by more than errors of a good calibration."""
        return bool(self.calibration.considerable) or self.stretch != UNSTRETCHED

    @property
    def estimates_calibration(self) -> bool:
        """Whether the calibration was estimated with the pose."""
        return bool((self.calibration_deviations > 0).any())

    @property
    def has_motion(self) -> bool:
        """Whether the motion of the camera while its rows were exposed was estimated with the pose."""
        return bool(self.motion.any())

    @property
    def takes_map_camera(self) -> bool:
        """Whether the intrinsics are those of the map's images, in place of the given ones."""
        return self.intrinsics is not None

    @property
    def full_covariance(self) -> Float[Tensor, "6 6"]:
        """The covariance, including that due to errors of the intrinsics, whether these were taken or estimated."""
        deviations = (
            self.calibration_scatter if self.estimates_calibration else self.miscalibration.deviations
        )
        by_calibration = self.slope * deviations
        return self.covariance + by_calibration @ by_calibration.mT

    @property
    def stated_covariance(self) -> Float[Tensor, "6 6"]:
        """``full_covariance``, enlarged where the intrinsics were estimated too."""
        return (ESTIMATED_INFLATION if self.estimates_calibration else 1.0) * self.full_covariance

    def with_correction(self, correction: Float[Tensor, "4"]) -> SE3:
        """Return the pose after a correction of the intrinsics, in the order of ``Calibration``, which moves it."""
        return self.T_world_camera.retract(self.slope @ correction)

    @property
    def alternative_shift(self) -> Float[Tensor, "6"]:
        """The right update by which the intrinsics that were not taken, given or the map's, would move the pose."""
        return self.slope @ self.miscalibration.alternative

    @property
    def unresolved_calibration(self) -> Float[Tensor, "6 6"]:
        """What usual errors of the intrinsics, as far as this image does not rule them out, add to ``full_covariance``."""
        if self.estimates_calibration:
            return torch.zeros_like(self.covariance)
        judged = self.miscalibration
        added = (judged.unresolved.square() - judged.deviations.square()).clamp(min=0)
        shift = self.alternative_shift
        by_alternative = judged.alternative_probability * torch.outer(shift, shift)
        return self.slope * added @ self.slope.mT + by_alternative

    @property
    def shared_covariance(self) -> Float[Tensor, "6 6"]:
        """The part of the covariance that rendered rays and measured points have in common with the landmarks.

        It is due to the poses of the map's own images and to the motion. The part of the motion is at most nine tenths of all
        that is not due to the map, in any direction.
        """
        rest = self.covariance - self.map_covariance
        root = torch.linalg.inv(torch.linalg.cholesky(rest))
        largest = float(torch.linalg.eigvalsh(root @ self.motion_covariance @ root.mT)[-1])
        return self.map_covariance + min(1.0, 0.9 / max(largest, 1e-12)) * self.motion_covariance

    @property
    def position_deviation(self) -> float:
        """The standard deviation of the position along its least certain direction, metres."""
        return position_deviation(self.full_covariance)

    @property
    def inliers(self) -> int:
        """The number of correspondences within three standard deviations."""
        return int((torch.linalg.vector_norm(self.normalized_residuals, dim=-1) <= 3).sum())
