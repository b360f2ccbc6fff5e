"""A figure of a comparison of maps: success, speed and cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bidnerf_core.evaluation.comparison import Comparison, MapRow
from bidnerf_core.evaluation.summary import seconds_to_success, usual_criterion
from bidnerf_core.results.errors import CRITERIA
from bidnerf_core.results.plot_style import (
    CRITERION_NAMES,
    SHORT_CRITERION_NAMES,
    line_look,
    new_figure,
    styled,
    write_figure,
)

COSTS: dict[str, Callable[[MapRow], float]] = {
    "ms a step": lambda row: row.ms_per_step,
    "samples a ray": lambda row: row.samples_per_ray,
    "peak memory, MiB": lambda row: row.peak_memory_bytes / 2**20,
    "map, MiB": lambda row: row.map_bytes / 2**20,
}


def comparison_figure(paths: Sequence[Path], comparison: Comparison) -> None:
    """Draw success with Wilson intervals, time to success and four costs, one colour per map; suffixes give the formats.

    Raises ``InputError`` where matplotlib, which is optional, is missing.
    """
    with styled():
        figure = new_figure(11, 6.4)
        grid = figure.add_gridspec(2, 4, height_ratios=(3, 2))
        _draw_success(figure.add_subplot(grid[0, :2]), comparison)
        _draw_times(figure.add_subplot(grid[0, 2:]), comparison)
        for place, (name, cost) in enumerate(COSTS.items()):
            _draw_cost(figure.add_subplot(grid[1, place]), comparison.rows, name, cost, place == 0)
        figure.suptitle(_title(comparison), fontsize="medium")
        for path in paths:
            write_figure(figure, path, dpi=130)


def _title(comparison: Comparison) -> str:
    size = " ".join(f"{x:g}" for x in comparison.size)
    starts = f"{comparison.trials} starts of {comparison.protocol} {size}".rstrip()
    return f"{comparison.data}, split {comparison.split}: {starts}, method {comparison.method}"


def _colour(place: int) -> str:
    return str(line_look(place)["color"])


def _draw_success(axes: Any, comparison: Comparison) -> None:
    """Draw a group of bars for each criterion that applies, with a bar for each map."""
    count = len(comparison.rows)
    names = [name for name in CRITERIA if all(row.success[name] for row in comparison.rows)]
    for place, row in enumerate(comparison.rows):
        rates = [found.rate for name in names if (found := row.success[name])]
        middles = np.arange(len(rates)) + (place - (count - 1) / 2) * 0.8 / count
        heights = np.array([r.rate for r in rates])
        spread = np.array([[r.rate - r.low for r in rates], [r.high - r.rate for r in rates]]).clip(min=0)
        axes.bar(
            middles, heights, 0.72 / count, yerr=spread, color=_colour(place), label=row.map, capsize=3,
            error_kw={"ecolor": "0.35", "elinewidth": 1},
        )  # fmt: skip
    axes.set_xticks(range(len(names)), [SHORT_CRITERION_NAMES[name].replace(": ", ":\n") for name in names])
    axes.set(ylim=(0, 1.02), ylabel="share of trials", title="success with 95 % intervals")
    axes.grid(axis="y")
    axes.set_axisbelow(True)


def _draw_times(axes: Any, comparison: Comparison) -> None:
    """Draw the share of trials that have met the usual criterion as a function of time."""
    criterion = usual_criterion([result for results in comparison.results for result in results])
    for place, (row, results) in enumerate(zip(comparison.rows, comparison.results, strict=True)):
        times = seconds_to_success(results, criterion)
        longest = max(r.seconds for r in results)
        shares = [0.0, *((i + 1) / len(results) for i in range(len(times)))]
        axes.step([0.0, *times, max([longest, *times])], [*shares, shares[-1]], where="post",
                  label=row.map, **line_look(place))  # fmt: skip
    axes.set(ylim=(0, 1.02), xlabel="seconds", ylabel="share of trials", title=CRITERION_NAMES[criterion])
    axes.set_xlim(left=0)
    axes.grid()
    axes.legend(loc="best")


def _draw_cost(
    axes: Any, rows: Sequence[MapRow], name: str, cost: Callable[[MapRow], float], named: bool
) -> None:
    """Draw a horizontal bar for each map, the first at the top, with its value beside it."""
    places, values = range(len(rows)), [cost(row) for row in rows]
    bars = axes.barh(places, values, 0.7, color=[_colour(place) for place in places])
    axes.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize="small")
    axes.set_yticks(places, [row.map if named else "" for row in rows])
    axes.invert_yaxis()
    axes.margins(x=0.25)
    axes.set_title(name, fontsize="medium")
