"""Maps as meshes: where the surface is, closed where it is closed, right side out, and in the frame of the map when read back."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from bidnerf import ImportOptions, Map, export_map, import_map
from bidnerf.results import read_pose
from bidnerf.testing import BOUNDS, textured_map, training_views
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import stored_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3, look_at, sphere
from bidnerf_core.mapping import SurfaceMap, surface_of_points
from bidnerf_core.maps import MapInfo
from bidnerf_scan import meshing, read_scan
from bidnerf_scan.meshing import Mesh, mesh_of_surface

CAMERA = Intrinsics(40.0, 40.0, 16.0, 16.0, 32, 32)
AROUND = SceneBounds((-2.0,) * 3, (2.0,) * 3, 0.01, 10.0)


def surface(points: torch.Tensor, eyes: torch.Tensor) -> SurfaceMap:
    """Return a surface whose colours are its coordinates, as cameras at ``eyes`` saw it."""
    poses = [look_at(eye.tolist(), [0.0, 0.0, 0.0], (0.0, 0.1, 1.0)) for eye in eyes]
    return surface_of_points(points, points / 2 + 0.5, AROUND, [(CAMERA, T) for T in poses])


def units(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=-1)


def trimesh_of(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.points, mesh.faces, process=False)


@pytest.mark.parametrize(("far", "side"), [(3.0, 1), (0.1, -1)])
def test_a_sphere_is_closed_and_its_outside_is_where_the_cameras_are(far: float, side: int) -> None:
    mesh = mesh_of_surface(surface(sphere(3000).float(), far * units(12, 1)))
    found = trimesh_of(mesh)
    assert found.is_watertight
    assert found.body_count == 1
    assert found.volume == pytest.approx(side * 4 / 3 * np.pi, rel=0.02)
    assert np.abs(np.linalg.norm(mesh.points, axis=-1) - 1).max() < 0.5 * mesh.cell
    assert (side * (mesh.normals * mesh.points).sum(-1)).min() > 0.95
    assert np.abs(mesh.rgb - (mesh.points / 2 + 0.5)).max() < 0.05


def test_a_plane_ends_where_its_surfels_end() -> None:
    generator = torch.Generator().manual_seed(0)
    flat = 2 * torch.rand((6000, 3), generator=generator) - 1
    flat[:, 2] = 0.3 * flat[:, 0]
    mesh = mesh_of_surface(surface(flat, torch.tensor([[0.2, 0.1, 2.0], [-0.3, 0.0, 2.5]])))
    found = trimesh_of(mesh)
    assert found.area == pytest.approx(4 * np.sqrt(1.09), rel=0.1)
    assert np.abs(mesh.points[:, 2] - 0.3 * mesh.points[:, 0]).max() < 0.1 * mesh.cell
    assert np.abs(mesh.points[:, :2]).max() < 1 + 3 * mesh.cell
    assert found.face_normals[:, 2].min() > 0  # towards the cameras


def test_the_mesh_does_not_depend_on_where_its_blocks_are(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = surface(sphere(3000).float(), 3 * units(12, 1))
    first = mesh_of_surface(ball)
    monkeypatch.setattr(meshing, "BLOCK", 7)
    second = mesh_of_surface(ball)
    order, other = (np.lexsort(m.points.round(9).T) for m in (first, second))
    assert len(first.faces) == len(second.faces)
    assert np.allclose(first.points[order], second.points[other], atol=1e-5)


@pytest.fixture(scope="module")
def scene() -> Map:
    known = textured_map(surface=True)
    info = MapInfo("ground", {}, BOUNDS, 1, True, "ground", cameras=stored_cameras(training_views()))
    turned = replace(info, gravity_up=(0.0, 0.6, 0.8), unit="metres")
    return Map(turned, known.field, known.surface, known.landmarks)


@pytest.mark.parametrize("ending", ["ply", "glb", "obj"])
def test_the_importer_reads_the_mesh_in_the_frame_and_unit_of_the_map(scene: Map, tmp_path: Path, ending: str) -> None:
    files = {file.name: file for file in export_map(scene, tmp_path / "out", f"mesh.{ending}")}
    scan = read_scan(files[f"mesh.{ending}"])
    pose = files.get("T_world_file.json")
    T = SE3.identity() if pose is None else read_pose(pose)
    points = T.apply(torch.from_numpy(scan.points)).float()
    assert float(scene.surface.distance(points).max()) < 3 * scene.surface.cell
    nearest = scene.surface.nearest(points)
    assert float((torch.from_numpy(scan.rgb) - scene.surface.surfels.rgb[nearest]).abs().mean()) < 0.1
    content = files[f"mesh.{ending}"].read_bytes()
    assert b"triangles, on a grid with cells of" in content
    assert b"lengths in metres" in content
    if ending == "obj":
        assert all(line[:2] in (b"# ", b"v ", b"vn", b"f ") for line in content.splitlines() if line)
    assert (b"turned so that y is upwards" in content) == (pose is not None)
    if pose is not None:  # these formats have y upwards
        assert T.rotation[:, 1].tolist() == pytest.approx([0, 0.6, 0.8])
    found = import_map(files[f"mesh.{ending}"], bake=False, options=ImportOptions(T_world_file=T))
    for own, other in zip(scene.info.cameras, found.info.cameras, strict=True):
        assert own.name == other.name
        assert torch.allclose(own.pose.matrix(), other.pose.matrix(), atol=1e-9)


def test_a_new_mesh_replaces_those_whose_cameras_are_turned_otherwise(scene: Map, tmp_path: Path) -> None:
    export_map(scene, tmp_path, "mesh.glb", overwrite=True)
    export_map(scene, tmp_path, "mesh.ply", overwrite=True)
    assert {file.name for file in tmp_path.iterdir()} == {"mesh.ply", "cameras.json"}


def test_what_gives_no_mesh(scene: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=re.escape("has no surface, from which a mesh could be made; 'bidnerf bake'")):
        export_map(replace(scene, surface=None), tmp_path / "out", "mesh.ply")
    with pytest.raises(InputError, match="without keyframes"):
        mesh_of_surface(surface(units(500, 0), torch.zeros(0, 3)))
    with pytest.raises(InputError, match="expected more"):
        mesh_of_surface(surface(units(5, 0), 3 * units(2, 1)))
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(
        InputError,
        match=re.escape("making a mesh of a surface needs a missing package: pip install 'scikit-image'"),
    ):
        export_map(scene, tmp_path / "out", "mesh.ply")
    assert not (tmp_path / "out").exists()
