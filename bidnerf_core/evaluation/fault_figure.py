"""A figure of success, acceptance and silent errors against the size of each fault."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bidnerf_core.evaluation.faults import NO_FAULT, find_fault, parse_faults
from bidnerf_core.evaluation.groups import Group, Situation, situation_titles
from bidnerf_core.evaluation.summary import ABSOLUTE, Summary, summarize
from bidnerf_core.results.errors import success_rate
from bidnerf_core.results.plot_style import COLOURS, new_figure, save_figure, styled

FIGURE_COLUMNS, FAULT_PANEL = 3, (3.6, 2.7)  # inches
DRAWN_SHARES: dict[str, tuple[Callable[[Summary], int], str]] = {
    "right": (lambda s: found.rate.successes if (found := s.criteria[ABSOLUTE]) else 0, COLOURS[2]),
    "converged": (lambda s: s.converged, COLOURS[0]),
    "converged, but wrong": (lambda s: s.converged_but_wrong, COLOURS[1]),
}
"""The lines of a panel: each a number of trials, and a colour."""


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

    Returns None where no fault was tried on its own. Raises ``InputError`` without matplotlib.
    """
    curves = fault_curves(groups)
    if not curves:
        return None
    titles = situation_titles([curve.situation for curve in curves])
    labels = {curve.label for curve in curves}
    rows = math.ceil(len(curves) / FIGURE_COLUMNS)
    with styled():
        figure = new_figure(FIGURE_COLUMNS * FAULT_PANEL[0], rows * FAULT_PANEL[1] + 0.3)
        axes = figure.subplots(rows, FIGURE_COLUMNS, squeeze=False).flatten()
        for panel, curve in zip(axes, curves, strict=False):
            places = [titles[curve.situation]] + ([curve.label] if len(labels) > 1 else [])
            _draw(panel, curve, f"{curve.name}\n{', '.join(places)}")
        for panel in axes[len(curves) :]:
            panel.set_axis_off()
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(DRAWN_SHARES))
        return save_figure(figure, folder, "faults")


def _draw(panel: Any, curve: FaultCurve, title: str) -> None:
    """Draw one curve. Sizes are evenly spaced, since those of a fault may span orders of magnitude."""
    fault = find_fault(curve.name)
    summaries = [summarize(group.results) for _, group in curve.points]
    places = np.arange(len(curve.points))
    for turn, (label, (count, colour)) in enumerate(DRAWN_SHARES.items()):
        rates = [success_rate(count(s), s.trials) for s in summaries]
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
