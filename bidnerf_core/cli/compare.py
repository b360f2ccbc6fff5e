"""``bidnerf compare``."""

from __future__ import annotations

from dataclasses import replace
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
from bidnerf_core.cli.evaluate import read_sizes
from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.method_options import Preset, chosen_settings
from bidnerf_core.cli.options import Flag, Names, option, parse, wrong_usage
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.evaluation import (
    PROTOCOLS,
    Comparison,
    Plan,
    changed_settings,
    comparison_figure,
    find_protocol,
    run_comparison,
)
from bidnerf_core.io import output_folder, to_plain
from bidnerf_core.localization import METHODS
from bidnerf_core.progress import Progress

Folders = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    option("MAP... DATA", "folders of maps, followed by the folder of a dataset of the same scene", ""),
]


def run(arguments: list[str]) -> None:
    """Run the command; its options include the settings of the method named in the arguments."""
    settings = chosen_settings(arguments, "bid")

    def compare(
        folders: Folders,
        out: Annotated[
            Path | None, option("DIR", "write compare.json, compare.png and compare.svg there", "")
        ] = None,
        split: Annotated[str, option("NAME", "split of the dataset; all: every image")] = "test",
        frame: Annotated[Names, option("NAME...", "try only these frames", "all of the split")] = (),
        protocol: Annotated[str, option("NAME", "how starts are chosen: " + ", ".join(PROTOCOLS))] = "bid",
        size: Annotated[
            str | None,
            option("SIZE", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's first"),
        ] = None,
        trials: Annotated[int | None, option("N", "number of starts", "the protocol's")] = None,
        method: Annotated[str, option("NAME", "how poses are found: " + ", ".join(METHODS))] = "bid",
        camera: DatasetCamera = None,
        register_depth: RegisterDepth = None,
        depth_unit: DatasetDepthUnit = None,
        masks: Masks = None,
        mask_hides: MaskHides = "black",
        seed: Annotated[int | None, option("N", "seed of every random choice", "the protocol's")] = None,
        json: Annotated[Flag, option(None, "print one JSON object", "")] = False,
        overwrite: Annotated[Flag, option(None, "replace the contents of --out", "")] = False,
        preset: Preset = None,
        config: Any = None,
    ) -> None:
        """Localize the same frames from the same starts in several maps, and compare success, time and
        memory.

        Each map has its own process, and the maps take turns at each start.
        """
        if len(folders) < 2:
            raise UsageError(
                f"{len(folders)} folder{'s' if len(folders) != 1 else ''} given",
                expected="the folders of one or more maps, then that of a dataset",
            )
        *maps, data = folders
        mask_folder(masks, mask_hides)  # rejects anything but a folder of masks
        with wrong_usage():
            plan = Plan(
                maps[0], data, protocol, read_sizes([] if size is None else [size]) or find_protocol(protocol).sizes[:1],
                method, changed_settings(method, config), trials, seed, split,
                tuple(name for group in frame for name in group) or None,
                masks=None if masks is None else str(masks), mask_hides=mask_hides,
                **stated_reading(camera, register_depth, depth_unit),
            )  # fmt: skip
        if out is None:
            found = run_comparison(plan, maps, progress=_say)
        else:
            check_folder(out, (*maps, data))
            with output_folder(out, overwrite):
                found = run_comparison(plan, maps, progress=_say)
                found.save(out / "compare.json")
                _draw(found, out)
        if json:
            print_json(to_plain(replace(found, results=())))
        else:
            for line in str(found).split("\n"):
                show(line)

    parse("compare", compare, arguments, settings)


def _say(progress: Progress) -> None:
    say(f"{progress.done}/{progress.total}  {progress.text}")


def _draw(found: Comparison, out: Path) -> None:
    try:
        comparison_figure([out / "compare.png", out / "compare.svg"], found)
        say(f"look at {out / 'compare.png'}")
    except InputError as error:  # matplotlib is optional
        say(str(error))
