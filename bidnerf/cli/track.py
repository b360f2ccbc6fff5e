"""``bidnerf track``: poses of a sequence's frames."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from bidnerf.cli.options import (
    NEW_POSES,
    POSE_FILE,
    CameraOptions,
    First,
    MapFolder,
    NoDepth,
    PhotoCamera,
    QueryImages,
    RunOptions,
    StartFile,
    existing,
    require_device,
    wrong_usage,
)
from bidnerf.cli.output import check_output, print_json, print_table, say
from bidnerf.cli.parameters import Group, Option, SettingsGroup
from bidnerf.cli.running import display_progress
from bidnerf.cli.signals import defer_interruptions
from bidnerf_core import maps
from bidnerf_core.errors import InputError, amount
from bidnerf_core.installation import import_extra
from bidnerf_core.registry import USUAL_METHOD
from bidnerf_core.settings import EXPERT, WholeNumbers


@dataclass(frozen=True)
class FrameOptions:
    """Which frames are tracked, and what they measure."""

    split: Annotated[str | None, EXPERT, Option("NAME", "use only the frames of one split of a dataset", "all")] = None
    first: First = None
    every: Annotated[int, WholeNumbers(1), Option("N", "use only every Nth frame")] = 1
    no_depth: NoDepth = False
    depth_sensor: Annotated[
        str, EXPERT, Option("NAME", "sensor that measured the depth: unknown, kinect, realsense, lidar or rendered")
    ] = "unknown"
    camera: PhotoCamera = CameraOptions()


@dataclass(frozen=True)
class TrackingOptions:
    """How tracking begins, and which poses it accepts."""

    start: Annotated[
        StartFile, Option("POSE.json", "file with the approximate 4x4 T_world_camera of the first frame")
    ] = None
    risk: Annotated[
        float | None,
        EXPERT,
        Option(
            "FRACTION",
            "tolerated fraction of wrong poses among those accepted",
            "accepted as usual",
        ),
    ] = None
    config: Annotated[
        Any,
        SettingsGroup(
            "settings of the tracker",
            "How poses are predicted, corrected and accepted from frame to frame.",
            lambda *_: maps.TrackerConfig(),
        ),
    ] = None


def run_track(
    map: MapFolder,
    sequence: Annotated[
        Path,
        Option("SEQUENCE", "folder of a dataset or images, or a video", positional=True),
        existing("a dataset, images or a video"),
    ],
    out: Annotated[Path, POSE_FILE, NEW_POSES],
    plot: Annotated[
        Path | None,
        Option("FILE", "draw the path over the map's surface, coloured by uncertainty, to this .png or .svg file"),
    ] = None,
    *,
    run: RunOptions,
    frames: Annotated[FrameOptions, Group("frames", "Which frames are tracked, and whether their depth is used.")],
    images: QueryImages,
    tracking: Annotated[TrackingOptions, Group("tracking", "How tracking begins, and which poses it accepts.")],
) -> None:
    """Find the poses of a sequence's frames in a map, one after another.

    Each pose is predicted from those before it, refined and validated. A frame whose pose is not accepted counts as lost; the
    following ones are searched for in the whole map. If the sequence has true poses, a table shows the errors.
    """
    named = (sequence, images.camera, tracking.start, images.register_depth)
    inputs = [Path(each) for each in named if isinstance(each, str | Path)]
    check_output(out, inputs, run.overwrite)
    if plot is not None:
        check_output(plot, inputs, run.overwrite, (".png", ".svg"))

    from bidnerf.results import Answers, read_pose, require_matplotlib, track
    from bidnerf_core.datasets import is_video
    from bidnerf_core.localization import settings_of
    from bidnerf_core.maps import Localizer, Tracker, load_map

    if plot is not None:
        require_matplotlib()
    require_device(run.device)
    if is_video(sequence):
        import_extra("av", "video", "reading a video", sequence, "; or extract its frames to a folder")
    start = None if tracking.start is None else read_pose(tracking.start)
    with wrong_usage():
        settings = settings_of(USUAL_METHOD, {"depth_sensor": frames.depth_sensor, "risk": tracking.risk})
    scene, config = load_map(map, run.device), tracking.config()
    path, began = Answers(scene, is_sequence=True, interval=config.frame_seconds), time.perf_counter()
    localizer = Localizer(scene, config=settings)
    try:
        with display_progress():
            source = frames.camera.source(images.camera, localizer.assumed_cameras)
            recorded = replace(images, camera=source, background=scene.bounds.background).open_sequence(sequence)
            recorded = recorded if frames.split is None else recorded.split(frames.split)
            tracker = Tracker(localizer, config, start)
            track(tracker, recorded[: frames.first], every=frames.every, depth=not frames.no_depth, answers=path)
    finally:  # however tracking ended, the frames so far are written
        with defer_interruptions():
            if path:
                try:
                    path.write(out)
                finally:
                    if plot is not None:
                        path.plot(plot, scene.surface, scene.up)
                if run.json:
                    for answer in path:
                        print_json(path.plain(answer))
                else:
                    print_table([""] * 2, path.summary(time.perf_counter() - began))
        if path.lost and all(answer.time is None for answer in path.answers):
            say(
                f"the frames have no time stamps, so the first ones are assumed to be {config.frame_seconds:.3g} s"
                " apart; if they are farther apart, set `frame_seconds`"
            )
        if path and not path.accepted:
            say(f"no pose of {amount(len(path), 'frame')} was accepted")
    if path.unread:
        raise InputError(f"{path.unread} of {path.unread + len(path)} frames could not be read, see above")
