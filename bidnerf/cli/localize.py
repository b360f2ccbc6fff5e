"""``bidnerf localize``: poses of images in one map or, if several are given, in the map that each image shows."""

from __future__ import annotations

import contextlib
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf.cli.options import (
    NEW_POSES,
    POSE_FILE,
    MethodGroup,
    Queries,
    QueryImages,
    RunOptions,
    Seed,
    StartFile,
    existing,
    refuse,
    require_device,
    require_map,
    require_one,
    wrong_usage,
)
from bidnerf.cli.output import check_folder, check_output, print_json, say, show
from bidnerf.cli.parameters import Group, Option
from bidnerf.cli.running import display_progress
from bidnerf.cli.signals import defer_interruptions
from bidnerf_core.errors import InputError, UsageError, amount, enumeration, errors_in
from bidnerf_core.settings import EXPERT

if TYPE_CHECKING:
    from bidnerf.results import Answer, Answers, Failure
    from bidnerf_core.datasets import Query
    from bidnerf_core.geometry import SE3
    from bidnerf_core.maps import Localizer, MapCollection


@dataclass(frozen=True)
class StartOptions:
    """Where localization starts: at most one of these, by default nowhere."""

    start: Annotated[
        StartFile,
        Option("POSE.json", "file with a 4x4 T_world_camera to start from, or with one per query by name"),
    ] = None
    perturb: Annotated[
        tuple[float, float] | None,
        Option(
            "T R",
            "start from the dataset's pose moved by T units of the map (metres if it is metric) and R degrees, each frame in a"
            " direction of its own",
        ),
    ] = None
    seed: Annotated[Seed, EXPERT] = 0

    def __post_init__(self) -> None:
        require_one({"--start": self.start, "--perturb": self.perturb})

    def of_queries(self) -> Callable[[Query], SE3 | None]:
        """Return a function that maps a query to its start pose, or to None if the query has none.

        Raises ``UsageError`` if the perturbation is out of range.
        """
        from bidnerf.evaluation import find_protocol
        from bidnerf.results import pose_of, read_poses
        from bidnerf_core.geometry import perturb

        start, moved = self.start, self.perturb
        if moved is not None:
            with wrong_usage(), errors_in("--perturb"):
                find_protocol("perturb").check_size(moved)
        poses = None if start is None else read_poses(start)

        def start_of(query: Query) -> SE3 | None:
            if moved is not None and query.truth is not None:
                return perturb(query.truth, *moved, self.seed + zlib.crc32(query.name.encode(errors="surrogatepass")))
            return None if poses is None else pose_of(poses, query.name, start or "start")

        return start_of


@dataclass(frozen=True)
class AnswerOutput(RunOptions):
    """Where answers are computed, and where they are written."""

    out: Annotated[Path | None, POSE_FILE, NEW_POSES] = None
    draw: Annotated[Path | None, Option("DIR", "draw each photo next to the map rendered from the pose found")] = None

    def check(self, inputs: Sequence[Path]) -> None:
        """Check that the outputs can be written, before any work is done."""
        if self.out is not None:
            check_output(self.out, inputs, self.overwrite)
        if self.draw is not None:
            check_folder(self.draw, inputs)

    def picture(self, name: str) -> Path:
        """Return the path of the picture for the image ``name``."""
        assert self.draw is not None
        return self.draw / f"overlay-{name}.png"


def run_localize(
    map: Annotated[Path, Option("MAP", "folder of a map, or of several maps", positional=True)],
    query: Annotated[
        tuple[Path, ...],
        Option(
            "[MAP...] QUERY...",
            "image files, folders of photos, or one dataset folder; before them, further maps or folders of maps: each"
            " image is localized in the one it shows",
            positional=True,
        ),
        existing("photos or a dataset"),
    ],
    *,
    output: Annotated[AnswerOutput, Group("output", "Where answers are computed, and where they are written.")],
    queries: Queries,
    images: QueryImages,
    start: Annotated[StartOptions, Group("start", "Where localization starts. By default, it needs no start.")],
    method: MethodGroup,
) -> None:
    """Find the poses of photos, or of a dataset's frames, in a map.

    If several maps are given, each image is localized in the one that it shows. QUERY is image files, folders of photos, or a dataset. A photo's camera comes from its EXIF unless it is given; if EXIF has no
    focal length, method auto begins with the camera of the map's images. With --rig, the frames in --frame form a rig: their
    relative poses come from the dataset, and the pose found is that of the last one's camera. Poses are camera to world with
    OpenCV axes (x right, y down, z forward).
    """
    count = next((n for n, path in enumerate(query) if not _holds_maps(path)), len(query))
    maps, paths = [map, *query[:count]], query[count:]
    if not paths:
        named = enumeration([repr(str(path)) for path in maps])
        expected = "MAP first, then image files, folders of photos, or a folder of a dataset"
        raise UsageError(f"no QUERY after {named};", expected=expected)
    from bidnerf_core.maps import maps_in

    if not maps_in(map):
        require_map(map)
    files = (*paths, *queries.depth, start.start, images.camera, images.register_depth)
    inputs = [Path(file) for file in files if isinstance(file, str | Path)]
    output.check(inputs)
    if start.perturb is not None and not queries.is_dataset(paths):
        raise UsageError("--perturb moves the true pose, which photos do not have;", expected="--start")
    opener = queries.opener(paths, images)

    from bidnerf.results import Answers, localize, pose_format
    from bidnerf_core.localization import matches_landmarks, require_fit
    from bidnerf_core.maps import Localizer, MapCollection, landmark_cameras, load_map

    config = method.config()
    start_of = start.of_queries()
    with wrong_usage():
        require_fit(
            method.method,
            lambda chosen: not chosen.needs_start or start.start is not None or start.perturb is not None,
            "needs a start; give one by --start, or use method",
        )
    require_device(output.device)
    if output.draw is not None:
        check_folder(output.draw, inputs, create=True)
    if len(maps) > 1 or maps_in(map) not in ([], [map]):
        given = {"--start": start.start, "--perturb": start.perturb, "--draw": output.draw}
        refuse(given, "applies to one map, but several are given")
        if output.out is not None and pose_format(output.out) != ".json":
            raise UsageError("poses in several maps have different worlds", where=output.out, expected="a .json file")
        with display_progress():
            collection = MapCollection(maps, method.method, config, device=output.device)
        finder: Localizer | MapCollection = collection
        answers, source = Answers(collection), opener(collection.cameras, None)
    else:
        scene = load_map(map, output.device)
        cameras = landmark_cameras(scene) if matches_landmarks(method.method, config) else ()
        source = opener(cameras, scene.bounds.background)
        answers = Answers(scene)
        finder = Localizer(scene, method.method, config, warm_up=len(source.names) > 1)
    if output.draw is not None:
        for name in source.names:
            check_output(output.picture(name), inputs, output.overwrite)
    shown = Run(output, answers, len(source.names), start_of)
    with display_progress(), shown.save_at_end():
        localize(finder, source, start=start_of, seed=start.seed, answers=answers, each=shown.show)


def _holds_maps(path: Path) -> bool:
    from bidnerf_core.maps import maps_in

    maps = maps_in(path)
    if not maps or maps == [path]:
        return bool(maps)

    from bidnerf_core.datasets import find_reader
    from bidnerf_core.io import IMAGE_SUFFIXES

    images = any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir())
    return not images and find_reader(path) is None


@dataclass
class Run:
    """Prints and draws answers as they arrive, and writes them to the pose file however the run ends."""

    output: AnswerOutput
    answers: Answers
    total: int  # queries
    start: Callable[[Query], SE3 | None]

    def show(self, query: Query, answer: Answer | Failure) -> None:
        """Print an answer or a failure, and draw an answer if a folder for drawings was given."""
        from bidnerf.results import Failure, overlay
        from bidnerf_core.io import png_bytes, write_file
        from bidnerf_core.maps import Map

        if isinstance(answer, Failure):
            say(f"{answer.name}: {answer.reason}")
        if self.output.json:
            print_json(self.answers.plain(answer))
        if isinstance(answer, Failure):
            return
        if not self.output.json:
            for line in answer_lines(answer, self.total == 1):
                show(line)
        if self.output.draw is not None:
            scene = self.answers.scene
            assert isinstance(scene, Map)
            picture = overlay(scene, query.frame, answer.localization, self.start(query))
            write_file(self.output.picture(query.name), png_bytes(picture))

    @contextlib.contextmanager
    def save_at_end(self) -> Iterator[None]:
        """Write the pose file at the end and, if there are several queries, print how many were accepted.

        If the run is stopped early, the answers so far are written. Raises ``InputError`` if the file's format takes
        only accepted poses and there are none, and if a query failed.
        """
        from bidnerf.results import pose_format
        from bidnerf_core.maps import MapCollection

        answers, out, total = self.answers, self.output.out, self.total
        takes_all, is_whole = out is not None and pose_format(out) == ".json", False
        try:
            yield
            is_whole = True
        finally:  # however the run ended: also by Ctrl-C, SIGTERM, a closed pipe or a full disk
            with defer_interruptions():
                if is_whole and total > 1:
                    more = f" in {len(answers.scene.names)} maps" if isinstance(answers.scene, MapCollection) else ""
                    hint = "; --out poses.json writes all poses" if out is None and not self.output.json else ""
                    say(f"{len(answers.accepted)} of {total} accepted{more}{hint}")
                if is_whole and answers.world_mismatch is not None:
                    say(answers.world_mismatch)
                is_written = out is not None and bool(answers if takes_all else answers.accepted)
                if out is not None and is_written:
                    answers.write(out)
                    if not is_whole:
                        say(f"{out}: written after {len(answers)} of {total} images")
        if out is not None and not is_written:
            raise InputError("not written, since no pose was accepted; a .json file takes all of them", where=out)
        if failed := len(answers) - len(answers.answers):
            raise InputError(f"{failed} of {total} queries could not be read or localized, see above")


def answer_lines(answer: Answer, full: bool) -> list[str]:
    """Return an answer as lines: the outcome, the runner-up among several maps and, if ``full``, the uncertainty and the pose."""
    from bidnerf.results import OPENCV_AXES, standard_deviations
    from bidnerf_core.geometry import symbol

    localization, error, placement = answer.localization, answer.error, answer.placement
    outcome = "accepted" if localization.converged else f"refused: {localization.outcome.value}"
    verdict, world, runner_up = f"{outcome} ({localization.reason})", "", []
    if placement is not None:
        where = "in" if localization.converged else "in none of the maps; nearest"
        verdict, world = f"{where} {placement.map}: {verdict}", f"in the frame of {placement.map}, "
    if placement is not None and placement.runner_up is not None:
        name, other = placement.runner_up
        outcome = "accepted too" if other.converged else other.outcome
        runner_up = [f"  runner-up {name}: {outcome} ({other.reason})"]
    if error is not None:
        distance, angle = float(error.translation), float(error.rotation_deg)
        verdict = f"error {distance:.4f} {symbol(error.unit)}, {angle:.3f} deg; {verdict}"
    lines = [
        f"{answer.name}: {verdict}; {amount(localization.steps, 'step')}, {localization.seconds:.2f} s",
        *runner_up,
    ]
    if full and localization.covariance is not None:
        position, rotation = standard_deviations(localization.covariance)
        lines.append(
            f"  uncertainty  {position:.4f} {symbol(localization.unit)}, {math.degrees(rotation):.3f} deg (one standard deviation)"
        )
    if full and not localization.T_world_camera.is_finite:
        lines.append("  no pose, since nothing was recognised")
    elif full:
        lengths = "metres" if localization.unit == "metres" else "units of the map"
        lines.append(f"  T_world_camera ({world}{OPENCV_AXES}; lengths in {lengths})")
        matrix = localization.T_world_camera.matrix().tolist()
        lines += ["    " + " ".join(f"{value: .6f}" for value in row) for row in matrix]
    return lines
