"""A comparison as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.comparison import USUAL, Comparison, MapRow, seconds_to_success
from bidnerf_core.evaluation.errors import CRITERIA

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Of maps: told apart with any kind of colour vision (Okabe and Ito 2008)."""

COSTS: dict[str, Callable[[MapRow], float]] = {
    "ms a step": lambda row: row.ms_per_step,
    "samples a ray": lambda row: row.samples_per_ray,
    "peak memory, MiB": lambda row: row.peak_memory_bytes / 2**20,
    "map, MiB": lambda row: row.map_bytes / 2**20,
}


def comparison_figure(paths: Sequence[Path], comparison: Comparison) -> None:
    """Success with Wilson intervals, how soon it comes, and four costs; one colour a map. The suffix tells the format.

    Raises ``InputError`` where matplotlib, an extra, is missing.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("plots need matplotlib, which is missing: pip install 'bidnerf[plots]'") from error
    figure = Figure(figsize=(11, 6.4), layout="constrained")
    FigureCanvasAgg(figure)  # not pyplot: no global state, no window
    grid = figure.add_gridspec(2, 4, height_ratios=(3, 2))
    _draw_success(figure.add_subplot(grid[0, :2]), comparison)
    _draw_times(figure.add_subplot(grid[0, 2:]), comparison)
    for place, (name, cost) in enumerate(COSTS.items()):
        _draw_cost(figure.add_subplot(grid[1, place]), comparison.rows, name, cost, place == 0)
    figure.suptitle(_title(comparison), fontsize="medium")
    for path in paths:
        figure.savefig(path, dpi=130)


def _title(comparison: Comparison) -> str:
    size = " ".join(f"{x:g}" for x in comparison.size)
    starts = f"{comparison.trials} starts of {comparison.protocol} {size}".rstrip()
    return f"{comparison.data}, split {comparison.split}: {starts}, method {comparison.method}"


def _colour(place: int) -> str:
    return COLOURS[place % len(COLOURS)]


def _draw_success(axes: Any, comparison: Comparison) -> None:
    """A group a criterion, a bar a map."""
    count = len(comparison.rows)
    for place, row in enumerate(comparison.rows):
        rates = [row.success[name].rate for name in CRITERIA]
        middles = np.arange(len(rates)) + (place - (count - 1) / 2) * 0.8 / count
        heights = np.array([r.rate for r in rates])
        spread = np.array([[r.rate - r.low for r in rates], [r.high - r.rate for r in rates]]).clip(min=0)
        axes.bar(
            middles, heights, 0.72 / count, yerr=spread, color=_colour(place), label=row.map, capsize=3,
            error_kw={"ecolor": "0.35", "elinewidth": 1},
        )  # fmt: skip
    axes.set_xticks(range(len(CRITERIA)), [_words(name) for name in CRITERIA])
    axes.set(ylim=(0, 1.02), ylabel="share of starts", title="success, with 95 % intervals")
    axes.grid(axis="y", alpha=0.25)
    axes.set_axisbelow(True)


def _draw_times(axes: Any, comparison: Comparison) -> None:
    """Share of the starts that have met the usual criterion after so many seconds."""
    for place, (row, results) in enumerate(zip(comparison.rows, comparison.results, strict=True)):
        times = seconds_to_success(results, USUAL)
        longest = max(r.seconds for r in results)
        shares = [0.0, *((i + 1) / len(results) for i in range(len(times)))]
        axes.step([0.0, *times, max([longest, *times])], [*shares, shares[-1]], where="post",
                  color=_colour(place), label=row.map, linewidth=1.8)  # fmt: skip
    axes.set(
        ylim=(0, 1.02),
        xlabel="seconds",
        ylabel="share of starts",
        title=f"{' '.join(_words(USUAL).split())}, after so long",
    )
    axes.set_xlim(left=0)
    axes.grid(alpha=0.25)
    axes.legend(fontsize="small", frameon=False, loc="best")


def _draw_cost(
    axes: Any, rows: Sequence[MapRow], name: str, cost: Callable[[MapRow], float], named: bool
) -> None:
    """One bar a map, the first at the top, its number beside it."""
    places, values = range(len(rows)), [cost(row) for row in rows]
    bars = axes.barh(places, values, 0.7, color=[_colour(place) for place in places])
    axes.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize="small")
    axes.set_yticks(places, [row.map if named else "" for row in rows])
    axes.invert_yaxis()
    axes.margins(x=0.25)
    axes.set_title(name, fontsize="medium")
    axes.spines[["top", "right"]].set_visible(False)


def _words(criterion: str) -> str:
    """``10%`` and ``5deg 0.05`` as they are said."""
    if criterion.endswith("%"):
        return f"to {criterion[:-1]} % of\nthe start's error"
    angle, _, distance = criterion.partition("deg ")
    return f"below {angle} deg\nand {distance} m"
