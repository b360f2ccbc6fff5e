"""``bidnerf localize``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.camera import CameraSource
from bidnerf_core.cli.camera_options import (
    CameraFile,
    FieldOfView,
    FocalLength,
    MaskHides,
    Masks,
    RegisterDepth,
    depth_registration,
    mask_folder,
)
from bidnerf_core.cli.folders import check_output, check_pose_file, make_folder
from bidnerf_core.cli.interruptions import uninterrupted
from bidnerf_core.cli.method_options import Preset, chosen_settings
from bidnerf_core.cli.options import Flag, MapFolder, Names, option, parse, require
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.cli.progress import counted
from bidnerf_core.cli.queries import FrameOptions, PhotoOptions, open_queries
from bidnerf_core.cli.several_maps import (
    check_for_several,
    collected,
    localize_in_several,
    named_maps,
    no_query,
)
from bidnerf_core.cli.starts import StartSpec
from bidnerf_core.datasets import DepthPoints, Photos, Query, QuerySource, SparseChoice, SparsePoints
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.evaluation import places_of
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.io import png_bytes, write_file
from bidnerf_core.localization import (
    METHODS,
    USUAL_METHOD,
    Localization,
    Localizer,
    landmark_cameras,
    matches_landmarks,
    require_start,
    require_use_of_depth,
)
from bidnerf_core.maps import Map, load_map, maps_in
from bidnerf_core.results import (
    OPENCV_AXES,
    Answer,
    Answers,
    Failure,
    PoseError,
    localize_each,
    overlay,
    pose_error,
    pose_format,
    read_poses,
    standard_deviations,
)
from bidnerf_core.settings import LARGEST_SEED

one_start = tyro.conf.create_mutex_group(required=False, title="where to start (default: no start)")


def run(arguments: list[str]) -> None:
    """Parse with the settings of the method named in the arguments, and localize."""
    settings = chosen_settings(arguments, USUAL_METHOD)

    def localize(
        map: MapFolder,
        query: Annotated[
            tuple[Path, ...],
            tyro.conf.Positional,
            option(
                "[MAP...] QUERY...",
                "image files, folders of photos, or one dataset folder (required); before them, further"
                " maps or folders of maps: each image is localized in the one it shows",
                "",
            ),
        ],
        *,
        depth: Annotated[
            tuple[Path, ...],
            option(
                "FILE...",
                "depth images or .npy files of the photos, in the same order, or matched by name",
                "",
            ),
        ] = (),
        camera: CameraFile = None,
        focal: FocalLength = None,
        hfov: FieldOfView = None,
        depth_unit: Annotated[
            float | None,
            option(
                "METRES",
                "metres per step of depth images",
                "0.001 for integers, 1 for floats; or as in the dataset",
            ),
        ] = None,
        register_depth: RegisterDepth = None,
        masks: Masks = None,
        mask_hides: MaskHides = "black",
        frame: Annotated[
            Names,
            option("NAME...", "frames of a dataset, together as a rig", "each frame of the split on its own"),
        ] = (),
        split: Annotated[str, option("NAME", "split of the dataset; all: every image")] = "test",
        method: Annotated[str, option("NAME", "how poses are found: " + ", ".join(METHODS))] = USUAL_METHOD,
        start: Annotated[
            Path | None,
            one_start,
            option(
                "POSE.json",
                "file with a 4x4 T_world_camera to start from, or with one per query by name",
                "",
            ),
        ] = None,
        perturb: Annotated[
            tuple[float, float] | None,
            one_start,
            option("T R", "start from the dataset's pose moved by T metres and R degrees", ""),
        ] = None,
        no_start: Annotated[Flag, one_start, option(None, "no start is known (the default)", "")] = False,
        window: Annotated[
            int, option("K", "combine each frame with those before it in the split, K in all, as a rig")
        ] = 1,
        depth_points: Annotated[
            Path | None,
            option(
                "FILE",
                "points measured by a sensor, in the camera frame, metres: rows of x y z, .npy, or .npz; or"
                " the folder of a COLMAP sparse model, whose points are used where the frames observe them",
                "",
            ),
        ] = None,
        out: Annotated[
            Path | None,
            option(
                "POSES",
                "write poses to this file: .txt or .tum, transforms.json, images.txt (COLMAP), or .json with all details",
                "",
            ),
        ] = None,
        draw: Annotated[
            Path | None, option("DIR", "draw each photo next to the map rendered from the pose found", "")
        ] = None,
        seed: Annotated[int, option("N", "seed of every random choice")] = 0,
        json: Annotated[Flag, option(None, "print one JSON object per query, each on a line", "")] = False,
        model_points: SparseChoice = SparseChoice(),
        preset: Preset = None,
        config: Any = None,
    ) -> None:
        """Find the poses of photos or dataset frames in a map, or in the one of several maps that they show.

        QUERY is image files, folders of photos, or a dataset. A photo's camera comes from its EXIF unless it
        is given; if EXIF has no focal length, method auto begins with the camera of the map's images. Dataset
        frames named by --frame form a rig: their relative poses come from the dataset, and the pose found is
        that of the last one's camera. Poses are camera to world with OpenCV axes (x right, y down, z
        forward). Points are in the camera's axes, unless a .npz also holds T_camera_sensor.
        """
        require("--seed", seed, 0, LARGEST_SEED)
        if frame and not any(frame):
            raise UsageError("--frame names no frame", expected="the stem of an image file")
        photos = PhotoOptions(
            depth, CameraSource(camera, focal, hfov), depth_unit, depth_registration(register_depth),
            mask_folder(masks, mask_hides),
        )  # fmt: skip
        frames = FrameOptions(split, tuple(name for group in frame for name in group), window)
        begin = StartSpec(None if start is None else read_poses(start), perturb, start)
        for part in (frames, begin):
            part.check()
        maps, query = named_maps(map, query)
        if not query:
            raise no_query(maps)
        require_start(method, begin.given)
        if depth_points is not None:
            require_use_of_depth(method)
        inputs = (*query, *depth, camera, start, depth_points, register_depth)
        if out is not None:
            check_pose_file(out, inputs)
        if draw is not None:
            make_folder(draw, inputs)
        if len(maps) > 1 or len(maps_in(map)) > 1 or maps_in(map) not in ([], [map]):
            given = {
                "--start": start is not None,
                "--perturb": perturb is not None,
                "--draw": draw is not None,
            }
            check_for_several(given | {"--depth-points": depth_points is not None}, out)
            collection = collected(maps, method, config)
            photos = replace(photos, camera=replace(photos.camera, assumed=collection.cameras))
            source = open_queries(query, photos, frames, None, None)
            localize_in_several(collection, source, seed, out, json)
            return
        stored = load_map(map)
        points = None if depth_points is None else _depth_points(depth_points, stored, model_points)
        assumed = landmark_cameras(stored) if matches_landmarks(method, config) else ()
        photos = replace(photos, camera=replace(photos.camera, assumed=assumed))
        source = open_queries(query, photos, frames, stored.bounds.background, points)
        if perturb is not None and isinstance(source, Photos):
            raise UsageError("--perturb moves the true pose, which photos do not have;", expected="--start")
        if draw is not None:
            for name in source.names:
                check_output(_picture_file(draw, name), inputs)
        localizer = Localizer(stored, method, config, warm_up=len(source.names) > 1)
        _localize(source, localizer, begin, seed, _Output(stored, out, draw, json, len(source.names)))

    parse("localize", localize, arguments, settings)


def _depth_points(path: Path, stored: Map, choice: SparseChoice) -> DepthPoints:
    if not path.is_dir():
        return DepthPoints(path, None)
    sparse = SparsePoints(path, places_of(stored.info), choice)
    say(sparse.summary)
    return DepthPoints(path, sparse)


def _localize(
    source: QuerySource, localizer: Localizer, begin: StartSpec, seed: int, output: _Output
) -> None:
    total = len(source.names)
    with counted(output.stage, "images", total) as report:
        try:
            localize_each(
                localizer, source, start=lambda query: begin.pose(query, seed), seed=seed, answers=output.answers,
                each=lambda query, answer: output.show(query, answer, None if isinstance(answer, Failure) else begin.pose(query, seed)),
                progress=lambda p: report(p.done, p.total),
            )  # fmt: skip
        except BaseException:  # whatever ended it: Ctrl-C, SIGTERM, a closed pipe, a full disk
            with uninterrupted():
                output.keep()
            raise
    with uninterrupted():
        output.finish()


class _Output:
    """Output of answers: printed, drawn, and written to the pose file at the end."""

    def __init__(self, stored: Map, out: Path | None, draw: Path | None, json: bool, total: int) -> None:
        self._stored, self._out, self._draw, self._json, self._total = stored, out, draw, json, total
        self._not_drawn = 0
        self.stage = "localizing" if draw is None else "localizing and rendering"
        self.answers = Answers(stored)

    def show(self, query: Query, answer: Answer | Failure, start: SE3 | None) -> None:
        """Print an answer and draw it."""
        if isinstance(answer, Failure):
            say(f"{answer.name}: {answer.reason}")
        if self._json:
            print_json(self.answers.plain(answer))
        if isinstance(answer, Failure):
            return
        if not self._json and self._total == 1:
            _show_in_full(answer, start)
        elif not self._json:
            _show_in_short(answer)
        if self._draw is not None:
            self._write_picture(_picture_file(self._draw, query.name), query, answer, start)

    def _write_picture(self, file: Path, query: Query, answer: Answer, start: SE3 | None) -> None:
        """Draw an answer. A picture that cannot be written does not end the run."""
        picture = overlay(self._stored, query.frame, answer.found, start)
        try:
            write_file(file, png_bytes(picture))
        except OSError as error:
            self._not_drawn += 1
            say(f"{file}: not drawn: {error.strerror or error}")

    def finish(self) -> None:
        """Write the pose file, and print how many of several queries converged.

        Raises ``InputError`` if a file of accepted poses would be empty, if a query failed, and if a picture
        is missing.
        """
        answers, out, accepted = self.answers, self._out, len(self.answers.accepted)
        if self._total > 1:
            say(f"{accepted} of {self._total} converged{answers.question}")
        if answers.remark is not None:
            say(answers.remark)
        if out is not None:
            if not accepted and pose_format(out) != ".json":
                raise InputError(
                    "not written, since no pose converged; a .json file takes all of them", where=out
                )
            answers.save(out)
        if failed := len(answers) - len(answers.answers):
            raise InputError(f"{failed} of {self._total} queries could not be read or localized, see above")
        if self._not_drawn:
            raise InputError(f"{amount(self._not_drawn, 'picture')} could not be written, see above")

    def keep(self) -> None:
        """Write the pose file with the answers so far, after a run that was stopped early."""
        out, answers = self._out, self.answers
        if out is None or not (answers.accepted or (answers.given and pose_format(out) == ".json")):
            return
        answers.save(out)
        say(f"{out}: written after {len(answers)} of {self._total} images")


def _picture_file(folder: Path, name: str) -> Path:
    return folder / f"overlay-{name}.png"


def _show_in_full(answer: Answer, start: SE3 | None) -> None:
    """Print an answer on several lines: its errors if the truth is known, its uncertainty, the matrix."""
    found = answer.found
    show(f"{answer.name}: {_verdict(found)} ({found.reason})")
    if answer.error is not None and answer.truth is not None:
        show(
            f"  start error  {'no start' if start is None else _shown(pose_error(start, answer.truth, found.unit))}"
        )
        show(f"  final error  {_shown(answer.error)}")
    if found.covariance is not None:
        position, rotation = standard_deviations(found.covariance)
        show(
            f"  uncertainty  {position:.4f} {symbol(found.unit)}, {math.degrees(rotation):.3f} deg (one standard deviation)"
        )
    show(
        f"  {amount(found.steps, 'step')}, {found.seconds:.2f} s, loss {found.loss:.5f}, method {found.method}"
    )
    lengths = "metres" if found.unit == "metres" else "units of the map"
    show(f"  T_world_camera ({OPENCV_AXES}; lengths in {lengths})")
    for row in found.T_world_camera.matrix().tolist():
        show("    " + " ".join(f"{value: .6f}" for value in row))


def _show_in_short(answer: Answer) -> None:
    """Print an answer in one line."""
    found, error = answer.found, answer.error
    known = "" if error is None else f"error {_shown(error)}; "
    took = f"{amount(found.steps, 'step')}, {found.seconds:.2f} s"
    show(f"{answer.name}: {known}{_verdict(found)} ({found.reason}); {took}")


def _verdict(found: Localization) -> str:
    """Return the outcome in words; the troubleshooting page of the documentation explains each one."""
    return "converged" if found.converged else f"NOT converged: {found.outcome.value}"


def _shown(error: PoseError) -> str:
    return f"{float(error.translation):.4f} {symbol(error.unit)}, {float(error.rotation_deg):.3f} deg"
