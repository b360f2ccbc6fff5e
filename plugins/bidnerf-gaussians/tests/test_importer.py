"""A file of Gaussians as a map: what is told, where it is put, and how wide its Gaussians are."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidnerf import ImportOptions, import_map, load_map
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import StoredCamera
from bidnerf_core.errors import InputWarning
from bidnerf_core.fields import render_image
from bidnerf_core.geometry import SE3, look_at
from bidnerf_gaussians import Gaussians, write_gaussians
from bidnerf_gaussians.importer import with_dilation

CAMERA = Intrinsics(40.0, 40.0, 16.0, 16.0, 32, 32)
EYE = look_at([0.5, -0.4, -4.0], [0.0, 0.0, 0.0], (0.0, -1.0, 0.0))
Some = Callable[..., Gaussians]


@pytest.fixture
def file(tmp_path: Path, some: Some) -> Path:
    path = tmp_path / "point_cloud.ply"
    g = some(400, 1)
    g.means[0, 0] = torch.nan
    write_gaussians(path, replace(g, logits=g.logits + 2))
    return path


def test_a_file_becomes_a_map(file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "bidnerf"):
        scene = import_map(file, tmp_path / "MAP", bake=False)
    assert "400 Gaussians, harmonics of degree 1 (PLY of splats)" in caplog.text
    assert "left out 1 with numbers that are not finite" in caplog.text
    assert scene.info.backend == "gaussians"
    again = load_map(tmp_path / "MAP")
    first, second = (render_image(m.field, CAMERA, EYE, m.bounds) for m in (scene, again))
    assert torch.equal(first.rgb, second.rgb)
    assert float(first.opacity.max()) > 0.9


def test_a_map_in_another_world(file: Path) -> None:
    """Moved with the field, a camera sees the same, at distances that are scaled."""
    T = SE3.exp(torch.tensor([1.0, -2, 0.5, 0.4, 1.1, -0.7], dtype=torch.float64))
    here = import_map(file, bake=False)
    there = import_map(file, bake=False, options=ImportOptions(scale=3.0, T_world_file=T))
    eye = SE3(T.rotation @ EYE.rotation, T.apply(3 * EYE.translation))
    first = render_image(here.field, CAMERA, EYE, replace(here.bounds, contracted=True))
    second = render_image(there.field, CAMERA, eye, replace(there.bounds, contracted=True))
    assert torch.allclose(first.rgb, second.rgb, atol=2e-3)
    assert torch.allclose(3 * first.depth, second.depth, atol=2e-2)


def test_the_cameras_beside_a_file_are_its_viewpoints(file: Path) -> None:
    entry = {
        "id": 0,
        "img_name": "a",
        "width": 64,
        "height": 48,
        "position": [1.0, 2, 3],
        "fx": 50.0,
        "fy": 51.0,
        "rotation": torch.eye(3).tolist(),
    }
    (file.parent / "cameras.json").write_text(json.dumps([entry]))
    (camera,) = import_map(file, bake=False, options=ImportOptions(scale=2.0)).info.cameras
    assert camera.intrinsics == Intrinsics(50.0, 51.0, 32.0, 24.0, 64, 48)
    assert camera.pose.translation.tolist() == [2, 4, 6]

    (file.parent / "cameras.json").write_text('{"another": "program\'s"}')
    with pytest.warns(InputWarning, match="ignored"):
        assert import_map(file, bake=False).info.cameras


def test_gaussians_are_as_wide_as_images_show_them(some: Some) -> None:
    """The first paper's code adds 0.3 square pixels to what a camera sees."""
    g = some(5)
    wide = with_dilation(g, 0.01, ())
    assert with_dilation(g, 0.0) is g
    added = (2 * wide.log_scales).exp() - (2 * g.log_scales).exp()
    assert torch.allclose(added[:, 0], added[:, 1], rtol=1e-3)
    assert float(added.min()) > 0
    alone = replace(g[:1], means=torch.zeros(1, 3))
    camera = import_camera([0.0, 0, -2])
    grown = (2 * with_dilation(alone, 0.01, (camera,)).log_scales).exp() - (2 * alone.log_scales).exp()
    assert float(grown[0, 0]) == pytest.approx(0.3 * (0.01 * 2) ** 2, rel=1e-3)
    assert math.isfinite(float(wide.log_scales.sum()))


def import_camera(position: list[float]) -> StoredCamera:
    pose = look_at(position, [0.0, 0, 0], (0.0, -1.0, 0.0)).matrix().tolist()
    return StoredCamera("a", CAMERA, tuple(tuple(row) for row in pose))  # type: ignore[arg-type]
