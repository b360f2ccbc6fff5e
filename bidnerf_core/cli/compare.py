"""``bidnerf compare``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.evaluate import TrialOptions
from bidnerf_core.cli.options import TEST_IMAGES, Json, MethodOptions
from bidnerf_core.cli.output import check_folder, print_json, say, show
from bidnerf_core.cli.parser import Flag, Option, Without
from bidnerf_core.cli.progress import displayed
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError


def run(
    folders: Annotated[
        tuple[str, ...],
        Option(
            "MAP... DATA",
            "folders of maps, followed by the folder of a dataset of the same scene",
            positional=True,
        ),
    ] = (),
    out: Annotated[
        Path | None, Option("DIR", "write compare.json, compare.png and compare.svg there")
    ] = None,
    size: Annotated[
        str | None,
        Option("SIZE", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's first"),
    ] = None,
    *,
    starts: Annotated[TrialOptions, Without("size")],
    json: Json = False,
    overwrite: Annotated[Flag, Option(None, "replace the contents of --out")] = False,
    images: Annotated[DatasetOptions, Without("largest", "background")] = TEST_IMAGES,
    method: MethodOptions,
) -> None:
    """Localize the same frames from the same starts in several maps, and compare success, time and memory.

    Each map has its own process, and the maps take turns at each start.
    """
    from bidnerf_core.evaluation import compare, comparison_figure
    from bidnerf_core.io import output_folder, to_plain

    if len(folders) < 2:
        raise UsageError(
            f"{len(folders)} folder{'s' if len(folders) != 1 else ''} given",
            expected="the folders of one or more maps, then that of a dataset",
        )
    *maps, data = folders
    plan = replace(starts, size=() if size is None else (size,)).plan(method, images)
    if out is None:
        with displayed():
            found = compare(maps, data, plan)
    else:
        check_folder(out, folders)
        with output_folder(out, overwrite), displayed():
            found = compare(maps, data, plan)
            found.save(out / "compare.json")
            try:
                say(f"look at {comparison_figure(out, found).with_suffix('.png')}")
            except InputError as error:  # matplotlib is optional
                say(str(error))
    if json:
        print_json(to_plain(replace(found, results=())))
        return
    for line in str(found).split("\n"):
        show(line)
