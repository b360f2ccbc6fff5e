"""The explanations of an image that a localization weighed, with their probabilities."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import Localization
from bidnerf_core.localization.acceptance import SurfaceDiagnostics
from bidnerf_core.localization.beyond_chance import DISPLACEMENT, NO_RIVAL, Support
from bidnerf_core.localization.landmarks.chance import odds, probability_of
from bidnerf_core.localization.landmarks.hypotheses import (
    APPROXIMATE,
    CROPPED_IMAGE,
    INEXACT,
    STATED,
    WRONG_CAMERA,
    WRONG_FOCAL,
    Explanation,
    Motion,
    Posterior,
    Whose,
)
from bidnerf_core.localization.recording import SearchRecord
from bidnerf_core.viewer.scene import rows_of

LEAST_SHOWN = 0.001
"""Least probability of an explanation that is listed."""
CAMERA_NAMES = {
    STATED: "the camera as given",
    INEXACT: "the camera as given, nearly",
    WRONG_FOCAL: "another focal length",
    WRONG_CAMERA: "another camera",
    APPROXIMATE: "the camera as given, approximately",
    CROPPED_IMAGE: "a cropped image",
}
MOTIONS = {
    Motion.STILL: "",
    Motion.MOVING: ", moving while rows were exposed",
    Motion.TRANSPOSED: ", moving while columns were exposed",
}


@dataclass(frozen=True)
class ShownExplanation:
    """An explanation, the question that it answers, and its probability among the answers."""

    question: str
    name: str
    probability: float
    chosen: bool
    pose: tuple[float, ...] | None = None  # T_world_camera, 16 numbers by rows, of another pose


def explanations(found: Localization, record: SearchRecord | None) -> tuple[ShownExplanation, ...]:
    """Return what was weighed: whose camera it is, whether another pose or a mirror image fits, and rivals of the pose."""
    shown = list[ShownExplanation]()
    if record is not None:
        if record.landmarks and record.landmarks[-1].guided is not None:
            shown += _of_camera(record.landmarks[-1].guided.posterior)
        for other in record.explanations:
            shown += _two("which pose", other.reason, other.log_odds, other.T)
    support = found.diagnostics
    if isinstance(support, SurfaceDiagnostics):
        support = support.support
    if isinstance(support, Support):
        shown += _of_support(support)
    return tuple(shown)


def _of_camera(posterior: Posterior) -> list[ShownExplanation]:
    weighed = list(zip(posterior.explanations, posterior.probabilities, strict=True))
    question = "whose camera"
    return sorted(
        (
            ShownExplanation(question, _name(each), p, each is posterior.best)
            for each, p in weighed
            if p >= LEAST_SHOWN or each is posterior.best
        ),
        key=lambda shown: -shown.probability,
    )


def _name(each: Explanation) -> str:
    name = each.hypothesis.name
    known = (
        "the camera of the map's images"
        if each.hypothesis.whose is Whose.MAP
        else CAMERA_NAMES.get(name, name)
    )
    return known + MOTIONS[each.motion]


def _two(question: str, reason: str, log_odds: float, other: SE3 | None) -> list[ShownExplanation]:
    p = probability_of(log_odds)
    return [
        ShownExplanation(question, "the pose found", p, log_odds >= 0),
        ShownExplanation(question, reason, 1 - p, log_odds < 0, None if other is None else rows_of(other)),
    ]


def _of_support(said: Support) -> list[ShownExplanation]:
    rivals = [
        (f"a pose displaced by {DISPLACEMENT:.0%} of the distance", said.displaced),
        ("another pose of the search", said.other),
        ("any image of a single colour", said.plain),
    ]
    weights = [(name, odds(-against)) for name, against in rivals if against < NO_RIVAL]
    total = 1 + sum(weight for _, weight in weights)
    shown = [ShownExplanation("which pose", "the pose found", 1 / total, True)]
    return shown + [ShownExplanation("which pose", name, w / total, False) for name, w in weights]
