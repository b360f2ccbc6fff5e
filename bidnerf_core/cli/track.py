"""``bidnerf track``."""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bidnerf_core.cli.folders import check_output, check_plot, check_pose_file
from bidnerf_core.cli.interruptions import uninterrupted
from bidnerf_core.cli.options import USUAL_METHOD, MapFolder, require
from bidnerf_core.cli.output import print_json, print_table, say
from bidnerf_core.cli.parser import Flag, Option, Settings, Without, parse
from bidnerf_core.cli.progress import displayed
from bidnerf_core.cli.queries import CameraOptions
from bidnerf_core.cli.watch_folder import STDIN, requests
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError, amount

if TYPE_CHECKING:
    from bidnerf_core.localization import Localizer
    from bidnerf_core.results import Answers, TrackingVideo


def _tracker_settings(*_: Any) -> Any:
    from bidnerf_core.localization import TrackerConfig

    return TrackerConfig()


@dataclass(frozen=True)
class Track:
    """Find the poses of a sequence's frames in a map, in chronological order.

    Each pose is predicted from those before it, refined and validated. A frame whose pose is not accepted counts as lost; the
    following ones are searched for in the whole map. If the sequence has true poses, a table shows the errors.
    """

    map: MapFolder
    sequence: Annotated[
        Path,
        Option(
            "SEQUENCE",
            "folder of a dataset or images, or a video; with --follow a folder, or - for stdin",
            positional=True,
        ),
    ]
    out: Annotated[
        Path | None,
        Option(
            "TRAJECTORY",
            "pose file, required without --follow: .txt or .tum, transforms.json, or .json with all details",
        ),
    ] = None
    plot: Annotated[
        Path | None, Option("PNG", "draw the path over the map's surface, coloured by uncertainty")
    ] = None
    video: Annotated[
        Path | None,
        Option("MP4", "draw each image next to the map rendered from its pose; takes far longer"),
    ] = None
    split: Annotated[str | None, Option("NAME", "use only the frames of one split of a dataset", "all")] = (
        None
    )
    every: Annotated[int, Option("N", "use only every Nth frame")] = 1
    start: Annotated[
        Path | None, Option("POSE.json", "file with the approximate 4x4 T_world_camera of the first frame")
    ] = None
    depth: Annotated[bool, Option(None, "use measured depth if available")] = True
    depth_sensor: Annotated[
        str, Option("NAME", "what measured the depth: unknown, kinect, realsense, lidar or rendered")
    ] = "unknown"
    risk: Annotated[
        float | None,
        Option(
            "SHARE",
            "tolerated fraction of wrong poses among those accepted after a search of the map; does not apply to the"
            " frames tracked from there",
            "accepted as usual",
        ),
    ] = None
    follow: Annotated[
        Flag,
        Option(
            None, "answer frames as they arrive, one JSON object per line on stdout, until Ctrl-C or the end"
        ),
    ] = False
    camera: CameraOptions = CameraOptions()
    images: Annotated[DatasetOptions, Without("split", "largest", "background")] = DatasetOptions()
    config: Annotated[Any, Settings(_tracker_settings)] = None
    """settings of the tracker"""

    def __post_init__(self) -> None:
        require("--every", self.every, 1)
        if self.follow and self.split is not None:
            raise UsageError("--split is for datasets, leave it out with --follow")
        if self.follow and self.images.depth_unit is not None:
            raise UsageError(
                "--depth-unit does not work with --follow", expected="depth_unit in each request"
            )
        if self.follow and self.images.masks is not None:
            raise UsageError(
                '--masks needs the images in advance; with --follow, lines of stdin may name a "mask"'
            )
        if self.out is None and not self.follow:
            raise UsageError("no --out", expected="the name of a pose file")

    def run(self) -> None:
        from bidnerf_core.localization import Localizer, settings_of
        from bidnerf_core.maps import load_map
        from bidnerf_core.results import (
            Answers,
            TrackingVideo,
            check_video,
            read_pose,
            require_matplotlib,
        )

        images = self.images
        named = (self.sequence, images.camera, self.start, images.register_depth)
        inputs = [each for each in named if isinstance(each, str | Path)]
        if self.out is not None:
            check_pose_file(self.out, inputs)
        if self.plot is not None:
            require_matplotlib()
            check_plot(self.plot, inputs)
        if self.video is not None:
            check_video(self.video)
            check_output(self.video, inputs)
        start = None if self.start is None else read_pose(self.start)
        settings = settings_of(USUAL_METHOD, {"depth_sensor": self.depth_sensor, "risk": self.risk})
        scene = load_map(self.map)
        path, began = Answers(scene, is_sequence=True), time.perf_counter()
        localizer = Localizer(scene, config=settings)
        try:
            with (
                nullcontext() if self.video is None else TrackingVideo(self.video, scene) as video,
                displayed(),
            ):
                (self._follow if self.follow else self._track)(localizer, start, path, video)
        finally:  # whatever ended it: the frames so far are written
            with uninterrupted():
                self._finish(path, scene, time.perf_counter() - began)
        if path.unread:
            read = amount(path.unread + len(path), "frame")
            raise InputError(f"{path.unread} of {read} could not be read, see above")

    def _track(self, localizer: Localizer, start: Any, path: Answers, video: TrackingVideo | None) -> None:
        """Track the frames of a recording."""
        from bidnerf_core.localization import Tracker, landmark_cameras
        from bidnerf_core.results import track

        scene = localizer.scene
        camera = self.camera.source(self.images, landmark_cameras(scene))
        images = replace(self.images, camera=camera, background=scene.bounds.background)
        frames = images.open_sequence(self.sequence)
        if self.split is not None:
            frames = frames.split(self.split)
        track(
            Tracker(localizer, self.config, start), frames, every=self.every, depth=self.depth, answers=path,
            each=None if video is None else video.add,
        )  # fmt: skip

    def _follow(self, localizer: Localizer, start: Any, path: Answers, video: TrackingVideo | None) -> None:
        """Answer each frame on arrival with one JSON object on a line of its own."""
        from bidnerf_core.localization import Tracker
        from bidnerf_core.results import BAD_INPUT

        source = str(self.sequence)
        sensor = self.images.sensor(source)
        camera = self.camera.source(self.images, localizer.assumed_cameras)
        tracker = Tracker(localizer, self.config, start)
        say(f"waiting for {'JSON lines on stdin' if source == STDIN else f'images in {source}'}; Ctrl-C ends")
        for request in requests(source):
            name = None
            try:
                if isinstance(request, InputError):
                    raise request
                name = request.image.stem
                frame = request.read(camera, sensor, localizer.scene.bounds.background)
                found = tracker(frame if self.depth else frame.replace(depth=None), request.time)
                answer = path.add(frame, found, request.time)
                if video is not None:
                    video.add(frame, answer)
                print_json(path.plain(answer))
            except InputError as error:
                print_json({"frame": name, "converged": False, "outcome": BAD_INPUT, "reason": str(error)})
            sys.stdout.flush()

    def _finish(self, path: Answers, scene: Any, seconds: float) -> None:
        """Write and draw the frames so far, if any, and print a summary of a recording."""
        if not path.given:
            return
        try:
            if self.out is not None:
                path.save(self.out)
        finally:
            if self.plot is not None:
                path.plot(self.plot, scene.surface, scene.up)
        if self.follow:
            return
        print_table([""] * 2, path.summary(seconds))
        if path.lost and path.without_times:
            say(
                f"the frames have no time stamps, so the first ones are assumed to be {self.config.frame_seconds:.3g} s"
                " apart; if they are farther apart, set --frame-seconds"
            )
        if not path.accepted:
            say(f"no pose of {amount(len(path), 'frame')} was accepted{path.question}")


def run(arguments: list[str]) -> None:
    parse("track", Track, arguments).run()
