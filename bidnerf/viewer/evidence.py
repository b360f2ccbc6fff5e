"""The evidence for and against a pose: the competing explanations, and each measure with its threshold."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from bidnerf.results import is_pose_of
from bidnerf.viewer.pictures import JsonObject
from bidnerf.viewer.scene import matrix_rows
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.localization import (
    ACCEPTED,
    CAMERAS,
    DISPLACEMENT,
    Evidence,
    LandmarkAnswer,
    Localization,
    SearchRecord,
    Support,
    odds,
)

HERE, EARLIER = "the pose found", "an earlier pose by landmarks, which was given up"


def last_answer(record: SearchRecord | None) -> LandmarkAnswer | None:
    """Return the last pose from landmarks in the record of a search, or None if there is none."""
    return None if record is None or not record.answers else record.answers[-1]


def contests(localization: Localization, record: SearchRecord | None) -> tuple[JsonObject, ...]:
    """Return up to three comparisons: between poses by landmarks, of the pose with other explanations, and between cameras."""
    shown, answer, support = list[JsonObject](), last_answer(record), localization.diagnostics
    if answer is not None and len(answer.modes) > 1:
        shown.append(_compare_modes(localization, answer))
    if isinstance(support, Support) and "displaced" in support.measures:
        shown.append(_compare_rivals(support))
    if answer is not None:
        shown.append(_compare_cameras(localization, answer))
    return tuple(shown)


def name_earlier(localization: Localization, answer: LandmarkAnswer) -> str:
    """Return ``EARLIER`` if the pose from landmarks differs from the pose found, else an empty string."""
    return "" if is_pose_of(localization, answer) else EARLIER


def probable_poses(answer: LandmarkAnswer) -> list[tuple[int, SE3, float]]:
    """Return the index, the most probable pose and the probability of each mode, in order of decreasing probability."""
    posterior = answer.posterior
    poses = [
        (mode, posterior.place(mode).to("cpu"), float(posterior.probability[posterior.states.mode == mode].sum()))
        for mode in range(len(answer.modes))
    ]
    return sorted(poses, key=lambda each: -each[2])


def _contest(
    question: str,
    answers: Iterable[tuple[str, float] | tuple[str, float, Sequence[float] | None]],
    note: str = "",
    of_pose: bool = True,
) -> JsonObject:
    """Return a comparison of poses or cameras: names, probabilities and, for other poses, the 16 numbers of T_world_camera."""
    return {
        "question": question,
        "answers": [
            {"pose": None} | dict(zip(("name", "probability", "pose"), each, strict=False)) for each in answers
        ],
        "note": note,
        "of_pose": of_pose,
    }


def _compare_modes(localization: Localization, answer: LandmarkAnswer) -> JsonObject:
    shown, here, best = [], answer.T_world_rig.to("cpu"), answer.posterior.mode
    for mode, T, probability in probable_poses(answer):
        distance = float((T.translation - here.translation).norm())
        name = f"a pose {distance:.3g} {symbol(localization.unit)} away"
        if mode == best:
            name = name_earlier(localization, answer) or HERE
        name = "the mirror image" if answer.modes[mode].mirrored else name
        shown.append((name, probability, None if mode == best else matrix_rows(T)))
    others = {mode.mirrored for mode in answer.modes[1:]}
    question = "Pose or mirror image?" if others == {True} else "This pose or another?"
    return _contest("This pose, another, or the mirror image?" if len(others) > 1 else question, shown)


def _compare_cameras(localization: Localization, answer: LandmarkAnswer) -> JsonObject:
    posterior, given = answer.posterior, answer.explanations
    own = posterior.probability * (posterior.states.mode == posterior.mode)
    shown = dict[str, float]()
    for row, probability in zip(posterior.states.row.tolist(), (own / own.sum()).tolist(), strict=True):
        name = CAMERAS[given.cameras[row]] + (", with rolling shutter" if given.moves[row] else "")
        shown[name] = shown.get(name, 0.0) + probability
    # Explanations that are less probable than one in a thousand are not listed.
    likely = [each for each in sorted(shown.items(), key=lambda each: -each[1]) if each[1] >= 0.001]
    return _contest(
        "Whose camera took it?",
        likely,
        f"Weighed at {EARLIER}." if name_earlier(localization, answer) else "",
        of_pose=False,
    )


def _compare_rivals(support: Support) -> JsonObject:
    names = {
        "displaced": f"the pose moved by {DISPLACEMENT:.0%} of its distance to the scene",
        "other": "another pose of the search",
        "plain": "an image of a single colour",
    }
    against = {name: each for name in names if (each := support.measures.get(name)) is not None}
    weights = [(HERE, 1.0), *((names[name], odds(-each)) for name, each in against.items())]
    total = sum(weight for _, weight in weights)
    moved = against["displaced"] < min([0.0, *(each for name, each in against.items() if name != "displaced")])
    note = "The image fits better when the pose is moved: it is not even a local optimum." if moved else ""
    return _contest("What fits the image best?", [(name, w / total) for name, w in weights], note)


MEASURES = {
    "log10_nfa": ("poses as good by chance", ".0e", "number expected of wrong poses; the bar compares exponents"),
    "inliers": (
        "landmarks that agree",
        ".0f",
        "matched near where the pose predicts them, within three standard deviations",
    ),
    "mirrored": ("mirrored", ".0f", "1 if the mirror image fits the map better than the image"),
    "above_chance": (
        "more than by chance",
        ".1f",
        "ratio of the landmarks that agree to those that would at a wrong pose",
    ),
    "spread": ("spread over the image", ".0%", "share of the image's cells that hold a landmark that agrees"),
    "other_view": ("another view", ".0f", "other keypoints of the image that match from another pose"),
    "other_place": ("another place or the mirror image", ".1%", "probability that it explains the image instead"),
    "credible": (
        "camera as stated, or nearly",
        ".0%",
        "probability of the explanations of the camera that the image may have",
    ),
    "precision": ("uncertainty of the position", ".2%", "standard deviation, as a share of the distance to the scene"),
    "difference": (
        "difference from the rendering",
        ".1f",
        "of a small image, relative to that of the map's own images from theirs",
    ),
    "mass": ("pose within the tolerance", ".0%", "probability by all explanations of the image together"),
    "replaced": (
        "another camera than stated",
        ".0%",
        "probability that it is not even like the map's; not tested by itself",
    ),
    "recall": (
        "landmarks recognised",
        ".0%",
        "share of the landmarks in view, or of the keypoints, that match; not tested by itself",
    ),
    "noise_ratio": ("reprojection errors", ".1f", "relative to those of the map's own images; not tested by itself"),
    "on_surface": (
        "measured points on the surface",
        ".0%",
        "share of the measured depth that lies there; not tested by itself",
    ),
    "colour_inliers": (
        "points with the surface's colour",
        ".0%",
        "share that lies there and has its colour; not tested by itself",
    ),
}
"""Label, format and meaning of each measure of a pose found by landmarks; the measures with a bound come first."""
WITHOUT_LANDMARKS = {
    "mean_loss": ("mean loss", ".3g", "of the last steps of the descent"),
    "on_surface": (
        "measured points on the surface",
        ".0%",
        "share of the measured depth that lies on the map's surface",
    ),
    "colour_inliers": ("points with the surface's colour", ".0%", "share that lies there and has its colour"),
    "free_space_violations": (
        "lines of sight through the surface",
        ".0%",
        "share that meets the surface well before the point that was measured",
    ),
    "image_inliers": (
        "small image that agrees",
        ".0%",
        "share of a small image that agrees with the surface's rendering at the best pose",
    ),
    "runner_up_margin": (
        "lead over the runner-up",
        ".2f",
        "by how much the best different pose of the search is worse",
    ),
    "rendered_inliers": (
        "rendered rays that agree",
        ".0%",
        "share of the rays whose rendering agrees with what was measured",
    ),
    "new_inliers": (
        "new rays that agree",
        ".0%",
        "share of newly drawn rays whose rendering agrees with what was measured",
    ),
    "confidence": (
        "distinguished from rivals",
        ".0%",
        "its probability among poses moved a little, the best different pose of the search and a plain image",
    ),
    "explained": ("contrast explained", ".0%", "share of the image's contrast that the rendering explains"),
    "further_step": (
        "further step",
        ".2g",
        "that newly drawn rays ask for, relative to the distance of the scene, and radians",
    ),
    "colour_ratio": ("differences of colour", ".1f", "relative to those of the map's own images"),
}
"""Label, format and meaning of each measure of a pose that landmarks did not find."""


def bar(value: float, threshold: float, at_least: bool) -> JsonObject | None:
    """Return the position of a value on a linear scale from 0 to 1, on which the threshold is at 0.5 and values are clamped to 1.

    If ``at_least`` is set, values below the threshold fail; otherwise, values above the threshold fail. Returns None
    if the value is not finite or the threshold is not positive.
    """
    if not math.isfinite(value) or threshold <= 0:
        return None
    return {"value": min(max(0.0, value / threshold / 2), 1.0), "at_least": at_least}


def _figure(text: tuple[str, str, str], value: float, limit: float | None = None, is_least: bool = True) -> JsonObject:
    """Return the ``name`` of a measure of a pose, its ``value`` and its ``meaning``, and the threshold that it is compared with.

    ``text`` holds the name, the format and the meaning. ``threshold`` begins with "at least" or "at most", and is empty for a
    measure without a ``limit``, for which ``passed`` is None. ``pose`` describes the measured pose if it is not the pose found.
    """
    name, spec, meaning = text
    figure = {"name": name, "value": format(value, spec), "meaning": meaning, "pose": ""}
    if limit is None:
        return figure | {"threshold": "", "passed": None, "bar": None}
    return figure | {
        "threshold": f"{'at least' if is_least else 'at most'} {format(limit, spec)}",
        "passed": value >= limit if is_least else value <= limit,
        "bar": bar(value, limit, is_least),
    }


def acceptance_figures(localization: Localization, record: SearchRecord | None) -> tuple[JsonObject, ...]:
    """Return the measures of the pose found and, if landmarks did not find it, of the last pose that they found; failures first."""
    measured, answer = localization.diagnostics, last_answer(record)
    figures = list[JsonObject]()
    if localization.confidence is not None and not isinstance(measured, Support):
        figures.append(
            _figure(
                ("confidence", ".1%", "probability that the pose is right, from all figures together"),
                localization.confidence,
                ACCEPTED,
            )
        )
    if isinstance(measured, Evidence):
        figures += _landmark_figures(measured)
    elif isinstance(measured, Support):
        figures += [
            _figure(WITHOUT_LANDMARKS[bound.measure], value, bound.limit, bound.is_least)
            for bound, value in measured.bounds
            if bound.measure in WITHOUT_LANDMARKS
        ]
    if answer is not None and not isinstance(measured, Evidence):
        pose = name_earlier(localization, answer)
        figures += [figure | {"pose": pose} for figure in _landmark_figures(answer.evidence)]
    return tuple(sorted(figures, key=lambda figure: figure["passed"] is not False))  # what failed comes first


def _landmark_figures(evidence: Evidence) -> Iterator[JsonObject]:
    bounds = {bound.measure: bound for bound, _ in evidence.bounds}
    for measure, text in MEASURES.items():
        value, bound = getattr(evidence, measure), bounds.get(measure)
        if value is None or (measure == "log10_nfa" and not evidence.searched):
            continue
        if bound is None:
            yield _figure(text, value)
        elif measure == "log10_nfa":
            chance, limit = (10.0 ** min(max(power, -300), 300) for power in (value, bound.limit))
            figure = _figure(text, chance, limit, bound.is_least)
            yield figure | {"bar": bar(bound.limit / min(value, -0.01), 1.0, False)}
        else:
            yield _figure(text, value, bound.limit, bound.is_least)
