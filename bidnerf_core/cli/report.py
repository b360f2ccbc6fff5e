"""``bidnerf report``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.table import Table

from bidnerf_core.cli.common import UsageError, console, option, output_folder, parse, print_table
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.errors import CRITERIA
from bidnerf_core.evaluation.groups import Group, grouped, situations
from bidnerf_core.evaluation.page import MARK, Figure, page
from bidnerf_core.evaluation.plots import NAMES, Figures
from bidnerf_core.evaluation.provenance import read_runs
from bidnerf_core.evaluation.results import read_results
from bidnerf_core.evaluation.summary import summarize
from bidnerf_core.storage import write_file

Bar = Literal["10%", "5deg 0.05", "1deg 0.02"]


def run(arguments: list[str]) -> None:
    parse("report", report, arguments)


def report(
    results: Annotated[
        tuple[Path, ...], tyro.conf.Positional, option("RESULTS...", "files as 'bidnerf evaluate' writes them")
    ],
    out: Annotated[Path, option("DIR", "folder for index.html, and the figures as PNG and SVG")] = Path("report"),
    criterion: Annotated[Bar, option(None, "what steps to success are counted to")] = "10%",
    title: Annotated[str, option("TEXT", "of the page")] = "Localization results",
) -> None:  # fmt: skip
    """Tables, figures and tests of results, as one page that needs no network.

    Trials are put side by side by map, start, method and settings. A trial that is in several files counts once.
    """
    if not results:
        raise UsageError("no file of results, expected at least one as 'bidnerf evaluate' writes it")
    found = read_results(results)
    if not found:
        raise InputError(f"{', '.join(map(str, results))}: no finished trial in it, nothing to report")
    _check_ours(out)
    runs = [(path.name, read_runs(path)) for path in results]
    groups = grouped(found)
    with output_folder(out, overwrite=True), console.status("drawing"):
        text = page(title, groups, draw(groups, out, criterion), runs, criterion)
        write_file(out / "index.html", text.encode())
    _print(groups)
    print(f"look at {out / 'index.html'}")


def _check_ours(out: Path) -> None:
    """A report may be replaced by a newer one; what is something else is left alone."""
    try:
        written = MARK in (out / "index.html").read_text(errors="replace")
    except OSError:
        written = False
    if out.is_dir() and any(out.iterdir()) and not written:
        raise InputError(
            f"{out}: holds something that is no report of bidnerf's; name another --out or remove it"
        )


def draw(groups: Sequence[Group], folder: Path, criterion: str) -> list[Figure]:
    """All figures of a report, written to ``folder``."""
    figures, success = Figures(groups, folder, criterion), NAMES[criterion]
    return [
        Figure(figures.rates(), "Success rates with Wilson's 95 % intervals."),
        Figure(
            figures.steps(),
            f"Steps to success ({success}): the first step from which on the error stays there. Median, quartiles, "
            "whiskers to 1.5 times their distance; each point is a trial; above, how many succeeded.",
        ),
        Figure(figures.share(), f"Share of all trials that have come to success ({success}) by each step, and stay."),
        Figure(
            figures.traces("translation"),
            "Translation error after each step: median and quartiles of all trials. Dashed: 0.05.",
        ),
        Figure(
            figures.traces("rotation_deg"),
            "Rotation error after each step: median and quartiles of all trials. Dashed: 5 degrees.",
        ),
    ]  # fmt: skip


def _print(groups: Sequence[Group]) -> None:
    table = Table(box=None, pad_edge=False)
    table.add_column("success by")
    for column in ("n", *CRITERIA, "median error"):
        table.add_column(column, justify="right", no_wrap=True)
    several = len({(s.map, s.weights) for s in situations(groups)}) > 1
    for situation in situations(groups):
        table.add_row(f"{situation.map}: {situation.start}" if several else situation.start)
        for group in (g for g in groups if g.situation == situation):
            s = summarize(group.results)
            rates = ["-" if j is None else f"{100 * j.rate.rate:.0f} %" for j in s.criteria.values()]
            error = f"{s.translation:.3f} m {s.rotation_deg:6.2f} deg"
            table.add_row(f"  {group.label}", str(s.trials), *rates, error)
    print_table(table)
