"""The measures by which a pose was accepted or rejected, each with its threshold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from bidnerf_core.localization import (
    ACCEPTED,
    LANDMARK_BOUNDS,
    SUPPORT_BOUNDS,
    Evidence,
    Localization,
    SearchRecord,
    Support,
)
from bidnerf_core.viewer.explanations import earlier, last_answer
from bidnerf_core.viewer.packing import Json

MEASURES = {
    "log10_nfa": ("poses as good by chance", ".0e", "number expected of wrong poses; the bar compares exponents"),
    "inliers": ("landmarks that agree", ".0f", "matched near where the pose predicts them, within three standard deviations"),
    "above_chance": ("more than by chance", ".1f", "ratio of the landmarks that agree to those that would at a wrong pose"),
    "spread": ("spread over the image", ".0%", "share of the image's cells that hold a landmark that agrees"),
    "other_place": ("another place or the mirror image", ".1%", "probability that it explains the image instead"),
    "credible": ("camera as stated, or nearly", ".0%", "probability of the explanations of the camera that the image may have"),
    "precision": ("uncertainty of the position", ".2%", "standard deviation, as a share of the distance to the scene"),
    "mass": ("pose within the tolerance", ".0%", "probability by all explanations of the image together"),
    "replaced": ("another camera than stated", ".0%", "probability that it is not even like the map's; not tested by itself"),
    "recall": ("landmarks recognised", ".0%", "share of the landmarks in view, or of the keypoints, that match; not tested by itself"),
    "noise_ratio": ("reprojection errors", ".1f", "relative to those of the map's own images; not tested by itself"),
    "on_surface": ("measured points on the surface", ".0%", "share of the measured depth that lies there; not tested by itself"),
    "colour_inliers": ("points with the surface's colour", ".0%", "share that lies there and has its colour; not tested by itself"),
}  # fmt: skip
"""The name, format and meaning of each measure of a pose by landmarks, those with a bound first."""
WITHOUT_LANDMARKS = {
    "mean_loss": ("mean loss", ".3g", "of the last steps of the descent"),
    "on_surface": ("measured points on the surface", ".0%", "share of the measured depth that lies on the map's surface"),
    "colour_inliers": ("points with the surface's colour", ".0%", "share that lies there and has its colour"),
    "free_space_violations": (
        "lines of sight through the surface", ".0%", "share that meets the surface well before the point that was measured"
    ),
    "runner_up_margin": ("lead over the runner-up", ".2f", "by how much the best different pose of the search is worse"),
    "rendered_inliers": ("rendered rays that agree", ".0%", "share of the rays whose rendering agrees with what was measured"),
    "new_inliers": ("new rays that agree", ".0%", "share of newly drawn rays whose rendering agrees with what was measured"),
    "confidence": (
        "distinguished from rivals", ".0%",
        "its probability among poses moved a little, the best different pose of the search and a plain image",
    ),
    "explained": ("contrast explained", ".0%", "share of the image's contrast that the rendering explains"),
    "further_step": ("further step", ".2g", "that newly drawn rays ask for, relative to the distance of the scene, and radians"),
    "colour_ratio": ("differences of colour", ".1f", "relative to those of the map's own images"),
}  # fmt: skip
"""Label, format and meaning of each measure of a pose that landmarks did not find."""


def bar(value: float, threshold: float, at_least: bool) -> Json | None:
    """Return a value on a linear scale from 0 to 1, whose middle is the threshold and whose end is twice that or more.

    If ``at_least`` is set, values below the threshold fail, else those above it. Returns None if the value is not finite
    or the threshold not positive.
    """
    if not math.isfinite(value) or threshold <= 0:
        return None
    return {"value": min(max(0.0, value / threshold / 2), 1.0), "at_least": at_least}


@dataclass(frozen=True)
class Figure:
    """A measure of a pose, and the threshold with which it is compared."""

    name: str
    value: str
    threshold: str  # with "at least" or "at most"; empty for a measure without one
    passed: bool | None  # None if there is no threshold
    bar: Json | None
    meaning: str
    pose: str = ""  # which one is measured, if not the pose found

    @staticmethod
    def of(
        text: tuple[str, str, str], value: float, limit: float | None = None, is_least: bool = True
    ) -> Figure:
        """Return a figure from its name, format and meaning, its value and its bound."""
        name, spec, meaning = text
        if limit is None:
            return Figure(name, format(value, spec), "", None, None, meaning)
        bound = f"{'at least' if is_least else 'at most'} {format(limit, spec)}"
        passed = value >= limit if is_least else value <= limit
        return Figure(name, format(value, spec), bound, passed, bar(value, limit, is_least), meaning)


def acceptance_figures(found: Localization, record: SearchRecord | None) -> tuple[Figure, ...]:
    """Return the measures of an answer and, if recorded, those of a pose by landmarks that was rejected on the way to it."""
    measured, answer = found.diagnostics, last_answer(record)
    figures = list[Figure]()
    if found.confidence is not None and not isinstance(measured, Support):
        meaning = "probability that the pose is right, from all figures together"
        figures.append(Figure.of(("confidence", ".1%", meaning), found.confidence, ACCEPTED))
    if isinstance(measured, Evidence):
        figures += _of_landmarks(measured)
    elif isinstance(measured, Support):
        figures += _without_landmarks(measured)
    if answer is not None and not isinstance(measured, Evidence):
        pose = earlier(found, answer)
        figures += [replace(figure, pose=pose) for figure in _of_landmarks(answer.evidence)]
    return tuple(sorted(figures, key=lambda figure: figure.passed is not False))  # what failed comes first


def _of_landmarks(evidence: Evidence) -> Iterator[Figure]:
    bounds = {bound.measure: bound for bound in LANDMARK_BOUNDS}
    for measure, text in MEASURES.items():
        value, bound = getattr(evidence, measure), bounds.get(measure)
        if value is None or (measure == "log10_nfa" and not evidence.searched):
            continue
        if bound is None:
            yield Figure.of(text, value)
        elif measure == "log10_nfa":
            chance, limit = (10.0 ** min(max(power, -300), 300) for power in (value, bound.limit))
            exponents = bar(bound.limit / min(value, -0.01), 1.0, False)
            yield replace(Figure.of(text, chance, limit, bound.is_least), bar=exponents)
        else:
            yield Figure.of(text, value, bound.limit, bound.is_least)


def _without_landmarks(measured: Support) -> Iterator[Figure]:
    for bound in SUPPORT_BOUNDS:
        value, limit = getattr(measured, bound.measure), measured.limits.get(bound.measure, bound.limit)
        if value is not None and bound.measure in WITHOUT_LANDMARKS:
            yield Figure.of(WITHOUT_LANDMARKS[bound.measure], value, limit, bound.is_least)
