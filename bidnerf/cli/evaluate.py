"""``bidnerf evaluate``, ``compare`` and ``report``: trials of localization and their results."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias
from urllib.parse import quote

from bidnerf.cli.options import (
    TEST_IMAGES,
    DaskAddress,
    First,
    FrameNames,
    MethodGroup,
    MethodOptions,
    Names,
    NoDepth,
    RunOptions,
    SeenImages,
    existing,
    require_device,
    require_map,
    wrong_usage,
)
from bidnerf.cli.output import check_folder, check_output, console, print_result, say
from bidnerf.cli.parameters import Check, Group, Option, Without
from bidnerf.cli.running import display_progress, interruptible_work
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.installation import import_extra
from bidnerf_core.io import require_existing
from bidnerf_core.settings import EXPERT, LARGEST_SEED, WholeNumbers

if TYPE_CHECKING:
    from bidnerf.evaluation import Plan


@dataclass(frozen=True)
class TrialOptions:
    """Which frames are tried, with what changes, and from which starts."""

    protocol: Annotated[
        Literal["bid", "bid-hard", "inerf", "perturb", "none"] | None,
        Option(
            "NAME",
            "how starts are chosen: bid, bid-hard, inerf, perturb or none",
            "none; bid for methods that need a start",
        ),
    ] = None
    size: Annotated[
        tuple[str, ...],
        Option(
            "SIZE...",
            "error of the start in units of the map, metres if it is metric: a length for bid and bid-hard (e_t in the"
            " BID-NeRF paper), LENGTH:DEGREES for perturb",
            "the protocol's; of several, compare uses the first",
        ),
    ] = ()
    trials: Annotated[
        int | None,
        WholeNumbers(1),
        Option("N", "number of trials per size; without a start, at most one per frame", "the protocol's"),
    ] = None
    seed: Annotated[
        int | None, EXPERT, WholeNumbers(0, LARGEST_SEED), Option("N", "seed of every random choice", "the protocol's")
    ] = None
    frame: FrameNames = ()
    first: First = None
    no_depth: NoDepth = False
    fault: Annotated[
        Names,
        Option(
            "NAME:SIZE...",
            "repeat every trial with each of these image faults, one of 'bidnerf plugins faults'; NAME:SIZE,SIZE gives"
            " several sizes, A:SIZE+B:SIZE combines two, none leaves the images unchanged",
            "none",
        ),
    ] = ()

    def plan(self, method: MethodOptions, images: DatasetOptions, **more: Any) -> Plan:
        """Return the plan of the trials; ``more`` holds the fields of the plan that these options do not set."""
        try:
            numbers = [[float(number) for number in size.split(":")] for size in self.size]
        except ValueError as error:
            raise UsageError(f"--size is {' '.join(self.size)!r}", expected="numbers such as 0.5, or 0.2:10") from error

        from bidnerf.evaluation import Plan
        from bidnerf_core.localization import find_method

        _ = images.mask_folder  # raises for anything but a folder of masks
        with wrong_usage():
            return Plan(
                protocol=self.protocol or ("bid" if find_method(method.method).needs_start else "none"),
                sizes=numbers or None,
                method=method.method,
                config=method.config(),
                trials=self.trials,
                seed=self.seed,
                frames=self.frame or None,
                first=self.first,
                images=replace(images, register_depth=images.registration),
                **more,
            )


Starts: TypeAlias = Annotated[
    TrialOptions, Group("trials", "Which frames are tried, with what changes, and from which starts.")
]


@dataclass(frozen=True)
class WorkOptions(RunOptions):
    """What runs the trials."""

    workers: Annotated[
        int | None,
        WholeNumbers(1, 10_000),
        Option("N", "number of single-threaded processes", "one per core; one on a GPU"),
    ] = None
    dask: Annotated[DaskAddress, Option("ADDRESS", "address of a dask scheduler whose workers run the trials")] = None


def run_evaluate(
    map: Annotated[str, Option("MAP", "folder of a map, or demo:blobs", positional=True), Check(require_map)],
    out: Annotated[Path, Option("RESULTS.jsonl", "results file; trials already in it are not run again")],
    data: Annotated[
        str | None,
        Option(
            "[DATA]",
            "folder of a dataset, or demo:object, demo:room, demo:blobs",
            "the scene of a demo: MAP",
            positional=True,
        ),
        existing("a dataset"),
    ] = None,
    *,
    starts: Starts,
    work: Annotated[WorkOptions, Group("work", "Where the trials are run."), Without("overwrite")],
    images: SeenImages = TEST_IMAGES,
    method: MethodGroup,
) -> None:
    """Localize many frames of a dataset, with a JSON line per trial.

    Trials begin at perturbed starts, or without a start. Finished trials are always kept: the same command resumes where it stopped.
    'bidnerf report' makes tables and figures from the results.
    """
    if data is None and not map.startswith("demo:"):
        raise UsageError(f"no DATA after map {map}; only closed-form maps have their own data")
    if work.dask is not None and work.workers is not None:
        raise UsageError("--workers and --dask contradict each other: a cluster has its own workers")
    if work.dask is not None:
        import_extra("distributed", "cluster", "a cluster")  # before the map is loaded
    check_output(out, (), overwrite=True, endings=(".jsonl",))  # finished trials are kept
    plan = starts.plan(
        method,
        images,
        device=work.device,
        depth=not starts.no_depth,
        faults=starts.fault,
    )
    require_device(work.device)

    from bidnerf.evaluation import evaluate

    with interruptible_work("waiting for the trials under way (Ctrl-C again: at once)"):
        table = evaluate(map, data or map, plan, out=out, workers=work.dask or work.workers)
    lines = [f"{amount(len(table.rows), 'trial')} in {out}; 'bidnerf report {out}' shows them"]
    print_result([row.plain() for row in table.rows], lines, work.json)


def run_compare(
    folders: Annotated[
        tuple[str, ...],
        Option(
            "MAP... DATA",
            "folders of maps, followed by the folder of a dataset of the same scene",
            positional=True,
        ),
    ],
    out: Annotated[
        Path | None, Option("DIR", "write compare.json, compare.png and compare.svg there", "not written")
    ] = None,
    *,
    starts: Annotated[
        Starts,
        Without("no_depth", "fault"),
        Group("trials", "Which frames are tried, and from which starts."),
    ],
    run: RunOptions,
    images: SeenImages = TEST_IMAGES,
    method: MethodGroup,
) -> None:
    """Localize the same frames in several maps, and compare the results.

    The starts are the same; success, steps, time and memory are compared. Each map runs in its own process; they take turns at
    each start.
    """
    if len(folders) < 2:
        raise UsageError(
            f"{len(folders)} folder{'s' if len(folders) != 1 else ''} given",
            expected="the folders of one or more maps, then that of a dataset",
        )
    *maps, data = folders
    existing("the folder of a dataset, after those of the maps").function(data)
    for map in maps:
        require_map(map)
    if out is not None:
        check_folder(out, folders)
    plan = starts.plan(method, images, device=run.device)
    require_device(run.device)

    from bidnerf.evaluation import compare, comparison_figure
    from bidnerf_core.io import output_folder, to_plain

    with nullcontext() if out is None else output_folder(out, run.overwrite), display_progress():
        comparison = compare(maps, data, plan)
        if out is not None:
            comparison.save(out / "compare.json")
            try:
                say(f"look at {comparison_figure(out, comparison).with_suffix('.png')}")
            except InputError as error:  # matplotlib is optional
                say(str(error))
    print_result(to_plain(replace(comparison, results=())), str(comparison).split("\n"), run.json)


def run_report(
    results: Annotated[
        tuple[Path, ...],
        Option("RESULTS...", "files written by 'bidnerf evaluate'", positional=True),
        Check(lambda files: require_existing(*files, expected="lines as written by 'bidnerf evaluate'")),
    ],
    out: Annotated[Path, Option("DIR", "folder for index.html and the figures as PNG and SVG")] = Path("report"),
    criterion: Annotated[
        Literal["10%", "5deg", "1deg"] | None,
        EXPERT,
        Option(
            None,
            "success criterion where only one is shown: 10% (of the start's error), 5deg (5 degrees, 0.05 units), 1deg (1"
            " degree, 0.02 units)",
            "10%; 5deg if trials had no start",
        ),
    ] = None,
    title: Annotated[str, EXPERT, Option("TEXT", "title of the page")] = "Localization results",
    view: Annotated[
        Path | None,
        EXPERT,
        Option("PAGE.html", "page of 'bidnerf view --results', whose frames the report links to", ""),
        existing("a page written by 'bidnerf view MAP --results ... --save'"),
    ] = None,
    data: Annotated[
        Names, Option("DATA...", "datasets of the results, from which the worst frames are shown", "no pictures")
    ] = (),
) -> None:
    """Write tables and figures of an evaluation as one page.

    The page works offline. Trials are compared by map, data, start, method and settings. A trial in several files counts once.
    """
    if missing := [folder for folder in data if not Path(folder).is_dir()]:
        raise InputError("no such folder", where=missing[0], expected="a dataset that the results are of")
    check_folder(out, (*results, *data))

    from bidnerf.evaluation import ResultTable, choose_criterion, read_runs, write_report
    from bidnerf.results import CRITERIA

    table = ResultTable.load(*results)
    with wrong_usage():
        names = [name for name in CRITERIA if criterion and name.startswith(criterion)]
        chosen = choose_criterion(names[0] if names else None, table.groups)
    runs = [(path.name, read_runs(path)) for path in results]
    link = None if view is None else quote(Path(os.path.relpath(view.resolve(), out.resolve())).as_posix())
    with console.status("drawing"):
        page = write_report(table, out, title, chosen, runs, link, data)
    print_result(None, [*str(table).split("\n"), f"look at {page}"], json=False)
