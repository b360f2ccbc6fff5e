"""``bidnerf evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.cli.camera_options import (
    DatasetCamera,
    DatasetDepthUnit,
    MaskHides,
    Masks,
    RegisterDepth,
    mask_folder,
    stated_reading,
)
from bidnerf_core.cli.folders import require_outside_maps
from bidnerf_core.cli.method_options import Preset, chosen_settings
from bidnerf_core.cli.options import Device, Names, option, parse, require, wrong_usage
from bidnerf_core.cli.output import show
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.errors import UsageError, amount
from bidnerf_core.evaluation import FAULTS, PROTOCOLS, Plan, Size, changed_settings, command_line, run_plan
from bidnerf_core.localization import METHODS, USUAL_METHOD

Place = Annotated[str, tyro.conf.Positional]
STOPPING = "waiting for the trials under way (Ctrl-C again: at once)"


def run(arguments: list[str]) -> None:
    """Run the command; its options include the settings of the method named in the arguments."""
    settings = chosen_settings(arguments, USUAL_METHOD)

    def evaluate(
        map: Annotated[Place, option("MAP", "folder of a map, or demo:blobs")],
        data: Annotated[
            str | None,
            tyro.conf.Positional,
            option("[DATA]", "folder of a dataset, or demo:object, demo:room, demo:blobs", ""),
        ] = None,
        *,
        out: Annotated[Path, option("RESULTS.jsonl", "results file; trials already in it are not run again")],
        protocol: Annotated[str, option("NAME", "how starts are chosen: " + ", ".join(PROTOCOLS))] = "bid",
        size: Annotated[
            tuple[str, ...],
            option("SIZE...", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's"),
        ] = (),
        method: Annotated[str, option("NAME", "how poses are found: " + ", ".join(METHODS))] = USUAL_METHOD,
        trials: Annotated[
            int | None,
            option(
                "N",
                "number of trials per size; without a start, at most one per frame",
                "the protocol's, 24 or 25",
            ),
        ] = None,
        seed: Annotated[int | None, option("S", "seed of every random choice", "the protocol's, 0")] = None,
        split: Annotated[str, option("NAME", "split of the dataset; all: every image")] = "test",
        frame: Annotated[Names, option("NAME...", "try only these frames", "all of the split")] = (),
        images: Annotated[int, option("K", "localize a sequence of K images around the object at once")] = 1,
        angle: Annotated[float, option("DEGREES", "angle between neighbours of a sequence")] = 15.0,
        depth: Annotated[bool, option(None, "use measured depth if available")] = True,
        depth_points: Annotated[
            Path | None,
            option(
                "MODEL", "COLMAP sparse model whose points, where frames observe them, are used as depth", ""
            ),
        ] = None,
        camera: DatasetCamera = None,
        register_depth: RegisterDepth = None,
        depth_unit: DatasetDepthUnit = None,
        masks: Masks = None,
        mask_hides: MaskHides = "black",
        fault: Annotated[
            Names,
            option(
                "NAME:SIZE...",
                "repeat every trial with each of these image faults; NAME:SIZE,SIZE gives several sizes,"
                " A:SIZE+B:SIZE combines two, none leaves the images unchanged; names: " + ", ".join(FAULTS),
                "none",
            ),
        ] = (),
        device: Device = "cpu",
        workers: Annotated[
            int | None, option("N", "number of single-threaded processes", "one per core; one on a GPU")
        ] = None,
        dask: Annotated[
            str | None, option("ADDRESS", "address of a dask scheduler whose workers run the trials", "")
        ] = None,
        shards: Annotated[int, option("N", "number of parts that the trials are split into")] = 1,
        shard: Annotated[int, option("I", "the part to run, from 0")] = 0,
        preset: Preset = None,
        config: Any = None,
    ) -> None:
        """Localize many frames from perturbed starts, or from none, and write one JSON line per trial.

        Finished trials are always kept: the same command resumes where it stopped. 'bidnerf report' makes
        tables and figures from the results.
        """
        mask_folder(masks, mask_hides)  # rejects anything but a folder of masks
        with wrong_usage():
            plan = Plan(
                map, data or _own_data(map), protocol, read_sizes(size) or None, method, changed_settings(method, config),
                trials, seed, split, tuple(name for group in frame for name in group) or None, images, angle, device,
                depth, None if depth_points is None else str(depth_points), None if masks is None else str(masks), mask_hides,
                tuple(f for group in fault for f in group),
                **stated_reading(camera, register_depth, depth_unit),
            )  # fmt: skip
            require("--workers", 1 if workers is None else workers, 1, 10_000)
            require("--shards", shards, 1)
            require("--shard", shard, 0, shards - 1)
            if dask is not None and workers is not None:
                raise UsageError("--workers and --dask contradict each other: a cluster has its own workers")
        require_outside_maps(out.parent, out)
        with Display() as display, stopped_by_ctrl_c(STOPPING) as cancel:
            found = run_plan(
                plan, shard=shard, shards=shards, workers=workers, dask=dask, out=out,
                command=command_line("bidnerf evaluate", arguments), progress=display, cancel=cancel,
            )  # fmt: skip
        show(f"{amount(len(found.rows), 'trial')} in {out}; 'bidnerf report {out}' shows them")

    parse("evaluate", evaluate, arguments, settings)


def read_sizes(words: Sequence[str]) -> tuple[Size, ...]:
    """Parse sizes such as 0.5 or 0.2:10."""
    try:
        return tuple(tuple(float(number) for number in word.split(":")) for word in words)
    except ValueError as error:
        raise UsageError(f"--size is {' '.join(words)}", expected="numbers such as 0.5, or 0.2:10") from error


def _own_data(map: str) -> str:
    if not map.startswith("demo:"):
        raise UsageError(f"no DATA after map {map}; only closed-form maps have their own data")
    return map
