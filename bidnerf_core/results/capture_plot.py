"""A plot of a capture from above: its landmarks by the number of photos that show them, its cameras, and
their problems.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.captures import CaptureReport, Gap, PhotoProblem, PhotoRecord, horizontal_axes
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.results.plot_style import COLOURS, new_figure, styled, write_figure

LOOKS: dict[PhotoProblem, tuple[str, str]] = {
    "mirrored": (COLOURS[3], "P"), "turned": (COLOURS[3], "v"), "badly posed": (COLOURS[1], "X"),
    "apart": (COLOURS[7], "s"), "isolated": (COLOURS[6], "D"), "blurred": (COLOURS[4], "h"),
    "badly exposed": (COLOURS[5], "*"),
}  # fmt: skip
"""Colour and marker of each problem."""
SOUND = COLOURS[2]
MOST_POINTS = 20_000
"""Maximum number of landmarks drawn."""
CAPTURE_MARGIN = 0.5
"""Margin of the plot around the cameras, relative to their extent; landmarks farther away are left out."""
MOST_LABELS = 16
"""Maximum number of photos with problems that are named in the plot."""


def draw_capture(
    report: CaptureReport, points: Float[Tensor, "n 3"] | None, seen_by: Int[Tensor, "n"] | None, out: Path,
    unit: LengthUnit = "units",
) -> None:  # fmt: skip
    """Draw a capture to ``out``, a PNG.

    ``points`` (world, in ``unit``) are its landmarks, ``seen_by`` the number of photos that show each.

    Raises ``InputError`` if matplotlib is not installed, or the file cannot be written.
    """
    with styled():
        figure = new_figure(7.6, 7.0)
        panel = figure.add_subplot()
        cameras = _from_above([photo.position for photo in report.photos], report)
        _frame(panel, cameras, report, unit)
        if points is not None and seen_by is not None and len(points):
            _draw_landmarks(figure, panel, _from_above(points.double().tolist(), report), seen_by)
        for gap in (*report.coverage.gaps, *filter(None, [report.coverage.open_side])):
            _draw_gap(panel, gap, cameras, report)
        _draw_cameras(panel, cameras, report)
        panel.set_title("The capture from above")
        figure.legend(loc="outside lower center", ncols=4)
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_figure(figure, out, dpi=150)
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror})", where=out) from error


def _from_above(points: Any, report: CaptureReport) -> Float[np.ndarray, "n 2"]:
    """Return points (world) projected to the horizontal plane, relative to the centre of the capture; metres."""
    up, centre = (torch.tensor(v, dtype=torch.float64) for v in (report.coverage.up, report.coverage.centre))
    away = torch.as_tensor(points, dtype=torch.float64).reshape(-1, 3) - centre
    first, second = horizontal_axes(up)
    return torch.stack([away @ first, away @ second], dim=-1).numpy()


def _frame(panel: Any, cameras: Float[np.ndarray, "v 2"], report: CaptureReport, unit: LengthUnit) -> None:
    """Set the visible part of the plane: the cameras, the centre if they look at it, and a margin."""
    shown = cameras
    if report.coverage.arrangement in ("around", "one side"):
        shown = np.concatenate([cameras, np.zeros((1, 2))])
    low, high = shown.min(0), shown.max(0)
    reach = max(float((high - low).max()), 1e-6) * (0.5 + CAPTURE_MARGIN)
    middle = (low + high) / 2
    panel.set_xlim(middle[0] - reach, middle[0] + reach)
    panel.set_ylim(middle[1] - reach, middle[1] + reach)
    panel.set_aspect("equal")
    panel.set_xlabel(f"{unit}, from the centre of the capture")


def _draw_landmarks(
    figure: Any, panel: Any, points: Float[np.ndarray, "n 2"], seen_by: Int[Tensor, "n"]
) -> None:
    """Draw landmarks, darker if more photos show them."""
    step = max(1, math.ceil(len(points) / MOST_POINTS))
    views = seen_by.numpy()[::step]
    order = np.argsort(views, kind="stable")
    drawn = panel.scatter(
        *points[::step][order].T, c=views[order], s=2, cmap="Blues", vmin=0,
        vmax=max(3.0, float(np.quantile(views, 0.98))), linewidths=0, zorder=1,
    )  # fmt: skip
    figure.colorbar(drawn, ax=panel, label="photos that show a landmark", shrink=0.7, pad=0.02)


def _draw_cameras(panel: Any, cameras: Float[np.ndarray, "v 2"], report: CaptureReport) -> None:
    ahead = _from_above(
        [[p + d for p, d in zip(photo.position, photo.direction, strict=True)] for photo in report.photos], report
    )  # fmt: skip
    length = 0.04 * (panel.get_xlim()[1] - panel.get_xlim()[0])
    for start, step in zip(cameras, ahead - cameras, strict=True):
        panel.plot(*np.stack([start, start + length * step]).T, color="#555", linewidth=0.7, zorder=2)
    worst = [photo.problems[0] if photo.problems else None for photo in report.photos]
    _mark(panel, cameras[[w is None for w in worst]], SOUND, "o", "without a finding", 18)
    for problem, (colour, marker) in LOOKS.items():
        _mark(panel, cameras[[w == problem for w in worst]], colour, marker, problem, 55)
    _label(panel, cameras, report)


def _mark(
    panel: Any, places: Float[np.ndarray, "k 2"], colour: str, marker: str, label: str, size: int
) -> None:
    if len(places):
        panel.scatter(
            *places.T, color=colour, marker=marker, s=size, label=f"{label} ({len(places)})", zorder=3,
            edgecolors="white", linewidths=0.5,
        )  # fmt: skip


def _label(panel: Any, cameras: Float[np.ndarray, "v 2"], report: CaptureReport) -> None:
    """Name the photos with problems, and those at the ends of gaps."""
    gaps = (*report.coverage.gaps, *filter(None, [report.coverage.open_side]))
    ends = {name for gap in gaps for name in (gap.after, gap.before)}
    named = [i for i, photo in enumerate(report.photos) if photo.problems or photo.name in ends]
    for i in named[:MOST_LABELS]:
        panel.annotate(
            report.photos[i].name, cameras[i], (4, 4), textcoords="offset points", fontsize=6, zorder=4
        )


def _draw_gap(panel: Any, gap: Gap, cameras: Float[np.ndarray, "v 2"], report: CaptureReport) -> None:
    """Shade the directions from the centre without any camera."""
    if report.coverage.arrangement not in ("around", "one side"):
        return
    from matplotlib.patches import Wedge

    places: dict[str, PhotoRecord] = {photo.name: photo for photo in report.photos}
    after, _ = (_from_above([places[name].position], report)[0] for name in (gap.after, gap.before))
    begin = math.degrees(math.atan2(after[1], after[0]))
    radius = float(np.median(np.linalg.norm(cameras, axis=1)))
    panel.add_patch(
        Wedge((0, 0), radius, begin, begin + gap.degrees, color=COLOURS[1], alpha=0.12, linewidth=0, zorder=0)
    )
    middle = math.radians(begin + gap.degrees / 2)
    place = 0.7 * radius * np.array([math.cos(middle), math.sin(middle)])
    panel.annotate(
        f"{gap.degrees:.0f}°, no photo", place, ha="center", color=COLOURS[1], fontsize=8, zorder=4
    )
