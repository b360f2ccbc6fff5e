"""``bidnerf demo``: training, localization and pictures of a closed-form scene, in a minute or two."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bidnerf_core.cli.options import DEFAULT_BACKEND, require
from bidnerf_core.cli.output import console, print_table, say, show
from bidnerf_core.cli.parser import Flag, Option, parse
from bidnerf_core.cli.progress import working
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.settings import LARGEST_SEED

if TYPE_CHECKING:
    from bidnerf_core.frames import View
    from bidnerf_core.geometry import SE3
    from bidnerf_core.localization import Localization
    from bidnerf_core.maps import Map
    from bidnerf_core.results import PoseError

TRAINING_VIEWS, RADIUS = 60, 3.5
START_ERROR = (0.55, 13.0)  # scene units (the object fills a 2x2x2 cube) and degrees
DESCENT = {"rays": 768, "max_steps": 150, "decay_steps": 60}  # faster than the defaults, for small images
ANIMATED = 14  # frames of the animation


@dataclass(frozen=True, eq=False)
class DemoTrial:
    """An unseen frame, a distant start, and the answers of two methods: one without the start, one from it."""

    view: View
    start: SE3
    without_start: Localization  # by method auto
    from_start: Localization  # by method bid

    def errors(self, poses: SE3) -> PoseError:
        """Return the errors of poses."""
        from bidnerf_core.results import pose_error

        return pose_error(poses, self.view.T_ref_camera, self.without_start.unit)

    def rows(self) -> list[list[str]]:
        """Return the rows of the table of errors."""

        def shown(error: PoseError, digits: int, digits_of_angle: int) -> list[str]:
            from bidnerf_core.geometry import symbol

            degrees = f"{float(error.rotation_deg):.{digits_of_angle}f} deg"
            return [f"{float(error.translation):.{digits}f} {symbol(error.unit)}", degrees]

        rows = []
        start = shown(self.errors(self.start), 3, 1)
        for found, begin in ((self.without_start, ["none", ""]), (self.from_start, start)):
            error = shown(self.errors(found.T_world_camera), 4, 2)
            verdict = "yes" if found.converged else "NO"
            took = [str(found.steps), f"{found.seconds:.1f}", verdict]
            rows.append([self.view.frame.name, found.method, *begin, *error, *took])
        return rows


@dataclass(frozen=True)
class Demo:
    """Train a closed-form scene, localize unseen frames in it, and draw the result.

    The frames are RGB-D images from poses that training never saw. Each is localized twice: by method auto without a start, and
    by method bid from a start far from its pose.
    """

    backend: Annotated[str, Option("NAME", "one of 'bidnerf backends'")] = DEFAULT_BACKEND
    out: Annotated[Path, Option("DIR", "folder for the map, the images and the pictures")] = Path("demo-out")
    frames: Annotated[int, Option("N", "number of unseen frames to localize")] = 4
    steps: Annotated[int | None, Option("N", "training steps", "the backend's quick choice")] = None
    seed: Annotated[int, Option("N", "seed of the views and the starts")] = 0
    overwrite: Annotated[Flag, Option(None, "replace the contents of --out")] = False

    def __post_init__(self) -> None:
        require("--frames", self.frames, 1)
        require("--steps", 1 if self.steps is None else self.steps, 1)
        require("--seed", self.seed, 0, LARGEST_SEED)

    def run(self) -> None:
        from bidnerf_core.backend import load_backend, quick_config
        from bidnerf_core.io import output_folder

        backend = load_backend(self.backend)
        try:
            config = quick_config(backend)
            config = config if self.steps is None else dataclasses.replace(config, steps=self.steps)
        except TypeError as error:
            raise UsageError(
                f"backend {self.backend!r} has no setting 'steps'", expected="one that has it"
            ) from error
        with output_folder(self.out, self.overwrite):
            trials, stored = self._trials(config)
            columns = ["frame", "method", "start", "", "found", "", "steps", "seconds", "converged"]
            show("Pose errors before and after")
            print_table(columns, [row for trial in trials for row in trial.rows()])
            _draw(stored, trials, self.out)

    def _trials(self, config: Any) -> tuple[list[DemoTrial], Map]:
        """Train, and localize each frame."""
        from bidnerf_core.camera import Intrinsics
        from bidnerf_core.datasets import DatasetOptions, write_transforms
        from bidnerf_core.evaluation import perturb
        from bidnerf_core.localization import Localizer, settings_of
        from bidnerf_core.maps import TrainOptions, train
        from bidnerf_core.scenes import demo_object, orbit, views

        scene, camera, seed, began = (
            demo_object(),
            Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128),
            self.seed,
            time.monotonic(),
        )
        seen = views(scene, camera, orbit(RADIUS, TRAINING_VIEWS, seed=seed))
        unseen = views(scene, camera, orbit(RADIUS, self.frames, elevation=(15.0, 50.0), seed=seed + 1))
        background = scene.bounds.background
        options = TrainOptions(DatasetOptions(background=background), overwrite=True)
        with working():
            stored = train(seen, self.backend, self.out / "map", config, options=options)
        seconds = time.monotonic() - began
        say(f"trained on {len(seen)} views of the closed-form scene, and baked: {seconds:.1f} s")
        write_transforms(self.out / "data", {"train": seen, "test": unseen}, background)
        auto, bid = Localizer(stored), Localizer(stored, "bid", settings_of("bid", DESCENT))
        trials = []
        for number, view in enumerate(unseen):
            start = perturb(view.T_ref_camera, *START_ERROR, seed=seed + number)
            with console.status(f"localizing frame {number + 1}"):
                found = auto(view.frame, seed=seed), bid(view.frame, start, seed=seed)
            trials.append(DemoTrial(view, start, *found))
        return trials, stored


def _draw(stored: Map, trials: list[DemoTrial], out: Path) -> None:
    import numpy as np

    from bidnerf_core.evaluation import convergence_plot
    from bidnerf_core.io import png_bytes, write_file
    from bidnerf_core.results import Painter, save_gif

    for trial in trials:
        painter, auto, bid = Painter(stored, trial.view.frame), trial.without_start, trial.from_start
        begin = painter.rendered(trial.start)
        rows = (
            painter.row(painter.observed, "observed", auto.T_world_camera, "found by auto, no start"),
            painter.row(begin, "rendered at the start", bid.T_world_camera, "found by bid from there"),
        )
        write_file(out / f"overlay-{trial.view.frame.name}.png", png_bytes(np.concatenate(rows, axis=0)))
    first = trials[0]
    painter, path, steps = Painter(stored, first.view.frame), first.from_start.poses, first.from_start.steps
    # Denser at the beginning, where most of the motion happens.
    moments = sorted({round(steps * (i / (ANIMATED - 1)) ** 2) for i in range(ANIMATED)})
    with console.status("drawing the animation"):
        save_gif(out / "localization.gif", [painter.blended(path[i]) for i in moments])
    drawn = ["overlay-*.png", "localization.gif"]
    traces = {trial.view.frame.name: trial.errors(trial.from_start.poses) for trial in trials}
    try:
        convergence_plot(out / "convergence.png", traces)
        drawn.append("convergence.png")
    except InputError as error:  # matplotlib is optional
        say(str(error))
    show(f"look at {', '.join(str(out / name) for name in drawn)}")
    show(f"see why a pose was found: bidnerf view {out / 'map'} {out / 'data'}")


def run(arguments: list[str]) -> None:
    parse("demo", Demo, arguments).run()
