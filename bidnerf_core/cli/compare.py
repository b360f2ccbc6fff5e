"""``bidnerf compare``."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from bidnerf_core.cli.folders import output_folder
from bidnerf_core.cli.method_options import Preset, chosen_settings
from bidnerf_core.cli.options import LARGEST_SEED, Flag, Names, option, parse, require, wrong_usage
from bidnerf_core.cli.output import print_json, print_table, say, show
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.evaluation.bench import changed_settings
from bidnerf_core.evaluation.comparison import Comparison, MapRow, compare_maps, plan_comparison
from bidnerf_core.evaluation.comparison_figure import comparison_figure
from bidnerf_core.evaluation.protocols import MOST_TRIALS, PROTOCOLS, Size, find_protocol
from bidnerf_core.evaluation.summary import ABSOLUTE, RELATIVE, Success
from bidnerf_core.evaluation.trial import Trial
from bidnerf_core.evaluation.trial_process import Measured
from bidnerf_core.io.files import write_file
from bidnerf_core.io.json import to_plain
from bidnerf_core.localization import METHODS
from bidnerf_core.maps.description import load_info
from bidnerf_core.results.errors import CRITERIA
from bidnerf_core.scenes.closed_form_data import is_closed_form

Folders = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    option("MAP... DATA", "folders of maps, and last the folder of a dataset of the same scene", ""),
]


def run(arguments: list[str]) -> None:
    """Run the command; its options include the settings of the method that the arguments name."""
    settings = chosen_settings(arguments, "bid")

    def compare(
        folders: Folders,
        out: Annotated[
            Path | None, option("DIR", "write compare.json, compare.png and compare.svg there", "")
        ] = None,
        split: Annotated[str, option("NAME", "split of the dataset")] = "test",
        frame: Annotated[Names, option("NAME...", "try only these frames", "all of the split")] = (),
        protocol: Annotated[str, option("NAME", "how starts are chosen: " + ", ".join(PROTOCOLS))] = "bid",
        size: Annotated[
            str | None,
            option("SIZE", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's first"),
        ] = None,
        trials: Annotated[int | None, option("N", "number of starts", "the protocol's")] = None,
        method: Annotated[str, option("NAME", "how poses are found: " + ", ".join(METHODS))] = "bid",
        seed: Annotated[int | None, option("N", "seed of every random choice", "the protocol's")] = None,
        json: Annotated[Flag, option(None, "print one JSON object", "")] = False,
        overwrite: Annotated[Flag, option(None, "replace what is in --out", "")] = False,
        preset: Preset = None,
        config: Any = None,
    ) -> None:
        """Localize the same frames from the same starts in several maps, and compare success, time and memory.

        Each map has a process of its own, and the maps take turns at each start.
        """
        if len(folders) < 2:
            raise UsageError(
                f"{len(folders)} folder{'s' if len(folders) != 1 else ''} given, "
                "expected the folders of one or more maps, then that of a dataset"
            )
        *maps, data = folders
        with wrong_usage():
            chosen = find_protocol(protocol)
            asked = chosen.sizes[0] if size is None else read_size(size)
            chosen.check_size(asked)
        usual = Trial(
            "", data, ("",), protocol, asked, method,
            changed_settings(method, config), chosen.seed if seed is None else seed, split,
        )  # fmt: skip
        names = [name for group in frame for name in group]
        found = _compare(maps, usual, names, trials, out, overwrite)
        if json:
            print_json(to_plain(replace(found, results=())))
        else:
            _print(found)

    parse("compare", compare, arguments, settings)


def read_size(given: str) -> Size:
    try:
        return tuple(float(number) for number in given.split(":"))
    except ValueError as error:
        raise UsageError(f"--size is {given}, expected numbers as 0.5, or 0.2:10") from error


def _compare(
    maps: Sequence[str], usual: Trial, names: Sequence[str], trials: int | None, out: Path | None, overwrite: bool
) -> Comparison:  # fmt: skip
    """Check all input, then run the comparison and write it to ``out``."""
    require("--trials", 1 if trials is None else trials, 1, MOST_TRIALS)
    require("--seed", usual.seed, 0, LARGEST_SEED)
    planned = plan_comparison(usual, maps, names, trials)
    for folder in maps:
        if not is_closed_form(folder):
            load_info(Path(folder))
    if out is None:
        return _compared(planned)
    with output_folder(out, overwrite):
        found = _compared(planned)
        _write(found, out)
    return found


def _compared(planned: Sequence[Sequence[Trial]]) -> Comparison:
    starts, maps = len(planned), len(planned[0])
    say(
        f"{starts} start{'s' if starts > 1 else ''} in {maps} map{'s' if maps > 1 else ''}; a process for each begins"
    )
    return compare_maps(planned, _say_progress)


def _say_progress(done: int, total: int, measured: Measured) -> None:
    """Write a line on stderr for a finished trial."""
    result = measured.result
    error = result.error
    off = f"{error.translation:.3f} m, {error.rotation_deg:.2f} deg" if error else "not finite"
    name = Path(result.trial.map).name
    say(
        f"{done}/{total}  {result.frame} in {name}: {off}, {amount(result.steps, 'step')}, {result.seconds:.1f} s"
    )


def _write(found: Comparison, out: Path) -> None:
    write_file(out / "compare.json", (jsonlib.dumps(to_plain(found), allow_nan=False) + "\n").encode())
    try:
        comparison_figure([out / "compare.png", out / "compare.svg"], found)
        say(f"look at {out / 'compare.png'}")
    except InputError as error:  # matplotlib is optional
        say(str(error))


def _print(found: Comparison) -> None:
    size = ":".join(f"{x:g}" for x in found.size)
    trials = f"{found.trials} trials" if found.protocol == "none" else f"{found.trials} starts of"
    start = "without a start" if found.protocol == "none" else f"{found.protocol} {size}".rstrip()
    show(f"{trials} {start} on {found.data}/{found.split}, method {found.method}")
    table = Table("", *(row.map for row in found.rows), box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, cell in LINES.items():
        table.add_row(name, *map(cell, found.rows))
    print_table(table)
    usual = RELATIVE if found.rows[0].success[RELATIVE] else ABSOLUTE
    print(f"success: number and Wilson's 95 % interval; to success: median of the trials that met {usual}")


def _rate(row: MapRow, criterion: str) -> str:
    success = row.success[criterion]
    if success is None:
        return "-"
    rate = success.rate
    return f"{rate.successes}/{rate.trials} ({100 * rate.low:.0f}-{100 * rate.high:.0f} %)"


def _usual(row: MapRow) -> Success:
    """Return the success by the relative criterion, or by the absolute one where there was no start."""
    success = row.success[RELATIVE] or row.success[ABSOLUTE]
    assert success is not None  # the absolute criterion always applies
    return success


def _known(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


LINES: dict[str, Callable[[MapRow], str]] = {
    "backend": lambda row: row.backend,
    **{f"success {name}": partial(_rate, criterion=name) for name in CRITERIA},
    "median error, m": lambda row: _known(row.translation, 4),
    "median error, deg": lambda row: _known(row.rotation_deg, 2),
    "steps": lambda row: f"{row.steps:g}",
    "steps to success": lambda row: _known(_usual(row).steps, 0),
    "ms a step": lambda row: f"{row.ms_per_step:.1f}",
    "ms to success": lambda row: _known(_usual(row).milliseconds, 0),
    "peak memory, MiB": lambda row: f"{row.peak_memory_bytes / 2**20:.0f}",
    "samples a ray": lambda row: f"{row.samples_per_ray:.1f}",
    "map, MiB": lambda row: f"{row.map_bytes / 2**20:.1f}",
}
"""The rows of the table, by name; each map has a column."""
