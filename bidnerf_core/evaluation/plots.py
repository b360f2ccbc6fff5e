"""The figures of an evaluation: results by situation, faults by size, maps side by side, and single trials.

A report has one panel per situation, and a condition has the same colour in all figures.
"""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.comparison import Comparison, MapRow
from bidnerf_core.evaluation.faults import NO_FAULT, find_fault, parse_faults
from bidnerf_core.evaluation.groups import Group, Situation, situation_titles, situations
from bidnerf_core.evaluation.summary import (
    NEVER,
    applies,
    frame_of,
    seconds_to_success,
    steps_of,
    succeeded,
    success_of,
    summarize,
    unit_of,
    usual_criterion,
)
from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.geometry import symbol
from bidnerf_core.results import (
    COLOURS,
    CRITERIA,
    CRITERION_NAMES,
    SHORT_CRITERION_NAMES,
    PoseError,
    Rate,
    as_array,
    line_look,
    new_figure,
    require_matplotlib,
    save_figure,
    styled,
    success_rate_by_frame,
    write_figure,
)

COLUMNS, PANEL = 3, (3.6, 2.7)  # inches
LABEL = 5.0  # inches: width of the line labels
PER_INCH = 13
"""Average number of characters per inch of text."""
MOST_LINES, MOST_PANELS = 150, 48
"""Maximum numbers of groups and of panels in a figure; larger figures can be neither drawn nor read."""
DrawPanel = Callable[[Any, list[Group]], None]


class Figures:
    """Draws figures of ``groups`` and saves them as PNG and SVG in ``folder``. Raises ``InputError`` without matplotlib.

    ``criterion`` defines success in the figures that show a single criterion. Figures of steps have panels only for images
    without faults, unless there are no such trials. Only the first ``MOST_LINES`` groups and ``MOST_PANELS`` panels are drawn.
    """

    def __init__(self, groups: Sequence[Group], folder: Path, criterion: str) -> None:
        require_matplotlib()
        self.groups, self.folder, self.criterion = list(groups), folder, criterion
        self.without_faults = [g for g in self.groups if g.situation.fault == NO_FAULT] or self.groups
        self.labels = list(dict.fromkeys(group.label for group in groups))
        self.titles = situation_titles(situations(groups))

    @property
    def omitted(self) -> str:
        """A sentence about what is not drawn; empty if everything is."""
        places = situations(self.groups)
        if len(self.groups) <= MOST_LINES and len(places) <= MOST_PANELS:
            return ""
        return (
            f"At most {MOST_LINES} of {len(self.groups)} groups and {MOST_PANELS} of {len(places)}"
            " situations are drawn; the tables have all."
        )

    def rates(self) -> Path:
        """Draw success rates with intervals: one panel per criterion, one line per group."""
        shown = self.groups[:MOST_LINES]
        height = 0.9 + 0.27 * len(shown) + 0.2 * len(situations(shown))
        with styled():
            figure = new_figure(3 * PANEL[0], height)
            axes = figure.subplots(1, len(CRITERIA), squeeze=False, sharey=True)
            places = _lines(shown)
            for panel, criterion in zip(axes[0], CRITERIA, strict=True):
                for group, y in zip(shown, places, strict=True):
                    self._interval(panel, group, criterion, y)
                panel.set(
                    title=SHORT_CRITERION_NAMES[criterion], xlabel="successful trials (%)", xlim=(-3, 103)
                )
                panel.grid(axis="x")
            axes[0][0].set_yticks(places, [self._line_label(group) for group in shown])
            axes[0][0].set_ylim(max(places) + 0.7, min(places) - 0.7)
            return save_figure(figure, self.folder, "rates")

    def steps(self) -> Path:
        """Draw box plots of steps to success, with whiskers to 1.5 times the interquartile range and one point per trial."""

        def draw(panel: Any, groups: list[Group]) -> None:
            for place, group in enumerate(groups):
                steps = [s for s in steps_of(group.results, self.criterion) if s < NEVER]
                self._box(panel, steps, place, group)
                panel.annotate(
                    f"{len(steps)}/{len(group.results)}", (place, 1.0), xycoords=("data", "axes fraction"),
                    ha="center", va="bottom", fontsize=7.5, color="#555",
                )  # fmt: skip
            panel.set(ylabel="steps to success", xticks=[], xlim=(-0.6, len(groups) - 0.4))
            panel.set_ylim(bottom=0)
            panel.grid(axis="y")

        return self._panels("steps", draw, title_pad=15)

    def share(self) -> Path:
        """Draw, for each step, the fraction of trials that meet the criterion from then on."""

        def draw(panel: Any, groups: list[Group]) -> None:
            last = max(1, *(result.steps for group in groups for result in group.results))
            for group in groups:
                steps = np.sort(steps_of(group.results, self.criterion))
                known = steps[np.isfinite(steps)]
                x = np.concatenate([[0], known, [last]])
                y = np.concatenate([[0], np.arange(1, len(known) + 1), [len(known)]]) / len(steps) * 100
                panel.step(x, y, where="post", **self._look(group))
            panel.set(xlabel="step", ylabel="successful trials (%)", ylim=(-2, 102), xlim=(0, last))
            panel.grid()

        return self._panels("share", draw)

    def traces(self, kind: str) -> Path:
        """Draw the median and quartiles of the error after each step. ``kind`` is "translation" or "rotation_deg"."""
        length = unit_of([result for group in self.groups for result in group.results])
        unit, bar = {"translation": (length, 0.05), "rotation_deg": ("degrees", 5.0)}[kind]

        def draw(panel: Any, groups: list[Group]) -> None:
            for group in groups:
                low, middle, high = _quartiles(_table(group, kind))
                look = self._look(group)
                panel.plot(middle, **look)
                panel.fill_between(
                    range(len(middle)), low, high, color=look["color"], alpha=0.14, linewidth=0
                )
            panel.axhline(bar, color="#999", linewidth=0.8, linestyle=(0, (4, 3)))
            what = "translation" if kind == "translation" else "rotation"
            panel.set(yscale="log", xlabel="step", ylabel=f"{what} error ({unit})")
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter("")
            panel.set_xlim(left=0)
            panel.grid(which="major")

        return self._panels(kind.partition("_")[0], draw, sharey=True, groups=self.without_faults)

    def _panels(
        self,
        name: str,
        draw: DrawPanel,
        title_pad: float = 6,
        sharey: bool = False,
        groups: Sequence[Group] | None = None,
    ) -> Path:
        """Draw one panel per situation of ``groups`` (by default those to which the criterion applies), and a
        legend below.
        """
        fitting = [group for group in self.without_faults if applies(self.criterion, group.results)]
        shown = fitting if groups is None else groups
        places = situations(shown)[:MOST_PANELS]
        shown = [group for group in shown if group.situation in places]
        columns = max(1, min(COLUMNS, len(places)))
        rows = max(1, math.ceil(len(places) / columns))
        width = max(columns, 1.6) * PANEL[0]
        labels = {
            label: _wrapped(label, width / (1 if len(self.labels) < 3 else 2) - 0.5) for label in self.labels
        }
        legend = 0.35 + 0.2 * sum(label.count("\n") + 1 for label in labels.values())
        with styled():
            figure = new_figure(width, rows * PANEL[1] + legend)
            axes = figure.subplots(rows, columns, squeeze=False, sharey=sharey)
            for panel, situation in zip(axes.flat, places, strict=False):
                draw(panel, [group for group in shown if group.situation == situation])
                panel.set_title(_wrapped(self.titles[situation], PANEL[0]), pad=title_pad)
            for panel in list(axes.flat)[len(places) :]:
                panel.set_axis_off()
            self._legend(figure, shown, labels)
            return save_figure(figure, self.folder, name)

    def _legend(self, figure: Any, groups: Sequence[Group], labels: Mapping[str, str]) -> None:
        from matplotlib.lines import Line2D

        first = {group.label: group for group in reversed(groups)}
        named = [label for label in self.labels if label in first]
        handles = [Line2D([], [], **self._look(first[label])) for label in named]
        shown = [labels[label] for label in named]
        figure.legend(handles, shown, loc="outside lower left", ncols=1 if len(named) < 3 else 2)

    def _interval(self, panel: Any, group: Group, criterion: str, y: float) -> None:
        found = success_of(group.results, criterion)
        if found is None:
            return
        rate = found.rate
        colour = self._look(group)["color"]
        panel.plot(
            [100 * rate.low, 100 * rate.high],
            [y, y],
            color=colour,
            linewidth=2,
            alpha=0.5,
            solid_capstyle="butt",
        )
        panel.plot([100 * rate.rate], [y], "o", color=colour, markersize=5)

    def _box(self, panel: Any, steps: list[float], place: int, group: Group) -> None:
        if not steps:
            return
        colour = self._look(group)["color"]
        line = {"color": colour, "linewidth": 1.1}
        panel.boxplot(
            [steps], positions=[place], widths=0.5, showfliers=False, medianprops={**line, "linewidth": 2},
            boxprops=line, whiskerprops=line, capprops=line,
        )  # fmt: skip
        beside = place + 0.16 * np.sin(2.4 * np.arange(len(steps)))  # spread out, and the same each time
        panel.plot(beside, steps, "o", color=colour, markersize=3.5, alpha=0.5, markeredgewidth=0, zorder=3)

    def _look(self, group: Group) -> dict[str, Any]:
        return line_look(self.labels.index(group.label))

    def _line_label(self, group: Group) -> str:
        count = f"  (n = {len(group.results)})"
        return _wrapped(f"{self.titles[group.situation]}  ·  {group.label}", LABEL, lines=2) + count


def _wrapped(text: str, width: float, lines: int = 4) -> str:
    """Wrap text to a width (inches), truncated to ``lines`` lines."""
    return "\n".join(textwrap.wrap(text, int(width * PER_INCH), max_lines=lines, placeholder=" ...")) or text


def _lines(groups: Sequence[Group]) -> list[float]:
    """Return the vertical positions of the lines, with a gap between situations."""
    heights: list[float] = []
    for place, group in enumerate(groups):
        new = place > 0 and group.situation != groups[place - 1].situation
        heights.append(heights[-1] + (1.6 if new else 1.0) if heights else 0.0)
    return heights


def _quartiles(errors: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "3 s"]:
    """Return the quartiles over the trials whose pose was finite, NaN if none was."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanpercentile(errors, (25, 50, 75), axis=0)


def _table(group: Group, kind: str) -> Float[np.ndarray, "n s"]:
    """Return errors (trials, steps); if a trial ended early, its last error is repeated."""
    rows = [
        np.array([np.nan if x is None else x for x in getattr(result.errors, kind)])
        for result in group.results
    ]
    longest = max(map(len, rows))
    return np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows])


# Faults.

DRAWN_SHARES: dict[str, tuple[Callable[[TrialResult], bool], str]] = {
    "right": (succeeded, COLOURS[2]),
    "converged": (lambda result: result.converged, COLOURS[0]),
    "converged, but wrong": (lambda result: result.converged and not succeeded(result), COLOURS[1]),
}
"""The lines of a panel: which trials each counts, and its colour."""


@dataclass(frozen=True)
class FaultCurve:
    """The trials of one condition under one kind of fault, by the fault's size in ascending order."""

    situation: Situation  # without fault
    label: str  # of the condition
    name: str  # of the fault
    points: tuple[tuple[float, Group], ...]


def fault_curves(groups: Sequence[Group]) -> list[FaultCurve]:
    """Return a curve for each fault that was tried on its own.

    Trials without any fault belong to every curve of their situation and condition whose fault has a neutral size.
    """
    found: dict[tuple[Situation, str, str], list[tuple[float, Group]]] = {}
    for group in groups:
        parts = parse_faults(group.situation.fault)
        if len(parts) == 1 and group.situation.size is not None:
            key = _without_fault(group.situation), group.label, parts[0].name
            found.setdefault(key, []).append((parts[0].size, group))
    clean = {(group.situation, group.label): group for group in groups}
    for (situation, label, name), points in found.items():
        neutral, usual = find_fault(name).neutral, clean.get((situation, label))
        if neutral is not None and usual is not None and neutral not in dict(points):
            points.append((neutral, usual))
    return [
        FaultCurve(*key, tuple(sorted(points, key=lambda point: point[0]))) for key, points in found.items()
    ]


def draw_faults(groups: Sequence[Group], folder: Path) -> Path | None:
    """Draw a panel for each curve with Wilson intervals, as PNG and SVG in ``folder``; return the SVG's path.

    Returns None if no fault was tried on its own. Raises ``InputError`` without matplotlib.
    """
    curves = fault_curves(groups)[:MOST_PANELS]
    if not curves:
        return None
    titles = situation_titles([curve.situation for curve in curves])
    labels = {curve.label for curve in curves}
    rows = math.ceil(len(curves) / COLUMNS)
    with styled():
        figure = new_figure(COLUMNS * PANEL[0], rows * PANEL[1] + 0.3)
        axes = figure.subplots(rows, COLUMNS, squeeze=False).flatten()
        for panel, curve in zip(axes, curves, strict=False):
            places = [titles[curve.situation]] + ([curve.label] if len(labels) > 1 else [])
            _draw_curve(panel, curve, f"{curve.name}\n{_wrapped(', '.join(places), PANEL[0])}")
        for panel in axes[len(curves) :]:
            panel.set_axis_off()
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(DRAWN_SHARES))
        return save_figure(figure, folder, "faults")


def _rate(group: Group, share: Callable[[TrialResult], bool]) -> Rate:
    return success_rate_by_frame(
        [share(result) for result in group.results], [frame_of(result) for result in group.results]
    )


def _draw_curve(panel: Any, curve: FaultCurve, title: str) -> None:
    """Draw one curve. Sizes are evenly spaced, since those of a fault may span orders of magnitude."""
    fault = find_fault(curve.name)
    summaries = [summarize(group.results) for _, group in curve.points]
    places = np.arange(len(curve.points))
    for turn, (label, (share, colour)) in enumerate(DRAWN_SHARES.items()):
        rates = [_rate(group, share) for _, group in curve.points]
        middle = np.array([rate.rate for rate in rates])
        ends = np.array([[r.low for r in rates], [r.high for r in rates]])
        spread = 100 * np.abs(ends - middle)
        panel.errorbar(
            places + 0.06 * (turn - 1), 100 * middle, yerr=spread, color=colour, label=label, marker="o", markersize=4,
            linewidth=1.4, elinewidth=1, alpha=0.9,
        )  # fmt: skip
    sizes = ["none" if size == fault.neutral else f"{size:g}" for size, _ in curve.points]
    counts = [f"{size}\nn={s.trials}" for size, s in zip(sizes, summaries, strict=True)]
    panel.set_xticks(places, counts)
    panel.set(xlabel=fault.unit, ylabel="trials (%)", ylim=(-3, 103), xlim=(-0.5, len(places) - 0.5))
    panel.set_title(title)
    panel.grid(axis="y")


def _without_fault(situation: Situation) -> Situation:
    return replace(situation, fault=NO_FAULT)


# Several maps.

COSTS: dict[str, Callable[[MapRow], float]] = {
    "ms a step": lambda row: row.ms_per_step,
    "samples a ray": lambda row: row.samples_per_ray,
    "peak memory, MiB": lambda row: row.peak_memory_bytes / 2**20,
    "map, MiB": lambda row: row.map_bytes / 2**20,
}


def comparison_figure(paths: Sequence[Path], comparison: Comparison) -> None:
    """Draw success with Wilson intervals, time to success and four costs, one colour per map; suffixes give
    the formats.

    Raises ``InputError`` if matplotlib, which is optional, is missing.
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
    """Draw the fraction of trials that have met the default criterion as a function of time."""
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
    """Draw a horizontal bar for each map, the first at the top, with its value next to it."""
    places, values = range(len(rows)), [cost(row) for row in rows]
    bars = axes.barh(places, values, 0.7, color=[_colour(place) for place in places])
    axes.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize="small")
    axes.set_yticks(places, [row.map if named else "" for row in rows])
    axes.invert_yaxis()
    axes.margins(x=0.25)
    axes.set_title(name, fontsize="medium")


# Single trials.


def convergence_plot(path: str | Path, traces: Mapping[str, PoseError]) -> None:
    """Plot translation and rotation error after each step on a logarithmic scale, one curve per name.

    Entry 0 of a trace is the start. Values without a logarithm leave a gap. Raises ``InputError`` without matplotlib.
    """
    if not traces:
        raise InputError("no traces to plot", where=path)
    with styled():
        figure = new_figure(9, 3.6)
        left, right = figure.subplots(1, 2)
        units = {symbol(trace.unit) for trace in traces.values()}
        length = f"translation ({units.pop() if len(units) == 1 else 'units'})"
        _draw_errors(left, {name: trace.translation for name, trace in traces.items()}, length, 0.05)
        _draw_errors(
            right, {name: trace.rotation_deg for name, trace in traces.items()}, "rotation (deg)", 5.0
        )
        left.legend(fontsize="small")
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_figure(figure, Path(path), dpi=130)


def _draw_errors(axes: Any, errors: Mapping[str, Tensor], unit: str, bar: float) -> None:
    for place, (name, trace) in enumerate(errors.items()):
        values = as_array(trace).astype(np.float64).reshape(-1)
        axes.plot(
            np.where(np.isfinite(values) & (values > 0), values, np.nan), label=name, **line_look(place)
        )
    axes.axhline(bar, color="0.6", linewidth=1, linestyle="--")
    axes.set(yscale="log", xlabel="step", ylabel=f"error in {unit}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.grid(which="both")
