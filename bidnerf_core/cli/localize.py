"""``bidnerf localize``: poses of images in one map, or in the one of several maps that each shows."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.folders import check_output, check_pose_file, make_folder
from bidnerf_core.cli.interruptions import uninterrupted
from bidnerf_core.cli.options import Json, MapFolder, MethodOptions, PointChoice, StartOptions, require
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.cli.parser import Option, Without, parse
from bidnerf_core.cli.progress import displayed
from bidnerf_core.cli.queries import QueryOptions
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError, amount, enumeration
from bidnerf_core.settings import LARGEST_SEED

if TYPE_CHECKING:
    from bidnerf_core.datasets import DepthPoints, Query
    from bidnerf_core.geometry import SE3
    from bidnerf_core.localization import Localizer
    from bidnerf_core.maps import Map, MapCollection
    from bidnerf_core.results import Answer, Answers, Failure, PoseError


@dataclass(frozen=True)
class OutputOptions:
    """What is written."""

    out: Annotated[
        Path | None,
        Option(
            "POSES",
            "write poses to this file: .txt or .tum, transforms.json, images.txt (COLMAP), or .json with all details",
        ),
    ] = None
    draw: Annotated[
        Path | None, Option("DIR", "draw each photo next to the map rendered from the pose found")
    ] = None
    json: Json = False

    def check(self, inputs: Sequence[Path | str | None]) -> None:
        """Check, before any work, that the outputs can be written."""
        if self.out is not None:
            check_pose_file(self.out, inputs)
        if self.draw is not None:
            make_folder(self.draw, inputs)

    def picture(self, name: str) -> Path:
        """Return the file of a picture."""
        assert self.draw is not None
        return self.draw / f"overlay-{name}.png"


@dataclass(frozen=True)
class Localize:
    """Find the poses of photos or dataset frames in a map, or in the one of several maps that they show.

    QUERY is image files, folders of photos, or a dataset. A photo's camera comes from its EXIF unless it is given; if EXIF has no
    focal length, method auto begins with the camera of the map's images. Dataset frames named by --frame form a rig: their
    relative poses come from the dataset, and the pose found is that of the last one's camera. Poses are camera to world with
    OpenCV axes (x right, y down, z forward). Points are in the camera's axes, unless a .npz also holds T_camera_sensor.
    """

    map: MapFolder
    query: Annotated[
        tuple[Path, ...],
        Option(
            "[MAP...] QUERY...",
            "image files, folders of photos, or one dataset folder; before them, further maps or folders of maps: each"
            " image is localized in the one it shows",
            positional=True,
        ),
    ] = ()
    output: OutputOptions = OutputOptions()
    queries: QueryOptions = QueryOptions()
    depth_points: Annotated[
        Path | None,
        Option(
            "FILE",
            "points measured by a sensor, in the camera frame, metres: rows of x y z, .npy, or .npz; or the folder of a"
            " COLMAP sparse model, whose points are used where the frames observe them",
        ),
    ] = None
    images: Annotated[DatasetOptions, Without("largest", "background")] = DatasetOptions(split="test")
    start: StartOptions = StartOptions()
    method: MethodOptions = MethodOptions()
    seed: Annotated[int, Option("N", "seed of every random choice")] = 0
    model_points: PointChoice = None
    """which points of a COLMAP model are used"""

    def run(self) -> None:
        from bidnerf_core.datasets import Photos
        from bidnerf_core.evaluation import perturb
        from bidnerf_core.localization import (
            Localizer,
            landmark_cameras,
            matches_landmarks,
            require_start,
            require_use_of_depth,
        )
        from bidnerf_core.maps import MapCollection, load_map, maps_in
        from bidnerf_core.results import Answers, localize_each, pose_of, read_poses

        require("--seed", self.seed, 0, LARGEST_SEED)
        maps, paths = self._maps_and_paths()
        start, images, output = self.start, self.images, self.output
        start.check()
        poses = None if start.start is None else read_poses(start.start)
        method, config = self.method.method, self.method.config
        require_start(method, start.given)
        if self.depth_points is not None:
            require_use_of_depth(method)
        files = (
            *paths,
            *self.queries.depth,
            start.start,
            self.depth_points,
            images.camera,
            images.register_depth,
        )
        inputs = [file for file in files if isinstance(file, str | Path)]
        output.check(inputs)

        def start_of(query: Query) -> SE3 | None:
            if start.perturb is not None and query.truth is not None:
                return perturb(query.truth, *start.perturb, self.seed)
            return None if poses is None else pose_of(poses, query.name, start.start or "start")

        if len(maps) > 1 or maps_in(maps[0]) not in ([], [maps[0]]):
            self._check_for_several()
            with displayed():
                collection = MapCollection(maps, method, config)
            finder: Localizer | MapCollection = collection
            answers, source = (
                Answers(collection),
                self.queries.open(paths, images, None, collection.cameras),
            )
        else:
            scene = load_map(maps[0])
            points = None if self.depth_points is None else self._points(scene)
            cameras = landmark_cameras(scene) if matches_landmarks(method, config) else ()
            source = self.queries.open(paths, images, scene.bounds.background, cameras, points)
            answers = Answers(scene)
            finder = Localizer(scene, method, config, warm_up=len(source.names) > 1)
        if start.perturb is not None and isinstance(source, Photos):
            raise UsageError("--perturb moves the true pose, which photos do not have;", expected="--start")
        if output.draw is not None:
            for name in source.names:
                check_output(output.picture(name), inputs)
        run = Run(output, answers, len(source.names), start_of)
        with displayed(), run.saved():
            localize_each(finder, source, start=start_of, seed=self.seed, answers=run.answers, each=run.show)

    def _maps_and_paths(self) -> tuple[list[Path], tuple[Path, ...]]:
        """Split the arguments into the maps, or folders of maps, that they begin with, and the queries after them."""
        from bidnerf_core.maps import maps_in

        count = next((n for n, path in enumerate(self.query) if not _holds_maps(path)), len(self.query))
        maps, paths = [self.map, *self.query[:count]], self.query[count:]
        if paths:
            return maps, paths
        expected = "image files, folders of photos, or a folder of a dataset"
        if len(maps) == 1:
            raise UsageError("no QUERY", expected=expected)
        if self.map.exists() and not maps_in(self.map):
            raise UsageError(
                f"{str(self.map)!r} is not a map, but {str(maps[1])!r} is: MAP comes first, then QUERY"
            )
        named = enumeration([repr(str(path)) for path in maps])
        raise UsageError(f"{named} are maps, and no QUERY follows them;", expected=expected)

    def _check_for_several(self) -> None:
        """Raise ``UsageError`` for options that apply only to one map."""
        from bidnerf_core.results import pose_format

        start, out = self.start, self.output.out
        given = {
            "--start": start.start, "--perturb": start.perturb, "--draw": self.output.draw,
            "--depth-points": self.depth_points,
        }  # fmt: skip
        for option, value in given.items():
            if value is not None:
                raise UsageError(f"{option} applies to one map, but several are given")
        if out is not None and pose_format(out) != ".json":
            raise UsageError(
                "poses in several maps have different worlds", where=out, expected="a .json file"
            )

    def _points(self, scene: Map) -> DepthPoints:
        from bidnerf_core.datasets import DepthPoints, SparsePoints
        from bidnerf_core.evaluation import places_of

        path = self.depth_points
        assert path is not None
        if not path.is_dir():
            return DepthPoints(path, None)
        sparse = SparsePoints(path, places_of(scene.info), self.model_points)
        say(sparse.summary)
        return DepthPoints(path, sparse)


def _holds_maps(path: Path) -> bool:
    from bidnerf_core.datasets import find_reader
    from bidnerf_core.io import IMAGE_SUFFIXES
    from bidnerf_core.maps import maps_in

    found = maps_in(path)
    if not found or found == [path]:
        return bool(found)
    images = any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir())
    return not images and find_reader(path) is None


@dataclass
class Run:
    """Answers as they come: printed, drawn, and written to the pose file however the run ends."""

    output: OutputOptions
    answers: Answers
    total: int  # queries
    start: Callable[[Query], SE3 | None]
    not_drawn: int = 0

    def show(self, query: Query, answer: Answer | Failure) -> None:
        """Print an answer and draw it."""
        from bidnerf_core.results import Failure

        if isinstance(answer, Failure):
            say(f"{answer.name}: {answer.reason}")
        if self.output.json:
            print_json(self.answers.plain(answer))
        if isinstance(answer, Failure):
            return
        if not self.output.json:
            for line in answer_lines(answer, self.start(query), self.total == 1):
                show(line)
        if self.output.draw is not None:
            self._draw(query, answer)

    def _draw(self, query: Query, answer: Answer) -> None:
        """Draw an answer. A picture that cannot be written does not end the run."""
        from bidnerf_core.io import png_bytes, write_file
        from bidnerf_core.maps import MapCollection
        from bidnerf_core.results import overlay

        file, scene = self.output.picture(query.name), self.answers.scene
        assert scene is not None
        assert not isinstance(scene, MapCollection)
        picture = overlay(scene, query.frame, answer.found, self.start(query))
        try:
            write_file(file, png_bytes(picture))
        except OSError as error:
            self.not_drawn += 1
            say(f"{file}: not drawn: {error.strerror or error}")

    @contextlib.contextmanager
    def saved(self) -> Iterator[None]:
        """Write the pose file at the end, and print how many of several queries converged.

        A run that is stopped early writes the answers so far. Raises ``InputError`` if a file of accepted poses would be
        empty, if a query failed, and if a picture is missing.
        """
        from bidnerf_core.maps import MapCollection
        from bidnerf_core.results import pose_format

        answers, out, total = self.answers, self.output.out, self.total
        takes_all = out is not None and pose_format(out) == ".json"
        try:
            yield
        except BaseException:  # whatever ended it: Ctrl-C, SIGTERM, a closed pipe, a full disk
            with uninterrupted():
                if out is not None and (answers.accepted or (answers.given and takes_all)):
                    answers.save(out)
                    say(f"{out}: written after {len(answers)} of {total} images")
            raise
        with uninterrupted():
            if total > 1:
                scene = answers.scene
                more = f" in {len(scene)} maps" if isinstance(scene, MapCollection) else answers.question
                say(f"{len(answers.accepted)} of {total} converged{more}")
            if answers.remark is not None:
                say(answers.remark)
            if out is not None and not takes_all and not answers.accepted:
                raise InputError(
                    "not written, since no pose converged; a .json file takes all of them", where=out
                )
            if out is not None:
                answers.save(out)
        if failed := len(answers) - len(answers.answers):
            raise InputError(f"{failed} of {total} queries could not be read or localized, see above")
        if self.not_drawn:
            raise InputError(f"{amount(self.not_drawn, 'picture')} could not be written, see above")


def answer_lines(answer: Answer, start: SE3 | None, full: bool) -> list[str]:
    """Return an answer in words: one line, or with its errors if the truth is known, its uncertainty, and the matrix."""
    from bidnerf_core.geometry import symbol
    from bidnerf_core.results import OPENCV_AXES, pose_error, standard_deviations

    def shown(error: PoseError) -> str:
        return f"{float(error.translation):.4f} {symbol(error.unit)}, {float(error.rotation_deg):.3f} deg"

    found, error = answer.found, answer.error
    placement = answer.placement
    where = world = ""
    if placement is not None:
        where = (
            f"in {placement.map}: " if found.converged else f"in none of the maps; nearest {placement.map}: "
        )
        world = f"in the frame of {placement.map}, "
    verdict = "converged" if found.converged else f"NOT converged: {found.outcome.value}"
    verdict = f"{where}{verdict} ({found.reason})"
    took = f"{amount(found.steps, 'step')}, {found.seconds:.2f} s"
    if full:
        lines = [f"{answer.name}: {verdict}"]
    else:
        known = "" if error is None else f"error {shown(error)}; "
        lines = [f"{answer.name}: {known}{verdict}; {took}"]
    if placement is not None and placement.runner_up is not None:
        name, other = placement.runner_up
        lines.append(
            f"  runner-up {name}: {'converged too' if other.converged else other.outcome} ({other.reason})"
        )
    if not full:
        return lines
    if error is not None and answer.truth is not None:
        before = "no start" if start is None else shown(pose_error(start, answer.truth, found.unit))
        lines += [f"  start error  {before}", f"  final error  {shown(error)}"]
    if found.covariance is not None:
        position, rotation = standard_deviations(found.covariance)
        lines.append(
            f"  uncertainty  {position:.4f} {symbol(found.unit)}, {math.degrees(rotation):.3f} deg (one standard deviation)"
        )
    lengths = "metres" if found.unit == "metres" else "units of the map"
    lines.append(f"  {took}, loss {found.loss:.5f}, method {found.method}")
    lines.append(f"  T_world_camera ({world}{OPENCV_AXES}; lengths in {lengths})")
    return lines + [
        "    " + " ".join(f"{value: .6f}" for value in row) for row in found.T_world_camera.matrix().tolist()
    ]


def run(arguments: list[str]) -> None:
    parse("localize", Localize, arguments).run()
