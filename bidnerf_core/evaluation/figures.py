"""Animations, and plots of convergence, which need matplotlib."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import write_file
from bidnerf_core.results.errors import PoseError
from bidnerf_core.results.overlays import as_array, as_picture, require_same_size
from bidnerf_core.results.plot_style import line_look, new_figure, styled, write_figure


def save_gif(path: str | Path, frames: Sequence[ArrayLike | Tensor], fps: float = 8.0) -> None:
    """Write an endless animation of images (h w 3) of the same size."""
    if not (math.isfinite(fps) and fps > 0):
        raise InputError(f"{path}: {fps} frames a second, expected a positive number")
    pictures = [as_picture(frame, f"frame {i}") for i, frame in enumerate(frames)]
    if not pictures:
        raise InputError(f"{path}: an animation of no frames")
    require_same_size(pictures, [f"frame {i}" for i in range(len(pictures))])
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    content = iio.imwrite("<bytes>", np.stack(pictures), extension=".gif", duration=1000 / fps, loop=0)
    write_file(Path(path), bytes(content))


def convergence_plot(path: str | Path, traces: Mapping[str, PoseError]) -> None:
    """Plot translation and rotation error after each step on a logarithmic scale, one curve per name.

    Entry 0 of a trace is the start. Values without a logarithm leave a gap. Raises ``InputError`` without matplotlib.
    """
    if not traces:
        raise InputError(f"{path}: a plot of no traces")
    with styled():
        figure = new_figure(9, 3.6)
        left, right = figure.subplots(1, 2)
        _draw_errors(
            left, {name: trace.translation for name, trace in traces.items()}, "translation (m)", 0.05
        )
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
    axes.grid(which="both")
