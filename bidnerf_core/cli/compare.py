"""``bidnerf compare``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.evaluate import read_sizes, stated_reading
from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import Json, MethodOptions, Names, wrong_usage
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.cli.parser import Flag, Option, Without, parse
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.progress import Progress


@dataclass(frozen=True)
class Compare:
    """Localize the same frames from the same starts in several maps, and compare success, time and memory.

    Each map has its own process, and the maps take turns at each start.
    """

    folders: Annotated[
        tuple[str, ...],
        Option(
            "MAP... DATA",
            "folders of maps, followed by the folder of a dataset of the same scene",
            positional=True,
        ),
    ] = ()
    out: Annotated[Path | None, Option("DIR", "write compare.json, compare.png and compare.svg there")] = None
    protocol: Annotated[
        str | None,
        Option(
            "NAME",
            "how starts are chosen: bid, bid-hard, inerf, parallel, perturb or none",
            "none; bid for methods that need a start",
        ),
    ] = None
    size: Annotated[
        str | None,
        Option("SIZE", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's first"),
    ] = None
    trials: Annotated[int | None, Option("N", "number of starts", "the protocol's")] = None
    seed: Annotated[int | None, Option("N", "seed of every random choice", "the protocol's")] = None
    frame: Annotated[Names, Option("NAME...", "try only these frames", "all of the split")] = ()
    json: Json = False
    overwrite: Annotated[Flag, Option(None, "replace the contents of --out")] = False
    reading: Annotated[DatasetOptions, Without("largest", "background")] = DatasetOptions(split="test")
    method: MethodOptions = MethodOptions()

    def run(self) -> None:
        from bidnerf_core.evaluation import Plan, compare, comparison_figure
        from bidnerf_core.io import output_folder, to_plain
        from bidnerf_core.localization import find_method

        if len(self.folders) < 2:
            raise UsageError(
                f"{len(self.folders)} folder{'s' if len(self.folders) != 1 else ''} given",
                expected="the folders of one or more maps, then that of a dataset",
            )
        *maps, data = self.folders
        _ = self.reading.mask_folder  # rejects anything but a folder of masks
        with wrong_usage():
            sizes = read_sizes([] if self.size is None else [self.size]) or None
            usual = "bid" if find_method(self.method.method).needs_start else "none"
            plan = Plan(
                protocol=self.protocol or usual, sizes=sizes, method=self.method.method, config=self.method.config,
                trials=self.trials, seed=self.seed, frames=self.frame or None, **stated_reading(self.reading),
            )  # fmt: skip
        if self.out is None:
            found = compare(maps, data, plan, progress=_say)
        else:
            check_folder(self.out, (*maps, data))
            with output_folder(self.out, self.overwrite):
                found = compare(maps, data, plan, progress=_say)
                found.save(self.out / "compare.json")
                try:
                    say(f"look at {comparison_figure(self.out, found).with_suffix('.png')}")
                except InputError as error:  # matplotlib is optional
                    say(str(error))
        if self.json:
            print_json(to_plain(replace(found, results=())))
            return
        for line in str(found).split("\n"):
            show(line)


def _say(progress: Progress) -> None:
    say(f"{progress.done}/{progress.total}  {progress.text}")


def run(arguments: list[str]) -> None:
    parse("compare", Compare, arguments).run()
