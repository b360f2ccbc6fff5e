"""``bidnerf evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bidnerf_core.cli.folders import require_outside_maps
from bidnerf_core.cli.options import Device, MethodOptions, Names, require, wrong_usage
from bidnerf_core.cli.output import show
from bidnerf_core.cli.parser import Option, Without, parse
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import UsageError, amount

if TYPE_CHECKING:
    from bidnerf_core.evaluation import Size

STOPPING = "waiting for the trials under way (Ctrl-C again: at once)"


@dataclass(frozen=True)
class Evaluate:
    """Localize many frames from perturbed starts, or from none, and write one JSON line per trial.

    Finished trials are always kept: the same command resumes where it stopped. 'bidnerf report' makes tables and figures from the
    results.
    """

    map: Annotated[str, Option("MAP", "folder of a map, or demo:blobs", positional=True)]
    out: Annotated[Path, Option("RESULTS.jsonl", "results file; trials already in it are not run again")]
    data: Annotated[
        str | None,
        Option("[DATA]", "folder of a dataset, or demo:object, demo:room, demo:blobs", positional=True),
    ] = None
    protocol: Annotated[
        str, Option("NAME", "how starts are chosen: bid, bid-hard, inerf, parallel, perturb or none")
    ] = "bid"
    size: Annotated[
        tuple[str, ...],
        Option("SIZE...", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's"),
    ] = ()
    trials: Annotated[
        int | None,
        Option(
            "N",
            "number of trials per size; without a start, at most one per frame",
            "the protocol's, 24 or 25",
        ),
    ] = None
    seed: Annotated[int | None, Option("S", "seed of every random choice", "the protocol's, 0")] = None
    frame: Annotated[Names, Option("NAME...", "try only these frames", "all of the split")] = ()
    sequence: Annotated[
        int, Option("K", "localize a sequence of K images around the object at once", name="images")
    ] = 1
    angle: Annotated[float, Option("DEGREES", "angle between neighbours of a sequence")] = 15.0
    depth: Annotated[bool, Option(None, "use measured depth if available")] = True
    depth_points: Annotated[
        Path | None,
        Option("MODEL", "COLMAP sparse model whose points, where frames observe them, are used as depth"),
    ] = None
    fault: Annotated[
        Names,
        Option(
            "NAME:SIZE...",
            "repeat every trial with each of these image faults, one of 'bidnerf plugins faults'; NAME:SIZE,SIZE gives"
            " several sizes, A:SIZE+B:SIZE combines two, none leaves the images unchanged",
            "none",
        ),
    ] = ()
    device: Device = "cpu"
    workers: Annotated[
        int | None, Option("N", "number of single-threaded processes", "one per core; one on a GPU")
    ] = None
    dask: Annotated[
        str | None, Option("ADDRESS", "address of a dask scheduler whose workers run the trials")
    ] = None
    shards: Annotated[int, Option("N", "number of parts that the trials are split into")] = 1
    shard: Annotated[int, Option("I", "the part to run, from 0")] = 0
    reading: Annotated[DatasetOptions, Without("largest", "background")] = DatasetOptions(split="test")
    method: MethodOptions = MethodOptions()

    def run(self, arguments: list[str]) -> None:
        from bidnerf_core.evaluation import Plan, command_line, evaluate

        _ = self.reading.mask_folder  # rejects anything but a folder of masks
        if self.data is None and not self.map.startswith("demo:"):
            raise UsageError(f"no DATA after map {self.map}; only closed-form maps have their own data")
        with wrong_usage():
            require("--workers", 1 if self.workers is None else self.workers, 1, 10_000)
            require("--shards", self.shards, 1)
            require("--shard", self.shard, 0, self.shards - 1)
            if self.dask is not None and self.workers is not None:
                raise UsageError("--workers and --dask contradict each other: a cluster has its own workers")
            plan = Plan(
                protocol=self.protocol, sizes=read_sizes(self.size) or None, method=self.method.method,
                config=self.method.config, trials=self.trials, seed=self.seed, frames=self.frame or None,
                images=self.sequence, angle=self.angle, device=self.device, depth=self.depth,
                depth_points=None if self.depth_points is None else str(self.depth_points), faults=self.fault,
                shard=self.shard, shards=self.shards, **stated_reading(self.reading),
            )  # fmt: skip
        require_outside_maps(self.out.parent, self.out)
        with Display() as display, stopped_by_ctrl_c(STOPPING) as cancel:
            found = evaluate(
                self.map, self.data or self.map, plan, out=self.out, workers=self.dask or self.workers,
                command=command_line("bidnerf evaluate", arguments), progress=display, cancel=cancel,
            )  # fmt: skip
        show(f"{amount(len(found.rows), 'trial')} in {self.out}; 'bidnerf report {self.out}' shows them")


def stated_reading(images: DatasetOptions) -> dict[str, Any]:
    """Return the options with which a dataset is opened, as the plain values that a plan of trials stores."""
    registration = images.registration
    return {
        "split": images.split,
        "camera": None if images.camera is None else str(images.camera),
        "register_depth": registration if registration in (None, False) else str(registration),
        "depth_unit": images.depth_unit,
        "masks": None if images.masks is None else str(images.masks),
        "mask_hides": images.mask_hides,
    }


def read_sizes(words: Sequence[str]) -> tuple[Size, ...]:
    """Parse sizes such as 0.5 or 0.2:10."""
    try:
        return tuple(tuple(float(number) for number in word.split(":")) for word in words)
    except ValueError as error:
        raise UsageError(f"--size is {' '.join(words)}", expected="numbers such as 0.5, or 0.2:10") from error


def run(arguments: list[str]) -> None:
    parse("evaluate", Evaluate, arguments).run(arguments)
