"""A COLMAP sparse model of views whose depth is known, written in its text format, in a world and a unit of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.frames import View, all_pixels, observe
from bidnerf_core.geometry import SE3
from optional import require

UNIT = 0.37
"""Metres that one of the model is long."""
T_MODEL_WORLD = SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.4, -1.1, 0.7], dtype=torch.float64))
GOOD, BAD = 0.5, 9.0
"""Reprojection errors, pixels."""


@dataclass(frozen=True, eq=False)
class Known:
    """What a model is made of, in metres of the world."""

    views: Sequence[View]
    names: Sequence[str]  # of the model's images
    points: torch.Tensor  # (p 3)
    seen: list[torch.Tensor]  # for each view, which of the points it observes
    wrong: int  # of the last points: a good one moved towards the origin, with a large error

    def truth(self, view: int) -> torch.Tensor:
        """The good points that a view observes, in its camera's frame."""
        seen = self.seen[view]
        return self.views[view].T_ref_camera.inverse().apply(self.points[seen[seen < self.good]])

    @property
    def good(self) -> int:
        return len(self.points) - self.wrong


def known(views: Sequence[View], names: Sequence[str], each: int = 12, wrong: int = 3, agree: float = 0.01) -> Known:
    """About ``each`` points of each view's depth; others see them whose depth there is the same but for ``agree``."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for view in views:
        pixels = observe(view, all_pixels(view.frame), torch.float64)
        measured = (pixels.distance > 0).nonzero()[:, 0]
        some = measured[torch.randperm(len(measured), generator=generator)[:each]]
        found.append(pixels.origins[some] + pixels.distance[some, None] * pixels.directions[some])
    points = torch.cat(found)
    seen = [_sees(view, points, agree) for view in views]
    twice = (torch.stack(seen).sum(0) > 1).nonzero()[:, 0]
    seen = [torch.cat([s[twice], torch.full((wrong,), True)]).nonzero()[:, 0] for s in seen]
    return Known(views, names, torch.cat([points[twice], 0.3 * points[twice][:wrong]]), seen, wrong)


def _sees(view: View, points: torch.Tensor, agree: float) -> torch.Tensor:
    camera, depth = view.frame.intrinsics, view.frame.depth
    there = view.T_ref_camera.inverse().apply(points)
    column, row = camera.project(there).nan_to_num(-1).floor().long().unbind(-1)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    z = require(depth)[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)].double()
    return inside & ((z - there[:, 2]).abs() < agree * z)


def write(folder: Path, what: Known) -> Path:
    """Write the model of what is known, in its own world and unit, and return its folder."""
    camera, images = what.views[0].frame.intrinsics, []
    size = f"{camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
    tracks = [list[str]() for _ in what.points]
    for number, (view, name, seen) in enumerate(zip(what.views, what.names, what.seen, strict=True), start=1):
        there = view.T_ref_camera.inverse().apply(what.points[seen])
        pixels = camera.project(there).nan_to_num(1.0).tolist()
        observed = [f"{u} {v} {p + 1}" for (u, v), p in zip(pixels, seen.tolist(), strict=True)]
        for place, p in enumerate(seen.tolist(), start=1):
            tracks[p].append(f"{number} {place}")
        T_model_camera = T_MODEL_WORLD @ view.T_ref_camera.to(torch.float64)
        T_model_camera = SE3(T_model_camera.rotation, T_model_camera.translation / UNIT)
        keypoints = " ".join(["1.5 2.5 -1", *observed])  # the first became no point
        images.append((name, 1, T_model_camera, keypoints))
    rows = []
    points = T_MODEL_WORLD.apply(what.points) / UNIT
    for p, (point, track) in enumerate(zip(points.tolist(), tracks, strict=True)):
        error = GOOD if p < what.good else BAD
        rows.append(" ".join([str(p + 1), *map(repr, point), "9 8 7", str(error), *track]))
    return write_model(folder, [f"1 PINHOLE {size}"], images, rows)


def write_model(
    folder: Path,
    cameras: Sequence[str],
    images: Sequence[tuple[str, int, SE3, str]],
    points: Sequence[str] = (),
) -> Path:
    """Write a model in the text format of COLMAP's documentation and return its folder.

    An image is its name, the number of its camera, ``T_model_camera``, and its row of keypoints.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for number, (name, camera, T_model_camera, keypoints) in enumerate(images, start=1):
        T = T_model_camera.inverse()
        x, y, z, w = Rotation.from_matrix(T.rotation.numpy()).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *T.translation))
        rows += [f"{number} {pose} {camera} {name}", keypoints]
    for file, lines in (
        ("cameras", ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *cameras]),
        ("images", rows),
        ("points3D", ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", *points]),
    ):
        (folder / f"{file}.txt").write_text("\n".join(lines) + "\n")
    return folder


def to_binary(model: Path) -> Path:
    """Replace the text files of a model by the binary ones that pycolmap writes, and return its folder."""
    import pycolmap

    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for file in model.glob("*.txt"):
        file.unlink()
    return model
