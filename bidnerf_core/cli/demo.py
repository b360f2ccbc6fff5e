"""``bidnerf demo``: training, localization and pictures of a closed-form scene, in a minute or two."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import UInt8
from rich.table import Table

from bidnerf_core.backend import Backend, load_backend, quick_config
from bidnerf_core.camera import Intrinsics
from bidnerf_core.cli.options import DEFAULT_BACKEND, Flag, option, parse, require
from bidnerf_core.cli.output import console, print_table, say, show
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c, timed
from bidnerf_core.datasets import DatasetOptions, write_transforms
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.evaluation import convergence_plot, perturb
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, symbol
from bidnerf_core.io import output_folder, png_bytes, write_file
from bidnerf_core.localization import Localization, Localizer, settings_of
from bidnerf_core.maps import Map, TrainOptions, train
from bidnerf_core.results import Painter, PoseError, pose_error, save_gif
from bidnerf_core.scenes import demo_object, orbit, views
from bidnerf_core.settings import LARGEST_SEED

PHOTO_CAMERA = Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128)
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

    @property
    def trace(self) -> PoseError:
        """The errors at the start and after each step from it."""
        return self.off(self.from_start.poses)

    def off(self, poses: SE3) -> PoseError:
        """Return how far poses are from the true one."""
        return pose_error(poses, self.view.T_ref_camera, self.without_start.unit)


def run(arguments: list[str]) -> None:
    parse("demo", demo, arguments)


def demo(
    backend: Annotated[str, option("NAME", "one of 'bidnerf backends'")] = DEFAULT_BACKEND,
    out: Annotated[Path, option("DIR", "folder for the map, the images and the pictures")] = Path("demo-out"),
    frames: Annotated[int, option("N", "number of unseen frames to localize")] = 4,
    steps: Annotated[int | None, option("N", "training steps", "the backend's quick choice")] = None,
    seed: Annotated[int, option("N", "seed of the views and the starts")] = 0,
    overwrite: Annotated[Flag, option(None, "replace the contents of --out", "")] = False,
) -> None:
    """Train a closed-form scene, localize unseen frames in it, and draw the result.

    The frames are RGB-D images from poses that training never saw. Each is localized twice: by method auto
    without a start, and by method bid from a start far from its pose.
    """
    require("--frames", frames, 1)
    require("--steps", 1 if steps is None else steps, 1)
    require("--seed", seed, 0, LARGEST_SEED)
    chosen = load_backend(backend)
    with output_folder(out, overwrite):
        trials, stored = _demonstrated(chosen, backend, out, frames, steps, seed)
        _print(trials)
        _draw(stored, trials, out)


def _demonstrated(
    chosen: Backend, backend: str, out: Path, frames: int, steps: int | None, seed: int
) -> tuple[list[DemoTrial], Map]:
    scene = demo_object()
    seen = views(scene, PHOTO_CAMERA, orbit(RADIUS, TRAINING_VIEWS, seed=seed))
    unseen = views(scene, PHOTO_CAMERA, orbit(RADIUS, frames, elevation=(15.0, 50.0), seed=seed + 1))
    try:
        config = quick_config(chosen)
        config = config if steps is None else dataclasses.replace(config, steps=steps)
    except TypeError as error:
        raise UsageError(f"backend {backend!r} has no setting 'steps'", expected="one that has it") from error
    with (
        timed(f"trained on {len(seen)} views of the closed-form scene, and baked"),
        stopped_by_ctrl_c() as cancel,
        Display() as progress,
    ):
        images = DatasetOptions(background=scene.bounds.background)
        stored = train(
            seen,
            backend,
            out / "map",
            config,
            options=TrainOptions(images, overwrite=True),
            progress=progress,
            cancel=cancel,
        )
    write_transforms(out / "data", {"train": seen, "test": unseen}, scene.bounds.background)
    auto, bid = Localizer(stored), Localizer(stored, "bid", settings_of("bid", DESCENT))
    trials = []
    for number, view in enumerate(unseen):
        start = perturb(view.T_ref_camera, *START_ERROR, seed=seed + number)
        with console.status(f"localizing frame {number + 1}"):
            found = auto(view.frame, seed=seed), bid(view.frame, start, seed=seed)
        trials.append(DemoTrial(view, start, *found))
    return trials, stored


def _print(trials: Sequence[DemoTrial]) -> None:
    table = Table(title="Pose errors before and after", title_justify="left", box=None, pad_edge=False)
    for column in ("frame", "method", "start", "", "found", "", "steps", "seconds", "converged"):
        table.add_column(column, justify="left" if column in ("frame", "method") else "right")
    for trial in trials:
        start = _shown(trial.off(trial.start), 3, 1)
        for found, begin in ((trial.without_start, ("none", "")), (trial.from_start, start)):
            error = _shown(trial.off(found.T_world_camera), 4, 2)
            verdict = "yes" if found.converged else "NO"
            row = (trial.view.frame.name, found.method, *begin, *error, str(found.steps))
            table.add_row(*row, f"{found.seconds:.1f}", verdict)
    print_table(table)


def _shown(error: PoseError, digits: int, digits_of_angle: int) -> tuple[str, str]:
    return (
        f"{float(error.translation):.{digits}f} {symbol(error.unit)}",
        f"{float(error.rotation_deg):.{digits_of_angle}f} deg",
    )


def _draw(stored: Map, trials: Sequence[DemoTrial], out: Path) -> None:
    for trial in trials:
        painter = Painter(stored, trial.view.frame)
        write_file(out / f"overlay-{trial.view.frame.name}.png", png_bytes(_overlay(painter, trial)))
    first = trials[0]
    painter, path = Painter(stored, first.view.frame), first.from_start.poses
    with console.status("drawing the animation"):
        pictures = [painter.blended(path[i]) for i in _moments(first.from_start.steps)]
    save_gif(out / "localization.gif", pictures)
    drawn = ["overlay-*.png", "localization.gif"]
    try:
        convergence_plot(out / "convergence.png", {t.view.frame.name: t.trace for t in trials})
        drawn.append("convergence.png")
    except InputError as error:  # matplotlib is optional
        say(str(error))
    show(f"look at {', '.join(str(out / name) for name in drawn)}")
    show(f"see why a pose was found: bidnerf view {out / 'map'} {out / 'data'}")


def _overlay(painter: Painter, trial: DemoTrial) -> UInt8[np.ndarray, "H W 3"]:
    """Return two rows of pictures: the pose found without a start, and the one found from a start."""
    auto, bid = trial.without_start.T_world_camera, trial.from_start.T_world_camera
    rows = (
        painter.row(painter.observed, "observed", auto, "found by auto, no start"),
        painter.row(painter.rendered(trial.start), "rendered at the start", bid, "found by bid from there"),
    )
    return np.concatenate(rows, axis=0)


def _moments(steps: int) -> list[int]:
    """Return the steps to show, which are denser at the beginning, where most of the motion happens."""
    return sorted({round(steps * (i / (ANIMATED - 1)) ** 2) for i in range(ANIMATED)})
