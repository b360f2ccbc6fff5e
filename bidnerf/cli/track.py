"""``bidnerf track``: poses of a recording's frames or, with ``--follow``, of those that arrive in a folder or on stdin."""

from __future__ import annotations

import sys
import time as clocks
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bidnerf.cli.options import CameraOptions, MapFolder, refuse
from bidnerf.cli.output import check_output, print_json, print_table, say
from bidnerf.cli.parser import Flag, Option, Settings, Without
from bidnerf.cli.running import displayed
from bidnerf.cli.signals import uninterrupted
from bidnerf_core import localization
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.registry import USUAL_METHOD
from bidnerf_core.settings import WholeNumbers

if TYPE_CHECKING:
    from bidnerf.results import Answers, TrackingVideo
    from bidnerf_core.depth import DepthCamera
    from bidnerf_core.frames import Frame
    from bidnerf_core.localization import Tracker

STDIN = "-"
POLL = 0.05
"""Seconds between two checks of a watched folder."""


@dataclass(frozen=True)
class OutputOptions:
    """What is written."""

    out: Annotated[
        Path | None,
        Option(
            "TRAJECTORY",
            "pose file, required without --follow: .txt or .tum, transforms.json, or .json with all details",
        ),
    ] = None
    plot: Annotated[Path | None, Option("PNG", "draw the path over the map's surface, coloured by uncertainty")] = None
    video: Annotated[
        Path | None,
        Option("MP4", "draw each image next to the map rendered from its pose; takes far longer"),
    ] = None

    def check(self, inputs: list[Path]) -> None:
        """Check that the outputs can be written, before any work is done."""
        from bidnerf.results import check_pose_file, check_video, require_matplotlib

        if self.out is not None:
            check_pose_file(self.out)
        if self.plot is not None:
            require_matplotlib()
            if self.plot.suffix.lower() not in (".png", ".svg"):
                raise UsageError(where=self.plot, expected="a name that ends with .png or .svg")
        if self.video is not None:
            check_video(self.video)
        for file in filter(None, (self.out, self.plot, self.video)):
            check_output(file, inputs)


@dataclass(frozen=True)
class FrameOptions:
    """Which frames are tracked, and what they measure."""

    follow: Annotated[
        Flag,
        Option(None, "answer frames as they arrive, one JSON object per line on stdout, until Ctrl-C or the end"),
    ] = False
    split: Annotated[str | None, Option("NAME", "use only the frames of one split of a dataset", "all")] = None
    every: Annotated[int, WholeNumbers(1), Option("N", "use only every Nth frame")] = 1
    depth: Annotated[bool, Option(None, "use measured depth if available")] = True
    depth_sensor: Annotated[
        str, Option("NAME", "what measured the depth: unknown, kinect, realsense, lidar or rendered")
    ] = "unknown"


@dataclass(frozen=True)
class TrackingOptions:
    """How tracking begins, and which poses it accepts."""

    start: Annotated[
        Path | None, Option("POSE.json", "file with the approximate 4x4 T_world_camera of the first frame")
    ] = None
    risk: Annotated[
        float | None,
        Option(
            "SHARE",
            "tolerated fraction of wrong poses among those accepted after a search of the map; does not apply to the"
            " frames tracked from there",
            "accepted as usual",
        ),
    ] = None
    config: Annotated[Any, Settings(lambda *_: localization.TrackerConfig(), "settings of the tracker")] = None


def run_track(
    map: MapFolder,
    sequence: Annotated[
        Path,
        Option(
            "SEQUENCE",
            "folder of a dataset or images, or a video; with --follow a folder, or - for stdin",
            positional=True,
        ),
    ],
    *,
    output: OutputOptions,
    frames: FrameOptions,
    camera: CameraOptions,
    images: Annotated[DatasetOptions, Without("split", "largest", "background")],
    tracking: TrackingOptions,
) -> None:
    """Find the poses of a sequence's frames in a map, in order of time.

    Each pose is predicted from those before it, refined and validated. A frame whose pose is not accepted counts as lost; the
    following ones are searched for in the whole map. If the sequence has true poses, a table shows the errors.
    """
    from bidnerf.results import Answers, TrackingVideo, read_pose, track
    from bidnerf_core.localization import Localizer, Tracker, settings_of
    from bidnerf_core.maps import load_map

    if frames.follow:
        given = {"--split": frames.split, "--depth-unit": images.depth_unit, "--masks": images.masks}
        refuse(given, "is for recordings; with --follow, a line of stdin may state the depth unit and a mask")
    if output.out is None and not frames.follow:
        raise UsageError("no --out", expected="the name of a pose file")
    named = (sequence, images.camera, tracking.start, images.register_depth)
    output.check([Path(each) for each in named if isinstance(each, str | Path)])
    start = None if tracking.start is None else read_pose(tracking.start)
    settings = settings_of(USUAL_METHOD, {"depth_sensor": frames.depth_sensor, "risk": tracking.risk})
    scene = load_map(map)
    path, began = Answers(scene, is_sequence=True), clocks.perf_counter()
    localizer = Localizer(scene, config=settings)
    try:
        with (
            nullcontext() if output.video is None else TrackingVideo(output.video, scene) as video,
            displayed(),
        ):
            source = camera.source(images, localizer.assumed_cameras)
            opened = replace(images, camera=source, background=scene.bounds.background)
            tracker = Tracker(localizer, tracking.config, start)
            if frames.follow:
                _follow(str(sequence), opened, frames.depth, tracker, path, video)
                return
            recorded = opened.open_sequence(sequence)
            recorded = recorded if frames.split is None else recorded.split(frames.split)
            track(
                tracker,
                recorded,
                every=frames.every,
                depth=frames.depth,
                answers=path,
                each=None if video is None else video.add,
            )
    finally:  # however tracking ended, the frames so far are written
        with uninterrupted():
            if path.given:
                try:
                    if output.out is not None:
                        path.save(output.out)
                finally:
                    if output.plot is not None:
                        path.plot(output.plot, scene.surface, scene.up)
            if path.given and not frames.follow:
                _summarize(path, clocks.perf_counter() - began, tracking.config.frame_seconds)
    if path.unread:
        read = amount(path.unread + len(path), "frame")
        raise InputError(f"{path.unread} of {read} could not be read, see above")


def _follow(
    source: str, images: DatasetOptions, depth: bool, tracker: Tracker, path: Answers, video: TrackingVideo | None
) -> None:
    """Answer each frame on arrival with one line of JSON."""
    from bidnerf.results import BAD_INPUT

    sensor = images.sensor(source)
    say(f"waiting for {'JSON lines on stdin' if source == STDIN else f'images in {source}'}; Ctrl-C ends")
    for request in requests(source):
        name = None
        try:
            if isinstance(request, InputError):
                raise request
            name = Path(request.image).stem
            frame = request.read(images, sensor)
            found = tracker(frame if depth else frame.replace(depth=None), request.time)
            answer = path.add(frame, found, request.time)
            if video is not None:
                video.add(frame, answer)
            print_json(path.plain(answer))
        except InputError as error:
            print_json({"frame": name, "converged": False, "outcome": BAD_INPUT, "reason": str(error)})
        sys.stdout.flush()


def _summarize(path: Answers, seconds: float, frame_seconds: float) -> None:
    """Print a summary of a tracked recording."""
    print_table([""] * 2, path.summary(seconds))
    if path.lost and all(answer.time is None for answer in path.answers):
        say(
            f"the frames have no time stamps, so the first ones are assumed to be {frame_seconds:.3g} s apart; if they"
            " are farther apart, set --frame-seconds"
        )
    if not path.accepted:
        say(f"no pose of {amount(len(path), 'frame')} was accepted")


@dataclass(frozen=True)
class FrameRequest:
    """A request to track a frame, whose image, depth and mask are files."""

    image: str  # path, as for the depth and the mask
    depth: str | None = None
    time: float | None = None  # seconds
    depth_unit: float | None = None  # metres per step
    mask: str | None = None  # black is ignored

    @staticmethod
    def parse(line: str) -> FrameRequest:
        """Parse a line such as ``{"image": path, "depth": path, "time": s}``; only the image is required."""
        from bidnerf_core.io import from_plain, parse_json

        return from_plain(FrameRequest, parse_json(line, "request", "a JSON object"), "request")

    def read(self, images: DatasetOptions, sensor: DepthCamera | None) -> Frame:
        """Read the image, depth and mask. Raises ``InputError`` if one cannot be read or the camera is unknown."""
        from bidnerf_core.frames import Frame, MaskFile

        mask = None if self.mask is None else MaskFile(Path(self.mask))
        return Frame.read(
            self.image,
            images.camera_source,
            depth=self.depth,
            depth_unit=self.depth_unit,
            sensor=sensor,
            background=images.background,
            mask=mask,
        )


def requests(source: str) -> Iterator[FrameRequest | InputError]:
    """Yield requests as they arrive: from lines of stdin until it ends, or from images in a folder until the program is stopped.

    For a line that is not a valid request, the ``InputError`` to send as its answer is yielded.
    """
    if source != STDIN:
        yield from _arriving(Path(source))
        return
    for line in iter(sys.stdin.readline, ""):  # iterating over stdin itself would wait for a full buffer
        if not line.strip():
            continue
        try:
            yield FrameRequest.parse(line)
        except InputError as error:
            yield error


def _arriving(folder: Path) -> Iterator[FrameRequest]:
    """Yield the images of a folder in natural name order, and then new images as they arrive."""
    from bidnerf_core.frames import photos_in
    from bidnerf_core.io import IMAGE_SUFFIXES

    if not folder.is_dir():
        raise InputError("no such folder", where=folder, expected=f"one that receives images, or {STDIN} for stdin")
    given, sizes = set[Path](), dict[Path, tuple[int, int]]()
    while True:
        photos, others = photos_in(folder)
        waiting = [photo for photo in photos if photo not in given]
        for photo in waiting:
            # Other files of the photo's name, such as NAME.json, are not depth.
            depths = [
                file
                for file in others
                if file.name.startswith(f"{photo.stem}.") and file.suffix.lower() in (".npy", *IMAGE_SUFFIXES)
            ]
            if not all(_is_steady(file, sizes) for file in (photo, *depths[:1])):
                break  # later names have to wait, to keep the name order
            given.add(photo)
            yield FrameRequest(str(photo), str(depths[0]) if depths else None)
        clocks.sleep(POLL)


def _is_steady(file: Path, sizes: dict[Path, tuple[int, int]]) -> bool:
    """Return whether the size of a file was unchanged in the last two checks, which suggests that it is written completely."""
    try:
        size = file.stat().st_size
    except OSError:
        return False
    before, looks = sizes.get(file, (-1, 0))
    looks = looks + 1 if size == before and size > 0 else 0
    sizes[file] = (size, looks)
    return looks >= 2
