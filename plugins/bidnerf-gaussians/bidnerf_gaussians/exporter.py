"""Exporters of maps as files of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.captures import write_inria_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.fields import ScaledField
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.maps import Map
from bidnerf_gaussians.field import GaussiansField
from bidnerf_gaussians.formats import write_gaussians
from bidnerf_gaussians.gaussians import Gaussians
from bidnerf_gaussians.spherical_harmonics import C0

NEIGHBOURS = 6
"""Neighbours of a surfel whose mean distance is the spacing of the surfels there: as many as in a hexagonal tiling."""
WIDTH = 0.6
"""Standard deviation of a disc in its plane, in units of that spacing: between two discs, an opacity above 0.9 is left."""
WIDEST = 4.0
"""Spacing of a lone surfel that still counts, in units of the median."""
OPACITY = 0.95


def export_ply(scene: Map, out: Path) -> list[Path]:
    """A splat in Inria's layout, with its cameras.json; of any field with a surface."""
    return _export(scene, out / "splat.ply")


def export_spz(scene: Map, out: Path) -> list[Path]:
    """A splat in Niantic's compressed layout, with Inria's cameras.json; of any field with a surface."""
    return _export(scene, out / "splat.spz")


def _export(scene: Map, file: Path) -> list[Path]:
    write_gaussians(file, gaussians_of_map(scene))
    return [file, *write_inria_cameras(file.parent, scene.info.cameras)]


def gaussians_of_map(scene: Map) -> Gaussians:
    """Return the Gaussians of a map of splats, or else a disc for each surfel.

    Raises ``InputError`` for a map that has neither.
    """
    field, scale = scene.field, 1.0
    while isinstance(field, ScaledField):
        field, scale = field.trained, scale * field.scale
    if isinstance(field, GaussiansField):
        return field.gaussians().similar(scale, torch.eye(3), torch.zeros(3))
    if scene.surface is None:
        raise InputError("has no surface, from which a splat could be made; 'bidnerf bake' adds one", where=scene.name)
    return gaussians_of_surface(scene.surface)


def gaussians_of_surface(surface: SurfaceMap) -> Gaussians:
    """Return a flat, nearly opaque Gaussian in the colour and the plane of each surfel, as wide as the surfels are apart."""
    surfels = surface.surfels
    spacing = _spacing(surfels.positions)
    normals = torch.where(surfels.normals[:, 2:] < 0, -surfels.normals, surfels.normals)
    x, y, z = normals.unbind(-1)
    turns = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=-1)  # take the third axis to the normal
    # Across the plane, the standard deviation is a tenth of the spacing.
    scales = spacing[:, None] * torch.tensor([WIDTH, WIDTH, 0.1])
    return Gaussians(
        surfels.positions,
        scales.log(),
        torch.nn.functional.normalize(turns, dim=-1),
        torch.full((len(surfels),), OPACITY).logit(),
        ((surfels.rgb - 0.5) / C0)[:, None],
    )


def _spacing(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the mean distance of each point from its neighbours (metres), within reason."""
    most = min(NEIGHBOURS + 1, len(points))
    if most < 2:
        raise InputError("a surface of one surfel", expected="more from which to make a splat")
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=most)
    found = torch.from_numpy(np.asarray(distances[:, 1:].mean(-1), dtype=np.float32))
    middle = float(found.median()) or float(found.max()) or 1.0
    return found.clamp(middle / WIDEST, middle * WIDEST)
