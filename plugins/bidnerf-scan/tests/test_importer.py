"""A scan as a map: what is told, where it is put, which way is up, and what is left out."""

from __future__ import annotations

import logging
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from bidnerf import ImportOptions, import_map, load_map
from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.fields import render_image
from bidnerf_core.geometry import SE3, look_at
from bidnerf_core.mapping import surface_of_points
from bidnerf_scan import Scan
from bidnerf_scan.importer import ScanSettings, imported

CAMERA = Intrinsics(40.0, 40.0, 16.0, 16.0, 32, 32)
EYE = look_at([0.5, -3.0, 1.0], [0.0, 0.0, 0.0], (0.0, 0.0, 1.0))


@pytest.fixture(autouse=True)
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("bidnerf_scan.importer"), "SURFACE_POINTS", 6000)


def box(scale: float = 1.0) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((1.0, 1.2, 0.8)).subdivide()
    mesh.apply_scale(scale)
    colours = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 4)).astype(np.uint8)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colours)
    return mesh


def test_a_mesh_becomes_a_map(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mesh = box()
    mesh.vertices[0] = np.nan
    (tmp_path / "box.ply").write_bytes(mesh.export(file_type="ply"))
    with caplog.at_level(logging.INFO, "bidnerf"):
        scene = import_map(tmp_path / "box.ply", tmp_path / "MAP", bake=False)
    assert "a mesh of 48 triangles, with colours (PLY)" in caplog.text
    assert "left out 1 points with coordinates that are not finite" in caplog.text
    assert "z up" in caplog.text
    again = load_map(tmp_path / "MAP")
    first, second = (render_image(m.field, CAMERA, EYE, m.bounds) for m in (scene, again))
    assert torch.equal(first.rgb, second.rgb)
    assert float(first.opacity.max()) > 0.99


def test_a_map_in_another_world(tmp_path: Path) -> None:
    """Moved with the scan, a camera sees the same, at distances that are scaled."""
    box().export(tmp_path / "box.glb")
    T = SE3.exp(torch.tensor([1.0, -2, 0.5, 0.4, 1.1, -0.7], dtype=torch.float64))
    here = import_map(tmp_path / "box.glb", bake=False)
    there = import_map(tmp_path / "box.glb", bake=False, options=ImportOptions(scale=3.0, T_world_file=T))
    eye = SE3(T.rotation @ EYE.rotation, T.apply(3 * EYE.translation))
    first = render_image(here.field, CAMERA, EYE, replace(here.bounds, contracted=True))
    second = render_image(there.field, CAMERA, eye, replace(there.bounds, contracted=True))
    assert torch.allclose(first.rgb, second.rgb, atol=1e-2)
    assert torch.allclose(3 * first.depth, second.depth, atol=1e-2)


def test_millimetres_are_suspected(tmp_path: Path) -> None:
    box(1000).export(tmp_path / "mm.ply")
    with pytest.warns(InputWarning, match="millimetres"):
        import_map(tmp_path / "mm.ply", bake=False)
    scene = import_map(tmp_path / "mm.ply", bake=False, options=ImportOptions(scale=0.001))
    assert max(scene.bounds.size) < 2


def test_up_is_that_of_the_format_or_as_said(tmp_path: Path) -> None:
    box().export(tmp_path / "box.glb")
    box().export(tmp_path / "box.ply")
    for name, config, up in (
        ("box.glb", {}, (0, 1, 0)),
        ("box.ply", {}, (0, 0, 1)),
        ("box.ply", {"up": "-y"}, (0, -1, 0)),
    ):
        scene = import_map(tmp_path / name, config=config, bake=False)
        # The vertical of each picture, of which most are not taken straight from above or below.
        downs = torch.stack([camera.pose.rotation[:, 1] for camera in scene.info.cameras])
        assert float((downs @ torch.tensor(up, dtype=downs.dtype)).median()) < -0.5, name


def test_coordinates_of_a_survey_are_moved_to_the_origin() -> None:
    far = np.random.default_rng(0).normal(size=(300, 3)) + np.array([500_000, 4_200_000, 100])
    with pytest.raises(InputError, match="`origin` 500000 4200000 100"):
        imported(Scan(far), "x")
    found = imported(Scan(far), "x", ScanSettings(origin=(500_000, 4_200_000, 100)))
    assert max(map(abs, (*found.bounds.lower, *found.bounds.upper))) < 10


def test_broken_parts_are_left_out_and_counted() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    points[0], points[1, 2], points[3] = np.nan, np.inf, points[2]
    found = " ".join(imported(Scan(points, np.full((200, 3), np.nan, np.float32)), "x").found)
    assert "left out 2 points with coordinates that are not finite, 1 duplicate points" in found
    with pytest.raises(InputError, match="finite"):
        imported(Scan(np.full((5, 3), np.nan)), "x")
    with pytest.raises(InputError, match="no points"):
        imported(Scan(np.zeros((0, 3))), "x")
    with pytest.raises(InputError, match="at least three"):
        imported(Scan(np.ones((9, 3))), "x")
    mesh = Scan(points, None, np.array([[2, 4, 5], [0, 4, 5], [4, 4, 5], [4, 5, 999]]))
    found = " ".join(imported(mesh, "x").found)
    assert "2 faces with corners that do not exist, 1 faces without an area" in found


def test_a_solid_object_is_seen_from_outside_and_a_room_from_inside(tmp_path: Path) -> None:
    """Faces of a closed object look outwards; in a scan of a room, they look to where the scanner was."""
    for name, turned in (("object.ply", False), ("room.ply", True)):
        mesh = box()
        if turned:
            mesh.faces = mesh.faces[:, ::-1]
        mesh.export(tmp_path / name)
        scene = import_map(tmp_path / name, bake=False)
        half = torch.tensor([0.5, 0.6, 0.4])
        inside = [bool((c.pose.translation.abs() < half).all()) for c in scene.info.cameras]
        assert all(inside) if turned else not any(inside), name


def test_the_surface_of_a_map_is_that_of_the_scan() -> None:
    """All of it, to within a cell, whether or not a viewpoint sees it."""
    mesh = box()
    found = imported(Scan(np.asarray(mesh.vertices), None, np.asarray(mesh.faces)), "x")
    surface = surface_of_points(*found.surface, found.bounds, [])
    away = (surface.surfels.positions.abs() - torch.tensor([0.5, 0.6, 0.4])).amax(-1)
    assert float(away.abs().max()) < 2 * surface.cell
    again = imported(Scan(np.asarray(mesh.subdivide().vertices)), "x").surface  # other points on all faces
    assert float(surface.distance(again[0]).max()) < 5 * surface.cell
