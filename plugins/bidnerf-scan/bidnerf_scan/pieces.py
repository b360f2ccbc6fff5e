"""Flat pieces of a surface: triangles of a mesh and discs around the points of a cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_scan.scan import Scan

NEIGHBOURS = 12
"""Number of points, including itself, to which the plane and colours of a disc are fitted."""
SPACED = 8
"""Neighbour whose distance measures the spacing of points."""
WIDER = 1.3
"""Radius of a disc in units of that distance: discs overlap enough that a surface of random points is opaque."""
OPAQUE = 8.0
"""Logit of the opacity of a triangle."""
DISC_OPACITY = 3.0
"""Logit of the opacity at the middle of a disc."""
AT_ONCE = 100_000
GREY = 0.5


@dataclass(frozen=True, eq=False)
class Textures:
    """Images on triangles, in one row of texels."""

    texels: UInt8[Tensor, "t 3"]
    shapes: Int[Tensor, "k 3"]  # of each image: its first texel, its width, its height
    image: Int[Tensor, "n"]  # index of a piece's image; -1 if it has none
    uv: Float[Tensor, "n 3 2"]  # at the corner, and its change along the first and second edge


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parallelograms ``corner + u first + v second`` in metres, in the world frame.

    A triangle is the part with ``u, v >= 0, u + v <= 1``, a disc that with ``u^2 + v^2 <= 1``.
    """

    corner: Float[Tensor, "n 3"]  # of a triangle; middle of a disc
    first: Float[Tensor, "n 3"]  # edge of a triangle; radius of a disc
    second: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3 3"]  # colour at the corner, and its change along the first and second edge
    logits: Float[Tensor, "n"]  # of the opacity
    is_round: Bool[Tensor, "n"]
    textures: Textures | None = None

    def __len__(self) -> int:
        return len(self.corner)


def mesh_pieces(scan: Scan, points: Float[Tensor, "v 3"]) -> Pieces:
    """Return the triangles of a mesh, whose vertices are at ``points`` (metres, world)."""
    assert scan.faces is not None
    faces = torch.from_numpy(scan.faces)
    corner, second, third = points[faces].float().unbind(1)
    rgb = torch.full((len(points), 3), GREY) if scan.rgb is None else torch.from_numpy(scan.rgb).float()
    if scan.rgb is None and scan.images:
        rgb = torch.ones_like(rgb)
    a, b, c = rgb[faces].unbind(1)
    return Pieces(
        corner,
        second - corner,
        third - corner,
        torch.stack([a, b - a, c - a], dim=1),
        torch.full((len(faces),), OPAQUE),
        torch.zeros(len(faces), dtype=torch.bool),
        _textures(scan),
    )


def _textures(scan: Scan) -> Textures | None:
    if not scan.images or scan.uv is None or scan.image is None:
        return None
    shapes, first = [], 0
    for image in scan.images:
        shapes.append((first, image.shape[1], image.shape[0]))
        first += image.shape[0] * image.shape[1]
    a, b, c = torch.from_numpy(scan.uv).float().unbind(1)
    texels = torch.from_numpy(np.concatenate([image.reshape(-1, 3) for image in scan.images]))
    return Textures(texels, torch.tensor(shapes), torch.from_numpy(scan.image), torch.stack([a, b - a, c - a], 1))


def cloud_pieces(points: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"] | None) -> Pieces:
    """Return a disc around each point (metres, world), in the plane of its neighbours and as wide as their distances.

    The colours of its neighbours give that of a disc, as a linear function within its plane (Park et al. 2017,
    eq. 10). There must be three points at least.
    """
    places = points.double().numpy()
    tree = cKDTree(places)
    known = torch.full((len(points), 3), GREY) if rgb is None else rgb
    parts = [
        _discs(points, known, tree, range(at, min(at + AT_ONCE, len(points)))) for at in range(0, len(points), AT_ONCE)
    ]
    first, second, colours = (torch.cat([part[i] for part in parts]) for i in range(3))
    radius = torch.linalg.vector_norm(first, dim=-1)
    # A point whose disc would be wider than four times the median is isolated.
    shrunk = (4.0 * radius.median() / radius.clamp(min=1e-30)).clamp(max=1)
    first, second = first * shrunk[:, None], second * shrunk[:, None]
    colours = torch.cat([colours[:, :1], colours[:, 1:] * shrunk[:, None, None]], dim=1)
    return Pieces(
        points.float(),
        first.float(),
        second.float(),
        colours.float(),
        torch.full((len(points),), DISC_OPACITY),
        torch.ones(len(points), dtype=torch.bool),
    )


def _discs(
    points: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"], tree: cKDTree, part: range
) -> tuple[Tensor, Tensor, Tensor]:
    """Return both radii (p 3) and the colours (p 3 3) of the discs around some points."""
    some = points.double()[part.start : part.stop]
    away, near = tree.query(some.numpy(), k=min(NEIGHBOURS, len(points)), workers=-1)
    index = torch.from_numpy(np.asarray(near, dtype=np.int64))
    count = index.shape[1]
    radius = torch.from_numpy(np.asarray(away))[:, min(SPACED, count - 1)].clamp(min=1e-12)
    radius = WIDER * radius * math.sqrt(SPACED / min(SPACED, count - 1))
    offsets = points.double()[index] - some[:, None]
    centred = offsets - offsets.mean(1, keepdim=True)
    _, axes = torch.linalg.eigh(centred.mT @ centred)
    first, second = axes[..., 2] * radius[:, None], axes[..., 1] * radius[:, None]
    # Colours are fitted in coordinates of the disc, in units of its radius, with slight regularization
    # against thin strips.
    flat = torch.stack([(offsets * edge[:, None]).sum(-1) for edge in (first, second)], -1)
    flat = flat / radius[:, None, None].square()
    ones = torch.ones_like(flat[..., :1])
    design = torch.cat([ones, flat], dim=-1)
    weight = 1 - 0.8 * flat.square().sum(-1, keepdim=True) / flat.square().sum(-1).amax(1)[:, None, None].clamp(
        min=1e-12
    )
    system = (weight * design).mT @ design
    system = system + 0.1 * torch.diag(torch.tensor([0.0, 1.0, 1.0], dtype=system.dtype))
    seen = (weight * design).mT @ rgb.double()[index]
    return first, second, torch.linalg.solve(system, seen)


def spacing(pieces: Pieces) -> float:
    """Return the mean distance (metres) of a cloud's points, from the radii of their discs, or 0 for a mesh."""
    if not len(pieces) or not bool(pieces.is_round.all()):
        return 0.0
    return float(torch.linalg.vector_norm(pieces.first, dim=-1).median()) / WIDER * math.sqrt(math.pi / SPACED)


def thinned(
    points: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"] | None, most: int
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"] | None]:
    """Return the means of points (metres) in cells of a grid that is as fine as ``most`` points allow."""
    if len(points) <= most:
        return points, rgb
    lower = points.amin(0)
    extent = float((points.amax(0) - lower).max())
    fine, coarse = extent / 2**20, extent
    for _ in range(18):  # halves the logarithm of the ratio of both sides
        cell = math.sqrt(fine * coarse)
        count = len(_cells(points, lower, cell).unique())
        fine, coarse = (cell, coarse) if count > most else (fine, cell)
    _, place, counts = _cells(points, lower, coarse).unique(return_inverse=True, return_counts=True)

    def mean(values: Tensor) -> Tensor:
        total = torch.zeros((len(counts), 3), dtype=torch.float64).index_add_(0, place, values.double())
        return (total / counts[:, None]).to(values.dtype)

    return mean(points), None if rgb is None else mean(rgb)


def _cells(points: Float[Tensor, "n 3"], lower: Float[Tensor, "3"], cell: float) -> Int[Tensor, "n"]:
    x, y, z = ((points - lower) / cell).long().clamp(0, 2**21 - 1).unbind(-1)
    return (x << 42) | (y << 21) | z
