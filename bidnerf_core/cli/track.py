"""``bidnerf track``."""

from __future__ import annotations

import sys
import time as clocks
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from bidnerf_core.camera import CameraSource
from bidnerf_core.cli.camera_options import (
    CameraFile,
    DatasetDepthUnit,
    DepthSensorName,
    FieldOfView,
    FocalLength,
    MaskHides,
    Masks,
    RegisterDepth,
    depth_registration,
    mask_folder,
)
from bidnerf_core.cli.folders import check_output, check_plot, check_pose_file
from bidnerf_core.cli.interruptions import uninterrupted
from bidnerf_core.cli.options import Flag, MapFolder, option, parse, require
from bidnerf_core.cli.output import print_json, print_table, say
from bidnerf_core.cli.progress import counted
from bidnerf_core.cli.watch_folder import STDIN, requests
from bidnerf_core.datasets import FileSequence, FrameSequence, ReadOptions
from bidnerf_core.depth import DepthCamera
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.localization import USUAL_METHOD, Localizer, Tracker, TrackerConfig, settings_of
from bidnerf_core.maps import Map, load_map
from bidnerf_core.results import (
    BAD_INPUT,
    Answers,
    TrackingVideo,
    check_video,
    opened_for,
    read_pose,
    require_matplotlib,
)
from bidnerf_core.results import track as track_frames


def run(arguments: list[str]) -> None:
    def track(
        map: MapFolder,
        sequence: Annotated[
            Path,
            tyro.conf.Positional,
            option(
                "SEQUENCE",
                "folder of a dataset or images, or a video; with --follow a folder, or - for stdin",
            ),
        ],
        *,
        out: Annotated[
            Path | None,
            option(
                "TRAJECTORY",
                "pose file, required without --follow: .txt or .tum, transforms.json, or .json with all"
                " details",
                "",
            ),
        ] = None,
        plot: Annotated[
            Path | None,
            option("PNG", "draw the path over the map's surface, coloured by uncertainty", ""),
        ] = None,
        video: Annotated[
            Path | None,
            option("MP4", "draw each image next to the map rendered from its pose; takes far longer", ""),
        ] = None,
        camera: CameraFile = None,
        focal: FocalLength = None,
        hfov: FieldOfView = None,
        register_depth: RegisterDepth = None,
        depth_unit: DatasetDepthUnit = None,
        masks: Masks = None,
        mask_hides: MaskHides = "black",
        depth: Annotated[bool, option(None, "use measured depth if available")] = True,
        depth_sensor: DepthSensorName = "unknown",
        risk: Annotated[
            float | None,
            option(
                "SHARE",
                "tolerated fraction of wrong poses among those accepted after a search of the map; does not"
                " apply to the frames tracked from there",
                "accepted as usual",
            ),
        ] = None,
        split: Annotated[
            str | None, option("NAME", "use only the frames of one split of a dataset", "all")
        ] = None,
        every: Annotated[int, option("N", "use only every Nth frame")] = 1,
        start: Annotated[
            Path | None,
            option("POSE.json", "file with the approximate 4x4 T_world_camera of the first frame", ""),
        ] = None,
        follow: Annotated[
            Flag,
            option(
                None,
                "answer frames as they arrive, one JSON object per line on stdout, until Ctrl-C or the end",
                "",
            ),
        ] = False,
        config: TrackerConfig = TrackerConfig(),
    ) -> None:
        """Find the poses of a sequence's frames in a map, in chronological order.

        Each pose is predicted from those before it, refined and validated. A frame whose pose is not accepted
        counts as lost; the following ones are searched for in the whole map. If the sequence has true poses,
        a table shows the errors.
        """
        require("--every", every, 1)
        if follow and split is not None:
            raise UsageError("--split is for datasets, leave it out with --follow")
        if follow and depth_unit is not None:
            raise UsageError(
                "--depth-unit does not work with --follow", expected="depth_unit in each request"
            )
        if follow and masks is not None:
            raise UsageError(
                '--masks needs the images in advance; with --follow, lines of stdin may name a "mask"'
            )
        if out is None and not follow:
            raise UsageError("no --out", expected="the name of a pose file")
        inputs = (sequence, camera, start, register_depth)
        if out is not None:
            check_pose_file(out, inputs)
        if plot is not None:
            require_matplotlib()
            check_plot(plot, inputs)
        if video is not None:
            check_video(video)
            check_output(video, inputs)
        registration, hiding = depth_registration(register_depth), mask_folder(masks, mask_hides)
        sensor = ReadOptions(register_depth=registration).sensor(sequence) if follow else None
        begin, settings = (
            None if start is None else read_pose(start),
            settings_of(USUAL_METHOD, {"depth_sensor": depth_sensor, "risk": risk}),
        )
        stored = load_map(map)
        path, began = Answers(stored, is_sequence=True), clocks.perf_counter()
        localizer = Localizer(stored, config=settings)
        try:
            with nullcontext() if video is None else TrackingVideo(video, stored) as drawn:
                if follow:
                    given = CameraSource(camera, focal, hfov, localizer.assumed_cameras)
                    _follow(
                        str(sequence), Tracker(localizer, config, begin), path, drawn, depth, given, sensor
                    )
                else:
                    frames = opened_for(
                        stored,
                        sequence,
                        camera=camera,
                        focal=focal,
                        hfov=hfov,
                        register_depth=registration,
                        depth_unit=depth_unit,
                        masks=hiding,
                    )
                    frames = frames if split is None else _of_split(frames, split)
                    with counted("tracking", "frames", -(-len(frames) // every)) as report:
                        track_frames(
                            Tracker(localizer, config, begin), frames, every=every, depth=depth, answers=path,
                            each=None if drawn is None else drawn.add, progress=lambda p: report(p.done, p.total),
                        )  # fmt: skip
        finally:  # whatever ended it: the frames so far are written
            with uninterrupted():
                _finish(path, stored, out, plot, None if follow else clocks.perf_counter() - began, config)
        if path.unread:
            read = amount(path.unread + len(path), "frame")
            raise InputError(f"{path.unread} of {read} could not be read, see above")

    parse("track", track, arguments)


def _finish(path: Answers, stored: Map, out: Path | None, plot: Path | None, seconds: float | None, config: TrackerConfig
) -> None:  # fmt: skip
    """Write and draw the frames so far, if any; if ``seconds`` are given, print a summary of the run."""
    if not path.given:
        return
    try:
        if out is not None:
            path.save(out)
    finally:
        if plot is not None:
            path.plot(plot, stored.surface, stored.up)
    if seconds is None:
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    for row in path.summary(seconds):
        table.add_row(*row)
    print_table(table)
    if path.lost and path.without_times:
        say(
            f"the frames have no time stamps, so the first ones are assumed to be {config.frame_seconds:.3g}"
            " s apart; if they are farther apart, set --frame-seconds"
        )
    if not path.accepted:
        say(f"no pose of {amount(len(path), 'frame')} was accepted{path.question}")


def _of_split(frames: FrameSequence, split: str) -> FileSequence:
    if not isinstance(frames, FileSequence):
        raise InputError(f"a video has no splits, leave out --split {split}", where=frames.path)
    return frames.of_split(split)


def _follow(
    source: str, tracker: Tracker, path: Answers, video: TrackingVideo | None, depth: bool, camera: CameraSource,
    sensor: DepthCamera | None,
) -> None:  # fmt: skip
    """Answer each frame on arrival with one JSON object on a line of its own."""
    say(f"waiting for {'JSON lines on stdin' if source == STDIN else f'images in {source}'}; Ctrl-C ends")
    for request in requests(source):
        try:
            if isinstance(request, InputError):
                raise request
            frame = request.read(camera, sensor, tracker.localizer.scene.bounds.background)
            found = tracker(frame if depth else frame.replace(depth=None), request.time)
            answer = path.add(frame, found, request.time)
            if video is not None:
                video.add(frame, answer)
            print_json(path.plain(answer))
        except InputError as error:
            print_json(
                {"frame": _name_of(request), "converged": False, "outcome": BAD_INPUT, "reason": str(error)}
            )
        sys.stdout.flush()


def _name_of(request: object) -> str | None:
    image = getattr(request, "image", None)
    return image.stem if isinstance(image, Path) else None
