"""``bidnerf report``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from bidnerf_core.cli.options import option, parse
from bidnerf_core.cli.output import console, show
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.io.folders import output_folder

if TYPE_CHECKING:  # the rest is imported when a report is made, since help pages do not need it
    from bidnerf_core.evaluation.groups import Group
    from bidnerf_core.evaluation.page import Figure

FAULT_CAPTION = (
    "Trials by fault of the images and its size, with Wilson's 95 % intervals: right (within 5 degrees and 0.05 units), "
    "converged by the method's own judgement, and converged but wrong."
)
LENGTH_OF_HEAD = 4096  # bytes at the beginning of a page that contain the mark of a report
CriterionName = Literal["10%", "5deg 0.05", "1deg 0.02"]


def run(arguments: list[str]) -> None:
    """Run the command."""
    parse("report", report, arguments)


def report(
    results: Annotated[
        tuple[Path, ...], tyro.conf.Positional, option("RESULTS...", "files that 'bidnerf evaluate' wrote", "")
    ],
    out: Annotated[Path, option("DIR", "folder for index.html and the figures as PNG and SVG")] = Path("report"),
    criterion: Annotated[
        CriterionName | None,
        option(None, "what counts as success where one criterion is shown", "10%; 5deg 0.05 if trials had no start"),
    ] = None,
    title: Annotated[str, option("TEXT", "title of the page")] = "Localization results",
) -> None:  # fmt: skip
    """Write tables, figures and statistical tests of results as one page that needs no network.

    Trials are compared by map, data, start, method and settings. A trial that several files hold counts once.
    """
    from bidnerf_core.evaluation.page import UNFINISHED, page
    from bidnerf_core.evaluation.provenance import read_runs
    from bidnerf_core.evaluation.results import ResultTable
    from bidnerf_core.io.files import write_file
    from bidnerf_core.results.plot_style import require_matplotlib

    if not results:
        raise UsageError("no file of results, expected at least one that 'bidnerf evaluate' wrote")
    found = ResultTable.load(*results)
    if not found.rows:
        raise InputError(f"{', '.join(map(str, results))}: no finished trial in it, nothing to report")
    groups = found.groups
    chosen = _criterion(criterion, groups)
    _check_ours(out)
    require_matplotlib()
    runs = [(path.name, read_runs(path)) for path in results]
    with output_folder(out, overwrite=True), console.status("drawing"):
        if not (out / "index.html").exists():  # so that an interrupted report is recognised as one
            write_file(out / "index.html", UNFINISHED.encode())
        text = page(title, groups, draw_figures(groups, out, chosen), runs, chosen)
        write_file(out / "index.html", text.encode())
    for line in str(found).split("\n"):
        show(line)
    show(f"look at {out / 'index.html'}")


def _criterion(asked: str | None, groups: Sequence[Group]) -> str:
    """Return the criterion to show where only one is shown. Raises ``UsageError`` for one that applies to no trial."""
    from bidnerf_core.evaluation.summary import applies, usual_criterion

    if asked is None:
        return usual_criterion([result for group in groups for result in group.results])
    if not any(applies(asked, group.results) for group in groups):
        raise UsageError(
            f"--criterion is {asked}, a share of the start's error, and no trial had a start; expected 5deg 0.05 or"
            " 1deg 0.02"
        )
    return asked


def _check_ours(out: Path) -> None:
    """Raise ``InputError`` where ``out`` holds anything but a report, which a newer report may replace."""
    from bidnerf_core.evaluation.page import MARK
    from bidnerf_core.io.files import is_temporary, open_binary

    try:
        with open_binary(out / "index.html", "the page of a report") as file:
            written = MARK.encode() in file.read(LENGTH_OF_HEAD)
    except InputError:
        written = False
    if out.is_dir() and not written and not all(is_temporary(file.name) for file in out.iterdir()):
        raise InputError(
            f"{out}: holds something that is no report of bidnerf's; name another --out or remove it"
        )


def draw_figures(groups: Sequence[Group], folder: Path, criterion: str) -> list[Figure]:
    """Write all figures of a report to ``folder`` and return them with their captions."""
    from bidnerf_core.evaluation.fault_figure import draw_faults
    from bidnerf_core.evaluation.page import Figure
    from bidnerf_core.evaluation.plots import Figures
    from bidnerf_core.evaluation.summary import applies
    from bidnerf_core.results.plot_style import CRITERION_NAMES

    figures, success = Figures(groups, folder, criterion), CRITERION_NAMES[criterion]
    by_fault = draw_faults(groups, folder)
    some = not all(applies(criterion, group.results) for group in groups)
    omitted = " Trials without a start are not shown." if some else ""
    return [
        Figure(figures.rates(), "Success rates with Wilson's 95 % intervals."),
        *([] if by_fault is None else [Figure(by_fault, FAULT_CAPTION)]),
        Figure(
            figures.steps(),
            f"Steps to success ({success}): the first step from which on the criterion holds. Boxes show the median and the "
            "quartiles, whiskers reach to 1.5 times the interquartile range, and each point is a trial; the numbers above "
            f"count the trials that succeeded.{omitted}",
        ),
        Figure(figures.share(), f"Share of all trials that meet the criterion ({success}) from each step on.{omitted}"),
        Figure(
            figures.traces("translation"),
            "Translation error after each step: median and quartiles of all trials. The dashed line is 0.05.",
        ),
        Figure(
            figures.traces("rotation_deg"),
            "Rotation error after each step: median and quartiles of all trials. The dashed line is 5 degrees.",
        ),
    ]  # fmt: skip
