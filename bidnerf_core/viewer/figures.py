"""The measures by which a pose was accepted or rejected, each with its threshold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from bidnerf_core.localization import (
    ACCEPTED,
    DECISIVE,
    LEAST_EXPLAINED,
    SHARPEST,
    ComparedExplanation,
    DescentDiagnostics,
    LandmarkDiagnostics,
    LandmarkPose,
    LandmarkThresholds,
    Localization,
    Outcome,
    SearchRecord,
    Support,
    SurfaceDiagnostics,
    SurfaceThresholds,
    landmark_diagnostics,
    probability_of,
)
from bidnerf_core.viewer.explanations import earlier, support_of, told

RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""Digits of an exponent."""


@dataclass(frozen=True)
class Bar:
    """A value on a linear scale from 0 to 1, whose middle is the threshold and whose end is twice that or more."""

    value: float
    at_least: bool  # whether values below the threshold fail, else those above

    @staticmethod
    def of(value: float, threshold: float, at_least: bool) -> Bar | None:
        """Return the bar for a value and a threshold; None if the value is not finite or the threshold is not positive."""
        if not math.isfinite(value) or threshold <= 0:
            return None
        return Bar(min(max(0.0, value / threshold / 2), 1.0), at_least)


@dataclass(frozen=True)
class Figure:
    """A measure of a pose, and the threshold with which it is compared."""

    name: str
    value: str
    threshold: str  # with "at least", "at most" or "below"; empty for a measure without one
    passed: bool | None  # None if there is no threshold
    bar: Bar | None
    meaning: str
    pose: str = ""  # which one is measured, if not the pose found


def acceptance_figures(
    found: Localization, record: SearchRecord | None, colour_noise: float | None = None
) -> tuple[Figure, ...]:
    """Return the measures of an answer and, if recorded, those of a pose by landmarks that was rejected on the way to it.

    ``colour_noise`` is that of the map.
    """
    by_landmarks = None if record is None or not record.landmarks else record.landmarks[-1]
    said, figures = found.diagnostics, list[Figure]()
    if isinstance(said, LandmarkDiagnostics):
        figures += _of_landmarks(said, by_landmarks)
    elif isinstance(said, SurfaceDiagnostics):
        figures += _of_surface(said)
    elif isinstance(said, DescentDiagnostics):
        figures += _of_descent(said)
    elif isinstance(said, Support):
        figures += _of_support(said)
    if record is not None and (compared := told(found, record)):
        figures.append(_of_explanations(compared))
    if by_landmarks is not None and not isinstance(said, LandmarkDiagnostics):
        pose, measured = earlier(found, by_landmarks), landmark_diagnostics(by_landmarks, _by_appearance(by_landmarks))  # fmt: skip
        figures += [replace(figure, pose=pose) for figure in _of_landmarks(measured, by_landmarks)]
    if found.outcome is Outcome.TOO_FEW_MATCHES and colour_noise is not None:
        figures.append(_of_sharpness(colour_noise))
    support = support_of(found)
    if found.confidence is not None and (support is None or support.confidence != found.confidence):
        meaning = "probability that the pose is right, from all figures together"
        figures.insert(
            0,
            _least(
                "confidence",
                found.confidence,
                ACCEPTED,
                f"{found.confidence:.1%}",
                f"{ACCEPTED:.0%}",
                meaning,
            ),
        )
    return tuple(sorted(figures, key=lambda figure: figure.passed is not False))  # what failed comes first


def _by_appearance(pose: LandmarkPose) -> bool:
    """Return whether the matches counted for a pose are by descriptors alone, from before there was a pose."""
    return pose.guided is not None and pose.matches == len(pose.guided.matches)


def _times(count: float, chance: float) -> str:
    return "over 100 times" if count > 100 * chance else f"{count / chance:.1f} times"


def _least(name: str, value: float, least: float, text: str, bound: str, meaning: str) -> Figure:
    return Figure(name, text, f"at least {bound}", value >= least, Bar.of(value, least, True), meaning)


def _most(name: str, value: float, most: float, text: str, bound: str, meaning: str) -> Figure:
    return Figure(name, text, f"at most {bound}", value <= most, Bar.of(value, most, False), meaning)


def _of_landmarks(said: LandmarkDiagnostics, pose: LandmarkPose | None) -> Iterator[Figure]:
    bounds = LandmarkThresholds()
    needed = bounds.inliers * (10 if said.estimated_calibration else 6) / 6
    before = (
        f"; before there was a pose, {said.agreeing} of {said.matches} matches by appearance alone agreed"
    )
    yield _least(
        "landmarks that agree", said.inliers, needed, f"{said.inliers}", f"{needed:.0f}",
        f"matched near where the pose predicts them, within three standard deviations{before if said.searched else ''}",
    )  # fmt: skip
    chance = bounds.above_chance * said.chance
    yield _least(
        "more than by chance", said.inliers, chance, _times(said.inliers, said.chance),
        f"{bounds.above_chance:g} times", f"{said.inliers} agree, about {said.chance:.2g} would at a wrong pose",
    )  # fmt: skip
    yield Figure(
        "agreements this good by chance", _power(said.log10_nfa), f"at most {_power(bounds.log10_nfa)}",
        said.log10_nfa <= bounds.log10_nfa, Bar.of(bounds.log10_nfa / min(said.log10_nfa, -0.01), 1.0, False),
        "expected number at wrong poses; the bar compares exponents",
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
            "shift by a wrong camera", pose.relative_shift, bounds.relative_shift, f"{pose.relative_shift:.2%}",
            f"{bounds.relative_shift:.2%}", "how far doubts about the camera move the position, as a share of that distance",
        )  # fmt: skip
    yield Figure(
        "reprojection errors", f"{said.noise_ratio:.1f} times", "", None, None,
        "those of the map's own images; not tested",
    )  # fmt: skip
    if said.on_surface is not None:
        yield Figure(
            "measured points on the surface", f"{said.on_surface:.0%}", "", None, None,
            "share of the measured depth that lies on the map's surface; not tested",
        )  # fmt: skip


def _of_sharpness(colour_noise: float) -> Figure:
    return _most(
        "error of rendered colours", colour_noise, SHARPEST, f"{colour_noise:.1%}", f"{SHARPEST:.0%}",
        "of the map on its own images; a more blurred map is not compared with images whose landmarks are unknown",
    )  # fmt: skip


def _power(log10: float) -> str:
    """Return a small number, given by its decimal logarithm, as text."""
    return f"{10**log10:.2g}" if log10 > -2 else "10" + f"{log10:.0f}".translate(RAISED)


def _of_explanations(compared: list[ComparedExplanation]) -> Figure:
    nearest = min(compared, key=lambda each: each.log_odds)
    name = "likelier than its mirror image" if nearest.T is None else "likelier than another pose"
    p, least = probability_of(nearest.log_odds), probability_of(DECISIVE)
    return _least(
        name, p, least, f"{p:.1%}", f"{least:.1%}", "probability beside the closest other explanation"
    )


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


def _of_descent(said: DescentDiagnostics) -> Iterator[Figure]:
    yield Figure(
        "mean loss", f"{said.mean_loss:.3g}", f"below {said.converged_loss:.3g}", said.mean_loss < said.converged_loss,
        Bar.of(said.mean_loss, said.converged_loss, False), "of the last steps of the descent",
    )  # fmt: skip
    yield from _of_support(said.support)


def _of_support(said: Support) -> Iterator[Figure]:
    yield _least(
        "contrast explained", said.explained, LEAST_EXPLAINED, f"{said.explained:.0%}", f"{LEAST_EXPLAINED:.0%}",
        "share of the image's contrast that the rendering explains",
    )  # fmt: skip
    yield _least(
        "distinguished from rivals", said.confidence, ACCEPTED, f"{said.confidence:.0%}", f"{ACCEPTED:.0%}",
        "its probability among poses moved a little, the best different pose of the search and a plain image",
    )  # fmt: skip
