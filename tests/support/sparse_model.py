"""A COLMAP sparse model of views whose depth is known, written in its text format, in a world and a unit of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.frames import View, all_pixels, observe
from bidnerf_core.geometry import SE3

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
    seen: list[
        torch.Tensor
    ]  # for each view, which of the points it observes, and of the wrong ones that follow them
    wrong: (
        int  # how many of the last points are wrong: a good one moved towards the origin, with a large error
    )

    def truth(self, view: int) -> torch.Tensor:
        """The good points that a view observes, in its camera's frame."""
        seen = self.seen[view]
        return self.views[view].T_ref_camera.inverse().apply(self.points[seen[seen < self.good]])

    @property
    def good(self) -> int:
        return len(self.points) - self.wrong


def known(
    views: Sequence[View], names: Sequence[str], each: int = 12, wrong: int = 3, agree: float = 0.01
) -> Known:
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
    false = torch.full((wrong,), True)
    seen = [torch.cat([s[twice], false]).nonzero()[:, 0] for s in seen]
    return Known(views, names, torch.cat([points[twice], 0.3 * points[twice][:wrong]]), seen, wrong)


def _sees(view: View, points: torch.Tensor, agree: float) -> torch.Tensor:
    camera, depth = view.frame.intrinsics, view.frame.depth
    assert depth is not None
    there = view.T_ref_camera.inverse().apply(points)
    column, row = camera.project(there).nan_to_num(-1).floor().long().unbind(-1)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    z = depth[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)].double()
    return inside & ((z - there[:, 2]).abs() < agree * z)


def write(folder: Path, what: Known) -> Path:
    """Write a model in the format of COLMAP's documentation and return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = what.views[0].frame.intrinsics
    size = f"{camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
    (folder / "cameras.txt").write_text(f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE {size}\n")
    images, tracks = ["# two lines an image\n"], [list[str]() for _ in what.points]
    for number, (view, name, seen) in enumerate(zip(what.views, what.names, what.seen, strict=True), start=1):
        T = _camera_model(view)
        x, y, z, w = Rotation.from_matrix(T.rotation.numpy()).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *T.translation))
        images.append(f"{number} {pose} 1 {name}\n")
        there = view.T_ref_camera.inverse().apply(what.points[seen])
        pixels = camera.project(there).nan_to_num(1.0).tolist()
        observed = [f"{u} {v} {p + 1}" for (u, v), p in zip(pixels, seen.tolist(), strict=True)]
        images.append(" ".join(["1.5 2.5 -1", *observed]) + "\n")  # a key point that became no point
        for place, p in enumerate(seen.tolist(), start=1):
            tracks[p].append(f"{number} {place}")
    (folder / "images.txt").write_text("".join(images))
    points = T_MODEL_WORLD.apply(what.points) / UNIT
    rows = []
    for p, (point, track) in enumerate(zip(points.tolist(), tracks, strict=True)):
        error = GOOD if p < what.good else BAD
        rows.append(" ".join([str(p + 1), *map(repr, point), "9 8 7", str(error), *track]) + "\n")
    (folder / "points3D.txt").write_text("".join(rows))
    return folder


def _camera_model(view: View) -> SE3:
    """Return the transform from the model's frame to the camera's, both in the model's unit."""
    T_model_camera = T_MODEL_WORLD @ view.T_ref_camera.to(torch.float64)
    return SE3(T_model_camera.rotation, T_model_camera.translation / UNIT).inverse()
