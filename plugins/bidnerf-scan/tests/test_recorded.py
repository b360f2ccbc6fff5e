"""Recorded images with depth, localized without a start in the fused depth of other images of the place."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bidnerf import Localizer, import_map, open_dataset
from bidnerf.results import pose_error
from bidnerf_core.frames import draw, uniform
from bidnerf_scan.pieces import thinned


def test_frames_with_depth_are_found_by_the_shape_of_a_cloud(tmp_path: Path) -> None:
    """Their poses are right, and no wrong one is accepted; without colours, most are not accepted at all."""
    folder = os.environ.get("BIDNERF_DATA")
    if not folder:
        pytest.skip("needs BIDNERF_DATA")
    dataset = open_dataset(Path(folder) / "room_living")
    names = dataset.frame_names("train")[::2]
    pixels = draw(dataset.views("train", names), 120_000, uniform, torch.Generator().manual_seed(0)).flattened()
    points = (pixels.origins + pixels.distance[:, None] * pixels.directions)[pixels.distance > 0]
    few, _ = thinned(points, None, 20_000)
    rows = few.numpy().astype("<f4")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    (tmp_path / "cloud.ply").write_bytes(head.encode() + b"end_header\n" + np.ascontiguousarray(rows).tobytes())
    scene = import_map(tmp_path / "cloud.ply")
    assert scene.landmarks is None
    localizer = Localizer(scene, "auto", {"rounds": 1})
    right = said = 0
    for view in dataset.views(
        "test", dataset.frame_names("test")[:: max(1, len(dataset.frame_names("test")) // 5)][:5]
    ):
        found = localizer(replace(view.frame))
        error = pose_error(found.T_world_camera, view.T_ref_camera)
        good = float(error.translation) < 0.05 and float(error.rotation_deg) < 5
        right, said = right + good, said + (found.converged and not good)
    assert right >= 4
    assert not said
