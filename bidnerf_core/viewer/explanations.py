"""The competing explanations of an image that a localization compared, with their probabilities."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.localization import (
    CAMERAS,
    DISPLACEMENT,
    MIRROR,
    MOVING,
    NO_RIVAL,
    Answer,
    Localization,
    SearchRecord,
    Support,
    odds,
)
from bidnerf_core.results import pose_error
from bidnerf_core.viewer.packing import Json
from bidnerf_core.viewer.scene import rows_of

HERE, EARLIER = "the pose found", "an earlier pose by landmarks, which was given up"
APART, TURNED_DEG = 0.1, 10.0
"""Distance (fraction of that to the scene) and angle beyond which two poses are different answers."""


def last_answer(record: SearchRecord | None) -> Answer | None:
    """Return the last pose by landmarks of a search; None if there was none."""
    return None if record is None or not record.answers else record.answers[-1]


def contests(found: Localization, record: SearchRecord | None) -> tuple[Json, ...]:
    """Return all comparisons: the pose with those of other places and of the mirror image, with its rivals, and of cameras."""
    shown, answer, support = list[Json](), last_answer(record), found.diagnostics
    if answer is not None and len(answer.modes) > 1:
        shown.append(_of_modes(found, answer))
    if isinstance(support, Support) and support.displaced is not None:
        shown.append(_of_support(support, support.displaced))
    if answer is not None:
        shown.append(_of_cameras(found, answer))
    return tuple(shown)


def earlier(found: Localization, answer: Answer) -> str:
    """Return ``EARLIER`` if a pose by landmarks is another one than the pose found, else an empty text."""
    off = pose_error(answer.T_world_rig.to("cpu"), found.T_world_camera.to("cpu"))
    near = float(off.translation) <= APART * answer.distance and float(off.rotation_deg) <= TURNED_DEG
    return "" if near else EARLIER


def probable_poses(answer: Answer) -> list[tuple[int, SE3, float]]:
    """Return the number, the most probable pose and the probability of each mode, the most probable mode first."""
    posterior, found = answer.posterior, list[tuple[int, SE3, float]]()
    for mode in range(len(answer.modes)):
        probability = float(posterior.probability[posterior.states.mode == mode].sum())
        found.append((mode, posterior.place(mode).to("cpu"), probability))
    return sorted(found, key=lambda each: -each[2])


def _contest(
    question: str,
    answers: Iterable[tuple[str, float] | tuple[str, float, Sequence[float] | None]],
    remark: str = "",
    of_pose: bool = True,
) -> Json:
    """Return a comparison of poses or cameras: names, probabilities and, for other poses, the 16 numbers of T_world_camera."""
    shown = [
        {"pose": None} | dict(zip(("name", "probability", "pose"), each, strict=False)) for each in answers
    ]
    return {"question": question, "answers": shown, "remark": remark, "of_pose": of_pose}


def _of_modes(found: Localization, answer: Answer) -> Json:
    shown, here, best = [], answer.T_world_rig.to("cpu"), answer.posterior.mode
    for mode, T, probability in probable_poses(answer):
        apart = float((T.translation - here.translation).norm())
        name = f"a pose {apart:.3g} {symbol(found.unit)} away"
        if mode == best:
            name = earlier(found, answer) or HERE
        name = "the mirror image" if answer.modes[mode].name == MIRROR else name
        shown.append((name, probability, None if mode == best else rows_of(T)))
    others = {mode.name == MIRROR for mode in answer.modes[1:]}
    question = "Pose or mirror image?" if others == {True} else "This pose or another?"
    return _contest("This pose, another, or the mirror image?" if len(others) > 1 else question, shown)


def _of_cameras(found: Localization, answer: Answer) -> Json:
    posterior, names = answer.posterior, answer.explanations.names
    own = posterior.probability * (posterior.states.mode == posterior.mode)
    shown = dict[str, float]()
    for row, probability in zip(posterior.states.row.tolist(), (own / own.sum()).tolist(), strict=True):
        camera = names[row].removesuffix(MOVING)
        name = CAMERAS[camera] + (", with rolling shutter" if names[row].endswith(MOVING) else "")
        shown[name] = shown.get(name, 0.0) + probability
    # Explanations that are less probable than one in a thousand are not listed.
    likely = [each for each in sorted(shown.items(), key=lambda each: -each[1]) if each[1] >= 0.001]
    pose = earlier(found, answer)
    return _contest("Whose camera took it?", likely, f"Weighed at {pose}." if pose else "", of_pose=False)


def _of_support(support: Support, displaced: float) -> Json:
    rivals = [
        (f"the pose moved by {DISPLACEMENT:.0%} of its distance to the scene", displaced),
        ("another pose of the search", support.other),
        ("an image of a single colour", support.plain),
    ]
    weights = [(HERE, 1.0), *((name, odds(-against)) for name, against in rivals if against < NO_RIVAL)]
    total = sum(weight for _, weight in weights)
    moved = displaced < min(0.0, support.other, support.plain)
    remark = "The image fits better when the pose is moved: it is not even a local optimum." if moved else ""
    return _contest("What fits the image best?", [(name, w / total) for name, w in weights], remark)
