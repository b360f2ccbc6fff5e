"""A report of results: tables, figures and statistical tests as one self-contained page."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from bidnerf_core.errors import InputError, printable
from bidnerf_core.evaluation.groups import Group, Situation, situations
from bidnerf_core.evaluation.plots import Figures, draw_faults
from bidnerf_core.evaluation.provenance import Provenance
from bidnerf_core.evaluation.results import ResultTable
from bidnerf_core.evaluation.summary import (
    ABSOLUTE,
    RELATIVE,
    Success,
    applies,
    pairwise_tests,
    usual_criterion,
)
from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.io import is_temporary, open_binary, output_folder, write_file
from bidnerf_core.results import CRITERIA, CRITERION_NAMES, require_matplotlib

TEMPLATE = "report.html.jinja"
MARK = '<meta name="generator" content="bidnerf report">'
"""Marks a page as a report, which a later report may replace."""
UNFINISHED = (
    f"<!doctype html>{MARK}<title>Unfinished report</title><p>This report was interrupted; the same command"
    " rewrites it.</p>\n"
)
LISTED_FRAMES = 100
"""Number of frames that a report lists with links to the page of a map."""
LENGTH_OF_HEAD = 4096  # bytes at the beginning of a page that contain the mark of a report
FAULT_CAPTION = (
    "Trials by fault of the images and its size, with Wilson's 95 % intervals: right (within 5 degrees and"
    " 0.05 units), converged according to the method itself, and converged but wrong."
)


@dataclass(frozen=True)
class Figure:
    """A figure of the page, with its caption."""

    file: Path  # SVG
    caption: str

    @property
    def base64(self) -> str:
        """The content of the file, encoded for embedding in a page."""
        return base64.b64encode(self.file.read_bytes()).decode()


def write_report(
    table: ResultTable,
    folder: str | Path,
    title: str = "Localization results",
    criterion: str | None = None,
    runs: Sequence[tuple[str, Sequence[Provenance]]] = (),
    view: str | None = None,
) -> Path:
    """Write ``index.html``, and its figures as PNG and SVG, to ``folder``, and return the path of the page.

    ``criterion`` is the one of ``CRITERIA`` used where only one is shown. ``runs`` has the name of each
    results file and the runs that made it. ``view`` is the address of a page of ``bidnerf view --results``,
    to whose frames the report links. An earlier report in the folder is replaced. Raises ``InputError``
    without results or matplotlib, and for a folder that holds anything but a report.
    """
    if not table.rows:
        raise InputError("no finished trial, nothing to report")
    folder = Path(folder)
    chosen = chosen_criterion(criterion, table.groups)
    require_matplotlib()
    _check_ours(folder)
    path = folder / "index.html"
    with output_folder(folder, overwrite=True):
        if not path.exists():  # so that an interrupted report is recognized as one
            write_file(path, UNFINISHED.encode())
        figures = draw_figures(table.groups, folder, chosen)
        write_file(path, page(title, table, figures, runs, chosen, view).encode())
    return path


def chosen_criterion(asked: str | None, groups: Sequence[Group]) -> str:
    """Return the criterion to use where only one is shown. Raises ``InputError`` for one that applies to no trial."""
    if asked is None:
        return usual_criterion([result for group in groups for result in group.results])
    if asked not in CRITERIA:
        raise InputError(f"criterion is {asked!r}", expected=f"one of {', '.join(CRITERIA)}")
    if not any(applies(asked, group.results) for group in groups):
        raise InputError(
            f"criterion is {asked}, relative to the start's error, but no trial had a start;",
            expected="5deg 0.05 or 1deg 0.02",
        )
    return asked


def draw_figures(groups: Sequence[Group], folder: Path, criterion: str) -> list[Figure]:
    """Write all figures of a report to ``folder`` and return them with their captions."""
    figures, success = Figures(groups, folder, criterion), CRITERION_NAMES[criterion]
    by_fault = draw_faults(groups, folder)
    some = not all(applies(criterion, group.results) for group in groups)
    omitted = " Trials without a start are not shown." if some else ""
    cut = figures.omitted
    return [
        Figure(figures.rates(), f"Success rates with Wilson's 95 % intervals.{cut}"),
        *([] if by_fault is None else [Figure(by_fault, FAULT_CAPTION + cut)]),
        Figure(
            figures.steps(),
            f"Steps to success ({success}): the first step from which on the criterion holds. Boxes show the median and the "
            "quartiles, whiskers reach to 1.5 times the interquartile range, and each point is a trial; the numbers above "
            f"count the trials that succeeded.{omitted}{cut}",
        ),
        Figure(
            figures.share(),
            f"Fraction of all trials that meet the criterion ({success}) from each step on.{omitted}{cut}",
        ),
        Figure(
            figures.traces("translation"),
            f"Translation error after each step: median and quartiles of all trials. The dashed line is 0.05.{cut}",
        ),
        Figure(
            figures.traces("rotation_deg"),
            f"Rotation error after each step: median and quartiles of all trials. The dashed line is 5 degrees.{cut}",
        ),
    ]  # fmt: skip


def page(
    title: str,
    table: ResultTable,
    figures: Sequence[Figure],
    runs: Sequence[tuple[str, Sequence[Provenance]]],
    criterion: str,
    view: str | None = None,
) -> str:
    """Return a report as HTML."""
    environment = Environment(
        autoescape=True, finalize=_printed, undefined=StrictUndefined, keep_trailing_newline=True
    )
    environment.filters |= {"number": _number, "steps": _steps, "plain": _plain}
    source = files(__package__).joinpath(TEMPLATE).read_text(encoding="utf-8")
    template = environment.from_string(source.strip() + "\n")
    groups = table.groups
    titles = {row.situation: row.start for row in table.summary}
    pairs = [
        (titles[s], pairwise_tests([g for g in groups if g.situation == s], criterion))
        for s in situations(groups)
    ]
    return template.render(
        mark=Markup(MARK),
        title=title,
        trials=len(table.rows),
        maps=list(dict.fromkeys(_map_name(s) for s in situations(groups))),
        criteria=[CRITERION_NAMES[name] for name in CRITERIA],
        sections=[
            (titles[s], list(rows)) for s, rows in itertools.groupby(table.summary, lambda row: row.situation)
        ],
        pooled=any(g.situation.size is None for g in groups),
        figures=figures,
        relative=RELATIVE,
        absolute=ABSOLUTE,
        pairs=[(start, found) for start, found in pairs if found],
        count=sum(len(found) for _, found in pairs),
        view=view,
        frames=doubtful(table.rows)[:LISTED_FRAMES],
        criterion=CRITERION_NAMES[criterion],
        runs=[(name, _facts(name, known), _commands(known)) for name, known in runs],
    )


def doubtful(rows: Sequence[TrialResult]) -> list[TrialResult]:
    """Return the trials that were accepted although wrong (beyond 5 degrees or 0.05 units), then the rejected ones."""

    def is_wrong(row: TrialResult) -> bool:
        return row.error is None or row.error.translation > 0.05 or row.error.rotation_deg > 5

    found = [row for row in rows if not row.converged or is_wrong(row)]
    return sorted(found, key=lambda row: not row.converged)


def _printed(value: Any) -> Any:
    """Return text without characters that a browser or a terminal would interpret; markup of the template is kept."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _number(value: float | None, digits: int, unit: str = "") -> str | None:
    return None if value is None else f"{value:.{digits}f}{unit}"


def _steps(success: Success | None) -> str | None:
    return None if success is None else _plain(success.steps)


def _plain(value: float | None) -> str | None:
    return None if value is None else f"{value:g}"


def _map_name(s: Situation) -> str:
    return f"{s.map} ({s.weights.partition('.')[0]}) on {s.data}/{s.split}"


def _commands(runs: Sequence[Provenance]) -> list[str]:
    return list(dict.fromkeys(run.command for run in runs))


def _facts(name: str, runs: Sequence[Provenance]) -> dict[str, str]:
    """Return how a results file was made, by the name of each fact; empty if that is not recorded."""
    if not runs:
        return {}
    last = runs[-1]
    return {
        "file": name,
        "began": runs[0].date if len(runs) == 1 else f"{runs[0].date}, last run {last.date}",
        "commit": "; ".join(dict.fromkeys(map(_commit, runs))),
        "machine": "; ".join(dict.fromkeys(map(_machine, runs))),
        "run by": "; ".join(dict.fromkeys(run.workers for run in runs)),
        "versions": ", ".join(f"{k} {v}" for k, v in {**last.versions, "Python": last.python}.items()),
    }


def _commit(run: Provenance) -> str:
    if run.commit is None:
        return "unknown (not run from a checkout)"
    return run.commit + (", with local changes" if run.dirty else "")


def _machine(run: Provenance) -> str:
    memory = "" if run.memory_bytes is None else f", {run.memory_bytes / 2**30:.0f} GiB"
    gpu = "no GPU" if run.gpu is None else run.gpu
    return f"{run.cpu}, {run.cores} cores{memory}, {gpu}, {run.system}"


def _check_ours(folder: Path) -> None:
    """Raise ``InputError`` if a folder holds anything but a report, which a newer report may replace."""
    try:
        with open_binary(folder / "index.html", "the page of a report") as file:
            written = MARK.encode() in file.read(LENGTH_OF_HEAD)
    except InputError:
        written = False
    if folder.is_dir() and not written and not all(is_temporary(file.name) for file in folder.iterdir()):
        raise InputError(
            "holds something other than a bidnerf report; name another --out or remove it", where=folder
        )
