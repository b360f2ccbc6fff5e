"""Tracking a whole sequence, and the resulting path: its pose file, its errors, its plot."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bidnerf_core.captures import UpDirection, as_given
from bidnerf_core.datasets import FileSequence, FrameSequence, TimedFrame, open_sequence
from bidnerf_core.errors import InputError, InputWarning, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.localization import (
    Localization,
    Localizer,
    SceneMap,
    Start,
    Tracker,
    TrackerConfig,
    landmark_cameras,
)
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.maps import MapInfo
from bidnerf_core.progress import Cancel, ProgressCallback, counter
from bidnerf_core.results.answers import Answer, Answers, Failure
from bidnerf_core.results.errors import standard_deviations, within
from bidnerf_core.results.trajectory import ErrorSummary, TrajectoryErrors, spans
from bidnerf_core.results.trajectory_plot import PlottedPath, plot_path

log = logging.getLogger("bidnerf")

TRIED = 3
"""Number of unreadable frames at the beginning of a sequence after which tracking is given up: probably none
can be read."""
SAME_POSE = 1e-4
"""Difference between the matrices of two poses (metres) that rounding in files may cause."""


def track(
    scene: SceneMap | Localizer,
    sequence: FrameSequence | str | Path,
    *,
    config: TrackerConfig | None = None,
    start: Start | None = None,
    depth: bool = True,
    every: int = 1,
    path: TrackedPath | None = None,
    each: Callable[[Frame, Answer], None] | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> TrackedPath:
    """Find the poses of a sequence's frames in a map, in chronological order.

    ``scene``: a map, or a localizer with its own settings. ``sequence``: the result of ``open_sequence``, or
    the path of a dataset, a folder of images or a video, whose images use the map's cameras if they have none
    of their own. ``start``: an estimate of the first T_world_camera. ``depth``: whether measured depth is
    used. ``every``: use only every n-th frame. ``path``: collects the answers, by default a new path; it
    holds those so far if an error ends the tracking. ``each`` is called with each frame and its answer,
    ``progress`` after each frame.

    A frame whose files cannot be read is left out with an ``InputWarning`` and counted in ``unread``. Raises
    ``InputError`` if none of the first frames can be read, and ``Cancelled`` once ``cancel`` returns True.
    """
    if every < 1:
        raise InputError(f"every is {every}", expected="1 or more")
    localizer = scene if isinstance(scene, Localizer) else Localizer(scene)
    if not isinstance(sequence, FrameSequence):
        sequence = opened_for(localizer.scene, sequence)
    path = TrackedPath.of(localizer.scene) if path is None else path
    tracker = Tracker(localizer, config, start)
    total = -(-len(sequence) // every)
    count = counter("tracking", "frames", progress, cancel)
    for number, timed in enumerate(_every(sequence, every)):
        if isinstance(timed, TimedFrame):
            frame = timed.frame if depth else timed.frame.replace(depth=None)
            answer = path.add(frame, tracker(frame, timed.time), timed.time, timed.truth, every * number)
            if each is not None:
                each(timed.frame, answer)
        elif not path.answers and number + 1 >= min(TRIED, total):
            first = "the first frame cannot" if number == 0 else f"none of the first {number + 1} frames can"
            raise InputError(f"{first} be read: {timed}")
        else:
            warnings.warn(f"{timed}; left out", InputWarning, stacklevel=2)
            path.unread += 1
        count(number + 1, total)
    return path


def opened_for(scene: SceneMap, path: str | Path, **options: Any) -> FrameSequence:
    """Open a sequence as ``open_sequence`` does, with the map's background and its cameras for images that have none."""
    return open_sequence(path, assumed=landmark_cameras(scene), background=scene.bounds.background, **options)


def _every(frames: FrameSequence, every: int) -> Iterator[TimedFrame | InputError]:
    """Yield every n-th frame; if each has its own files, an unreadable one is yielded as an error."""
    if not isinstance(frames, FileSequence):
        yield from islice(frames, 0, None, every)
        return
    for place in range(0, len(frames), every):
        try:
            yield frames[place]
        except InputError as error:
            yield error


class TrackedPath(Answers):
    """The answers to the frames of a sequence, in chronological order."""

    def __init__(self, info: MapInfo | None = None) -> None:
        """Start an empty path in the map that ``info`` describes."""
        super().__init__("" if info is None else info.backend, "units" if info is None else info.unit)
        self.unread = 0  # frames whose files could not be read
        cameras = () if info is None else as_given(info.cameras)
        origin = (0.0, 0.0, 0.0) if info is None else info.origin
        self._origin = torch.tensor(origin, dtype=torch.float64)
        self._trained_on = {camera.name: camera.pose.translated(self._origin) for camera in cameras}
        self._lost_at: int | None = None
        self._camera_sources: set[str] = set()

    @staticmethod
    def of(scene: SceneMap) -> TrackedPath:
        """Return an empty path in a map."""
        return TrackedPath(getattr(scene, "info", None))

    def add(
        self,
        frame: Frame,
        found: Localization,
        time: float | None = None,
        truth: SE3 | None = None,
        number: int | None = None,
    ) -> Answer:
        """Add the answer to a frame, and return it. Tracking losses and recoveries are logged.

        ``number`` is the frame's index in its sequence, by default one more than the last. ``time`` is in
        seconds, ``truth`` is the true T_world_camera.
        """
        if number is None:
            number = self.answers[-1].number + 1 if self.given else 0
        if frame.camera_source and frame.camera_source not in self._camera_sources:
            self._camera_sources.add(frame.camera_source)
            log.info("%s: %s", frame.name, frame.camera_source)
        answer = Answer.of(frame, number, found, truth=truth, time=time)
        self.append(answer)
        if not found.converged and self._lost_at is None:
            self._lost_at = len(self)
            log.info("frame %d (%s): %s: %s", number + 1, frame.name, found.outcome, found.reason)
        elif found.converged and self._lost_at is not None:
            missed = amount(len(self) - self._lost_at, "frame")
            log.info("frame %d (%s): tracking again after %s", number + 1, frame.name, missed)
            self._lost_at = None
        return answer

    def plain(self, answer: Answer | Failure) -> dict[str, Any]:
        """Return a frame's answer as JSON values: the keys of ``localize --json``, and ``time``."""
        time = answer.time if isinstance(answer, Answer) else None
        return {"frame": answer.name, "time": time} | super().plain(answer)

    @property
    def lost(self) -> list[tuple[int, int]]:
        """The first and the last index of each run of frames without an accepted pose."""
        return spans([not answer.accepted for answer in self.answers])

    @property
    def without_times(self) -> bool:
        """Whether no frame has a time stamp."""
        return all(answer.time is None for answer in self.answers)

    def errors(self) -> TrajectoryErrors | None:
        """Return the errors of the accepted poses whose truth is known, or None if there are none."""
        known = [(a.found.T_world_camera, a.truth) for a in self.accepted if a.truth is not None]
        if not known:
            return None
        return TrajectoryErrors.of(SE3.stack([found for found, _ in known]), SE3.stack([t for _, t in known]))

    def consistency(self) -> float | None:
        """Return the fraction of accepted poses whose error lies within the 95 % bound of their covariance,
        or None if unknown.
        """
        inside = [
            bool(within(answer.found.T_world_camera, answer.truth, answer.found.covariance))
            for answer in self.accepted
            if answer.truth is not None and answer.found.covariance is not None
        ]
        return sum(inside) / len(inside) if inside else None

    def trained_on(self) -> int:
        """Return the number of frames that are training images of the map, judging by names and true poses."""
        return sum(map(self._is_of_training, self.answers))

    def plot(
        self, file: str | Path, surface: SurfaceMap | None = None, up: UpDirection | None = None
    ) -> None:
        """Draw the path over the surface of its map, as PNG or SVG by file extension.

        ``up`` is the upward direction of the scene (``Map.up``), by default estimated from the surface and
        the cameras.

        Raises ``InputError`` without matplotlib or without any finite pose.
        """
        drawn = [a for a in self.answers if bool(a.found.T_world_camera.matrix().isfinite().all())]
        if not drawn:
            raise InputError("not drawn, since no frame was tracked", where=file)
        path = PlottedPath(
            SE3.stack([a.found.T_world_camera for a in drawn]).translated(-self._origin),
            torch.tensor([answer.accepted for answer in drawn]),
            torch.tensor([_deviation(a.found.covariance) for a in drawn], dtype=torch.float64),
            [None if a.truth is None else a.truth.translated(-self._origin) for a in drawn],
            self.unit,
        )
        plot_path(path, surface, Path(file), up)

    def summary(self, seconds: float) -> list[tuple[str, str]]:
        """Return the rows of a table that describes a run that took ``seconds``: frames, losses, errors."""
        total, accepted, lost = len(self), len(self.accepted), self.lost
        longest = max((last - first + 1 for first, last in lost), default=0)
        rows = [
            ("frames", f"{total}, {total / max(seconds, 1e-9):.1f} per second"),
            ("tracked", f"{accepted} ({accepted / max(1, total):.1%})"),
            ("not read", amount(self.unread, "frame") if self.unread else ""),
            (
                "lost",
                f"{amount(len(lost), 'time')}, at most for {amount(longest, 'frame')}" if lost else "never",
            ),
        ]
        unit = symbol(self.unit)
        if (errors := self.errors()) is not None:
            rows.append(("raw error", _written(errors.raw, unit)))
            if errors.ate is not None:
                rows.append(("ATE", f"{errors.ate:.4f} {unit} (root mean square, rigidly aligned)"))
            if errors.rpe is not None:
                rows.append(("RPE per frame", _written(errors.rpe, unit)))
        if (share := self.consistency()) is not None:
            rows.append(("inside 95 % bound", f"{share:.1%} (by the poses' covariances)"))
        if seen := self.trained_on():
            no_test = "errors on training frames of the map are no test"
            rows.append(("trained on", f"{amount(seen, 'frame')}; {no_test}"))
        return [(name, text) for name, text in rows if text]

    def _is_of_training(self, answer: Answer) -> bool:
        given = self._trained_on.get(answer.name)
        if given is None or answer.truth is None:
            return False
        return torch.allclose(given.matrix(), answer.truth.matrix(), rtol=0, atol=SAME_POSE)


def _written(summary: ErrorSummary, unit: str) -> str:
    return (
        f"median {summary.translation_median:.4f} {unit}, {summary.rotation_deg_median:.3f} deg;"
        f" 95 % within {summary.translation_p95:.4f} {unit}, {summary.rotation_deg_p95:.3f} deg"
    )


def _deviation(covariance: Tensor | None) -> float:
    return math.nan if covariance is None else standard_deviations(covariance)[0]
