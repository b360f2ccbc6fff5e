"""Plots: their common style, a capture from above with its problems, and the path of a trajectory over the surface."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.captures import (
    CaptureReport,
    Gap,
    PhotoProblem,
    UpDirection,
    horizontal_axes,
    up_direction,
)
from bidnerf_core.devices import moved
from bidnerf_core.errors import InputError, printable
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import write_file
from bidnerf_core.mapping import SurfaceMap

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
"""The colour-blind-safe palette of Okabe and Ito (2008), with brown instead of yellow, which is hard to see on white."""

CRITERION_NAMES = {
    "10%": "translation error at most 10 % of the start's",
    "5deg 0.05": "under 5° and 0.05 units",
    "1deg 0.02": "under 1° and 0.02 units",
}
SHORT_CRITERION_NAMES = {
    "10%": "translation: 10 % of the start's",
    "5deg 0.05": "5° and 0.05 units",
    "1deg 0.02": "1° and 0.02 units",
}


def require_matplotlib() -> Any:
    """Return matplotlib. Raises ``InputError`` if this optional dependency is not installed."""
    try:
        import matplotlib
    except ImportError as error:
        raise InputError("plots need matplotlib, which is missing: pip install 'bidnerf[plots]'") from error
    return matplotlib


def styled() -> Any:
    """Return a context in which figures are drawn and saved in the common style."""
    style = {
        "font.family": "DejaVu Sans", "font.size": 9, "axes.titlesize": 9, "axes.titlelocation": "left",
        "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7, "axes.edgecolor": "#555",
        "xtick.color": "#333", "ytick.color": "#333", "xtick.major.width": 0.7, "ytick.major.width": 0.7,
        "grid.color": "#ddd", "grid.linewidth": 0.6, "legend.frameon": False, "legend.fontsize": 8.5,
        "svg.hashsalt": "bidnerf", "text.parse_math": False,  # names may contain dollar signs
    }  # fmt: skip
    return require_matplotlib().rc_context(style)


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure (inches) without a window, which pyplot does not keep alive."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, folder: Path, name: str) -> Path:
    """Save a figure as SVG, and as PNG next to it; return the path of the SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    write_figure(figure, folder / f"{name}.png", dpi=160)
    write_figure(figure, folder / f"{name}.svg", metadata={"Date": None})
    return folder / f"{name}.svg"


def write_figure(figure: Any, path: Path, **options: Any) -> None:
    """Write a figure atomically in the format of the path's suffix.

    Its text, which includes names of files, frames and settings, is made printable and truncated to a
    drawable length.
    """
    require_matplotlib()
    from matplotlib.text import Text
    from matplotlib.ticker import FuncFormatter

    for text in figure.findobj(Text):
        text.set_text(_drawable(text.get_text()))
    for formatter in (
        axis.get_major_formatter() for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)
    ):
        if isinstance(formatter, FuncFormatter):  # its labels are set again whenever a figure is drawn
            formatter.func = lambda *place, labels=formatter.func: _drawable(str(labels(*place)))
    file = io.BytesIO()
    figure.savefig(file, format=path.suffix.lstrip(".") or "png", **options)
    write_file(path, file.getvalue())


def _drawable(text: str) -> str:
    """Return a text without unprintable characters, its lines truncated to 200 characters."""
    lines = (printable(line) for line in text.split("\n"))
    return "\n".join(line if len(line) <= 200 else line[:197] + "..." for line in lines)


def line_look(place: int) -> dict[str, Any]:
    """Return the colour and the dashes of line number ``place``."""
    turn, colour = divmod(place, len(COLOURS))
    return {"color": COLOURS[colour], "linestyle": ("-", "--", ":", "-.")[turn % 4], "linewidth": 1.6}


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
        looks_inwards = report.coverage.arrangement in ("around", "one side")
        # The plot shows the cameras, and the centre if they look at it, with a margin of half of their extent; landmarks
        # farther away are left out.
        shown = np.concatenate([cameras, np.zeros((1, 2))]) if looks_inwards else cameras
        low, high = shown.min(0), shown.max(0)
        middle, reach = (low + high) / 2, max(float((high - low).max()), 1e-6)
        panel.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
        panel.set(aspect="equal", xlabel=f"{unit}, from the centre of the capture")
        # Landmarks are the darker, the more photos show them.
        if points is not None and seen_by is not None and len(points):
            step = max(1, math.ceil(len(points) / 20_000))
            views, places = seen_by.numpy()[::step], _from_above(points[::step].double().tolist(), report)
            order = np.argsort(views, kind="stable")
            drawn = panel.scatter(
                *places[order].T, c=views[order], s=2, cmap="Blues", vmin=0,
                vmax=max(3.0, float(np.quantile(views, 0.98))), linewidths=0, zorder=1,
            )  # fmt: skip
            figure.colorbar(drawn, ax=panel, label="photos that show a landmark", shrink=0.7, pad=0.02)
        gaps = [*report.coverage.gaps, *filter(None, [report.coverage.open_side])]
        for gap in gaps if looks_inwards else ():
            _draw_gap(panel, gap, cameras, report)
        _draw_cameras(panel, cameras, report, {name for gap in gaps for name in (gap.after, gap.before)})
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


def _draw_cameras(
    panel: Any, cameras: Float[np.ndarray, "v 2"], report: CaptureReport, ends: set[str]
) -> None:
    """Draw the cameras with their directions and problems.

    The first ones with problems or at the ``ends`` of gaps are named.
    """
    looks: dict[PhotoProblem | None, tuple[str, str]] = {
        None: (COLOURS[2], "o"), "mirrored": (COLOURS[3], "P"), "turned": (COLOURS[3], "v"), "badly posed": (COLOURS[1], "X"),
        "apart": (COLOURS[7], "s"), "isolated": (COLOURS[6], "D"), "blurred": (COLOURS[4], "h"),
        "badly exposed": (COLOURS[5], "*"),
    }  # fmt: skip
    ahead = [[p + d for p, d in zip(photo.position, photo.direction, strict=True)] for photo in report.photos]
    length = 0.04 * (panel.get_xlim()[1] - panel.get_xlim()[0])
    for start, step in zip(cameras, _from_above(ahead, report) - cameras, strict=True):
        panel.plot(*np.stack([start, start + length * step]).T, color="#555", linewidth=0.7, zorder=2)
    worst = [photo.problems[0] if photo.problems else None for photo in report.photos]
    for problem, (colour, marker) in looks.items():
        if not len(places := cameras[[each == problem for each in worst]]):
            continue
        panel.scatter(
            *places.T,
            color=colour,
            marker=marker,
            s=18 if problem is None else 55,
            label=f"{problem or 'without a finding'} ({len(places)})",
            zorder=3,
            edgecolors="white",
            linewidths=0.5,
        )
    named = [i for i, photo in enumerate(report.photos) if photo.problems or photo.name in ends]
    for i in named[:16]:
        panel.annotate(
            report.photos[i].name, cameras[i], (4, 4), textcoords="offset points", fontsize=6, zorder=4
        )


def _draw_gap(panel: Any, gap: Gap, cameras: Float[np.ndarray, "v 2"], report: CaptureReport) -> None:
    """Shade the directions from the centre without any camera."""
    from matplotlib.patches import Wedge

    (after,) = _from_above([photo.position for photo in report.photos if photo.name == gap.after], report)
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
    """Draw the path of estimated ``poses`` (n, T_world_camera) to ``out``, a PNG or SVG, from above and from the side.

    ``accepted`` says which poses were, ``deviations`` are the standard deviations of the positions (``unit``, NaN if unknown),
    ``truth`` holds the true poses as far as they are known. ``up`` is the upward direction, by default estimated from the
    surface and the cameras. Raises ``InputError`` without matplotlib.
    """
    if up is None:
        up = up_direction(poses, None if surface is None else surface.surfels.normals)
    axes, (scale, fine) = _axes(poses, up.tensor()), (1000.0, "mm") if unit == "metres" else (1.0, "units")
    known = [T.translation.double().numpy() for T in truth if T is not None]
    with styled():
        figure = new_figure(9.6, 4.9)
        panels = figure.subplots(1, 2)
        for panel, upward, title in zip(panels, (1, 2), ("from above", "from the side"), strict=True):
            projection = np.stack([axes[0], axes[upward]], axis=-1)
            places = poses.translation.double().numpy() @ projection
            # A sample of the surfels around the path is drawn, as far as half of the scene's extent or more.
            if surface is not None:
                surfels = moved(surface.surfels, "cpu")
                points, middle = surfels.positions.double().numpy() @ projection, places.mean(0)
                size = max(0.5 * surface.extent, 1.5 * float(np.abs(places - middle).max()))
                near = np.flatnonzero((np.abs(points - middle) <= size).all(-1))
                some = near[:: max(1, -(-len(near) // 12_000))]
                paint = 0.3 + 0.7 * surfels.rgb[torch.from_numpy(some)].clamp(0, 1).numpy()
                panel.scatter(*points[some].T, s=2, c=paint, linewidths=0, rasterized=True)
            if known:
                panel.plot(
                    *(np.array(known) @ projection).T, color="#000", linewidth=0.8, label="ground truth"
                )
            found, colours = accepted.numpy(), scale * deviations.double().numpy()
            if not found.all():
                panel.scatter(
                    *places[~found].T, s=14, marker="x", linewidths=0.8, color=COLOURS[1], label="lost"
                )
            marks = panel.scatter(
                *places[found].T, c=colours[found], s=9, cmap="viridis", label="tracked", zorder=3
            )
            panel.set(title=title, xlabel=unit, aspect="equal")
        label = f"standard deviation of the position ({fine})"
        figure.colorbar(marks, ax=list(panels), label=label, shrink=0.85)
        handles, labels = panels[0].get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        write_figure(figure, out, dpi=150)


def _axes(poses: SE3, up: Float[Tensor, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the axes of the plot (rows, world): the longest horizontal one, the other horizontal one, and up."""
    centred = poses.translation.double() - poses.translation.double().mean(0)
    level = centred - (centred @ up)[:, None] * up
    right = torch.linalg.svd(level, full_matrices=True)[2][0]
    right = right - (right @ up) * up
    if float(right.norm()) < 1e-6:
        right = torch.linalg.cross(up, torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())])
    right = right / right.norm()
    return torch.stack([right, torch.linalg.cross(up, right), up]).numpy()
