"""Maps as splats: discs that render as the surface they were made from, and what a splat had before."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidnerf import Map, export_map, import_map
from bidnerf.testing import BOUNDS, textured_map, training_views
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import StoredCamera, stored_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.fields import render_image
from bidnerf_core.maps import MapInfo
from bidnerf_gaussians import Gaussians, read_gaussians, write_gaussians
from bidnerf_gaussians.quaternions import matrices
from bidnerf_gaussians.spherical_harmonics import C0


@pytest.fixture(scope="module")
def scene() -> Map:
    known = textured_map(surface=True)
    info = MapInfo("ground", {}, BOUNDS, 1, True, "ground", cameras=stored_cameras(training_views()))
    return Map(info, known.field, known.surface, known.landmarks)


@pytest.mark.parametrize("to", ["splat.ply", "splat.spz"])
def test_a_surface_is_as_opaque_and_as_far_away_as_splat(scene: Map, tmp_path: Path, to: str) -> None:
    files = export_map(scene, tmp_path / "out", to)
    assert [file.name for file in files] == ["cameras.json", to]
    found = import_map(files[1], config={"background": BOUNDS.background}, bake=False)
    view = training_views()[1]
    first, second = (
        render_image(each.field, view.frame.intrinsics, view.T_ref_camera, each.bounds) for each in (scene, found)
    )
    seen = (first.opacity > 0.99) & (second.opacity > 0.5)
    assert float(seen.float().mean()) > 0.9 * float((first.opacity > 0.99).float().mean())
    assert float(second.opacity[seen].median()) > 0.95
    assert float(((first.depth - second.depth).abs() / first.depth)[seen].median()) < 0.01
    # surfels are coarser than the texture, so their colours explain most of the image's variance, not all
    assert float((first.rgb - second.rgb)[seen].square().mean()) < 0.3 * float(first.rgb[seen].var(0).mean())


def test_discs_lie_in_the_surface(scene: Map, tmp_path: Path) -> None:
    export_map(scene, tmp_path / "out", "splat.ply")
    found = read_gaussians(tmp_path / "out" / "splat.ply")
    surfels = scene.surface.surfels
    assert torch.equal(found.means, surfels.positions)
    axes = matrices(found.quaternions)
    assert float((axes[:, :, 2] * surfels.normals).sum(-1).abs().min()) > 1 - 1e-5
    across = found.log_scales.exp()
    assert torch.allclose(across[:, 0], across[:, 1])
    assert bool((across[:, 2] < 0.2 * across[:, 0]).all())
    assert torch.allclose(0.5 + C0 * found.harmonics[:, 0], surfels.rgb, atol=1e-6)


def test_cameras_are_found_again(scene: Map, tmp_path: Path) -> None:
    files = export_map(scene, tmp_path / "out", "splat.ply")
    found = import_map(files[1], bake=False).info.cameras
    assert [camera.name for camera in found] == [camera.name for camera in scene.info.cameras]
    for own, other in zip(scene.info.cameras, found, strict=True):
        assert other.intrinsics == replace(own.intrinsics, cx=own.intrinsics.width / 2, cy=own.intrinsics.height / 2)
        assert torch.allclose(own.pose.matrix(), other.pose.matrix(), atol=1e-9)


def test_a_map_of_splats_keeps_its_own(some: Callable[..., Gaussians], tmp_path: Path) -> None:
    given = some(200, 2)
    write_gaussians(tmp_path / "given.ply", given)
    lens = Intrinsics(40.0, 40.0, 16.0, 16.0, 32, 32)
    config = {"pixel_angle": 0.0}
    scene = import_map(tmp_path / "given.ply", config=config, bake=False)
    rows = tuple((r[0], r[1], r[2], r[3]) for r in torch.eye(4).tolist())
    scene = replace(scene, info=replace(scene.info, cameras=(StoredCamera("a", lens, rows),)))
    export_map(scene, tmp_path / "out", "splat.ply")
    found = read_gaussians(tmp_path / "out" / "splat.ply")
    assert torch.equal(found.means, given.means)
    assert torch.equal(found.harmonics, given.harmonics)
    assert torch.allclose(found.log_scales, given.log_scales, atol=1e-6)

    export_map(scene.scaled(2.5, "metres"), tmp_path / "scaled", "splat.ply")
    scaled = read_gaussians(tmp_path / "scaled" / "splat.ply")
    assert torch.allclose(scaled.means, 2.5 * given.means, atol=1e-5)
    assert torch.allclose(scaled.log_scales.exp(), 2.5 * given.log_scales.exp(), rtol=1e-4)


def test_a_map_without_a_surface_gives_no_splat(scene: Map, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape("has no surface, from which a splat could be made")):
        export_map(replace(scene, surface=None), tmp_path / "out", "splat.ply")
    assert not (tmp_path / "out").exists()
