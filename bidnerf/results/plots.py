"""Plots: their common style, a top view of a capture with its problems, and a trajectory over the surface."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.captures import (
    CaptureReport,
    PhotoProblem,
    UpDirection,
    horizontal_axes,
    up_direction,
)
from bidnerf_core.devices import move_to
from bidnerf_core.errors import printable
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.installation import import_extra
from bidnerf_core.io import library_errors, write_file
from bidnerf_core.mapping import LandmarkMap, SurfaceMap

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
"""The colour-blind-safe palette of Okabe and Ito (2008), with brown instead of yellow, which is hard to see on white."""

CRITERION_NAMES = {
    "10%": "translation error at most 10 % of the start's",
    "5deg 0.05": "under 5° and 0.05 units",
    "1deg 0.02": "under 1° and 0.02 units",
}


def require_matplotlib() -> Any:
    """Return matplotlib. Raises ``InputError`` if this optional dependency is not installed."""
    return import_extra("matplotlib", "plots", "drawing a plot")


def common_style() -> Any:
    """Return a context in which figures are drawn and saved in the common style.

    A matplotlibrc, which may lie in the current folder and make text run LaTeX, does not count.
    """
    style = {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "axes.titlesize": 9,
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.7,
        "axes.edgecolor": "#555",
        "xtick.color": "#333",
        "ytick.color": "#333",
        "xtick.major.width": 0.7,
        "ytick.major.width": 0.7,
        "grid.color": "#ddd",
        "grid.linewidth": 0.6,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "svg.hashsalt": "bidnerf",
        "text.parse_math": False,  # names may contain dollar signs
    }
    require_matplotlib()
    from matplotlib.style import context

    return context(style, after_reset=True)


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure of the given size (inches) that has no window and is not managed by pyplot."""
    require_matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def write_figure(figure: Any, *paths: Path, dpi: int = 150) -> None:
    """Write a figure atomically to each path, in the format of its suffix.

    The text in the figure, which includes names of files, frames and settings, is made printable and
    truncated to 200 characters a line.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        lines = (printable(line) for line in text.get_text().split("\n"))
        text.set_text("\n".join(line if len(line) <= 200 else line[:197] + "..." for line in lines))
    for path in paths:
        file, suffix = io.BytesIO(), path.suffix.lstrip(".") or "png"
        figure.savefig(file, format=suffix, dpi=dpi, metadata={"Date": None} if suffix == "svg" else {})
        write_file(path, file.getvalue())
        figure.set_layout_engine("none")  # laying it out again would take as long as drawing it


def line_style(number: int) -> dict[str, Any]:
    """Return the colour, dash pattern and width of a line, given its number."""
    turn, colour = divmod(number, len(COLOURS))
    return {"color": COLOURS[colour], "linestyle": ("-", "--", ":", "-.")[turn % 4], "linewidth": 1.6}


def draw_capture(
    report: CaptureReport,
    landmarks: LandmarkMap | None,
    out: Path,
    unit: LengthUnit = "units",
) -> None:
    """Draw a top view of a capture to ``out``, a PNG: its cameras with their directions and problems, and its landmarks.

    Lengths are in ``unit``. Raises ``InputError`` if matplotlib is not installed, or the file cannot be written.
    """
    up, centre = (torch.tensor(v, dtype=torch.float64) for v in (report.coverage.up, report.coverage.centre))
    axes = torch.stack(horizontal_axes(up), dim=-1)
    position, ahead = (
        torch.tensor([getattr(photo, name) for photo in report.photos], dtype=torch.float64)
        for name in ("position", "direction")
    )
    cameras, directions = ((position - centre) @ axes).numpy(), (ahead @ axes).numpy()
    with common_style():
        figure = new_figure(7.6, 7.0)
        panel = figure.add_subplot()
        # The plot shows the cameras and the centre with a margin; landmarks farther away are left out.
        reach = 1.5 * max(float(np.abs(cameras).max()), 1e-6)
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title="The capture from above")
        panel.set_xlabel(f"{unit}, from the centre of the capture")
        if landmarks is not None and len(landmarks):
            step = math.ceil(len(landmarks) / 20_000)
            places, views = (landmarks.positions[::step].double() - centre) @ axes, landmarks.views[::step].numpy()
            drawn = panel.scatter(*places.numpy().T, c=views, s=2, cmap="Blues", vmin=0, linewidths=0, zorder=1)
            figure.colorbar(drawn, ax=panel, label="photos that show a landmark", shrink=0.7, pad=0.02)
        panel.quiver(*cameras.T, *directions.T, color="#555", scale=25, width=0.002, headwidth=1, zorder=2)
        worst = [photo.problems[0] if photo.problems else "without a finding" for photo in report.photos]
        for rank, problem in enumerate(("without a finding", *get_args(PhotoProblem))):
            here = [number for number, each in enumerate(worst) if each == problem]
            style = {"color": COLOURS[(rank + 2) % len(COLOURS)], "marker": "oPvXsDh*"[rank % 8]}
            if here:
                label, size = f"{problem} ({len(here)})", 55 if rank else 18
                panel.scatter(*cameras[here].T, s=size, label=label, edgecolors="white", zorder=3, **style)
        for photo, camera in zip(report.photos, cameras, strict=True):
            if photo.problems:
                panel.annotate(photo.name, camera, (4, 4), textcoords="offset points", fontsize=6)
        figure.legend(loc="outside lower center", ncols=4)
        with library_errors(out, "cannot be written", "a file in a folder that can be written", OSError):
            out.parent.mkdir(parents=True, exist_ok=True)
            write_figure(figure, out)


def draw_path(
    poses: SE3,
    accepted: Bool[Tensor, "n"],
    deviations: Float[Tensor, "n"],
    truth: Sequence[SE3 | None],
    out: Path,
    surface: SurfaceMap | None = None,
    up: UpDirection | None = None,
    unit: LengthUnit = "units",
) -> None:
    """Draw the trajectory of estimated ``poses`` (n, T_world_camera) to ``out``, a PNG or SVG, from above and from the side.

    ``accepted`` marks the accepted poses, ``deviations`` are the standard deviations of the positions
    (``unit``, NaN if unknown), and ``truth`` holds the true poses where known. ``up`` is the up direction, by
    default estimated from the surface and the cameras. Raises ``InputError`` without matplotlib.
    """
    if up is None:
        up = up_direction(poses, None if surface is None else surface.surfels.normals)
    right, back = horizontal_axes(up.tensor())
    scale, fine = (1000.0, "mm") if unit == "metres" else (1.0, "units")
    known = [T.translation.double().numpy() for T in truth if T is not None]
    with common_style():
        figure = new_figure(9.6, 4.9)
        panels = figure.subplots(1, 2)
        for panel, upward, title in zip(panels, (back, up.tensor()), ("from above", "from the side"), strict=True):
            projection = torch.stack([right, upward], dim=-1).numpy()
            places = poses.translation.double().numpy() @ projection
            # A sample of the surfels around the path is drawn, up to a distance of at least half of the
            # scene's extent.
            if surface is not None:
                surfels = move_to(surface.surfels, "cpu")
                points, middle = surfels.positions.double().numpy() @ projection, places.mean(0)
                size = max(0.5 * surface.extent, 1.5 * float(np.abs(places - middle).max()))
                near = np.flatnonzero((np.abs(points - middle) <= size).all(-1))
                some = near[:: max(1, -(-len(near) // 12_000))]
                paint = 0.3 + 0.7 * surfels.rgb[torch.from_numpy(some)].clamp(0, 1).numpy()
                panel.scatter(*points[some].T, s=2, c=paint, linewidths=0, rasterized=True)
            if known:
                panel.plot(*(np.array(known) @ projection).T, color="#000", linewidth=0.8, label="ground truth")
            is_accepted, colours = accepted.numpy(), scale * deviations.double().numpy()
            if not is_accepted.all():
                panel.scatter(*places[~is_accepted].T, s=14, marker="x", color=COLOURS[1], label="lost")
            marks = panel.scatter(*places[is_accepted].T, c=colours[is_accepted], s=9, label="tracked", zorder=3)
            panel.set(title=title, xlabel=unit, aspect="equal")
        label = f"standard deviation of the position ({fine})"
        figure.colorbar(marks, ax=list(panels), label=label, shrink=0.85)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        write_figure(figure, out)
