"""``bidnerf track``."""

from __future__ import annotations

import sys
import time as clocks
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.camera.source import CameraSource
from bidnerf_core.cli.another_scene import question_about_scene
from bidnerf_core.cli.camera_options import (
    CameraFile,
    DepthSensorName,
    FieldOfView,
    FocalLength,
    RegisterDepth,
    depth_registration,
)
from bidnerf_core.cli.following import STDIN, requests
from bidnerf_core.cli.opened_map import opened_map
from bidnerf_core.cli.options import Flag, MapFolder, UsageError, option, parse, require
from bidnerf_core.cli.output import print_json, print_table, say
from bidnerf_core.cli.progress import counted
from bidnerf_core.cli.starts import read_pose
from bidnerf_core.cli.tracked_path import TrackedPath, check_out
from bidnerf_core.cli.tracking_video import TrackingVideo, check_video
from bidnerf_core.datasets import FileSequence, FrameSequence, ReadOptions, TimedFrame, open_sequence
from bidnerf_core.depth.registration import DepthCamera
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import AutoConfig, Localization, Localizer, Tracker, TrackerConfig
from bidnerf_core.results.plot_style import require_matplotlib

TRIED = 3
"""Number of unreadable frames at the beginning of a sequence after which it is given up: probably none can be read."""


def run(arguments: list[str]) -> None:
    def track(
        map: MapFolder,
        sequence: Annotated[
            Path,
            tyro.conf.Positional,
            option(
                "SEQUENCE",
                "folder of a dataset or of images, a video; with --follow a folder, or - for stdin",
            ),
        ],
        *,
        out: Annotated[
            Path | None,
            option(
                "TRAJECTORY",
                "file of poses, needed without --follow: .txt or .tum, transforms.json, or .json with all details",
                "",
            ),
        ] = None,
        plot: Annotated[
            Path | None,
            option("PNG", "draw the path over the map's surface, coloured by its uncertainty", ""),
        ] = None,
        video: Annotated[
            Path | None,
            option("MP4", "draw each image beside the map as rendered from its pose; takes far longer", ""),
        ] = None,
        camera: CameraFile = None,
        focal: FocalLength = None,
        hfov: FieldOfView = None,
        register_depth: RegisterDepth = None,
        depth: Annotated[bool, option(None, "use the measured depth where there is any")] = True,
        depth_sensor: DepthSensorName = "unknown",
        split: Annotated[
            str | None, option("NAME", "take the frames of one split of a dataset only", "all")
        ] = None,
        every: Annotated[int, option("N", "take every Nth frame only")] = 1,
        start: Annotated[
            Path | None, option("POSE.json", "file with a 4x4 T_world_camera of about the first frame", "")
        ] = None,
        follow: Annotated[
            Flag,
            option(
                None,
                "answer frames as they come, one JSON object per line on stdout, until Ctrl-C or the end",
                "",
            ),
        ] = False,
        config: TrackerConfig = TrackerConfig(),
    ) -> None:
        """Find the poses of a sequence's frames in a map, in chronological order.

        Each pose is predicted from those before it, refined and judged. A frame whose pose is not accepted counts as lost;
        the following ones are searched in the whole map. Where the sequence has true poses, a table shows the errors.
        """
        require("--every", every, 1)
        if follow and split is not None:
            raise UsageError("--split is for datasets, expected none with --follow")
        if out is None and not follow:
            raise UsageError("no --out, expected the name of a file of poses")
        if out is not None:
            check_out(out)
        if plot is not None:
            require_matplotlib()
        if video is not None:
            check_video(video)
        registration = depth_registration(register_depth)
        sensor = ReadOptions(register_depth=registration).sensor(sequence) if follow else None
        begin, settings = None if start is None else read_pose(start), AutoConfig(depth_sensor=depth_sensor)
        stored = opened_map(map)
        assumed = () if stored.landmarks is None else stored.landmarks.cameras
        path = TrackedPath(stored.info)
        tracker = Tracker(Localizer(stored, config=settings), config, begin)
        drawn = nullcontext() if video is None else TrackingVideo(video, stored)
        began = clocks.perf_counter()
        try:
            with drawn as drawing:
                step = _Step(tracker, path, depth, drawing)
                if follow:
                    given = CameraSource(camera, focal, hfov, assumed)
                    _follow(str(sequence), step, given, sensor, stored.bounds.background)
                else:
                    frames = open_sequence(
                        sequence, camera=camera, focal=focal, hfov=hfov, assumed=assumed,
                        background=stored.bounds.background, register_depth=registration,
                    )  # fmt: skip
                    _track(frames if split is None else _of_split(frames, split), step, every)
        finally:  # also on Ctrl-C: the frames so far are written
            seconds = clocks.perf_counter() - began
            if out is not None and path.frames:
                path.write(out)
            if plot is not None and path.frames:
                path.plot(plot, stored.surface)
            if not follow and path.frames:
                print_table(path.table(seconds))
                if path.lost and path.without_times:
                    say(
                        f"the frames have no time stamps, so the first ones count as {config.frame_seconds:.3g} s apart; "
                        "if they were taken farther apart, set --frame-seconds"
                    )
                if not path.accepted:
                    question = question_about_scene([frame.found for frame in path.frames])
                    say(f"no pose of {amount(len(path.frames), 'frame')} was accepted{question}")

    parse("track", track, arguments)


class _Step:
    """Tracks a frame, keeps the answer, and prints when the tracker gets lost and when it has recovered."""

    def __init__(self, tracker: Tracker, path: TrackedPath, depth: bool, video: TrackingVideo | None) -> None:
        self.tracker, self.path, self._depth, self._video = tracker, path, depth, video
        self._lost_at: int | None = None
        self._cameras: set[str] = set()  # the sources of frames' cameras that were printed already

    def __call__(
        self, frame: Frame, time: float | None, truth: SE3 | None = None, place: int | None = None
    ) -> Localization:
        if frame.camera_source and frame.camera_source not in self._cameras:
            self._cameras.add(frame.camera_source)
            say(f"{frame.name}: {frame.camera_source}")
        found = self.tracker(frame if self._depth else replace(frame, depth=None), time)
        self.path.add(frame, time, found, truth, place)
        if self._video is not None:
            self._video.add(frame, time, found)
        number, count = self.path.frames[-1].posed.number + 1, len(self.path.frames)
        if not found.converged and self._lost_at is None:
            self._lost_at = count
            say(f"frame {number} ({frame.name}): {found.outcome}: {found.reason}")
        elif found.converged and self._lost_at is not None:
            say(
                f"frame {number} ({frame.name}): tracking again after {amount(count - self._lost_at, 'frame')}"
            )
            self._lost_at = None
        return found


def _of_split(frames: FrameSequence, split: str) -> FileSequence:
    if not isinstance(frames, FileSequence):
        raise InputError(f"{frames.path}: a video has no splits, expected none (--split {split})")
    return frames.of_split(split)


def _track(frames: FrameSequence, step: _Step, every: int) -> None:
    """Track every n-th frame. One whose files cannot be read is reported and skipped, unless the first ones all are.

    Raises ``InputError`` at the end if any could not be read.
    """
    total = -(-len(frames) // every)
    with counted("tracking", "frames", total) as report:
        for number, timed in enumerate(_chosen(frames, every)):
            if isinstance(timed, TimedFrame):
                step(timed.frame, timed.time, timed.truth, every * number)
            elif not step.path.frames and number + 1 >= min(TRIED, total):
                first = (
                    "the first frame cannot" if number == 0 else f"none of the first {number + 1} frames can"
                )
                raise InputError(f"{first} be read: {timed}")
            else:
                say(f"{timed}; left out")
                step.path.unread += 1
            report(number + 1, total)
    if step.path.unread:
        raise InputError(f"{step.path.unread} of {amount(total, 'frame')} could not be read, see above")


def _chosen(frames: FrameSequence, every: int) -> Iterator[TimedFrame | InputError]:
    """Yield every n-th frame; where each has files of its own, an unreadable one is yielded as an error."""
    if not isinstance(frames, FileSequence):
        yield from islice(frames, 0, None, every)
        return
    for place in range(0, len(frames), every):
        try:
            yield frames[place]
        except InputError as error:
            yield error


def _follow(
    source: str, step: _Step, camera: CameraSource, sensor: DepthCamera | None,
    background: tuple[float, float, float],
) -> None:  # fmt: skip
    """Answer each frame that arrives, at once, with one JSON object on a line of its own."""
    say(f"waiting for {'JSON lines on stdin' if source == STDIN else f'images in {source}'}; Ctrl-C ends")
    for request in requests(source):
        try:
            if isinstance(request, InputError):
                raise request
            frame = request.read(camera, sensor, background)
            step(frame, request.time)
            print_json(step.path.plain(step.path.frames[-1]))
        except InputError as error:
            print_json(
                {"frame": _name_of(request), "converged": False, "outcome": "bad input", "reason": str(error)}
            )
        sys.stdout.flush()


def _name_of(request: object) -> str | None:
    image = getattr(request, "image", None)
    return image.stem if isinstance(image, Path) else None
