"""A report of results: tables and figures as one self-contained page."""

from __future__ import annotations

import base64
import io
import math
import os
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from itertools import groupby
from operator import attrgetter
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from PIL import Image

from bidnerf.evaluation.plots import Figure, Figures
from bidnerf.evaluation.results import Provenance, ResultTable
from bidnerf.evaluation.summary import (
    ABSOLUTE,
    RELATIVE,
    ResultGroup,
    applies,
    are_stepwise,
    is_right,
    number_text,
    situations,
)
from bidnerf.evaluation.trial import TrialResult, open_data, trial_views
from bidnerf.results import CRITERIA, CRITERION_NAMES, as_picture, common_unit, require_matplotlib
from bidnerf.scenes import is_closed_form
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, printable
from bidnerf_core.geometry import symbol
from bidnerf_core.io import is_temporary, output_folder, write_file

MARK = '<meta name="generator" content="bidnerf report">'
"""Marks a page as a report, which a later report may replace."""


def write_report(
    table: ResultTable,
    folder: str | Path,
    title: str = "Localization results",
    criterion: str | None = None,
    runs: Sequence[tuple[str, Sequence[Provenance]]] = (),
    view: str | None = None,
    data: Sequence[str | Path] = (),
) -> Path:
    """Write a report to ``folder``: ``index.html``, and its figures as PNG and SVG; return the path of the page.

    ``criterion`` is the one of ``CRITERIA`` used where the report shows a single criterion. ``runs`` pairs the
    name of each results file with the runs that made it. ``view`` is the address of a page of ``bidnerf view
    --results``, to whose frames the report links. ``data`` lists dataset folders, from which the images of the
    listed trials are shown. An earlier report in the folder is replaced. Raises ``InputError`` without results
    or matplotlib, for a folder that holds anything but a report, and for a dataset that cannot be read.
    """
    require_matplotlib()
    if not table.rows:
        raise InputError("no finished trial, nothing to report")
    folder = Path(folder)
    chosen = choose_criterion(criterion, table.groups)
    path = folder / "index.html"
    is_ours = path.is_file() and MARK.encode() in path.read_bytes()[:4096]  # the head of the page
    if folder.is_dir() and not is_ours and not all(is_temporary(file.name) for file in folder.iterdir()):
        raise InputError(
            "holds something other than a bidnerf report; name another folder (`out`) or remove it", where=folder
        )
    frames = add_images(worst_first(table.rows)[:24], data)
    with output_folder(folder, overwrite=True):
        if not path.exists():  # so that an interrupted report is recognized as one
            text = "This report was interrupted; the same command rewrites it."
            write_file(path, f"<!doctype html>{MARK}<title>Unfinished report</title><p>{text}</p>\n".encode())
        drawn = Figures(table.groups, folder, chosen)
        figures = [figure for figure in (drawn.errors(), drawn.convergence()) if figure is not None]
        write_file(path, render_page(title, table, figures, runs, view, frames).encode())
    return path


def choose_criterion(name: str | None, groups: Sequence[ResultGroup]) -> str:
    """Return the criterion to use where a report shows a single one: ``name``, or one that applies to all groups.

    Raises ``InputError`` for an unknown criterion, and for one that applies to no trial.
    """
    if name is None:
        return RELATIVE if all(applies(RELATIVE, group.results) for group in groups) else ABSOLUTE
    if name not in CRITERIA:
        raise InputError(f"criterion is {name!r}", expected=f"one of {', '.join(CRITERIA)}")
    if not any(applies(name, group.results) for group in groups):
        raise InputError(
            f"criterion is {name}, relative to the start's error, but no trial had a start;",
            expected="5deg 0.05 or 1deg 0.02",
        )
    return name


def render_page(
    title: str,
    table: ResultTable,
    figures: Sequence[Figure],
    runs: Sequence[tuple[str, Sequence[Provenance]]] = (),
    view: str | None = None,
    frames: Sequence[tuple[TrialResult, str | None]] = (),
) -> str:
    """Return a report as HTML; ``frames`` lists trials with their images, see ``add_images``."""
    environment = Environment(
        autoescape=True,
        # No character of a name reaches a browser or a terminal as an instruction; markup of the template is kept.
        finalize=lambda x: printable(x) if isinstance(x, str) and not isinstance(x, Markup) else x,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    environment.filters["number"] = number_text
    source = files(__package__).joinpath("report.html.jinja").read_text(encoding="utf-8")
    template = environment.from_string(source.strip() + "\n")
    groups = table.groups
    maps = (f"{s.map} ({s.weights.partition('.')[0]}), on {s.data}/{s.split}" for s in situations(groups))
    unit = symbol(common_unit(table.rows))
    return template.render(
        mark=Markup(MARK),
        title=title,
        trials=len(table.rows),
        maps=list(dict.fromkeys(maps)),
        criteria={
            n: CRITERION_NAMES[n].replace("units", unit) for n in CRITERIA if any(applies(n, g.results) for g in groups)
        },
        sections=[(title, list(own)) for title, own in groupby(groups, attrgetter("title"))],
        pooled=any(g.situation.size is None for g in groups),
        stepwise=any(are_stepwise(group.results) for group in groups),
        figures=[(caption, base64.b64encode(file.read_bytes()).decode()) for file, caption in figures],
        relative=RELATIVE,
        absolute=ABSOLUTE,
        view=view,
        frames=frames,
        is_right=is_right,
        wrong=sum(row.converged and not is_right(row) for row in table.rows),
        refused=sum(not row.converged for row in table.rows),
        runs=[(name, _describe_runs(name, own), list(dict.fromkeys(r.command for r in own))) for name, own in runs],
    )


def worst_first(rows: Sequence[TrialResult]) -> list[TrialResult]:
    """Return the trials, the most worrying ones first.

    Wrongly accepted trials (beyond 5 degrees or 0.05 units) come first, then the refused ones, then the others;
    each kind is sorted by decreasing error.
    """
    return sorted(
        rows,
        key=lambda row: (
            row.converged and is_right(row),
            not row.converged,
            -math.inf if row.error is None else -row.error.translation,
        ),
    )


def add_images(rows: Sequence[TrialResult], data: Sequence[str | Path]) -> list[tuple[TrialResult, str | None]]:
    """Return each trial with its image (with faults) as a base64-encoded JPEG, or with None if its dataset is not in ``data``."""
    folders = {Path(os.path.realpath(folder)).name: str(folder) for folder in data}
    opened = cache(open_data)
    pairs: list[tuple[TrialResult, str | None]] = []
    for row in rows:
        trial, encoded = row.trial, None
        if name := trial.data if is_closed_form(trial.data) else folders.get(trial.data):
            # Results hold names of the files of masks, cameras and sensors, not their paths.
            own = {
                key: value for key, value in vars(trial.images).items() if key == "split" or not isinstance(value, str)
            }
            view, content = trial_views(trial, opened(name, DatasetOptions(**own)))[-1], io.BytesIO()
            image = Image.fromarray(as_picture(view.frame.rgb))
            image.thumbnail((240, 240))
            image.save(content, "JPEG", quality=80)
            encoded = base64.b64encode(content.getvalue()).decode()
        pairs.append((row, encoded))
    return pairs


def _describe_runs(name: str, runs: Sequence[Provenance]) -> dict[str, str]:
    """Return the facts about how a results file was made, by name; empty if no runs are recorded."""
    if not runs:
        return {}
    first, last = runs[0], runs[-1]
    commits = [
        f"{r.commit}{', with local changes' * r.dirty}" if r.commit else "unknown (no checkout of this code)"
        for r in runs
    ]
    machines = [
        f"{r.cpu}, {r.cores} cores{f', {r.memory_bytes / 2**30:.0f} GiB' if r.memory_bytes else ''},"
        f" {r.gpu or 'no GPU'}, {r.system}"
        for r in runs
    ]
    return {
        "file": name,
        "began": first.date if len(runs) == 1 else f"{first.date}, last run {last.date}",
        "commit": "; ".join(dict.fromkeys(commits)),
        "machine": "; ".join(dict.fromkeys(machines)),
        "run by": "; ".join(dict.fromkeys(run.workers for run in runs)),
        "versions": ", ".join(f"{k} {v}" for k, v in {**last.versions, "Python": last.python}.items()),
    }
