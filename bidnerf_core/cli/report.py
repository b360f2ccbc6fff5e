"""``bidnerf report``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

from bidnerf_core.cli.options import Names, wrong_usage
from bidnerf_core.cli.output import check_folder, console, show
from bidnerf_core.cli.parser import Option
from bidnerf_core.errors import InputError, UsageError


def run(
    results: Annotated[
        tuple[Path, ...], Option("RESULTS...", "files written by 'bidnerf evaluate'", positional=True)
    ] = (),
    out: Annotated[Path, Option("DIR", "folder for index.html and the figures as PNG and SVG")] = Path("report"),
    criterion: Annotated[
        Literal["10%", "5deg 0.05", "1deg 0.02"] | None,
        Option(None, "success criterion for displays that use only one", "10%; 5deg 0.05 if trials had no start"),
    ] = None,
    title: Annotated[str, Option("TEXT", "title of the page")] = "Localization results",
    view: Annotated[
        Path | None, Option("PAGE.html", "page of 'bidnerf view --results', whose frames the report links to", "")
    ] = None,
    data: Annotated[
        Names, Option("DATA...", "datasets of the results, from which the worst frames are shown", "no pictures")
    ] = (),
) -> None:  # fmt: skip
    """Write tables and figures of results as one page that works offline.

    Trials are compared by map, data, start, method and settings. A trial in several files counts once.
    """
    # Imported when a report is made, since help pages do not need it.
    from bidnerf_core.evaluation import ResultTable, chosen_criterion, read_runs, write_report

    if not results:
        raise UsageError("no results file", expected="at least one written by 'bidnerf evaluate'")
    table = ResultTable.load(*results)
    with wrong_usage():
        chosen = chosen_criterion(criterion, table.groups)
    if view is not None and not view.is_file():
        raise InputError(
            "no such page", where=view, expected="one written by 'bidnerf view MAP --results ... --save'"
        )
    if missing := [folder for folder in data if not Path(folder).is_dir()]:
        raise InputError("no such folder", where=missing[0], expected="a dataset that the results are of")
    check_folder(out, (*results, *data))
    runs = [(path.name, read_runs(path)) for path in results]
    with console.status("drawing"):
        page = write_report(
            table, out, title, chosen, runs, None if view is None else link_to(view, out), data
        )
    for line in str(table).split("\n"):
        show(line)
    show(f"look at {page}")


def link_to(page: Path, folder: Path) -> str:
    """Return the link to a page from another page in a folder."""
    return quote(Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix())
