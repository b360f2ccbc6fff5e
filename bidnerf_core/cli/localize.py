"""``bidnerf localize``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.cli.answers import Answer, Answers, OutputSpec
from bidnerf_core.cli.camera_options import (
    CameraFile,
    FieldOfView,
    FocalLength,
    RegisterDepth,
    depth_registration,
)
from bidnerf_core.cli.depth_remark import depth_remark
from bidnerf_core.cli.method_options import Preset, chosen_settings
from bidnerf_core.cli.opened_map import opened_map
from bidnerf_core.cli.options import LARGEST_SEED, Flag, MapFolder, Names, UsageError, option, parse, require
from bidnerf_core.cli.output import say
from bidnerf_core.cli.progress import counted
from bidnerf_core.cli.queries import (
    DepthPoints,
    FrameOptions,
    PhotoOptions,
    Photos,
    QuerySource,
    open_queries,
)
from bidnerf_core.cli.starts import StartSpec, read_pose
from bidnerf_core.datasets.colmap import SparseChoice, SparsePoints
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.trials import places_of
from bidnerf_core.localization import METHODS, AutoConfig, Localizer
from bidnerf_core.localization.methods import require_use_of_depth
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.maps.map import Map

one_start = tyro.conf.create_mutex_group(required=False, title="where to start (default: no start is known)")


def run(arguments: list[str]) -> None:
    """Parse with the settings of the method that the arguments name, and localize."""
    settings = chosen_settings(arguments, "auto")

    def localize(
        map: MapFolder,
        query: Annotated[
            tuple[Path, ...],
            tyro.conf.Positional,
            option("QUERY...", "image files, folders of photos, or one folder of a dataset (required)", ""),
        ],
        *,
        depth: Annotated[
            tuple[Path, ...],
            option(
                "FILE...", "depth images or .npy of the photos, in the same order, or matched by name", ""
            ),
        ] = (),
        camera: CameraFile = None,
        focal: FocalLength = None,
        hfov: FieldOfView = None,
        depth_unit: Annotated[
            float | None,
            option("METRES", "length of one unit of --depth", "0.001 for integers, 1 for floats"),
        ] = None,
        register_depth: RegisterDepth = None,
        frame: Annotated[
            Names,
            option("NAME...", "frames of a dataset, together as a rig", "each of the split, on its own"),
        ] = (),
        split: Annotated[str, option("NAME", "split of the dataset")] = "test",
        method: Annotated[str, option("NAME", "how poses are found: " + ", ".join(METHODS))] = "auto",
        start: Annotated[
            Path | None, one_start, option("POSE.json", "file with a 4x4 T_world_camera to start from", "")
        ] = None,
        perturb: Annotated[
            tuple[float, float] | None,
            one_start,
            option("T R", "start from the dataset's pose moved by T metres and R degrees", ""),
        ] = None,
        no_start: Annotated[Flag, one_start, option(None, "no start is known, as by default", "")] = False,
        window: Annotated[
            int, option("K", "take a frame and those before it in the split, K in all, as a rig")
        ] = 1,
        depth_points: Annotated[
            Path | None,
            option(
                "FILE",
                "points that a sensor measured from the camera, metres: x y z a row, .npy, or .npz; or the folder of"
                " a COLMAP sparse model, of which the points that the frames observe are taken",
                "",
            ),
        ] = None,
        out: Annotated[
            Path | None,
            option(
                "POSES",
                "write poses to this file: .txt or .tum, transforms.json, or .json with all details",
                "",
            ),
        ] = None,
        draw: Annotated[
            Path | None, option("DIR", "draw each photo beside the map rendered from the pose found", "")
        ] = None,
        seed: Annotated[int, option("N", "seed of every random choice")] = 0,
        json: Annotated[Flag, option(None, "print one JSON object per query, each on a line", "")] = False,
        model_points: SparseChoice = SparseChoice(),
        preset: Preset = None,
        config: Any = None,
    ) -> None:
        """Find the poses of photos, or of frames of a dataset, in a map.

        QUERY is image files, folders of photos, or a dataset. A photo's camera comes from its EXIF unless it is given; if EXIF
        has no focal length, method auto begins with that of the map's images.
        Frames of a dataset that are named by --frame form a rig: their relative poses come from the dataset, and the
        pose found is that of the last one's camera. Poses are camera to world with OpenCV axes (x right, y down, z forward).
        Points have the camera's axes, unless a .npz holds T_camera_sensor as well.
        """
        require("--seed", seed, 0, LARGEST_SEED)
        if frame and not any(frame):
            raise UsageError("--frame names no frame, expected the stem of an image file")
        photos = PhotoOptions(depth, camera, focal, hfov, depth_unit, depth_registration(register_depth))
        frames = FrameOptions(split, tuple(name for group in frame for name in group), window)
        output = OutputSpec(out, draw, json)
        begin = StartSpec(None if start is None else read_pose(start), perturb)
        for part in (frames, begin):
            part.check()
        if not query:
            raise UsageError("no QUERY, expected image files, folders of photos, or a folder of a dataset")
        if METHODS[method].needs_start and not begin.given:
            raise InputError(f"method {method!r} needs a start; give one by --start, or take method 'auto'")
        if depth_points is not None:
            require_use_of_depth(method)
        output.prepare()
        stored = opened_map(map)
        points = None if depth_points is None else _depth_points(depth_points, stored, model_points)
        photos = replace(photos, assumed=_assumed_cameras(stored.landmarks, config))
        source = open_queries(query, photos, frames, stored.bounds.background, points)
        if perturb is not None and isinstance(source, Photos):
            raise UsageError("--perturb moves the true pose, which photos do not have; expected --start")
        localizer = Localizer(stored, method, config, warm_up=len(source.names) > 1)
        _localize(source, localizer, begin, seed, Answers(stored, output, len(source.names)))

    parse("localize", localize, arguments, settings)


def _depth_points(path: Path, stored: Map, choice: SparseChoice) -> DepthPoints:
    if not path.is_dir():
        return DepthPoints(path, None)
    sparse = SparsePoints(path, places_of(stored.info), choice)
    say(sparse.summary)
    return DepthPoints(path, sparse)


def _assumed_cameras(landmarks: LandmarkMap | None, config: Any) -> tuple[Intrinsics, ...]:
    """Return the cameras of a map's images if photos without a focal length can be localized, which takes landmarks."""
    if landmarks is None or not (isinstance(config, AutoConfig) and config.landmarks):
        return ()
    return landmarks.cameras


def _localize(
    source: QuerySource, localizer: Localizer, begin: StartSpec, seed: int, answers: Answers
) -> None:  # fmt: skip
    """Localize each query. A failure does not stop the others; the error of a single query is raised."""
    total = len(source.names)
    without_depth = list[str]()
    try:
        with counted("localizing", "images", total) as report:
            for number, name in enumerate(source.names):
                try:
                    answer = _answered(number, source, localizer, begin, seed, without_depth)
                except UsageError:
                    raise
                except InputError as error:
                    if total == 1:
                        raise
                    answers.fail(name, localizer.method, error)
                else:
                    answers.add(answer)
                report(number + 1, total)
    except KeyboardInterrupt:
        answers.keep()
        raise
    answers.finish()


def _answered(
    number: int, source: QuerySource, localizer: Localizer, begin: StartSpec, seed: int, said: list[str]
) -> Answer:
    query = source.read(number)
    bare = [view.frame.name for view in query.views if not view.frame.has_depth]
    if bare and query.truth is not None and query.depth_rays is None and not said:
        said += bare
        say(f"{', '.join(bare)}: no measured depth; colour only")
    if number == 0 and (remark := depth_remark(query.frame, localizer.config)) is not None:
        say(f"{query.name}: {remark}")
    start = begin.pose(query.truth, seed)
    found = localizer(query.views, start, query.depth_rays, seed)
    if not bool(found.T_world_camera.matrix().isfinite().all()):
        raise InputError(
            f"{query.name}: {found.method} came to a pose that is not finite, expected a sound map"
        )
    return Answer(number, query, start, found)
