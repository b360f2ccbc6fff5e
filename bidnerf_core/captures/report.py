"""Report on a capture: how usable its photos are, how well they cover the scene, and what to photograph next.

The records are plain JSON-serializable data; ``sentences`` puts them into words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from bidnerf_core.errors import amount
from bidnerf_core.geometry import LengthUnit, scale_point, symbol
from bidnerf_core.mapping import HeldOutTrial
from bidnerf_core.settings import Coordinate, Degrees, Length, NotNegative, Range, Share, WholeNumber

PhotoProblem = Literal["mirrored", "turned", "badly posed", "apart", "isolated", "blurred", "badly exposed"]
"""Problems that a photo may have, most serious first. A photo is "apart" if it belongs to a smaller group of
linked photos, such as photos of a second place.
"""
Arrangement = Literal["around", "inside", "one side", "one place", "unknown"]
"""How the cameras are arranged: around what they look at, inside it, all on one side of it, all at about
the same position, or unknown."""

Point = tuple[Coordinate, Coordinate, Coordinate]
Elevation = Annotated[float, Range(-90, 90)]
Stops = Annotated[float, Range(-1000, 1000)]
"""The logarithm to base 2 of a ratio of two brightnesses or energies."""
SUMMARY_LINES = 5
"""Largest number of lines of a summary."""
ARRANGEMENTS: dict[Arrangement, str] = {
    "around": "taken all around the scene",
    "inside": "taken from inside the scene",
    "one side": "taken from one side of the scene",
    "one place": "taken from one place",
    "unknown": "too few to tell how they are arranged",
}
PROBLEMS: dict[PhotoProblem, tuple[str, str]] = {
    "mirrored": ("mirrored", "flip the image back, and turn off the mirroring of selfies"),
    "turned": (
        "rotated against the pose",
        "rotate the image, or the pose, so that both agree on what is up",
    ),
    "badly posed": (
        "not where the given pose says, according to the landmarks of other photos",
        "re-estimate such poses, or leave the photos out",
    ),
    "apart": (
        "not linked to the rest by any landmark",
        "photos of another place need a map of their own; otherwise take more in between",
    ),
    "isolated": (
        "short of landmarks in common with others",
        "leave such photos out, or take more between them and the rest",
    ),
    "blurred": ("blurred compared with nearby photos", "retake such photos with more light or a steadier camera"),
    "badly exposed": ("exposed differently from the rest", "retake such photos with locked exposure"),
}
"""For each problem, the words that follow "is" or "are", and advice."""


@dataclass(frozen=True)
class PhotoRecord:
    """Information about one photo of a capture."""

    name: str
    position: Point  # of the camera, metres, world
    direction: Point  # of the optical axis, unit, world
    sharpness: Stops  # ratio of fine to coarse energy, relative to nearby photos
    # brightness of the same landmarks, relative to the other photos; None if it shows too few
    exposure: Stops | None
    overexposed: Share  # of the pixels
    underexposed: Share
    keypoints: WholeNumber
    landmarks: WholeNumber  # number of triangulated landmarks that it shows
    linked: WholeNumber  # number of photos with which it shares enough landmarks
    group: int  # index of its group of linked photos; 0 for the largest, -1 for none
    # Distance of its given pose from the pose estimated from landmarks; None if there is no estimate.
    pose_translation: Length | None = None  # metres
    pose_rotation_deg: Degrees | None = None
    pose_deviations: NotNegative | None = None  # in standard deviations of such differences in this capture
    problems: tuple[PhotoProblem, ...] = ()


@dataclass(frozen=True)
class Gap:
    """A range of directions from the centre of the scene in which there is no camera."""

    degrees: Annotated[float, Range(0, 360)]
    after: str  # names of the photos on either side
    before: str

    def __str__(self) -> str:
        return f"in the {self.degrees:.0f}° between {self.after} and {self.before}"


@dataclass(frozen=True)
class CoverageRecord:
    """How well a capture covers its scene."""

    arrangement: Arrangement = "unknown"
    # metres: where the optical axes converge, or the median landmark
    centre: Point = (0.0, 0.0, 0.0)
    up: Point = (0.0, 0.0, 1.0)  # unit, world: the upward direction of the scene
    parallax_deg: Degrees = 0.0  # median angle between the rays to a point
    landmarks: WholeNumber = 0  # number of triangulated landmarks
    seen_by: NotNegative = 0.0  # median number of photos that show a landmark
    seen_by_two: Share = 0.0  # of the landmarks: that only two photos show
    seen_within_deg: Degrees = 0.0  # median angle between the directions from which a landmark is seen
    # widest range of directions without a camera if the cameras do not go all the way around; ``gaps`` are the others
    open_side: Gap | None = None
    gaps: tuple[Gap, ...] = ()  # much wider than the capture's other steps, the widest first
    # elevation of the cameras seen from the centre, or of the axes of cameras inside: 5th and 95th percentiles
    heights_deg: tuple[Elevation, Elevation] = (0.0, 0.0)


@dataclass(frozen=True)
class CaptureReport:
    """Information about the photos of a map."""

    photos: tuple[PhotoRecord, ...]
    coverage: CoverageRecord
    trial: HeldOutTrial = HeldOutTrial()
    exposure_range: Stops = 0.0  # between the darkest and the brightest tenth of the photos

    def scaled(self, factor: float) -> CaptureReport:
        """Return the report with all lengths multiplied by ``factor``."""
        return replace(
            self,
            photos=tuple(
                replace(
                    photo,
                    position=scale_point(photo.position, factor),
                    pose_translation=None if photo.pose_translation is None else photo.pose_translation * factor,
                )
                for photo in self.photos
            ),
            coverage=replace(self.coverage, centre=scale_point(self.coverage.centre, factor)),
            trial=self.trial.scaled(factor),
        )


def summary(report: CaptureReport, unit: LengthUnit = "units") -> list[str]:
    """Return at most ``SUMMARY_LINES`` lines of the report; if some were left out, the last line gives their number."""
    lines = sentences(report, unit)
    left = len(lines) - SUMMARY_LINES + 1
    more = f"{left} more remarks: 'bidnerf info' prints them all, and 'bidnerf info --plot' plots the capture"
    return lines if left <= 1 else [*lines[: SUMMARY_LINES - 1], more]


def sentences(report: CaptureReport, unit: LengthUnit = "units") -> list[str]:
    """Return all remarks on a capture, whose lengths are in ``unit``: one or two sentences per line, the most serious problems first."""
    covered, trial, photos = report.coverage, report.trial, amount(len(report.photos), "photo")
    low, high = covered.heights_deg
    is_outside, few = covered.arrangement in ("around", "one side"), len(report.photos) < 8
    heights = f", {low:.0f}° to {high:.0f}° above the horizon" if is_outside else ""
    if covered.arrangement == "inside":
        heights = f", looking {low:.0f}° to {high:.0f}° up"
    landmarks = (
        f"{covered.landmarks} landmarks in several photos, typically in {covered.seen_by:.0f}, which see it from directions within"
        f" {covered.seen_within_deg:.0f}°"
        if covered.landmarks
        else "no landmark seen by several of them could be triangulated"
    )
    errors = (
        f", median error {trial.translation:.3g} {symbol(unit)} and {trial.rotation_deg:.2g}°" if trial.found else ""
    )
    remarks = [
        (True, f"{photos}, {ARRANGEMENTS[covered.arrangement]}{heights}; {landmarks}"),
        (
            trial.images > 0,
            f"from the landmarks of the others alone, without field or depth, {trial.found} of {amount(trial.images, 'photo')} of the"
            f" map {'was' if trial.found == 1 else 'were'} localized{errors}; expect this or better for new photos taken the same way",
        ),
        (
            covered.arrangement == "one place",
            f"rays to the same point differ by {covered.parallax_deg:.1f}°: photos from one place"
            " do not determine distances; move by at least a tenth of the distance to the scene between photos",
        ),
    ]
    for problem, (what, advice) in PROBLEMS.items():
        names = [photo.name for photo in report.photos if problem in photo.problems]
        more = f" and {len(names) - 6} more" if len(names) > 6 else ""
        remarks.append(
            (bool(names), f"{', '.join(names[:6])}{more} {'is' if len(names) == 1 else 'are'} {what}: {advice}")
        )
    remarks.append((few, f"{photos}: hardly enough for a map; take twenty or more, with much overlap"))
    dark = [photo.name for photo in report.photos if photo.exposure is None]
    unknown = bool(dark) and len(dark) < len(report.photos)
    remarks += [
        (
            unknown,
            f"too few landmarks to compare the exposure of {', '.join(dark[:6])}{' ...' if len(dark) > 6 else ''}",
        ),
        *((True, f"there are no photos {gap}: take some there, every 10 to 15°") for gap in covered.gaps),
        (
            # A capture of less than a quarter turn is one-sided on purpose.
            covered.open_side is not None and covered.open_side.degrees < 270,
            f"there are no photos {covered.open_side}: take some there if you expect queries from that side",
        ),
        (
            is_outside and high - low < 10,
            "all photos were taken at the same height: add some from higher and lower",
        ),  # degrees
        (
            not few and covered.seen_by_two > 0.6,
            f"{covered.seen_by_two:.0%} of the landmarks are seen in only two photos: photos"
            " in between would constrain them better",
        ),
        (
            report.exposure_range > 1,
            f"exposure varies by {report.exposure_range:.1f} stops: lock it if the camera allows",
        ),
    ]
    return [text for holds, text in remarks if holds]
