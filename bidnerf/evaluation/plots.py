"""Figures of an evaluation: errors, times and convergence, and the comparison of several maps.

All figures have the same width, so that their font sizes match on a page. A condition has the same colour in all
figures.
"""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bidnerf.evaluation.comparison import Comparison
from bidnerf.evaluation.faults import NO_FAULT
from bidnerf.evaluation.summary import (
    NEVER,
    ResultGroup,
    Situation,
    applies,
    are_stepwise,
    is_right,
    situations,
    steps_of,
)
from bidnerf.evaluation.trial import TrialResult
from bidnerf.results import (
    CRITERION_NAMES,
    common_style,
    common_unit,
    line_style,
    new_figure,
    require_matplotlib,
    write_figure,
)
from bidnerf_core.errors import amount

WIDTH, COLUMNS = 10.8, 3
"""Width of a figure in inches, and number of panels side by side."""
PER_INCH = 13
"""Average number of characters per inch of text."""
MOST_SITUATIONS = 16
"""Maximum number of situations in a figure; larger figures can be neither drawn nor read."""
MOST_CONDITIONS = 48
"""Maximum number of conditions in a figure, whose legend has a line for each."""
PLOTTED_STEPS = 1_000
"""Maximum number of steps at which quartiles are computed and drawn."""
BOUND: dict[str, Any] = {"color": "#999", "linewidth": 0.8, "linestyle": (0, (4, 3))}
"""The line style of a bound."""


QUANTITIES: dict[str, tuple[str, str, float | None, Callable[[TrialResult, str], float]]] = {
    "translation": (
        "translation error ({unit})",
        "trials (%)",
        0.05,
        lambda r, _: r.error.translation if r.error else NEVER,
    ),
    "rotation_deg": (
        "rotation error (degrees)",
        "trials (%)",
        5.0,
        lambda r, _: r.error.rotation_deg if r.error else NEVER,
    ),
    "seconds": ("time by the clock (s)", "right trials (%)", None, lambda r, _: r.seconds if is_right(r) else NEVER),
    "steps": (
        "step",
        "successful trials (%)",
        None,
        lambda r, criterion: steps_of([r], criterion)[0] if applies(criterion, [r]) else NEVER,
    ),
}
"""The quantities of trials that a panel shows, by name: the axis label of the quantity, the axis label of the share of trials, the
bound for right answers (None: no bound), and a function that returns the value for a result and a criterion, infinite for trials
that never count."""
POSE_ERRORS = ("translation", "rotation_deg")

Panel = tuple[str, Callable[[Any], None]]
"""The title of a panel, and the function that draws it."""


Figure = tuple[Path, str]
"""The path of an SVG, next to which the same figure is stored as PNG, and its caption."""


class Figures:
    """Draws figures of ``groups`` and saves them as PNG and SVG in ``folder``. Raises ``InputError`` without matplotlib.

    ``criterion`` defines success by step. At most ``MOST_SITUATIONS`` situations and ``MOST_CONDITIONS`` conditions are drawn; if there
    are more, first those without faults.
    """

    def __init__(self, groups: Sequence[ResultGroup], folder: Path, criterion: str) -> None:
        require_matplotlib()
        self.folder, self.criterion = folder, criterion
        labels = list(dict.fromkeys(group.label for group in groups))
        self.looks = {label: line_style(number) for number, label in enumerate(labels[:MOST_CONDITIONS])}
        self.undrawn = len(labels) - len(self.looks)
        drawn = (group for group in groups if group.label in self.looks)
        self.groups = sorted(drawn, key=lambda group: group.situation.fault != NO_FAULT)

    def errors(self) -> Figure | None:
        """Draw the cumulative share of trials over their errors, and that of right answers over time, for each situation."""
        return self._by_situation(
            "errors",
            self.groups,
            self.cumulative(),
            "Cumulative errors: the share of all trials whose final error is at most that on the axis; answers that the"
            " method itself refused count as well, and the dashed lines are 0.05 and 5 degrees. Right: the share of all"
            " trials that were answered rightly (within both) in at most that time.",
        )

    def cumulative(self) -> list[Callable[..., None]]:
        """Return functions that draw the cumulative share of trials over each kind of error, and over time."""
        return [partial(self._shares, of=of) for of in (*POSE_ERRORS, "seconds")]

    def convergence(self) -> Figure | None:
        """Draw errors and success after each step, for methods that work in steps; None if there are none."""
        draw = [*(partial(self._quartiles, kind=kind) for kind in POSE_ERRORS), partial(self._shares, of="steps")]
        return self._by_situation(
            "convergence",
            [group for group in self.groups if are_stepwise(group.results)],
            draw,
            "Errors after each step: median and quartiles of all trials; the dashed lines are 0.05 and 5 degrees. Right: the"
            f" share of all trials that meet the criterion ({CRITERION_NAMES[self.criterion]}) from each step on.",
        )

    # What a panel shows of the groups of a situation.

    def _shares(self, axes: Any, groups: Sequence[ResultGroup], of: str) -> None:
        """Draw the cumulative share of trials over the quantity ``of``."""
        label, share, bound, value = QUANTITIES[of]
        for group in groups:
            values = sorted(value(result, self.criterion) for result in group.results)
            reached = [each for each in values if each < NEVER]
            if bound is not None:  # errors below bound / 500 are drawn as equal on the logarithmic axis
                reached = np.maximum(reached, bound / 500).tolist()
            if reached:
                shares = [100 * count / len(values) for count in range(len(reached) + 1)]
                axes.step([reached[0], *reached], shares, where="post", **self.looks[group.label])
        axes.set(xlabel=label.format(unit=common_unit(groups[0].results)), ylabel=share, ylim=(-2, 102))
        if bound is not None:
            axes.axvline(bound, **BOUND)
        if of == "steps":
            axes.set_xlim(0, max(result.steps for group in groups for result in group.results))
            axes.grid()
        else:
            _set_logarithmic(axes, "x")

    def _quartiles(self, axes: Any, groups: Sequence[ResultGroup], kind: str) -> None:
        """Draw the median and the quartiles of an error after each step."""
        label, _, bound, _ = QUANTITIES[kind]
        for group in groups:
            rows = [np.array(getattr(r.errors, kind), dtype=float) for r in group.results]
            longest = max(map(len, rows))
            steps = np.unique(np.linspace(0, longest - 1, PLOTTED_STEPS).round().astype(int))
            # If a trial ended early, its last error is repeated.
            table = np.stack([row[np.minimum(steps, len(row) - 1)] for row in rows])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # no pose of a step was finite
                low, middle, high = np.nanpercentile(table, (25, 50, 75), axis=0)
            look = self.looks[group.label]
            axes.plot(steps, middle, **look)
            axes.fill_between(steps, low, high, color=look["color"], alpha=0.14, linewidth=0)
        axes.axhline(bound, **BOUND)
        axes.set(xlabel="step", ylabel=label.format(unit=common_unit(groups[0].results)))
        axes.set_xlim(left=0)
        _set_logarithmic(axes, "y")

    # How panels become a figure.

    def _by_situation(
        self, name: str, groups: Sequence[ResultGroup], draw: Sequence[Callable[..., None]], caption: str
    ) -> Figure | None:
        """Draw a row of panels for each situation, one panel for each function in ``draw``."""
        panels, count = list[Panel](), len(situations(groups))
        if count > MOST_SITUATIONS:
            caption += f" At most {MOST_SITUATIONS} of {count} situations are drawn; the tables have all."
        if self.undrawn:
            caption += f" {amount(self.undrawn, 'further condition')} in the tables are not drawn."
        for situation in situations(groups)[:MOST_SITUATIONS]:
            own = [group for group in groups if group.situation == situation]
            panels += [(own[0].title, partial(each, groups=own)) for each in draw]
        shown = {group.label for group in groups}
        looks = {label: look for label, look in self.looks.items() if label in shown}
        return self._figure(name, panels, looks, caption) if panels else None

    def _figure(
        self, name: str, panels: Sequence[Panel], looks: Mapping[str, Mapping[str, Any]], caption: str
    ) -> Figure:
        """Draw one or more panels in rows of ``COLUMNS`` with a legend below."""
        from matplotlib.lines import Line2D

        columns = min(COLUMNS, len(panels))
        rows = math.ceil(len(panels) / columns)
        titles = [_wrap(title, WIDTH / columns - 0.4) for title, _ in panels]
        beside = 2 if len(looks) > 2 and max(map(len, looks)) < WIDTH / 2 * PER_INCH else 1
        labels = [_wrap(label, WIDTH / beside - 0.5) for label in looks]
        legend = 0.35 + 0.2 * sum(label.count("\n") + 1 for label in labels) / beside
        with common_style():
            figure = new_figure(WIDTH, rows * (2.7 + 0.15 * max(t.count("\n") for t in titles)) + legend)
            axes = figure.subplots(rows, columns, squeeze=False).flatten()
            for panel, title, (_, draw) in zip(axes, titles, panels, strict=False):
                draw(panel)
                panel.set_title(title)
            for panel in axes[len(panels) :]:
                panel.set_axis_off()
            handles = [Line2D([], [], **look) for look in looks.values()]
            figure.legend(handles, labels, loc="outside lower left", ncols=beside)
            svg = self.folder / f"{name}.svg"
            self.folder.mkdir(parents=True, exist_ok=True)
            write_figure(figure, svg.with_suffix(".png"), svg, dpi=160)
            return svg, caption


def _set_logarithmic(axes: Any, name: str) -> None:
    """Give the axis ``name`` a logarithmic scale with plain numbers, and a grid."""
    from matplotlib.ticker import LogLocator

    axes.set(**{f"{name}scale": "log"})
    axis = getattr(axes, f"{name}axis")
    axis.set_major_formatter("{x:g}")
    low, high = getattr(axes, f"get_{name}lim")()
    if high < 10 * low:  # at most one power of ten is in view
        axis.set_minor_locator(LogLocator(subs=(1.5, 2, 3, 5)))
    axis.set_minor_formatter("{x:g}" if high < 10 * low else "")
    axes.grid(which="major")


def _wrap(text: str, width: float) -> str:
    """Wrap each line of text to a width (inches), truncated to four lines."""
    wrap = partial(textwrap.wrap, width=int(width * PER_INCH), max_lines=4, placeholder=" ...")
    return "\n".join("\n".join(wrap(line)) or line for line in text.split("\n"))


# Several maps.


def comparison_figure(folder: Path, comparison: Comparison) -> Path:
    """Draw errors, times and costs of each map as ``compare.png`` and ``compare.svg``, and return the path of the SVG.

    Raises ``InputError`` if matplotlib, which is optional, is missing.
    """
    first = comparison.results[0][0].trial
    situation = Situation("", "", first.data, first.images.split, first.protocol, first.fault, first.size)
    pairs = zip(comparison.rows, comparison.results, strict=True)
    groups = [ResultGroup(situation, "", row.map, results) for row, results in pairs]
    figures = Figures(groups, folder, "")

    def bars(axes: Any, values: Sequence[float]) -> None:
        colours = [look["color"] for look in figures.looks.values()]
        axes.bar_label(axes.barh(range(len(values)), values, 0.7, color=colours), fmt="{:.3g}", padding=3)
        axes.set_yticks([])
        axes.invert_yaxis()
        axes.margins(x=0.25)

    costs = {
        "CPU s a trial": [row.cpu_seconds for row in comparison.rows],
        "peak memory, MiB": [row.peak_memory_bytes / 2**20 for row in comparison.rows],
        "map, MiB": [row.map_bytes / 2**20 for row in comparison.rows],
    }
    titles = (comparison.title, "", "")
    panels: list[Panel] = [
        (title, partial(draw, groups=figures.groups)) for title, draw in zip(titles, figures.cumulative(), strict=True)
    ]
    panels += [(name, partial(bars, values=values)) for name, values in costs.items() if any(values)]
    return figures._figure("compare", panels, figures.looks, "")[0]
