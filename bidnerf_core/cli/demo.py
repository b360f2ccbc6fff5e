"""``bidnerf demo``: the whole way in two minutes, with nothing but this package."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import imageio.v3 as iio
from rich.table import Table

from bidnerf_core.backend import Backend, quick_config
from bidnerf_core.camera import Intrinsics
from bidnerf_core.cli.common import (
    DEFAULT_BACKEND,
    LARGEST_SEED,
    Flag,
    UsageError,
    console,
    option,
    output_folder,
    parse,
    print_table,
    require,
    say,
)
from bidnerf_core.cli.progress import timed
from bidnerf_core.cli.train import train_map
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.errors import PoseError, pose_error
from bidnerf_core.evaluation.figures import blend, convergence_plot, overlay, save_gif
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.frames import View
from bidnerf_core.localization import BidConfig, Localization, localize, single
from bidnerf_core.registry import load_backend
from bidnerf_core.rendering import render_image
from bidnerf_core.scenes.closed_form import views
from bidnerf_core.scenes.demo import demo_object
from bidnerf_core.scenes.trajectories import orbit
from bidnerf_core.se3 import SE3
from bidnerf_core.storage import Map, load_map
from bidnerf_core.training import TrainingStopped

CAMERA = Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128)
TRAINING_VIEWS, RADIUS = 60, 3.5
START_ERROR = (0.55, 13.0)  # scene units (the object fills a 2x2x2 cube) and degrees
DESCENT = BidConfig(rays=768, max_steps=150, decay_steps=60)  # quicker than the defaults, for small images
ANIMATED = 14  # frames of the animation


@dataclass(frozen=True, eq=False)
class Trial:
    """One unseen frame, where its search began, and what came of it."""

    view: View
    start: SE3
    found: Localization

    @property
    def trace(self) -> PoseError:
        return pose_error(self.found.poses, self.view.T_ref_camera)


def run(arguments: list[str]) -> None:
    parse("demo", demo, arguments)


def demo(
    backend: Annotated[str, option("NAME", "one of 'bidnerf backends'")] = DEFAULT_BACKEND,
    out: Annotated[Path, option("DIR", "folder for the map and the pictures")] = Path("demo-out"),
    frames: Annotated[int, option("N", "how many unseen frames to localize")] = 4,
    steps: Annotated[int | None, option("N", "training steps", "what the backend finds quick")] = None,
    seed: Annotated[int, option("N", "of the views and of the starts")] = 0,
    overwrite: Annotated[Flag, option(None, "replace what is in --out", "")] = False,
) -> None:
    """Train a closed-form scene, localize unseen frames in it, draw the result.

    The frames are RGB-D images from poses that the training has not seen; the search for each begins far from its pose.
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
) -> tuple[list[Trial], Map]:
    scene = demo_object()
    seen = views(scene, CAMERA, orbit(RADIUS, TRAINING_VIEWS, seed=seed))
    unseen = views(scene, CAMERA, orbit(RADIUS, frames, elevation=(15.0, 50.0), seed=seed + 1))
    try:
        config = quick_config(chosen)
        config = config if steps is None else dataclasses.replace(config, steps=steps)
    except TypeError as error:
        raise UsageError(f"backend {backend!r} has no setting 'steps', expected one that has") from error
    with timed(f"trained on {len(seen)} views of the closed-form scene"):
        try:
            train_map(
                chosen, backend, seen, config, out / "map", scene.name, scene.bounds.background, baked=False
            )
        except TrainingStopped as stopped:
            raise KeyboardInterrupt from stopped
    stored = load_map(out / "map")
    return [_trial(stored, view, number, seed) for number, view in enumerate(unseen)], stored


def _trial(stored: Map, view: View, number: int, seed: int) -> Trial:
    start = perturb(view.T_ref_camera, *START_ERROR, seed=seed + number)
    with console.status(f"localizing frame {number + 1}"):
        found = localize(single(stored.field, stored.bounds, view.frame, start), "bid", DESCENT, seed)
    return Trial(view, start, found)


def _print(trials: Sequence[Trial]) -> None:
    table = Table(title="Pose errors before and after", title_justify="left", box=None, pad_edge=False)
    for column in ("frame", "start", "", "found", "", "steps", "seconds", "converged"):
        table.add_column(column, justify="left" if column == "frame" else "right")
    for trial in trials:
        before, after = trial.trace[0], trial.trace[-1]
        table.add_row(
            trial.view.frame.name, f"{float(before.translation):.3f} m", f"{float(before.rotation_deg):.1f} deg",
            f"{float(after.translation):.4f} m", f"{float(after.rotation_deg):.2f} deg",
            str(trial.found.steps), f"{trial.found.seconds:.1f}", "yes" if trial.found.converged else "NO",
        )  # fmt: skip
    print_table(table)


def _draw(stored: Map, trials: Sequence[Trial], out: Path) -> None:
    for trial in trials:
        name = trial.view.frame.name
        pair = [_rendered(stored, trial, T) for T in (trial.start, trial.found.T_world_camera)]
        iio.imwrite(out / f"overlay-{name}.png", overlay(trial.view.frame.rgb, *pair))
    first = trials[0]
    shown = _moments(first.found.steps)
    with console.status("drawing the animation"):
        pictures = [
            blend(first.view.frame.rgb, _rendered(stored, first, first.found.poses[i])) for i in shown
        ]
    save_gif(out / "localization.gif", pictures)
    drawn = ["overlay-*.png", "localization.gif"]
    try:
        convergence_plot(out / "convergence.png", {t.view.frame.name: t.trace for t in trials})
        drawn.append("convergence.png")
    except InputError as error:  # matplotlib is an extra
        say(str(error))
    print(f"look at {', '.join(str(out / name) for name in drawn)}")


def _moments(steps: int) -> list[int]:
    """Steps to show: close together at the beginning, where most happens."""
    return sorted({round(steps * (i / (ANIMATED - 1)) ** 2) for i in range(ANIMATED)})


def _rendered(stored: Map, trial: Trial, T_world_camera: SE3) -> Any:
    return render_image(stored.field, trial.view.frame.intrinsics, T_world_camera, stored.bounds).rgb
