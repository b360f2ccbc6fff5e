"""``bidnerf demo``: training, localization and pictures of a closed-form scene, in a minute or two."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from bidnerf.cli.options import Overwrite, Seed, installed, wrong_usage
from bidnerf.cli.output import console, print_table, say, show
from bidnerf.cli.parser import Option
from bidnerf.cli.running import interruptible_work, report_time
from bidnerf_core.registry import USUAL_BACKEND
from bidnerf_core.settings import EXPERT, WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.frames import View
    from bidnerf_core.geometry import SE3
    from bidnerf_core.localization import Localization
    from bidnerf_core.maps import Map

TRAINING_VIEWS = 60
"""Number of training images."""
DESCENT = {"rays": 768, "max_steps": 150, "decay_steps": 60}  # faster than the defaults, for small images


DemoFrame: TypeAlias = "tuple[View, SE3, Localization, Localization]"
"""An unseen frame, a start far from its true pose, and the answers of method auto without the start and of bid from the start."""


def run_demo(
    backend: Annotated[str, installed("backends"), Option("NAME", "one of 'bidnerf backends'")] = USUAL_BACKEND,
    out: Annotated[Path, Option("DIR", "folder for the map, the images and the pictures")] = Path("demo-out"),
    frames: Annotated[int, WholeNumbers(1), Option("N", "number of unseen frames to localize")] = 4,
    steps: Annotated[int | None, WholeNumbers(1), Option("N", "training steps", "the backend's quick choice")] = None,
    seed: Annotated[Seed, EXPERT] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Train a map of a closed-form scene, and localize frames in it.

    The results are drawn. The frames are RGB-D images from poses that training never saw. Each is localized twice: by method auto without a start, and
    by method bid from a start far from its pose.
    """
    from bidnerf.results import pose_error
    from bidnerf.scenes import demo_object, orbit, views
    from bidnerf_core.backend import load_backend, quick_config
    from bidnerf_core.camera import Intrinsics
    from bidnerf_core.datasets import DatasetOptions, write_transforms
    from bidnerf_core.geometry import perturb, symbol
    from bidnerf_core.io import output_folder
    from bidnerf_core.localization import settings_of
    from bidnerf_core.maps import Localizer, TrainOptions, train
    from bidnerf_core.settings import from_flat

    config = quick_config(load_backend(backend))
    if steps is not None:
        with wrong_usage():
            config = from_flat(config, {"steps": steps}, f"backend {backend!r}")
    with output_folder(out, overwrite):
        scene, camera = demo_object(), Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128)
        radius, background = 3.5, scene.bounds.background
        seen = views(scene, camera, orbit(radius, TRAINING_VIEWS, seed=seed))
        unseen = views(scene, camera, orbit(radius, frames, elevation=(15.0, 50.0), seed=seed + 1))
        write_transforms(out / "data", {"train": seen, "test": unseen}, background)
        options = TrainOptions(DatasetOptions(background=background), overwrite=True)
        stopped = f"stopped; the demo cannot be continued, 'bidnerf demo --out {out} --overwrite' starts again"
        what = f"trained on {len(seen)} images of the closed-form scene, and baked"
        with report_time(what), interruptible_work(kept=stopped):
            stored = train(out / "data", backend, out / "map", config, options=options)
        say(f"localizing {frames} unseen frames by auto without a start, and by bid from a start nearby")
        auto, bid = Localizer(stored), Localizer(stored, "bid", settings_of("bid", DESCENT))
        trials, rows = list[DemoFrame](), []
        for number, view in enumerate(unseen):
            # The error of the start is in scene units (the object fills a 2x2x2 cube) and degrees.
            start = perturb(view.T_ref_camera, 0.55, 13.0, seed=seed + number)
            with console.status(f"localizing frame {number + 1}"):
                answers = auto(view.frame, seed=seed), bid(view.frame, start, seed=seed)
            trials.append((view, start, *answers))
            begin, unit = pose_error(start, view.T_ref_camera), symbol(stored.unit)
            starts = ["none", ""], [f"{begin.translation:.3f} {unit}", f"{begin.rotation_deg:.1f} deg"]
            for localization, cells in zip(answers, starts, strict=True):
                end = pose_error(localization.T_world_camera, view.T_ref_camera)
                rows.append(
                    [
                        view.frame.name,
                        localization.method,
                        *cells,
                        f"{end.translation:.4f} {unit}",
                        f"{end.rotation_deg:.2f} deg",
                        str(localization.steps),
                        f"{localization.seconds:.1f}",
                        "yes" if localization.converged else "NO",
                    ]
                )
        show("Pose errors before and after")
        print_table(["frame", "method", "off before", "", "off after", "", "steps", "seconds", "accepted"], rows)
        _draw(stored, trials, out)


def _draw(stored: Map, trials: list[DemoFrame], out: Path) -> None:
    import numpy as np

    from bidnerf.results import Painter
    from bidnerf_core.io import png_bytes, write_file

    for view, start, auto, bid in trials:
        painter = Painter(stored, view.frame)
        rows = (
            painter.row(painter.observed, "observed", auto.T_world_camera, "found by auto, no start"),
            painter.row(
                painter.render(start),
                "rendered at the start",
                bid.T_world_camera,
                "found by bid from there",
            ),
        )
        write_file(out / f"overlay-{view.frame.name}.png", png_bytes(np.concatenate(rows, axis=0)))
    show(f"look at {out / 'overlay-*.png'}")
    frame = trials[0][0].frame
    photo = out / "data" / "images" / "test" / f"{frame.name}.png"
    show(f"ask for a photo: bidnerf localize {out / 'map'} {photo} --focal {frame.intrinsics.fx:g}")
    show(f"see why a pose was found: bidnerf view {out / 'map'} {out / 'data'}  (pip install 'bidnerf[viewer]')")
