"""``bidnerf demo``: training, localization and pictures of a closed-form scene, in a minute or two."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf.cli.options import Overwrite, Seed, installed, wrong_usage
from bidnerf.cli.output import console, print_table, say, show
from bidnerf.cli.parameters import Option
from bidnerf.cli.running import explained_interruption, interruptible_work, report_time
from bidnerf_core.registry import USUAL_BACKEND
from bidnerf_core.settings import EXPERT, WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.localization import Localization

TRAINING_VIEWS = 60
"""Number of training images."""
DESCENT = {"rays": 768, "max_steps": 150, "decay_steps": 60}  # faster than the defaults, for small images


def run_demo(
    backend: Annotated[
        str, installed("backends"), Option("NAME", "kind of field, one of 'bidnerf backends'")
    ] = USUAL_BACKEND,
    out: Annotated[Path, Option("DIR", "folder for the map, the images and the pictures")] = Path("demo-out"),
    frames: Annotated[int, WholeNumbers(1), EXPERT, Option("N", "number of unseen frames to localize")] = 4,
    steps: Annotated[int | None, WholeNumbers(1), Option("N", "training steps", "the backend's quick choice")] = None,
    seed: Annotated[Seed, EXPERT] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Train a map of a synthetic scene, and localize frames in it.

    The frames are RGB-D images from poses that training never saw. Method auto finds each pose without a start, and method bid that of the first frame
    from a start far from it. Pictures of the results are saved.
    """
    from bidnerf.results import Painter, pose_error
    from bidnerf.scenes import demo_object, orbit, views
    from bidnerf_core.backend import load_backend, quick_config
    from bidnerf_core.camera import Intrinsics
    from bidnerf_core.datasets import DatasetOptions, write_transforms
    from bidnerf_core.geometry import SE3, perturb
    from bidnerf_core.io import output_folder, png_bytes, write_file
    from bidnerf_core.localization import settings_of
    from bidnerf_core.mapping import colour_noise
    from bidnerf_core.maps import Localizer, TrainOptions, train
    from bidnerf_core.settings import from_flat

    config = quick_config(load_backend(backend))
    if steps is not None:
        with wrong_usage():
            config = from_flat(config, {"steps": steps}, f"backend {backend!r}")
    stopped = f"stopped; the demo cannot be continued, 'bidnerf demo --out {out} --overwrite' starts again"
    with output_folder(out, overwrite), explained_interruption(lambda: stopped):
        scene, camera = demo_object(), Intrinsics(350.0, 350.0, 128.0, 128.0, 256, 256)
        say(f"drawing a toy lorry from {TRAINING_VIEWS} poses, and from {frames} others that training will not see")
        seen = views(scene, camera, orbit(3.5, TRAINING_VIEWS, seed=seed))
        unseen = views(scene, camera, orbit(3.5, frames, elevation=(15.0, 50.0), seed=seed + 1))
        write_transforms(out / "data", {"train": seen, "test": unseen}, scene.bounds.background)
        options = TrainOptions(DatasetOptions(background=scene.bounds.background), overwrite=True)
        with report_time(f"made a map from the {len(seen)} images"), interruptible_work(kept=stopped):
            stored = train(out / "data", backend, out / "map", config, options=options)
        psnr = -20 * math.log10(colour_noise(stored.field, stored.bounds, unseen))
        show(f"the field renders the {frames} others with a PSNR of {psnr:.1f} dB; bid depends on it, auto hardly does")
        say(
            f"finding the poses of the {frames} others without a start (auto, by landmarks and depth), and of the first from a start"
            " (bid, by rendering the field)"
        )
        localizers = {"auto": Localizer(stored), "bid": Localizer(stored, "bid", settings_of("bid", DESCENT))}
        # Far from the pose in metres, of which the lorry is nearly two long, and in degrees.
        far = perturb(unseen[0].T_ref_camera, 0.55, 13.0, seed=seed)
        trials = [("auto", None, view) for view in unseen] + [("bid", far, unseen[0])]
        answers: list[Localization] = []
        rows, seconds = [], list[float]()
        for method, start, view in trials:
            began = time.process_time()
            with console.status(f"finding {view.frame.name} by {method}"):
                found = localizers[method](view.frame, start, seed=seed)
            answers.append(found)
            seconds.append(time.process_time() - began)
            painter, true = Painter(stored, view.frame), view.T_ref_camera
            left = (painter.observed, "observed") if start is None else (painter.render(start), "rendered at the start")
            picture = painter.row(*left, found.T_world_camera, f"found by {method}")
            write_file(out / f"overlay-{view.frame.name}-{method}.png", png_bytes(picture))
            begin = "none" if start is None else str(pose_error(start, true, stored.unit))
            error = pose_error(found.T_world_camera, true, stored.unit)
            accepted = "yes" if found.converged else "NO"
            rows.append([view.frame.name, method, begin, str(error), accepted, f"{seconds[-1]:.2f} s"])
        print_table(["frame", "method", "error of the start", "error of the pose", "accepted", "CPU time"], rows)
        poses = SE3.stack([found.T_world_camera for found in answers[:frames]])
        error = pose_error(poses, SE3.stack([view.T_ref_camera for view in unseen]), stored.unit)
        converged = sum(found.converged for found in answers[:frames])
        used = sum(seconds[:frames]) / frames
        show(f"without a start: {converged} of {frames} poses accepted; errors: {error}; {used:.2f} s of CPU time each")
        show(f"see the poses: {out / 'overlay-*.png'}")
        focal = unseen[0].frame.intrinsics.fx
        photo = out / "data" / "images" / "test" / f"{unseen[0].frame.name}.png"
        show(f"ask for a photo: bidnerf localize {out / 'map'} {photo} --focal {focal:g}")
        show(f"see why a pose was found: bidnerf view {out / 'map'} {out / 'data'}  (pip install 'bidnerf[viewer]')")
