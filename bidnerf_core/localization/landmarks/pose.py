"""A pose by landmarks, with its covariance and the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches
from bidnerf_core.localization.landmarks.guided_pose import GuidedPose
from bidnerf_core.localization.landmarks.hypotheses import Posterior, Whose
from bidnerf_core.mapping import FIXED, GIVEN, Calibration

ESTIMATED_INFLATION = 3.0
"""Factor on the covariance of poses with estimated intrinsics.

Errors of landmarks and lenses, which matter less with known intrinsics, bias the estimate. With this factor, 146 of 153 such
poses lie inside their 95 % bound in the record ``faults_camera``.
"""


@dataclass(frozen=True, eq=False)
class Rival:
    """Another pose that explains the keypoints about as well."""

    T_world_rig: SE3
    log_odds: float  # of the pose itself against this one, given the landmarks
    reason: str


@dataclass(frozen=True, eq=False)
class CameraDoubt:
    """Effect of uncertainty about the intrinsics on a pose."""

    wrong: float = 0.0  # probability that neither the stated intrinsics nor the map's are right, if one of these was used
    expected_shift: float = (
        0.0  # metres: sum over other intrinsics of their probability times the resulting shift
    )
    covariance: Float[Tensor, "6 6"] = field(default_factory=lambda: torch.zeros((6, 6), dtype=torch.float64))
    other: Calibration = (
        GIVEN  # of the intrinsics that contribute most to the expected shift, relative to the stated ones
    )
    other_is_known: bool = True  # whether these are the stated ones or the map's

    @staticmethod
    def of(found: Posterior) -> CameraDoubt:
        """Return the uncertainty about the intrinsics of a posterior's best explanation."""
        taken, other = found.best.hypothesis.whose, found.riskiest
        return CameraDoubt(
            0.0 if taken is Whose.ESTIMATED else found.wrong, found.expected_shift, found.doubt_of_camera,
            GIVEN if other is None else other.calibration,
            other is None or other.hypothesis.group != Whose.ESTIMATED,
        )  # fmt: skip


@dataclass(frozen=True)
class MatchEvidence:
    """How many keypoints match landmarks at a pose, compared with chance."""

    matches: int  # by descriptors alone, before there was a pose
    agreeing: int  # inliers among these matches
    log10_nfa: float  # logarithm of the number of false alarms of this agreement (Moisan and Stival 2004)
    chance: float  # correspondences that guided matching would find at a wrong pose
    visible: int  # landmarks that should be visible from the pose
    keypoints: int  # in the images


@dataclass(frozen=True, eq=False)
class LandmarkPose(MatchEvidence):
    """A pose by landmarks, its covariance, and the evidence for it."""

    T_world_camera: SE3  # of the last view, float64
    # Covariance of the right update, translation (metres) first: due to errors of keypoints, landmarks and calibration, and of
    # the poses of the map's own images.
    covariance: Float[Tensor, "6 6"]
    map_covariance: Float[Tensor, "6 6"]  # the part of it due to the poses of the map's own images
    noise: float  # pixels: robust standard deviation of the reprojection errors along each axis
    correspondences: LandmarkMatches  # the matches used in the refinement
    residuals: Float[Tensor, "m 2"]  # pixels, of the correspondences
    normalized_residuals: Float[
        Tensor, "m 2"
    ]  # the same in standard deviations, including the landmarks' errors
    pixels: Float[Tensor, "m 2"]  # keypoints of the correspondences, in pixels of their images
    spread: float  # 0 to 1: fraction of the image's cells that contain correspondences
    noise_ratio: float  # ratio of ``noise`` to that of the map's own images
    distance: float  # metres: median distance of the correspondences' landmarks
    calibration: (
        Calibration  # of the camera: estimated, or that of the map's images if their intrinsics were used
    )
    calibration_deviations: Float[Tensor, "5"]  # standard deviations, in the order of ``Calibration``
    # Motion of the camera during the readout, see ``rolling_shutter``; 0 if none is evident.
    motion: Float[Tensor, "6"]
    motion_covariance: Float[Tensor, "6 6"]  # the part of the pose's covariance due to the motion
    doubt: CameraDoubt
    intrinsics: Intrinsics | None  # of the map's images, if these were used instead of the given ones
    depth_scale: float | None  # factor that corrects measured depth; None if too few depths were measured
    # A camera with far more inliers, but with which no pose could be refined.
    better_camera: Calibration | None = None
    rivals: tuple[Rival, ...] = ()  # if searched for: other poses that explain the keypoints about as well
    guided: GuidedPose | None = (
        None  # state to which evidence about the camera can be added; None for tracked landmarks
    )

    @property
    def evidence(self) -> MatchEvidence:
        """The evidence alone."""
        return MatchEvidence(*(getattr(self, field.name) for field in fields(MatchEvidence)))

    @property
    def focal_factor(self) -> float:
        """Ratio of the estimated to the given focal length; for a stretched image, the geometric mean of both axes."""
        return self.calibration.focal_factor

    def intrinsics_of(self, given: Intrinsics) -> Intrinsics | None:
        """Return the intrinsics used for images with the ``given`` ones; None if these were kept."""
        if self.intrinsics is not None:
            return self.intrinsics
        return None if self.calibration == GIVEN else self.calibration.applied(given)

    @property
    def given_or_assumed(self) -> str:
        """How the query's intrinsics are known: "given", or "assumed" if their focal length is approximate."""
        return "given" if self.guided is None or self.guided.query.prior == FIXED else "assumed"

    @property
    def changes_camera(self) -> bool:
        """Whether the camera differs from the given one by more than the errors of a good calibration."""
        return bool(self.calibration.considerable)

    @property
    def estimates_calibration(self) -> bool:
        """Whether the calibration was estimated with the pose."""
        return bool((self.calibration_deviations > 0).any())

    @property
    def has_motion(self) -> bool:
        """Whether the camera's motion during the readout was estimated with the pose."""
        return bool(self.motion.any())

    @property
    def takes_map_camera(self) -> bool:
        """Whether the intrinsics are those of the map's images instead of the given ones."""
        return self.intrinsics is not None

    @property
    def full_covariance(self) -> Float[Tensor, "6 6"]:
        """The covariance of the pose, including the uncertainty of its intrinsics: given, the map's, or estimated."""
        return self.covariance + self.doubt.covariance

    @property
    def stated_covariance(self) -> Float[Tensor, "6 6"]:
        """``covariance``, inflated if the intrinsics were estimated too."""
        return (ESTIMATED_INFLATION if self.estimates_calibration else 1.0) * self.covariance

    @property
    def relative_shift(self) -> float:
        """Expected shift of the position under other intrinsics, as a fraction of the landmarks' distance."""
        return self.doubt.expected_shift / self.distance

    @property
    def shared_covariance(self) -> Float[Tensor, "6 6"]:
        """The part of the covariance that rendered rays and measured points share with the landmarks.

        It is due to the poses of the map's own images and to the motion. In any direction, the motion's part is at most 90 % of
        the covariance that is not due to the map.
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
