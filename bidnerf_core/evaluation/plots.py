"""The figures of an evaluation: success, errors, confidence, convergence and faults; maps side by side; single trials.

A figure is a grid of panels of one size, so that all of a page have the same type. A condition has the same colour in all.
"""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.comparison import Comparison
from bidnerf_core.evaluation.faults import FAULTS, NO_FAULT
from bidnerf_core.evaluation.summary import (
    NEVER,
    FaultCurve,
    Group,
    Situation,
    applies,
    are_stepwise,
    fault_curves,
    rate_of,
    situation_titles,
    situations,
    steps_of,
    succeeded,
    success_of,
    unit_of,
)
from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.geometry import symbol
from bidnerf_core.results import (
    COLOURS,
    CRITERIA,
    CRITERION_NAMES,
    SHORT_CRITERION_NAMES,
    PoseError,
    as_array,
    line_look,
    new_figure,
    require_matplotlib,
    save_figure,
    standard_deviations,
    styled,
    write_figure,
)

WIDTH, COLUMNS = 10.8, 3
"""Width of a figure in inches, and number of panels side by side."""
PER_INCH = 13
"""Average number of characters per inch of text."""
MOST_LINES, MOST_SITUATIONS = 150, 16
"""Maximum numbers of groups and of situations in a figure; larger figures can be neither drawn nor read."""
BARS = {"translation": 0.05, "rotation_deg": 5.0}
"""The largest errors of a right answer."""
BOUND: dict[str, Any] = {"color": "#999", "linewidth": 0.8, "linestyle": (0, (4, 3))}
"""The look of a bound, or of where two quantities are equal."""

Panel = tuple[str, Callable[[Any], None]]
"""The title of a panel, and the function that draws it."""


@dataclass(frozen=True)
class Figure:
    """A figure with its caption; the file is an SVG, next to which the same is a PNG."""

    file: Path
    caption: str


class Figures:
    """Draws figures of ``groups`` and saves them as PNG and SVG in ``folder``. Raises ``InputError`` without matplotlib.

    ``criterion`` defines success in the figures that show a single criterion. Only the first ``MOST_LINES`` groups and
    ``MOST_SITUATIONS`` situations are drawn.
    """

    def __init__(self, groups: Sequence[Group], folder: Path, criterion: str) -> None:
        require_matplotlib()
        self.groups, self.folder, self.criterion = list(groups), folder, criterion
        self.labels = list(dict.fromkeys(group.label for group in groups))
        self.titles = situation_titles(situations(groups))
        self.clean = [g for g in self.groups if g.situation.fault == NO_FAULT] or self.groups

    def all(self) -> list[Figure]:
        """Draw every figure that the results have something to show in."""
        drawn = (self.rates(), self.faults(), self.errors(), self.calibration(), self.convergence())
        return [figure for figure in drawn if figure is not None]

    @property
    def omitted(self) -> str:
        """A sentence about what is not drawn; empty if everything is."""
        places = situations(self.groups)
        if len(self.groups) <= MOST_LINES and len(places) <= MOST_SITUATIONS:
            return ""
        return (
            f" At most {MOST_LINES} of {len(self.groups)} groups and {MOST_SITUATIONS} of {len(places)} situations are"
            " drawn; the tables have all."
        )

    def rates(self) -> Figure:
        """Draw success rates with intervals: a panel for each criterion that applies, a line for each group."""
        shown = self.groups[:MOST_LINES]
        heights: list[float] = []
        for place, group in enumerate(shown):
            new = place > 0 and group.situation != shown[place - 1].situation
            heights.append(heights[-1] + (1.6 if new else 1.0) if heights else 0.0)
        named = [
            _wrapped(f"{self.titles[g.situation]}  ·  {g.label}", 5.0, 2) + f"  (n = {len(g.results)})"
            for g in shown
        ]  # fmt: skip
        criteria = [name for name in CRITERIA if any(applies(name, group.results) for group in shown)]
        with styled():
            figure = new_figure(WIDTH, 0.9 + 0.27 * heights[-1] + 0.27)
            axes = figure.subplots(1, len(criteria), squeeze=False, sharey=True)[0]
            for panel, criterion in zip(axes, criteria, strict=True):
                for group, y in zip(shown, heights, strict=True):
                    found = success_of(group.results, criterion)
                    if found is not None:
                        colour, rate = self._look(group)["color"], found.rate
                        panel.plot(
                            [100 * rate.low, 100 * rate.high], [y, y], color=colour, linewidth=2, alpha=0.5
                        )
                        panel.plot([100 * rate.rate], [y], "o", color=colour, markersize=5)
                panel.set(
                    title=SHORT_CRITERION_NAMES[criterion], xlabel="successful trials (%)", xlim=(-3, 103)
                )
                panel.grid(axis="x")
            axes[0].set_yticks(heights, named)
            axes[0].set_ylim(heights[-1] + 0.7, -0.7)
            file = save_figure(figure, self.folder, "rates")
        return Figure(file, f"Success rates with Wilson's 95 % intervals.{self.omitted}")

    def errors(self) -> Figure:
        """Draw, for each situation, the shares of trials within an error, and those answered rightly within a time."""
        panels = self._by_situation(self.clean, self._cumulative, self._times)
        return Figure(
            self._draw("errors", panels, self.clean),
            "Cumulative errors: the share of all trials whose final error is at most that on the axis; answers that the"
            " method itself refused count as well, and the dashed lines are 0.05 and 5 degrees. Right: the share of all"
            f" trials that were answered rightly (within both) in at most that time.{self.omitted}",
        )

    def _cumulative(self, axes: Any, groups: Sequence[Group], kind: str) -> None:
        for group in groups:
            errors = [math.inf if r.error is None else getattr(r.error, kind) for r in group.results]
            # Errors below a 500th of the bound count as equal, since the axis is logarithmic.
            self._steps(axes, group, np.maximum(errors, BARS[kind] / 500))
        axes.axvline(BARS[kind], **BOUND)
        what = f"translation error ({unit_of(groups[0].results)})"
        axes.set(xlabel=what if kind == "translation" else "rotation error (degrees)")
        axes.set(ylabel="trials (%)", ylim=(-2, 102))
        _set_logarithmic(axes, "x")

    def _times(self, axes: Any, groups: Sequence[Group]) -> None:
        for group in groups:
            self._steps(
                axes, group, np.array([r.seconds if succeeded(r) else math.inf for r in group.results])
            )
        axes.set(xlabel="time (s)", ylabel="right trials (%)", ylim=(-2, 102))
        _set_logarithmic(axes, "x")

    def _steps(self, axes: Any, group: Group, values: Float[np.ndarray, "n"]) -> None:
        """Draw the share of all values that are at most that on the axis; infinite ones never are."""
        known = np.sort(values[np.isfinite(values)])
        shares = 100 * np.arange(1, len(known) + 1) / len(values)
        if len(known):
            axes.step([known[0], *known], [0, *shares], where="post", **self._look(group))
            axes.plot(known[-1:], shares[-1:], "o", markersize=3, color=self._look(group)["color"])

    def calibration(self) -> Figure | None:
        """Draw how often answers of a confidence are right, and errors against their standard deviations."""
        judged: dict[str, list[TrialResult]] = {label: [] for label in self.labels}
        measured: dict[str, list[TrialResult]] = {label: [] for label in self.labels}
        for group in self.groups:
            # The results of a group that pools all sizes are among those of the others.
            results = () if group.situation.size is None else group.results
            judged[group.label] += [r for r in results if r.confidence is not None]
            measured[group.label] += [r for r in results if r.covariance is not None and r.error is not None]
        panels: list[Panel] = []
        if any(map(len, judged.values())):
            panels.append(("confidence", partial(self._reliability, judged=judged)))
        if any(map(len, measured.values())):
            panels += [
                (kind.partition("_")[0], partial(self._deviations, measured=measured, kind=kind)) for kind in BARS
            ]  # fmt: skip
        if not panels:
            return None
        return Figure(
            self._draw("calibration", panels, self.groups),
            "Confidence: how often the answers of a confidence are right, in bins of as many trials each, with 95 % intervals;"
            " on the dashed line, confidences are the frequencies that they claim. Errors against the standard deviations"
            " that the answers state, filled where the method accepted its answer; on the dashed line they are equal, and if"
            " the deviations are right, about two thirds of the points lie below.",
        )

    def _reliability(self, axes: Any, judged: Mapping[str, list[TrialResult]]) -> None:
        axes.plot([0, 100], [0, 100], **BOUND)
        for label, results in judged.items():
            ordered = sorted(results, key=lambda r: r.confidence or 0.0)
            colour = line_look(self.labels.index(label))["color"]
            bins = max(1, min(6, len(ordered) // 8))  # each has at least eight trials, if there are as many
            for part in (
                list(some) for some in np.array_split(np.array(ordered, dtype=object), bins) if len(some)
            ):
                rate = rate_of(part, [succeeded(r) for r in part])
                middle = 100 * float(np.mean([r.confidence for r in part]))
                spread = [[100 * (rate.rate - rate.low)], [100 * (rate.high - rate.rate)]]
                axes.errorbar([middle], [100 * rate.rate], yerr=np.maximum(spread, 0), fmt="o", color=colour,
                              markersize=4, elinewidth=1)  # fmt: skip
        axes.set(xlabel="stated confidence (%)", ylabel="right trials (%)", xlim=(-3, 103), ylim=(-3, 103))
        axes.grid()

    def _deviations(self, axes: Any, measured: Mapping[str, list[TrialResult]], kind: str) -> None:
        for label, results in measured.items():
            colour = line_look(self.labels.index(label))["color"]
            for accepted, face in ((True, colour), (False, "none")):
                shown = []
                for r in (r for r in results if r.converged == accepted):
                    position, rotation = standard_deviations(torch.tensor(r.covariance, dtype=torch.float64))
                    stated = math.degrees(rotation) if kind == "rotation_deg" else position
                    if 0 < stated < math.inf and getattr(r.error, kind) > 0:
                        shown.append((stated, getattr(r.error, kind)))
                if shown:
                    axes.plot(*zip(*shown, strict=True), "o", markersize=3.5, color=colour, markerfacecolor=face,
                              alpha=0.7)  # fmt: skip
        unit = (
            "degrees" if kind == "rotation_deg" else unit_of([r for some in measured.values() for r in some])
        )
        axes.set(xlabel=f"stated deviation ({unit})", ylabel=f"error ({unit})")
        _set_logarithmic(axes, "x", "y")
        low, high = axes.get_xlim()
        axes.axline((low, low), (high, high), **BOUND)

    def convergence(self) -> Figure | None:
        """Draw errors and success after each step of the methods that have steps; None if none has."""
        stepwise = [group for group in self.clean if are_stepwise(group.results)]
        if not stepwise:
            return None
        panels = self._by_situation(stepwise, self._traces, self._share)
        return Figure(
            self._draw("convergence", panels, stepwise),
            "Errors after each step: median and quartiles of all trials; the dashed lines are 0.05 and 5 degrees. Right: the"
            f" share of all trials that meet the criterion ({CRITERION_NAMES[self.criterion]}) from each step on."
            f"{self.omitted}",
        )

    def _traces(self, axes: Any, groups: Sequence[Group], kind: str) -> None:
        for group in groups:
            rows = [
                np.array([np.nan if x is None else x for x in getattr(r.errors, kind)]) for r in group.results
            ]
            longest = max(map(len, rows))  # if a trial ended early, its last error is repeated
            table = np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # no pose of a step was finite
                low, middle, high = np.nanpercentile(table, (25, 50, 75), axis=0)
            look = self._look(group)
            axes.plot(middle, **look)
            axes.fill_between(range(longest), low, high, color=look["color"], alpha=0.14, linewidth=0)
        unit = "degrees" if kind == "rotation_deg" else unit_of(groups[0].results)
        _error_axis(axes, BARS[kind], f"{kind.partition('_')[0]} error ({unit})")

    def _share(self, axes: Any, groups: Sequence[Group]) -> None:
        last = max(1, *(result.steps for group in groups for result in group.results))
        for group in (group for group in groups if applies(self.criterion, group.results)):
            steps = steps_of(group.results, self.criterion)
            known = sorted(s for s in steps if s < NEVER)
            shares = [100 * count / len(steps) for count in (0, *range(1, len(known) + 1), len(known))]
            axes.step([0, *known, last], shares, where="post", **self._look(group))
        axes.set(xlabel="step", ylabel="successful trials (%)", ylim=(-2, 102), xlim=(0, last))
        axes.grid()

    def faults(self) -> Figure | None:
        """Draw a panel for each curve of ``fault_curves``; None if no fault was tried on its own."""
        curves = fault_curves(self.groups)[: COLUMNS * MOST_SITUATIONS]
        titles = situation_titles([curve.situation for curve in curves])
        panels: list[Panel] = []
        for curve in curves:
            places = [titles[curve.situation]] + ([curve.label] if len(self.labels) > 1 else [])
            panels.append((f"{curve.name}\n{', '.join(places)}", partial(_draw_curve, curve=curve)))
        if not panels:
            return None
        handles = {name: {"color": colour, "marker": "o"} for name, (_, colour) in SHARES.items()}
        return Figure(
            _draw_panels(self.folder, "faults", panels, handles),
            "Trials by fault of the images and its size, with 95 % intervals: right (within 5 degrees and 0.05 units),"
            f" accepted by the method itself, and accepted but wrong.{self.omitted}",
        )

    def _by_situation(
        self, groups: Sequence[Group], error: Callable[..., None], other: Callable[..., None]
    ) -> list[Panel]:
        """Return three panels for each situation: ``error`` draws one for each kind of error, ``other`` the third."""
        panels: list[Panel] = []
        for situation in situations(groups)[:MOST_SITUATIONS]:
            title, own = self.titles[situation], [group for group in groups if group.situation == situation]
            panels += [(title, partial(error, groups=own, kind=kind)) for kind in BARS]
            panels.append((title, partial(other, groups=own)))
        return panels

    def _look(self, group: Group) -> dict[str, Any]:
        return line_look(self.labels.index(group.label))

    def _draw(self, name: str, panels: Sequence[Panel], groups: Sequence[Group]) -> Path:
        shown = {group.label for group in groups}
        looks = {label: line_look(place) for place, label in enumerate(self.labels) if label in shown}
        return _draw_panels(self.folder, name, panels, looks)


def _draw_panels(
    folder: Path, name: str, panels: Sequence[Panel], looks: Mapping[str, Mapping[str, Any]]
) -> Path:
    """Draw panels in rows of ``COLUMNS`` with a legend below, and return the path of the SVG."""
    from matplotlib.lines import Line2D

    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    titles = [_wrapped(title, WIDTH / columns - 0.4) for title, _ in panels]
    beside = 2 if len(looks) > 2 and max(map(len, looks)) < WIDTH / 2 * PER_INCH else 1
    labels = [_wrapped(label, WIDTH / beside - 0.5) for label in looks]
    legend = 0.35 + 0.2 * sum(label.count("\n") + 1 for label in labels) / beside
    with styled():
        figure = new_figure(WIDTH, rows * (2.7 + 0.15 * max(t.count("\n") for t in titles)) + legend)
        axes = figure.subplots(rows, columns, squeeze=False).flatten()
        for panel, title, (_, draw) in zip(axes, titles, panels, strict=False):
            draw(panel)
            panel.set_title(title)
        for panel in axes[len(panels) :]:
            panel.set_axis_off()
        handles = [Line2D([], [], **look) for look in looks.values()]
        figure.legend(handles, labels, loc="outside lower left", ncols=beside)
        return save_figure(figure, folder, name)


def _error_axis(axes: Any, bar: float, label: str) -> None:
    """Set up axes of an error by step, on a logarithmic scale, with a dashed line at a bound."""
    axes.axhline(bar, **BOUND)
    axes.set(xlabel="step", ylabel=label)
    axes.set_xlim(left=0)
    _set_logarithmic(axes, "y")


def _set_logarithmic(axes: Any, *names: str) -> None:
    """Give axes a logarithmic scale with plain numbers, and a grid."""
    from matplotlib.ticker import LogLocator

    for name in names:
        axes.set(**{f"{name}scale": "log"})
        axis = getattr(axes, f"{name}axis")
        axis.set_major_formatter("{x:g}")
        low, high = getattr(axes, f"get_{name}lim")()
        if high < 10 * low:  # at most one power of ten is in view
            axis.set_minor_locator(LogLocator(subs=(1.5, 2, 3, 5)))
        axis.set_minor_formatter("{x:g}" if high < 10 * low else "")
    axes.grid(which="major")


def _wrapped(text: str, width: float, lines: int = 4) -> str:
    """Wrap each line of text to a width (inches), truncated to ``lines`` lines."""
    most = int(width * PER_INCH)
    return "\n".join(
        "\n".join(textwrap.wrap(line, most, max_lines=lines, placeholder=" ...")) or line
        for line in text.split("\n")
    )


# Faults.

SHARES: dict[str, tuple[Callable[[TrialResult], bool], str]] = {
    "right": (succeeded, COLOURS[2]),
    "accepted": (lambda result: result.converged, COLOURS[0]),
    "accepted, but wrong": (lambda result: result.converged and not succeeded(result), COLOURS[1]),
}
"""The lines of a panel of faults: which trials each counts, and its colour."""


def _draw_curve(axes: Any, curve: FaultCurve) -> None:
    """Draw one curve. Sizes are evenly spaced, since those of a fault may span orders of magnitude."""
    fault, places = FAULTS.load(curve.name), np.arange(len(curve.points))
    for turn, (share, colour) in enumerate(SHARES.values()):
        rates = [rate_of(group.results, list(map(share, group.results))) for _, group in curve.points]
        middle = np.array([rate.rate for rate in rates])
        spread = np.abs(np.array([[r.low for r in rates], [r.high for r in rates]]) - middle)
        axes.errorbar(
            places + 0.06 * (turn - 1), 100 * middle, yerr=100 * spread, color=colour, marker="o", markersize=4,
            linewidth=1.4, elinewidth=1, alpha=0.9,
        )  # fmt: skip
    sizes = ["none" if size == fault.neutral else f"{size:g}" for size, _ in curve.points]
    counts = [f"{size}\nn={len(g.results)}" for size, (_, g) in zip(sizes, curve.points, strict=True)]
    axes.set_xticks(places, counts)
    axes.set(xlabel=fault.unit, ylabel="trials (%)", ylim=(-3, 103), xlim=(-0.5, len(places) - 0.5))
    axes.grid(axis="y")


# Several maps.


def comparison_figure(folder: Path, comparison: Comparison) -> Path:
    """Draw errors, times and costs of each map as ``compare.png`` and ``compare.svg``, and return the path of the latter.

    Raises ``InputError`` if matplotlib, which is optional, is missing.
    """
    first = comparison.results[0][0].trial
    place = Situation("", "", first.data, first.split, first.protocol, first.fault, first.size)
    groups = [
        Group(place, row.map, some) for row, some in zip(comparison.rows, comparison.results, strict=True)
    ]
    figures = Figures(groups, folder, "")
    panels: list[Panel] = [
        (comparison.title, partial(figures._cumulative, groups=groups, kind="translation")),
        ("", partial(figures._cumulative, groups=groups, kind="rotation_deg")),
        ("", partial(figures._times, groups=groups)),
    ]

    def bars(axes: Any, values: Sequence[float]) -> None:
        drawn = axes.barh(range(len(values)), values, 0.7, color=[figures._look(g)["color"] for g in groups])
        axes.bar_label(drawn, [f"{value:.3g}" for value in values], padding=3)
        axes.set_yticks([])
        axes.invert_yaxis()
        axes.margins(x=0.25)

    costs = {
        "s a trial": [row.seconds for row in comparison.rows],
        "peak memory, MiB": [row.peak_memory_bytes / 2**20 for row in comparison.rows],
        "map, MiB": [row.map_bytes / 2**20 for row in comparison.rows],
    }
    panels += [(name, partial(bars, values=values)) for name, values in costs.items() if any(values)]
    return figures._draw("compare", panels, groups)


# Single trials.


def convergence_plot(path: str | Path, traces: Mapping[str, PoseError]) -> None:
    """Plot translation and rotation error after each step on a logarithmic scale, one curve per name.

    Entry 0 of a trace is the start. Values without a logarithm leave a gap. Raises ``InputError`` without matplotlib.
    """
    if not traces:
        raise InputError("no traces to plot", where=path)
    units = {symbol(trace.unit) for trace in traces.values()}
    names = {
        "translation": f"translation error ({units.pop() if len(units) == 1 else 'units'})",
        "rotation_deg": "rotation error (deg)",
    }
    with styled():
        figure = new_figure(9, 3.6)
        for axes, (kind, name) in zip(figure.subplots(1, 2), names.items(), strict=True):
            for place, (label, trace) in enumerate(traces.items()):
                values = as_array(getattr(trace, kind)).astype(np.float64).reshape(-1)
                drawn = np.where(np.isfinite(values) & (values > 0), values, np.nan)
                axes.plot(drawn, label=label, **line_look(place))
            _error_axis(axes, BARS[kind], name)
        figure.axes[0].legend(fontsize="small")
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_figure(figure, Path(path), dpi=130)
