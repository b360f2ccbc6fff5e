"""A plot of a trajectory over the map's surface, from above and from the side, coloured by uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.captures import UpDirection, up_direction
from bidnerf_core.devices import moved
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.results.plot_style import new_figure, styled, write_figure

SURFELS = 12_000
"""Maximum number of surfels drawn."""
PATH_MARGIN = 1.5
"""Extent of the drawn surface around the path, in multiples of the path's size; at least half of the scene's extent."""


@dataclass(frozen=True, eq=False)
class PlottedPath:
    """The estimated poses of a sequence's frames, their acceptance and uncertainty, and the true poses if known."""

    poses: SE3  # (n) T_world_camera
    accepted: Bool[Tensor, "n"]
    deviations: Float[Tensor, "n"]  # standard deviation of the position; NaN if unknown
    truth: Sequence[SE3 | None] = ()
    unit: LengthUnit = "units"  # of the poses


def plot_path(
    path: PlottedPath, surface: SurfaceMap | None, file: Path, up: UpDirection | None = None
) -> None:
    """Draw a path as PNG or SVG, by file extension. Raises ``InputError`` without matplotlib.

    ``up`` is the upward direction, by default estimated from the surface and the cameras.
    """
    if up is None:
        normals = None if surface is None else surface.surfels.normals
        up = up_direction(path.poses, normals)
    axes = _axes(path.poses, up.tensor())
    with styled():
        figure = new_figure(9.6, 4.9)
        panels = figure.subplots(1, 2)
        for panel, (across, upward), title in zip(
            panels, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True
        ):
            projection = np.stack([axes[across], axes[upward]], axis=-1)
            marks = _panel(panel, path, surface, projection)
            panel.set(title=title, xlabel=path.unit, aspect="equal")
        figure.colorbar(
            marks,
            ax=list(panels),
            label=f"standard deviation of the position ({_fine(path)[1]})",
            shrink=0.85,
        )
        handles, labels = panels[0].get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        write_figure(figure, file, dpi=150)


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


def _fine(path: PlottedPath) -> tuple[float, str]:
    """Return the factor and unit in which deviations are drawn."""
    return (1000.0, "mm") if path.unit == "metres" else (1.0, "units")


def _panel(
    panel: Any, path: PlottedPath, surface: SurfaceMap | None, projection: Float[np.ndarray, "3 2"]
) -> Any:
    """Draw one projection and return the artist that the colour bar describes."""
    places = path.poses.translation.double().numpy() @ projection
    if surface is not None:
        _draw_surface(panel, surface, projection, places)
    known = [T.translation.double().numpy() @ projection for T in path.truth if T is not None]
    if known:
        panel.plot(*np.array(known).T, color="#000", linewidth=0.8, label="ground truth")
    accepted, deviations = path.accepted.numpy(), _fine(path)[0] * path.deviations.double().numpy()
    lost = places[~accepted]
    if len(lost):
        panel.scatter(*lost.T, s=14, marker="x", linewidths=0.8, color="#D55E00", label="lost")
    return panel.scatter(
        *places[accepted].T, c=deviations[accepted], s=9, cmap="viridis", label="tracked", zorder=3
    )


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
