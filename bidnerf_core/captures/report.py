"""A record of a capture: what its photos are fit for, and how well they cover the scene.

The records are plain data that JSON can hold; ``captures.advice`` puts them into words.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from bidnerf_core.mapping import HeldOutTrial

PhotoProblem = Literal["mirrored", "turned", "badly posed", "apart", "isolated", "blurred", "badly exposed"]
"""What can be wrong with a photo, the gravest first. A photo that is "apart" is linked to a few others only, as are photos of
a second place.
"""
Arrangement = Literal["around", "inside", "one side", "one place", "unknown"]
"""How the cameras lie: around what they look at, inside what they look at, all on one side of it, or all in one place."""


@dataclass(frozen=True)
class PhotoRecord:
    """What is known about one photo of a capture."""

    name: str
    position: tuple[float, float, float]  # of the camera, metres, world
    direction: tuple[float, float, float]  # of the optical axis, unit, world
    sharpness: (
        float  # log2 of the energy of fine over that of coarse detail, relative to photos from nearby places
    )
    exposure: float  # stops: brightness of the same landmarks, relative to the other photos
    overexposed: float  # share of the pixels
    underexposed: float
    keypoints: int
    landmarks: int  # triangulated ones that it shows
    linked: int  # number of photos with which it shares enough landmarks
    group: int  # the same number for linked photos; 0 is the largest group, -1 is no group
    # How far its pose is from the one that the landmarks of the other photos give; None where they give none.
    pose_translation: float | None = None  # metres
    pose_rotation_deg: float | None = None
    pose_deviations: float | None = None  # in standard deviations of such differences in this capture
    problems: tuple[PhotoProblem, ...] = ()


@dataclass(frozen=True)
class Gap:
    """A range of directions, seen from the middle of the scene, in which there is no camera."""

    degrees: float
    after: str  # names of the photos on both of its sides
    before: str


@dataclass(frozen=True)
class CoverageRecord:
    """How well a capture covers its scene."""

    arrangement: Arrangement = "unknown"
    centre: tuple[float, float, float] = (
        0.0,
        0.0,
        0.0,
    )  # metres: where the optical axes meet, as far as they do
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # unit, world: the upward direction of the scene
    parallax_deg: float = 0.0  # median angle between the rays to a point
    landmarks: int = 0  # triangulated
    seen_by: float = 0.0  # median number of photos that show a landmark
    seen_by_two: float = 0.0  # share of the landmarks that only two photos show
    seen_within_deg: float = 0.0  # median angle between the directions from which a landmark is seen
    # Widest range of directions without a camera, where the cameras do not go all around; ``gaps`` are the other ones.
    open_side: Gap | None = None
    gaps: tuple[Gap, ...] = ()  # much wider than the capture's other steps, the widest first
    heights_deg: tuple[float, float] = (
        0.0,
        0.0,
    )  # of the cameras above the centre's horizon: limits of the lowest and the highest twentieth


@dataclass(frozen=True)
class CaptureReport:
    """What is known about the photos of a map."""

    photos: tuple[PhotoRecord, ...]
    coverage: CoverageRecord
    trial: HeldOutTrial = HeldOutTrial()
    exposure_range: float = 0.0  # stops between the darkest and the brightest tenth of the photos

    def with_problem(self, *problems: PhotoProblem) -> list[PhotoRecord]:
        """Return the photos that have any of the problems, in the order of the capture."""
        return [photo for photo in self.photos if set(photo.problems) & set(problems)]

    @property
    def groups(self) -> list[list[PhotoRecord]]:
        """The groups of linked photos, the largest first."""
        count = max((photo.group for photo in self.photos), default=-1) + 1
        return [[photo for photo in self.photos if photo.group == number] for number in range(count)]
