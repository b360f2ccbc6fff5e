"""The common parts of all plots: the palette, the style, the names of criteria, and figures without global state."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError, printable
from bidnerf_core.io import write_file

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
