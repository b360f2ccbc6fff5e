"""Report on a capture: how usable its photos are, and how well they cover the scene.

The records are plain JSON-serializable data; ``captures.advice`` puts them into words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from bidnerf_core.geometry import multiplied
from bidnerf_core.mapping import HeldOutTrial

PhotoProblem = Literal["mirrored", "turned", "badly posed", "apart", "isolated", "blurred", "badly exposed"]
"""Problems that a photo may have, most serious first. A photo that is "apart" is linked to only a few others,
as are photos of a second place.
"""
Arrangement = Literal["around", "inside", "one side", "one place", "unknown"]
"""How the cameras are arranged: around what they look at, inside it, all on one side of it, or all in one
place."""


@dataclass(frozen=True)
class PhotoRecord:
    """Information about one photo of a capture."""

    name: str
    position: tuple[float, float, float]  # of the camera, metres, world
    direction: tuple[float, float, float]  # of the optical axis, unit, world
    sharpness: float  # log2 of the ratio of fine to coarse energy, relative to nearby photos
    exposure: float  # stops: brightness of the same landmarks, relative to the other photos
    overexposed: float  # fraction of the pixels
    underexposed: float
    keypoints: int
    landmarks: int  # number of triangulated ones that it shows
    linked: int  # number of photos with which it shares enough landmarks
    group: int  # index of its group of linked photos; 0 is the largest, -1 is none
    # Distance of its pose from the one given by the other photos' landmarks; None if there is no such pose.
    pose_translation: float | None = None  # metres
    pose_rotation_deg: float | None = None
    pose_deviations: float | None = None  # in standard deviations of such differences in this capture
    problems: tuple[PhotoProblem, ...] = ()


@dataclass(frozen=True)
class Gap:
    """A range of directions, seen from the middle of the scene, without any camera."""

    degrees: float
    after: str  # names of the photos on either side
    before: str


@dataclass(frozen=True)
class CoverageRecord:
    """How well a capture covers its scene."""

    arrangement: Arrangement = "unknown"
    # metres: where the optical axes converge, or the median landmark
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # unit, world: the upward direction of the scene
    parallax_deg: float = 0.0  # median angle between the rays to a point
    landmarks: int = 0  # triangulated
    seen_by: float = 0.0  # median number of photos that show a landmark
    seen_by_two: float = 0.0  # fraction of the landmarks that only two photos show
    seen_within_deg: float = 0.0  # median angle between the directions from which a landmark is seen
    # widest range of directions without a camera if the cameras do not go all the way around; ``gaps`` are the others
    open_side: Gap | None = None
    gaps: tuple[Gap, ...] = ()  # much wider than the capture's other steps, the widest first
    # elevation of the cameras above the centre's horizon, or of the axes of cameras inside: 5th and 95th percentiles
    heights_deg: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class CaptureReport:
    """Information about the photos of a map."""

    photos: tuple[PhotoRecord, ...]
    coverage: CoverageRecord
    trial: HeldOutTrial = HeldOutTrial()
    exposure_range: float = 0.0  # stops between the darkest and the brightest tenth of the photos

    def scaled(self, factor: float) -> CaptureReport:
        """Return the report on the capture with lengths multiplied by ``factor``."""
        photos = tuple(
            replace(
                photo,
                position=multiplied(photo.position, factor),
                pose_translation=None if photo.pose_translation is None else photo.pose_translation * factor,
            )
            for photo in self.photos
        )
        coverage = replace(self.coverage, centre=multiplied(self.coverage.centre, factor))
        return replace(self, photos=photos, coverage=coverage, trial=self.trial.scaled(factor))

    def with_problem(self, *problems: PhotoProblem) -> list[PhotoRecord]:
        """Return the photos that have any of the problems, in capture order."""
        return [photo for photo in self.photos if set(photo.problems) & set(problems)]
