"""The contents of a scan: points or vertices, and the faces between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bidnerf_core.errors import InputError


@dataclass(frozen=True, eq=False)
class Scan:
    """A point cloud (without faces) or a mesh, in the coordinates of its file."""

    points: NDArray[np.float64]  # (n, 3): points of a cloud, vertices of a mesh
    rgb: NDArray[np.float32] | None = None  # (n, 3), in [0, 1]; None if the file holds no colours
    faces: NDArray[np.int64] | None = None  # (m, 3): triangles; None for a cloud
    uv: NDArray[np.float32] | None = None  # (m, 3, 2): place of each corner in its texture, v upwards
    image: NDArray[np.int64] | None = None  # (m,): index of each triangle's texture; -1 if it has none
    images: tuple[NDArray[np.uint8], ...] = ()  # textures, (h, w, 3)

    @property
    def has_colours(self) -> bool:
        """Whether any colours are known."""
        return self.rgb is not None or bool(self.images)


def cleaned(scan: Scan, where: str) -> tuple[Scan, str]:
    """Return the usable part of a scan, and a text that says what was left out, empty if nothing was.

    Raises ``InputError``, whose message begins with ``where``, if nothing is left.
    """
    if not len(scan.points):
        raise InputError("holds no points", where=where, expected="a mesh or a point cloud")
    # A point with larger coordinates counts as broken.
    good = np.asarray(np.all(np.isfinite(scan.points) & (np.abs(scan.points) < 1e12), axis=-1))
    left = {"points with coordinates that are not finite": int((~good).sum())}
    rgb = None if scan.rgb is None else np.nan_to_num(scan.rgb, nan=0.5).clip(0, 1)
    if scan.faces is None:
        points, rgb = scan.points[good], None if rgb is None else rgb[good]
        if not len(points):
            raise InputError(f"none of its {len(good):,} points has finite coordinates", where=where)
        _, first = np.unique(points, axis=0, return_index=True)
        left["duplicate points"] = len(points) - len(first)
        first.sort()
        if len(first) < 3:  # which define a plane
            raise InputError(f"{len(first)} distinct points", where=where, expected="at least three")
        return Scan(points[first], None if rgb is None else rgb[first]), _listed(left)
    exists = np.asarray(np.all((scan.faces >= 0) & (scan.faces < len(scan.points)), axis=-1))
    whole = exists.copy()
    whole[exists] = good[scan.faces[exists]].all(-1)
    corners = scan.points[np.where(whole[:, None], scan.faces, 0)]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.maximum((a * a).sum(-1), (b * b).sum(-1))
    with np.errstate(invalid="ignore"):
        has_area = np.linalg.norm(np.cross(a, b), axis=-1) > 1e-7 * longest
    kept = whole & has_area
    left["faces with corners that do not exist"] = int((~whole).sum())
    left["faces without an area"] = int((whole & ~has_area).sum())
    if not kept.any():
        raise InputError(f"none of its {len(kept):,} faces has three finite corners and an area", where=where)
    part = replace(
        scan,
        points=np.where(good[:, None], scan.points, 0.0),
        rgb=rgb,
        faces=scan.faces[kept],
        uv=None if scan.uv is None else np.nan_to_num(scan.uv[kept]),
        image=None if scan.image is None else scan.image[kept],
    )
    return part, _listed(left)


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)


def colours_of(rows: NDArray, *names: tuple[str, str, str]) -> NDArray[np.float32] | None:
    """Return the colours (n, 3) in [0, 1] of points with any of ``names``; None if they have none."""
    found = next((three for three in names if set(three) <= set(rows.dtype.names or ())), None)
    if found is None:
        return None
    rgb = np.stack([rows[name] for name in found], axis=-1)
    # The type states the range, however dark the colours are.
    return rgb.astype(np.float32) / np.float32(65535) if rgb.dtype == np.uint16 else in_unit_range(rgb)


def in_unit_range(rgb: NDArray) -> NDArray[np.float32]:
    """Return colours in [0, 1]; their type and largest value tell whether they are in units of 1, 255 or 65535."""
    largest = np.nanmax(rgb) if rgb.size else 0
    whole = 65535 if largest > 255 else 255 if rgb.dtype.kind in "ui" or largest > 1.5 else 1
    return rgb.astype(np.float32) / np.float32(whole)


def joined(scans: Sequence[Scan]) -> Scan:
    """Merge several meshes or clouds into one. Meshes without colours become grey if others have some."""
    if len(scans) == 1:
        return scans[0]
    points = np.concatenate([scan.points for scan in scans])
    rgb = None
    if any(scan.rgb is not None for scan in scans):
        grey = [np.full((len(s.points), 3), 1.0 if s.images else 0.5, np.float32) for s in scans]
        rgb = np.concatenate([g if s.rgb is None else s.rgb for s, g in zip(scans, grey, strict=True)])
    if scans[0].faces is None:
        return Scan(points, rgb)
    faces, uv, image, images, before = [], [], [], list[NDArray[np.uint8]](), 0
    for scan in scans:
        assert scan.faces is not None
        count = len(scan.faces)
        faces.append(scan.faces + before)
        uv.append(np.zeros((count, 3, 2), np.float32) if scan.uv is None else scan.uv)
        number = np.full(count, -1) if scan.image is None else scan.image
        image.append(np.where(number >= 0, number + len(images), -1))
        images += scan.images
        before += len(scan.points)
    return Scan(points, rgb, np.concatenate(faces), np.concatenate(uv), np.concatenate(image), tuple(images))
