"""``track``: the poses of a sequence, collected as answers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

from bidnerf.results.answers import Answer, Answers
from bidnerf_core.datasets import BreaksOff, Capture, open_sequence
from bidnerf_core.errors import InputError, InputWarning, amount
from bidnerf_core.frames import Frame
from bidnerf_core.localization import SceneMap
from bidnerf_core.maps import Localizer, Tracker, TrackerConfig, landmark_cameras
from bidnerf_core.progress import Cancel, ProgressCallback, job_context, log, report_each


def track(
    scene: SceneMap | Localizer | Tracker,
    sequence: Capture | str | Path,
    *,
    every: int = 1,
    depth: bool = True,
    answers: Answers | None = None,
    each: Callable[[Frame, Answer], None] | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Answers:
    """Find the poses of a sequence's frames in a map, in chronological order.

    ``scene``: a map, a localizer with its own settings, or a tracker with its own settings and start.
    ``sequence``: the result of ``open_sequence``, or the path of a dataset, a folder of images or a video;
    images without a camera of their own use the map's cameras. ``every``: use only every n-th frame. ``depth``:
    whether measured depth is used. ``answers``: the object that collects the answers, by default a new one; if
    an error ends the tracking, it holds the answers so far. ``each`` is called with each frame and its answer,
    ``progress`` after each frame.

    A frame whose files cannot be read is left out with an ``InputWarning`` and counted in ``unread``. Raises
    ``InputError`` if none of the first frames can be read, and ``Cancelled`` once ``cancel`` returns True.
    """
    if every < 1:
        raise InputError(f"every is {every}", expected="1 or more")
    localizer = scene if isinstance(scene, Localizer | Tracker) else Localizer(scene)
    tracker = localizer if isinstance(localizer, Tracker) else Tracker(localizer)
    if not isinstance(sequence, Capture):
        stored = tracker.localizer.scene
        sequence = open_sequence(sequence, assumed=landmark_cameras(stored), background=stored.bounds.background)
    if answers is None:
        answers = Answers(tracker.localizer.scene, is_sequence=True, interval=TrackerConfig().frame_seconds)
    indices, sources, lost_at = range(0, len(sequence), every), set[str](), None
    with job_context(progress, cancel):
        for number, index in enumerate(report_each(indices, "tracking", "frames")):
            try:
                timed = sequence[index]
            except BreaksOff:
                raise
            except InputError as error:
                # If none of the first three frames can be read, probably none can.
                if not answers.answers and number + 1 >= min(3, len(indices)):
                    many = "the first frame cannot" if number == 0 else f"none of the first {number + 1} frames can"
                    raise InputError(f"{many} be read: {error}") from error
                warnings.warn(f"{error}; left out", InputWarning, stacklevel=2)
                answers.unread += 1
            else:
                frame = timed.frame if depth else timed.frame.replace(depth=None)
                localization, file = tracker(frame, timed.time), sequence.shots[index].file
                answer = Answer.of(frame, index, localization, truth=timed.truth, time=timed.time, file=file)
                answers.append(answer)
                if frame.camera_source and frame.camera_source not in sources:
                    sources.add(frame.camera_source)
                    log.info("%s: %s", frame.name, frame.camera_source)
                if not localization.converged and lost_at is None:
                    lost_at = len(answers)
                    log.info("frame %d (%s): %s: %s", index + 1, frame.name, localization.outcome, localization.reason)
                elif localization.converged and lost_at is not None:
                    missed = amount(len(answers) - lost_at, "frame")
                    log.info("frame %d (%s): tracking again after %s", index + 1, frame.name, missed)
                    lost_at = None
                if each is not None:
                    each(timed.frame, answer)
    return answers
