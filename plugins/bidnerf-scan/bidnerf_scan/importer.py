"""The importer of meshes and point clouds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.captures import StoredCamera, cameras_beside
from bidnerf_core.errors import InputError
from bidnerf_core.fields import Rays, SceneBounds
from bidnerf_core.geometry import Similarity
from bidnerf_core.maps import UNMOVED, ImportedField, bounds_about
from bidnerf_core.settings import Range, Settings
from bidnerf_scan.field import ScanField
from bidnerf_scan.formats import Format, format_of
from bidnerf_scan.pieces import GREY, Pieces, cloud_pieces, mesh_pieces, spacing, thinned
from bidnerf_scan.recipe import config_of
from bidnerf_scan.scan import Scan, cleaned

UPS = {
    "+x": (1, 0, 0),
    "-x": (-1, 0, 0),
    "+y": (0, 1, 0),
    "-y": (0, -1, 0),
    "+z": (0, 0, 1),
    "-z": (0, 0, -1),
}
Up = Literal["format", "+x", "-x", "+y", "-y", "+z", "-z"]
SURFACE_POINTS = 300_000
"""Number of points sampled uniformly on a mesh, which form its surface and determine its extent."""
TRIED = 4000
"""Number of rays used to distinguish a solid object from a room."""
MOSTLY = 0.9


@dataclass(frozen=True)
class ScanSettings(Settings):
    """Settings that a file does not contain."""

    # upward axis in the file's coordinates; by default that of the format's convention
    up: Up = "format"
    # place in the file's coordinates that becomes the origin, before scaling: surveys have coordinates of
    # millions of metres
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # largest number of discs: larger clouds are thinned on a grid
    points: Annotated[int, Range(3, 10**8)] = 1_000_000
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # colour (rgb) where a ray hits nothing


@dataclass(frozen=True)
class ScanImporter:
    """Reads meshes and point clouds in all formats."""

    summary: str = "meshes and point clouds: .ply, .obj, .glb, .gltf, .pcd, .las, .laz, .e57"
    config_type: type = ScanSettings

    def recognises(self, path: Path) -> bool:
        """Return whether the file is one of the formats."""
        try:
            return format_of(path) is not None
        except OSError:
            return False

    def read(self, path: Path, config: ScanSettings, placement: Similarity) -> ImportedField:
        """Read the mesh or cloud in a file as a field, see ``Importer``."""
        found = format_of(path)
        if found is None:
            raise InputError("not a readable mesh or point cloud", where=path, expected=self.summary)
        return imported(found.read(path), str(path), config, placement, found, cameras_beside(path, placement))


def imported(
    scan: Scan,
    where: str,
    config: ScanSettings = ScanSettings(),
    placement: Similarity = UNMOVED,
    of: Format | None = None,
    cameras: tuple[StoredCamera, ...] = (),
) -> ImportedField:
    """Build a field from a scan of any source. Raises ``InputError`` if nothing in it can be rendered."""
    kept, dropped = cleaned(scan, where)
    points = placement.apply(torch.from_numpy(kept.points - np.array(config.origin)).double())
    used = points if kept.faces is None else points[torch.from_numpy(kept.faces).unique()]
    _check_precision(used, where, config)
    facts = [_counts(scan) + (f" ({of.name})" if of else "")]
    if dropped:
        facts.append(f"left out {dropped}")
    if not scan.has_colours:
        facts.append(
            "no colours: it gives no landmarks, and poses are found from its shape alone, which needs"
            " images with depth and is seldom accepted (`photos` gives landmarks)"
        )
    colours: Tensor | None = None
    if kept.faces is None:
        rgb = None if kept.rgb is None else torch.from_numpy(kept.rgb)
        few, rgb = thinned(points, rgb, config.points)
        if len(few) < len(points):
            facts.append(f"thinned from {len(points):,} to {len(few):,} points (`points`)")
        pieces = cloud_pieces(few, rgb)
        matter = few.float()
        colours = None if rgb is None else rgb.float()
        facts.append(f"points about {spacing(pieces):.3g} apart")
    else:
        pieces = mesh_pieces(kept, points)
        matter = surface_points(pieces)
    bounds = _bounds(matter, config.background, spacing(pieces))
    settings = replace(config_of(pieces), steps=1, thickness=spacing(pieces))
    field = ScanField(settings, bounds)
    field.assign(pieces)
    solid = kept.faces is not None and is_solid(field)
    if solid:
        facts.append("its faces all point outwards: a solid object, seen from outside")
    axis = ("+z" if of is None else of.up) if config.up == "format" else config.up
    facts.append(
        f"axes: {axis[1]} {'up' if axis[0] == '+' else 'down'}"
        + (", as said" if config.up != "format" else f", {of.convention}" if of else "")
        + (f"; {config.origin} is the origin" if any(config.origin) else "")
    )
    up = placement.T_target_source.rotation.double() @ torch.tensor(UPS[axis], dtype=torch.float64)
    return ImportedField(
        "scan",
        settings,
        dict(field.state_dict()),
        bounds,
        found=tuple(facts),
        steps=settings.steps,
        points=matter,
        up=(float(up[0]), float(up[1]), float(up[2])),
        surface=(matter, torch.full_like(matter, GREY) if colours is None else colours),
        is_coloured=scan.has_colours,
        is_solid=solid,
        cameras=cameras,
    )


@torch.no_grad()
def is_solid(field: ScanField) -> bool:
    """Return whether a mesh is a model of an object: rays from within hit the backs of its faces, unlike in a room.

    If faces point to either side at random, or few rays from within the box hit any, it counts as not solid.
    """
    bounds, generator = field.bounds, torch.Generator().manual_seed(0)
    lower, size = torch.tensor(bounds.lower), torch.tensor(bounds.size)
    origins = lower + size * torch.rand((TRIED, 3), generator=generator)
    directions = torch.nn.functional.normalize(torch.randn((TRIED, 3), generator=generator), dim=-1)
    near = torch.zeros(TRIED)
    piece, valid = field.met(Rays(origins, directions, near, near + bounds.far))
    opposite, other = field.met(Rays(origins, -directions, near, near + bounds.far))
    if not piece.shape[1] or not opposite.shape[1]:
        return False
    backs = []
    for index, way in ((piece[:, 0], directions), (opposite[:, 0], -directions)):
        normal = torch.linalg.cross(field.first[index], field.second[index])
        backs.append((normal * way).sum(-1) > 0)
    between = valid[:, 0] & other[:, 0]  # something is hit either way
    # Matter on two opposite sides of too few places in the box says nothing.
    if float(between.float().mean()) < 0.02:
        return False
    both = (backs[0] & backs[1])[between].float().mean()
    neither = (~backs[0] & ~backs[1])[between].float().mean()
    return float(both) > MOSTLY * float(both + neither) and float(both) > 0.5


def _counts(scan: Scan) -> str:
    if scan.faces is None:
        found = f"a cloud of {len(scan.points):,} points"
    else:
        found = f"a mesh of {len(scan.faces):,} triangles"
        if scan.images:
            found += f" with {len(scan.images)} texture{'s' if len(scan.images) > 1 else ''}"
    return found + (", with colours" if scan.rgb is not None else "")


def _check_precision(points: Float[Tensor, "n 3"], where: str, config: ScanSettings) -> None:
    """Raise ``InputError`` for coordinates so large that single precision does not resolve the scene."""
    middle = points.median(0).values
    side = float((points.quantile(0.9, dim=0) - points.quantile(0.1, dim=0)).max()) if len(points) < 2**24 else 0
    side = side or float((points.amax(0) - points.amin(0)).max())
    # A coordinate in single precision is rounded relatively by less than this, with some margin. Where that is
    # too coarse for the scene's longest side, the scan must be moved to the origin.
    rounding = 2.0**-22 * float(middle.abs().max())
    if rounding > 2e-4 * side:
        x, y, z = (round(o + float(m)) for o, m in zip(config.origin, middle, strict=True))
        raise InputError(
            f"its coordinates are around ({x}, {y}, {z}), which single precision resolves only to {rounding:.2g};",
            where=where,
            expected=f"a scan near the origin (`origin` {x} {y} {z} makes that place the origin)",
        )


def surface_points(pieces: Pieces) -> Float[Tensor, "n 3"]:
    """Return points (metres, world) distributed uniformly over the area of triangles."""
    piece, u, v = surface_places(pieces)
    return pieces.corner[piece] + u[:, None] * pieces.first[piece] + v[:, None] * pieces.second[piece]


def surface_places(
    pieces: Pieces,
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return points distributed uniformly over the area of triangles, as triangle indices, u and v. Deterministic."""
    area = torch.linalg.vector_norm(torch.linalg.cross(pieces.first, pieces.second), dim=-1).double()
    ends = area.cumsum(0) / area.sum().clamp(min=1e-300)
    generator = torch.Generator().manual_seed(0)
    places = (torch.arange(SURFACE_POINTS, dtype=torch.float64) + 0.5) / SURFACE_POINTS
    piece = torch.searchsorted(ends, places).clamp(max=len(area) - 1)
    u, v = torch.rand((2, SURFACE_POINTS), generator=generator)
    return piece, torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)


def _bounds(points: Float[Tensor, "n 3"], background: tuple[float, float, float], footprint: float) -> SceneBounds:
    """Return bounds that contain all points, unless a few of them are far away."""
    found = bounds_about(points, background, footprint)
    lower, upper = points.amin(0).double(), points.amax(0).double()
    # The box contains all points unless that makes it larger by half than a box around nearly all of them.
    if found.contracted or float((upper - lower).max()) > 1.5 * found.side:
        return found
    pad = 0.01 * float((upper - lower).max())
    low = torch.minimum(lower - pad, torch.tensor(found.lower, dtype=torch.float64)).tolist()
    high = torch.maximum(upper + pad, torch.tensor(found.upper, dtype=torch.float64)).tolist()
    return replace(found, lower=(low[0], low[1], low[2]), upper=(high[0], high[1], high[2]))


importer = ScanImporter()
"""Meshes and point clouds: .ply, .obj, .glb, .gltf, .pcd, .las, .laz, .e57"""
