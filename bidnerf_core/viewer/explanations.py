"""The competing explanations of an image that a localization compared, with their probabilities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.localization import (
    DECISIVE,
    DISPLACEMENT,
    NO_RIVAL,
    ComparedExplanation,
    DescentDiagnostics,
    Explanation,
    LandmarkPose,
    Localization,
    Motion,
    Posterior,
    SearchRecord,
    Stated,
    Support,
    SurfaceDiagnostics,
    Whose,
    odds,
    probability_of,
)
from bidnerf_core.results import pose_error
from bidnerf_core.viewer.scene import rows_of

LEAST_SHOWN = 0.001
"""Minimum probability of an explanation that is listed."""
CAMERA_NAMES: dict[str, str] = {
    Stated.EXACT: "given camera",
    Stated.INEXACT: "given camera (slightly off)",
    Stated.WRONG: "another camera",
    Stated.APPROXIMATE: "given camera (approximate)",
    Stated.CROPPED: "a cropped image",
}
MOTIONS = {
    Motion.STILL: "",
    Motion.MOVING: ", with rolling shutter",
}
HERE, EARLIER = "the pose found", "an earlier pose by landmarks, which was given up"
APART, TURNED_DEG = 0.1, 10.0
"""Distance (fraction of that to the scene) and angle beyond which two poses are different answers."""


KEPT = (
    f"The search keeps the pose that it found first unless another is {probability_of(DECISIVE):.1%} likely."
)


@dataclass(frozen=True)
class ShownExplanation:
    """One of the explanations in a comparison, and its probability."""

    name: str
    probability: float
    pose: tuple[float, ...] | None = None  # T_world_camera, 16 numbers by rows, of another pose


@dataclass(frozen=True)
class Contest:
    """A comparison of explanations: a question, its possible answers without the improbable ones, and a remark."""

    question: str
    answers: tuple[ShownExplanation, ...]
    remark: str = ""
    of_pose: bool = True  # whether it compares poses, else cameras


def contests(found: Localization, record: SearchRecord | None) -> tuple[Contest, ...]:
    """Return all comparisons: the pose with another one or a mirror image, with its rivals, and between possible cameras."""
    shown = list[Contest]()
    if record is not None:
        shown += [_against(found, other) for other in told(found, record)]
    support = support_of(found)
    if support is not None:
        shown.append(_of_support(support))
    if record is not None and record.landmarks and record.landmarks[-1].guided is not None:
        shown.append(_of_camera(record.landmarks[-1].guided.posterior, earlier(found, record.landmarks[-1])))
    return tuple(shown)


def told(found: Localization, record: SearchRecord) -> list[ComparedExplanation]:
    """Return the recorded comparisons of the pose found, except those of a rejected pose with a less probable mirror image.

    If the other pose of a comparison was taken instead, the pose that it replaced is the other one.
    """
    return [
        _from_found(found, each, record)
        for each in record.explanations
        if found.converged or each.T is not None or each.log_odds < DECISIVE
    ]


def _from_found(found: Localization, each: ComparedExplanation, record: SearchRecord) -> ComparedExplanation:
    if each.T is None or not record.landmarks or is_elsewhere(found, each.T, record.landmarks[-1].distance):
        return each
    return replace(each, log_odds=-each.log_odds, T=record.landmarks[-1].T_world_camera)


def is_elsewhere(found: Localization, T_world_camera: SE3, distance: float) -> bool:
    """Return whether a pose is another answer than the pose found, for a scene at a ``distance`` in the unit of the map."""
    off = pose_error(T_world_camera.to("cpu"), found.T_world_camera.to("cpu"))
    return not (float(off.translation) <= APART * distance and float(off.rotation_deg) <= TURNED_DEG)


def earlier(found: Localization, pose: LandmarkPose) -> str:
    """Return ``EARLIER`` if a pose by landmarks is another answer than the pose found, else an empty text."""
    return EARLIER if is_elsewhere(found, pose.T_world_camera, pose.distance) else ""


def support_of(found: Localization) -> Support | None:
    """Return how well measurements distinguish a pose from its rivals; None if it was not compared with any."""
    said = found.diagnostics
    if isinstance(said, SurfaceDiagnostics | DescentDiagnostics):
        return said.support
    return said if isinstance(said, Support) else None


def _against(found: Localization, other: ComparedExplanation) -> Contest:
    p = probability_of(other.log_odds)
    if other.T is None:
        rival, question = ShownExplanation("its mirror image", 1 - p), "Pose or mirror image?"
    else:
        apart = float((other.T.translation - found.T_world_camera.to("cpu", other.T.translation.dtype).translation).norm())  # fmt: skip
        name = f"a pose {apart:.3g} {symbol(found.unit)} away"
        rival, question = ShownExplanation(name, 1 - p, rows_of(other.T)), "This pose or another?"
    keeps = other.T is not None and p < 0.5 and not found.converged
    return Contest(question, (ShownExplanation(HERE, p), rival), KEPT if keeps else other.reason)


def _of_camera(posterior: Posterior, place: str) -> Contest:
    answers = sorted(
        (
            ShownExplanation(_name(each), p)
            for each, p in zip(posterior.explanations, posterior.probabilities, strict=True)
            if p >= LEAST_SHOWN
        ),
        key=lambda shown: -shown.probability,
    )
    remark = f"Weighed at {place}." if place else ""
    return Contest("Whose camera took it?", tuple(answers), remark, of_pose=False)


def _name(each: Explanation) -> str:
    name = each.hypothesis.name
    is_maps = each.hypothesis.whose is Whose.MAP
    return ("the camera of the map's images" if is_maps else CAMERA_NAMES.get(name, name)) + MOTIONS[
        each.motion
    ]


def _of_support(said: Support) -> Contest:
    rivals = [
        (f"the pose moved by {DISPLACEMENT:.0%} of its distance to the scene", said.displaced),
        ("another pose of the search", said.other),
        ("an image of a single colour", said.plain),
    ]
    weights = [(name, odds(-against)) for name, against in rivals if against < NO_RIVAL]
    total = 1 + sum(weight for _, weight in weights)
    answers = (ShownExplanation(HERE, 1 / total), *(ShownExplanation(name, w / total) for name, w in weights))
    return Contest("What fits the image best?", answers, "".join(_worse_than_moved(said)))


def _worse_than_moved(said: Support) -> Iterator[str]:
    if said.displaced < min(0.0, said.other, said.plain):
        yield "The image fits better when the pose is moved: it is not even a local optimum."
