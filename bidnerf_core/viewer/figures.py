"""The figures by which a pose was accepted or rejected, each beside its threshold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bidnerf_core.localization import Localization
from bidnerf_core.localization.acceptance import (
    LandmarkDiagnostics,
    LandmarkThresholds,
    SurfaceDiagnostics,
    SurfaceThresholds,
    landmark_diagnostics,
)
from bidnerf_core.localization.beyond_chance import ACCEPTED, LEAST_EXPLAINED, Support
from bidnerf_core.localization.confidence import least_confidence
from bidnerf_core.localization.landmarks.chance import DECISIVE, probability_of
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.recording import ComparedExplanation, SearchRecord


@dataclass(frozen=True)
class Figure:
    """A measure of a pose and the threshold that it is held against."""

    name: str
    value: str
    threshold: str  # with "at least" or "at most"; empty for a measure that decides nothing by itself
    passed: bool | None  # None where there is no threshold
    fulfilled: float | None  # value over threshold or its inverse: 1 at the threshold, more is better
    meaning: str


def acceptance_figures(
    found: Localization, record: SearchRecord | None, approximate: bool = False
) -> tuple[Figure, ...]:
    """Return the figures of an answer; those of landmarks that were matched in vain too, where a record has them.

    ``approximate``: whether the focal length was given as approximate.
    """
    by_landmarks = None if record is None or not record.landmarks else record.landmarks[-1]
    said, figures = found.diagnostics, list[Figure]()
    if isinstance(said, LandmarkDiagnostics):
        figures += _of_landmarks(said, by_landmarks)
    elif isinstance(said, SurfaceDiagnostics):
        figures += _of_surface(said)
    elif isinstance(said, Support):
        figures += _of_support(said)
    if record is not None and record.explanations:
        figures.append(_of_explanations(record.explanations))
    if by_landmarks is not None and not isinstance(said, LandmarkDiagnostics):
        figures += _of_landmarks(landmark_diagnostics(by_landmarks), by_landmarks)
    if found.confidence is not None:
        least = least_confidence(said, approximate)
        meaning = "probability that the pose is right, from all figures together"
        figures.insert(
            0,
            _least("confidence", found.confidence, least, f"{found.confidence:.1%}", f"{least:.0%}", meaning),
        )
    return tuple(sorted(figures, key=lambda figure: figure.passed is not False))  # what failed comes first


def _times(count: float, chance: float) -> str:
    return "over 100 times" if count > 100 * chance else f"{count / chance:.1f} times"


def _least(name: str, value: float, least: float, text: str, bound: str, meaning: str) -> Figure:
    ratio = value / least if least > 0 else 2.0
    return Figure(name, text, f"at least {bound}", value >= least, max(0.0, min(2.0, ratio)), meaning)


def _most(name: str, value: float, most: float, text: str, bound: str, meaning: str) -> Figure:
    ratio = 2.0 if value <= most / 2 else most / value
    return Figure(name, text, f"at most {bound}", value <= most, max(0.0, min(2.0, ratio)), meaning)


def _of_landmarks(said: LandmarkDiagnostics, pose: LandmarkPose | None) -> Iterator[Figure]:
    bounds = LandmarkThresholds()
    needed = bounds.inliers * (10 if said.estimated_calibration else 6) / 6
    yield _least(
        "landmarks that agree", said.inliers, needed, f"{said.inliers}", f"{needed:.0f}",
        f"correspondences within three standard deviations; {said.agreeing} of {said.matches} matches by appearance agree",
    )  # fmt: skip
    chance = bounds.above_chance * said.chance
    yield _least(
        "more than by chance", said.inliers, chance, _times(said.inliers, said.chance),
        f"{bounds.above_chance:g} times", f"about {said.chance:.0f} would agree at a wrong pose",
    )  # fmt: skip
    yield Figure(
        "log10 of false alarms", f"{said.log10_nfa:.0f}", f"at most {bounds.log10_nfa:.0f}",
        said.log10_nfa <= bounds.log10_nfa, max(0.0, min(2.0, said.log10_nfa / bounds.log10_nfa)),
        "how often chance would make as many matches agree",
    )  # fmt: skip
    yield _least(
        "spread over the image", said.spread, bounds.spread, f"{said.spread:.0%}", f"{bounds.spread:.0%}",
        "share of the image's cells that hold a landmark that agrees",
    )  # fmt: skip
    yield _most(
        "uncertainty of the position", said.precision, bounds.precision, f"{said.precision:.2%}", f"{bounds.precision:.0%}",
        "standard deviation by landmarks alone, as a share of their distance",
    )  # fmt: skip
    if pose is not None:
        yield _most(
            "shift by other intrinsics", pose.expected_shift, bounds.expected_shift, f"{pose.expected_shift:.3%}",
            f"{bounds.expected_shift:.2%}", "probability that the camera is another one times how far that moves the position",
        )  # fmt: skip
    yield Figure(
        "noise of keypoints", f"{said.noise_ratio:.1f} times", "", None, None,
        "reprojection errors over those of the map's own images",
    )  # fmt: skip
    if said.on_surface is not None:
        yield Figure(
            "measured points on the surface", f"{said.on_surface:.0%}", "", None, None,
            "share of the measured depth that lies on the map's surface",
        )  # fmt: skip


def _of_explanations(compared: list[ComparedExplanation]) -> Figure:
    nearest = min(compared, key=lambda each: each.log_odds)
    bound = f"{probability_of(DECISIVE):.2%}"
    return _least(
        "likelier than other explanations", nearest.log_odds, DECISIVE, f"{probability_of(nearest.log_odds):.2%}", bound,
        f"probability beside the closest of them: {nearest.reason}",
    )  # fmt: skip


def _of_surface(said: SurfaceDiagnostics) -> Iterator[Figure]:
    bounds = SurfaceThresholds()
    shares = (
        ("measured points on the surface", "on_surface", "share of the measured depth that lies on the map's surface"),
        ("points with the surface's colour", "colour_inliers", "share that lies there and has its colour"),
        ("rendered rays that agree", "rendered_inliers", "share of fresh rays whose rendering agrees with what was measured"),
        ("lead over the runner-up", "runner_up_margin", "by how much the best different pose of the search is worse"),
    )  # fmt: skip
    for name, key, meaning in shares:
        value, bound = getattr(said, key), getattr(bounds, key)
        text = f"{value:.2f}" if key == "runner_up_margin" else f"{value:.0%}"
        yield _least(
            name, value, bound, text, f"{bound:.2f}" if key == "runner_up_margin" else f"{bound:.0%}", meaning
        )
    value, bound = said.free_space_violations, bounds.free_space_violations
    yield _most(
        "lines of sight through the surface", value, bound, f"{value:.0%}", f"{bound:.0%}",
        "share that meets the surface well before the point that was measured",
    )  # fmt: skip
    if said.support is not None:
        yield from _of_support(said.support)


def _of_support(said: Support) -> Iterator[Figure]:
    yield _least(
        "contrast explained", said.explained, LEAST_EXPLAINED, f"{said.explained:.0%}", f"{LEAST_EXPLAINED:.0%}",
        "share of the image's contrast that the rendering explains",
    )  # fmt: skip
    yield _least(
        "distinguished from rivals", said.confidence, ACCEPTED, f"{said.confidence:.0%}", f"{ACCEPTED:.0%}",
        "probability among displaced poses, the best different pose of the search and a plain image",
    )  # fmt: skip
