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

DASHES = ("-", "--", ":", "-.")  # for more lines than there are colours
STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans", "font.size": 9, "axes.titlesize": 9, "axes.titlelocation": "left",
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7, "axes.edgecolor": "#555",
    "xtick.color": "#333", "ytick.color": "#333", "xtick.major.width": 0.7, "ytick.major.width": 0.7,
    "grid.color": "#ddd", "grid.linewidth": 0.6, "legend.frameon": False, "legend.fontsize": 8.5,
    "svg.hashsalt": "bidnerf", "text.parse_math": False,  # names may contain dollar signs
}  # fmt: skip

LONGEST_LINE = 200
"""Maximum number of characters of a line of text in a figure."""

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
LOOKS: dict[PhotoProblem, tuple[str, str]] = {
    "mirrored": (COLOURS[3], "P"), "turned": (COLOURS[3], "v"), "badly posed": (COLOURS[1], "X"),
    "apart": (COLOURS[7], "s"), "isolated": (COLOURS[6], "D"), "blurred": (COLOURS[4], "h"),
    "badly exposed": (COLOURS[5], "*"),
}  # fmt: skip
"""Colour and marker of each problem."""
MOST_POINTS = 20_000
"""Maximum number of landmarks drawn."""
CAPTURE_MARGIN = 0.5
"""Margin of the plot around the cameras, relative to their extent; landmarks farther away are left out."""
MOST_LABELS = 16
"""Maximum number of photos with problems that are named in the plot."""
SURFELS = 12_000
"""Maximum number of surfels drawn."""
PATH_MARGIN = 1.5
"""Extent of the drawn surface around the path, in multiples of the path's size; at least half of the scene's extent."""


def require_matplotlib() -> Any:
    """Return matplotlib. Raises ``InputError`` if this optional dependency is not installed."""
    try:
        import matplotlib
    except ImportError as error:
        raise InputError("plots need matplotlib, which is missing: pip install 'bidnerf[plots]'") from error
    return matplotlib


def styled() -> Any:
    """Return a context in which figures are drawn and saved in the common style."""
    return require_matplotlib().rc_context(STYLE)


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

    for text in figure.findobj(Text):
        text.set_text(_drawable(text.get_text()))
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            _make_labels_drawable(axis.get_major_formatter())
    file = io.BytesIO()
    figure.savefig(file, format=path.suffix.lstrip(".") or "png", **options)
    write_file(path, file.getvalue())


def _make_labels_drawable(formatter: Any) -> None:
    """Modify a formatter of given labels, which are set again whenever a figure is drawn."""
    from matplotlib.ticker import FuncFormatter

    if isinstance(formatter, FuncFormatter):
        labels = formatter.func
        formatter.func = lambda *place: _drawable(str(labels(*place)))


def _drawable(text: str) -> str:
    lines = (printable(line) for line in text.split("\n"))
    return "\n".join(
        line if len(line) <= LONGEST_LINE else line[: LONGEST_LINE - 3] + "..." for line in lines
    )


def line_look(place: int) -> dict[str, Any]:
    """Return the colour and the dashes of line number ``place``."""
    turn, colour = divmod(place, len(COLOURS))
    return {"color": COLOURS[colour], "linestyle": DASHES[turn % len(DASHES)], "linewidth": 1.6}


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
    """Draw the cameras with their directions and problems; name those with problems, and those at the ends of gaps."""
    ahead = [[p + d for p, d in zip(photo.position, photo.direction, strict=True)] for photo in report.photos]
    length = 0.04 * (panel.get_xlim()[1] - panel.get_xlim()[0])
    for start, step in zip(cameras, _from_above(ahead, report) - cameras, strict=True):
        panel.plot(*np.stack([start, start + length * step]).T, color="#555", linewidth=0.7, zorder=2)
    worst = [photo.problems[0] if photo.problems else None for photo in report.photos]
    for problem, (colour, marker) in ((None, (COLOURS[2], "o")), *LOOKS.items()):
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
            if surface is not None:
                _draw_surface(panel, surface, projection, places)
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


def _draw_surface(
    panel: Any, surface: SurfaceMap, projection: Float[np.ndarray, "3 2"], places: Float[np.ndarray, "n 2"]
) -> None:
    """Draw a sample of the surfels around the path in their colours."""
    surfels = moved(surface.surfels, "cpu")
    points = surfels.positions.double().numpy() @ projection
    middle = places.mean(0)
    size = max(0.5 * surface.extent, PATH_MARGIN * float(np.abs(places - middle).max()))
    near = np.flatnonzero((np.abs(points - middle) <= size).all(-1))
    some = near[:: max(1, -(-len(near) // SURFELS))]
    colours = surfels.rgb[torch.from_numpy(some)].clamp(0, 1).numpy()
    panel.scatter(*points[some].T, s=2, c=0.3 + 0.7 * colours, linewidths=0, rasterized=True)
