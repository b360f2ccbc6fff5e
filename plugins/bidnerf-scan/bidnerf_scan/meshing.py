"""Meshes of surfaces made of surfels: the zero level of a signed distance, found by marching cubes.

The distance of a place is the weighted mean of its distances to the tangent planes of the nearest surfels (Kolluri 2005,
"Provably good moving least squares"; with the single nearest one, Hoppe et al. 1992, "Surface reconstruction from
unorganized points"). It is positive on the side of the cameras. Only cells near surfels are evaluated, block by block, so memory
grows with the area of the surface and not with the volume of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.mapping import SurfaceMap, cast
from bidnerf_scan.extras import library

NEIGHBOURS = 8
"""Number of surfels whose planes are averaged."""
SPACED = 4
"""Number of neighbours of a surfel whose mean distance is the spacing there: as many as in a square tiling."""
WIDTH = 1.0
"""Standard deviation of the weights over the distance, in units of the spacing."""
BLOCK = 16
"""Cells along the side of a block."""
LEAST = 4e-3
"""Smallest distance at a corner of a cell, in units of the cell, so that no vertex of the mesh lies on a corner."""
AT_ONCE = 1 << 16
"""Number of surfels whose sights are traced at once."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh with colours. World frame, metres; its faces turn counterclockwise as seen by the cameras."""

    points: Float64[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]  # unit, towards the cameras
    rgb: Float32[np.ndarray, "n 3"]  # in [0, 1]
    faces: Int64[np.ndarray, "m 3"]
    cell: float  # side of the cells of the grid


def mesh_of_surface(surface: SurfaceMap) -> Mesh:
    """Return a mesh of a surface on a grid whose cells are as large as the surfels are apart.

    It ends where the surfels end. Raises ``InputError`` for a surface of too few surfels, and for one without keyframes.
    """
    distance = SignedDistance.of(surface)
    cell, places, faces, count = distance.spacing, [], list[Int64[np.ndarray, "m 3"]](), 0
    for found, corners in _blocks(distance, cell):
        places.append(found)
        faces.append(corners + count)
        count += len(found)
    if not places:
        raise InputError("its surface has no place on whose two sides the distance differs in sign")
    vertices, triangles = _joined(np.concatenate(places), np.concatenate(faces))
    points = cell * vertices
    return Mesh(points, *distance.shading(points), triangles, cell)


@dataclass(frozen=True, eq=False)
class SignedDistance:
    """The signed distance from the surface, positive on the side of the cameras, with the surface's colour."""

    tree: cKDTree
    normals: Float[Tensor, "n 3"]  # towards the cameras
    rgb: Float[Tensor, "n 3"]
    rgb_gradient: Float[Tensor, "n 3 3"]
    spacing: float  # metres

    @staticmethod
    def of(surface: SurfaceMap) -> SignedDistance:
        """Prepare the distance from a surface on the CPU."""
        surfels = surface.surfels
        if len(surfels) <= NEIGHBOURS:
            raise InputError(f"a surface of {len(surfels)} surfels", expected="more from which to make a mesh")
        tree = cKDTree(surfels.positions.double().numpy())
        away, near = tree.query(tree.data, k=NEIGHBOURS, workers=-1)
        spacing = float(np.median(away[:, 1 : SPACED + 1]))
        normals = facing_cameras(surface, torch.from_numpy(near))
        return SignedDistance(tree, normals, surfels.rgb, surfels.rgb_gradient, spacing)

    def near(self, points: Float64[np.ndarray, "p 3"], reach: float) -> Float64[np.ndarray, "p"]:
        """Return the distances (metres), NaN where no surfel is within ``reach`` (metres)."""
        found = np.full(len(points), np.nan)
        nearest, _ = self.tree.query(points, distance_upper_bound=reach, workers=-1)
        some = np.isfinite(nearest)
        if some.any():
            _, offsets, weights, normals = self._around(points[some])
            found[some] = (weights * (offsets * normals).sum(-1)).sum(-1).numpy()
        return found

    def shading(
        self, points: Float64[np.ndarray, "p 3"]
    ) -> tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, "p 3"]]:
        """Return the unit normals and the colours of the surface at places on it."""
        index, offsets, weights, normals = self._around(points)
        normal = torch.nn.functional.normalize((weights[..., None] * normals).sum(1), dim=-1)
        rgb = self.rgb[index] + (self.rgb_gradient[index] @ offsets[..., None].float())[..., 0]
        return normal.float().numpy(), (weights[..., None] * rgb).sum(1).clamp(0, 1).float().numpy()

    def _around(self, points: Float64[np.ndarray, "p 3"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the indices (p k) of the surfels around places, the offsets from them, their weights and normals."""
        away, near = self.tree.query(points, k=NEIGHBOURS, workers=-1)
        index, distance = torch.from_numpy(near), torch.from_numpy(away)
        offsets = torch.from_numpy(points[:, None] - self.tree.data[near])
        weights = torch.softmax(-0.5 * (distance / (WIDTH * self.spacing)).square(), dim=-1)
        return index, offsets, weights, self.normals[index]


def facing_cameras(surface: SurfaceMap, near: Int64[Tensor, "n k"]) -> Float64[Tensor, "n 3"]:
    """Return the surfels' normals, turned towards the keyframes that have them in sight.

    ``near`` holds the indices of each surfel's neighbours, itself first. They vote together, and where none of them is in
    sight, the side is that of neighbours beyond.
    """
    normals = surface.surfels.normals.double()
    vote = torch.cat([_facing(surface, start, start + AT_ONCE) for start in range(0, len(normals), AT_ONCE)])
    alike = (normals[near] * normals[:, None]).sum(-1)
    own = vote = (alike * vote[near]).median(-1).values  # without those of rays through a gap of the surface
    for _ in range(20):  # the votes on the side of the cameras spread to the neighbours
        vote = own + (alike * vote[near]).mean(-1)
    vote = vote.sign()
    unknown = vote == 0
    while bool(unknown.any()):
        own = unknown.nonzero()[:, 0]
        vote[own] = (alike[own] * vote[near[own]]).sum(-1).sign()
        unknown, before = vote == 0, unknown
        if torch.equal(unknown, before):  # an island that no camera sees
            vote[unknown] = 1.0
            break
    return normals * vote[:, None]


def _facing(surface: SurfaceMap, start: int, end: int) -> Float64[Tensor, "n"]:
    """Return the sums of the cosines at which surfels are in sight, positive on the side to which their normals point."""
    cameras = surface.keyframes[:, :3, 3].double()
    if not len(cameras):
        raise InputError("a surface without keyframes, which tell its outside; 'bidnerf bake' stores some")
    positions = surface.surfels.positions[start:end].double()
    # A surfel is looked for from the nearest keyframes only.
    count = min(8, len(cameras))
    _, near = cKDTree(cameras.numpy()).query(positions.numpy(), k=range(1, count + 1))
    origins = cameras[torch.from_numpy(near)]
    away = torch.linalg.vector_norm(positions[:, None] - origins, dim=-1).clamp(min=1e-12)
    directions = (positions[:, None] - origins) / away[..., None]
    cosine = -(directions * surface.surfels.normals[start:end, None]).sum(-1)
    met = cast(surface, origins.float().reshape(-1, 3), directions.float().reshape(-1, 3))
    # A ray hits a surfel within its radius, and the earlier, the more it grazes the surface.
    along = torch.where(met.met, met.along, torch.inf).view(away.shape)
    # A ray that meets a surfel at too small an angle to its plane does not tell the surfel's sides apart.
    in_sight = (cosine.abs() > 0.3) & (along > away - 2 * surface.surfel_radius / cosine.abs())
    return torch.where(in_sight, cosine, 0).sum(-1)


def _blocks(
    distance: SignedDistance, cell: float
) -> Iterator[tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "m 3"]]]:
    """Yield the vertices, in units of cells, and the faces of each block with some."""
    measure = library("skimage.measure", "making a mesh of a surface", "scikit-image")
    # The mesh extends as far beyond a surfel as the surfels are apart.
    reach = distance.spacing + math.sqrt(3) * cell
    box = reach * np.array(np.meshgrid(*3 * [[-1, 1]])).reshape(3, -1).T
    side = BLOCK * cell
    found = [np.floor((distance.tree.data + corner) / side).astype(np.int64) for corner in box]
    nodes = np.indices(3 * (BLOCK + 1,)).reshape(3, -1).T
    for block in np.unique(np.concatenate(found), axis=0):
        values = distance.near(cell * (BLOCK * block + nodes), reach).reshape(3 * (BLOCK + 1,)) / cell
        values = np.where(np.abs(values) < LEAST, np.copysign(LEAST, values), values)
        cells = _crossed(values)
        if cells.any():
            mask = np.zeros(values.shape, dtype=bool)
            mask[1:, 1:, 1:] = cells  # it masks cells by their upper corners
            vertices, corners, _, _ = measure.marching_cubes(
                np.nan_to_num(values, nan=1.0), 0.0, gradient_direction="descent", mask=mask
            )
            yield BLOCK * block + vertices.astype(np.float64), corners.astype(np.int64)


def _crossed(values: Float64[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x-1 y-1 z-1"]:
    """Return which cells have values of both signs at their corners, all of which are known."""
    ends = slice(None, -1), slice(1, None)
    corners = np.stack([values[x, y, z] for x in ends for y in ends for z in ends])
    return (corners > 0).any(0) & (corners < 0).any(0) & np.isfinite(corners).all(0)


def _joined(
    places: Float64[np.ndarray, "n 3"], faces: Int64[np.ndarray, "m 3"]
) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "m 3"]]:
    """Merge the vertices that neighbouring blocks have on the same edge of the grid."""
    lower = np.floor(places)
    between = (places - lower > LEAST / 100) & (lower + 1 - places > LEAST / 100)
    edge = np.concatenate([np.where(between, lower, np.round(places)), between], axis=-1).astype(np.int64)
    _, first, index = np.unique(edge, axis=0, return_index=True, return_inverse=True)
    return places[first], index.reshape(-1)[faces]
