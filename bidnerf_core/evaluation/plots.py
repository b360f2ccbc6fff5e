"""The figures of a report: one panel per situation, and the same colour for a condition in all of them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bidnerf_core.evaluation.faults import NO_FAULT
from bidnerf_core.evaluation.groups import Group, situation_titles, situations
from bidnerf_core.evaluation.summary import NEVER, applies, steps_of, success_of
from bidnerf_core.results.errors import CRITERIA
from bidnerf_core.results.plot_style import (
    SHORT_CRITERION_NAMES,
    line_look,
    new_figure,
    require_matplotlib,
    save_figure,
    styled,
)

COLUMNS, PANEL = 3, (3.6, 2.7)  # inches
DrawPanel = Callable[[Any, list[Group]], None]


class Figures:
    """Draws figures of ``groups`` and saves them as PNG and SVG in ``folder``. Raises ``InputError`` without matplotlib.

    ``criterion`` defines success in the figures that show a single criterion. Figures of steps have panels only for images
    without faults, unless there are no such trials.
    """

    def __init__(self, groups: Sequence[Group], folder: Path, criterion: str) -> None:
        require_matplotlib()
        self.groups, self.folder, self.criterion = list(groups), folder, criterion
        self.without_faults = [g for g in self.groups if g.situation.fault == NO_FAULT] or self.groups
        self.labels = list(dict.fromkeys(group.label for group in groups))
        self.titles = situation_titles(situations(groups))

    def rates(self) -> Path:
        """Draw success rates with intervals: one panel per criterion, one line per group."""
        shown = self.groups
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
        """Draw, for each step, the share of trials that meet the criterion from then on."""

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
        """Draw median and quartiles of the error after each step. ``kind`` is "translation" or "rotation_deg"."""
        unit, bar = {"translation": ("units", 0.05), "rotation_deg": ("degrees", 5.0)}[kind]

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
        """Draw one panel per situation of ``groups`` (by default those to which the criterion applies), and a legend below."""
        fitting = [group for group in self.without_faults if applies(self.criterion, group.results)]
        shown = fitting if groups is None else groups
        places = situations(shown)
        columns = max(1, min(COLUMNS, len(places)))
        rows = max(1, math.ceil(len(places) / columns))
        legend = 0.35 + 0.2 * len(self.labels)
        with styled():
            size = (max(columns, 1.6) * PANEL[0], rows * PANEL[1] + legend)
            figure = new_figure(*size)
            axes = figure.subplots(rows, columns, squeeze=False, sharey=sharey)
            for panel, situation in zip(axes.flat, places, strict=False):
                draw(panel, [group for group in shown if group.situation == situation])
                panel.set_title(self.titles[situation], pad=title_pad)
            for panel in list(axes.flat)[len(places) :]:
                panel.set_axis_off()
            self._legend(figure, shown)
            return save_figure(figure, self.folder, name)

    def _legend(self, figure: Any, groups: Sequence[Group]) -> None:
        from matplotlib.lines import Line2D

        first = {group.label: group for group in reversed(groups)}
        named = [label for label in self.labels if label in first]
        handles = [Line2D([], [], **self._look(first[label])) for label in named]
        figure.legend(handles, named, loc="outside lower left", ncols=1 if len(named) < 3 else 2)

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
        beside = place + 0.16 * np.sin(2.4 * np.arange(len(steps)))  # apart, and the same each time
        panel.plot(beside, steps, "o", color=colour, markersize=3.5, alpha=0.5, markeredgewidth=0, zorder=3)

    def _look(self, group: Group) -> dict[str, Any]:
        return line_look(self.labels.index(group.label))

    def _line_label(self, group: Group) -> str:
        return f"{self.titles[group.situation]}  ·  {group.label}  (n = {len(group.results)})"


def _lines(groups: Sequence[Group]) -> list[float]:
    """Return the vertical positions of the lines, with a gap between situations."""
    heights: list[float] = []
    for place, group in enumerate(groups):
        new = place > 0 and group.situation != groups[place - 1].situation
        heights.append(heights[-1] + (1.6 if new else 1.0) if heights else 0.0)
    return heights


def _quartiles(errors: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "3 s"]:
    """Return the quartiles over the trials whose pose was finite, NaN where none was."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanpercentile(errors, (25, 50, 75), axis=0)


def _table(group: Group, kind: str) -> Float[np.ndarray, "n s"]:
    """Return errors (trials, steps); where a trial ended early, its last error is repeated."""
    rows = [
        np.array([np.nan if x is None else x for x in getattr(result.errors, kind)])
        for result in group.results
    ]
    longest = max(map(len, rows))
    return np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows])
