"""The field: what rays meet is what plane geometry says, whatever the tree."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from bidnerf_core.devices import without_waiting
from bidnerf_core.fields import Rays, SceneBounds, render
from bidnerf_core.maps import UNMOVED
from bidnerf_scan import Scan, ScanField, importer
from bidnerf_scan.importer import ScanSettings, imported
from bidnerf_scan.pieces import Pieces, cloud_pieces, mesh_pieces, spacing, thinned
from bidnerf_scan.recipe import config_of

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.01, 10.0)


def field_of(pieces: Pieces) -> ScanField:
    field = ScanField(config_of(pieces), BOUNDS)
    field.assign(pieces)
    return field.requires_grad_(False)


def rays_to(targets: torch.Tensor, origin: tuple[float, float, float] = (0.3, -0.2, 5.0)) -> Rays:
    origins = torch.tensor(origin).expand_as(targets)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return BOUNDS.rays(origins, directions)


def sphere() -> Scan:
    mesh = trimesh.creation.icosphere(3, 1.0)
    points = np.asarray(mesh.vertices)
    return Scan(points, (points / 2 + 0.5).astype(np.float32), np.asarray(mesh.faces, np.int64))


def test_a_mesh_of_a_sphere_is_a_sphere() -> None:
    """Distance and colour are those of the sphere, without holes at the edges, and in the same way in known shapes."""
    scan = sphere()
    field = field_of(mesh_pieces(scan, torch.from_numpy(scan.points)))
    generator = torch.Generator().manual_seed(0)
    rays = rays_to(0.4 * torch.randn((2000, 3), generator=generator).clamp(-1, 1))
    seen = render(field, rays)
    b = (rays.origins * rays.directions).sum(-1)
    root = b.square() - rays.origins.square().sum(-1) + 1
    sure = root > 0.1
    expected = -b - root.clamp(min=0).sqrt()
    assert float(seen.opacity[sure].min()) > 0.99
    assert float((seen.distance / seen.opacity - expected)[sure].abs().max()) < 0.02
    place = rays.origins + expected[:, None] * rays.directions
    assert float((seen.rgb / seen.opacity[:, None] - (place / 2 + 0.5))[sure].abs().max()) < 0.02
    with without_waiting(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("bidnerf_gaussians.pieces"), "may_wait", lambda device: False)
        again = render(field, rays)
    assert torch.allclose(again.rgb, seen.rgb, atol=1e-4)


def test_rays_meet_what_every_triangle_by_itself_gives() -> None:
    generator = torch.Generator().manual_seed(2)
    corners = torch.randn((60, 3, 3), generator=generator).clamp(-1.9, 1.9)
    scan = Scan(
        corners.reshape(-1, 3).double().numpy(),
        torch.rand((180, 3), generator=generator).numpy(),
        np.arange(180).reshape(60, 3),
    )
    pieces = mesh_pieces(scan, corners.reshape(-1, 3).double())
    rays = rays_to(torch.randn((300, 3), generator=generator))
    hits = field_of(pieces).hits(rays)
    a, b, c = corners.double().unbind(1)
    system = torch.stack([b - a, c - a, torch.zeros_like(a)], -1).expand(300, -1, -1, -1).clone()
    system[..., 2] = -rays.directions.double()[:, None]
    solved = torch.linalg.solve(system, rays.origins.double()[:, None] - a)
    u, v, t = solved.unbind(-1)
    inside = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < rays.far[:, None]) & (t > rays.near[:, None])
    expected = torch.where(inside, t, torch.inf).amin(1)
    found = torch.where(hits.valid & (hits.alpha > 0), hits.distance, torch.inf)
    first = found.amin(1) if found.shape[1] else torch.full_like(rays.near, torch.inf)
    same = (first.double() - expected).abs() < 1e-4
    assert float((same | (torch.isinf(first) & torch.isinf(expected))).double().mean()) > 0.99


def test_a_cloud_of_a_plane_is_opaque_and_keeps_its_colours() -> None:
    generator = torch.Generator().manual_seed(1)
    flat = 3 * torch.rand((4000, 2), generator=generator, dtype=torch.float64) - 1.5
    points = torch.cat([flat, (0.3 * flat[:, :1])], dim=-1)
    rgb = torch.stack([flat[:, 0] / 3 + 0.5, flat[:, 1] / 3 + 0.5, torch.full_like(flat[:, 0], 0.25)], -1)
    pieces = cloud_pieces(points, rgb.float())
    assert spacing(pieces) == pytest.approx(math.sqrt(9 * math.sqrt(1.09) / 4000), rel=0.15)
    aim = 2 * torch.rand((500, 2), generator=generator) - 1
    seen = render(field_of(pieces), rays_to(torch.cat([aim, 0.3 * aim[:, :1]], dim=-1)))
    away = torch.linalg.vector_norm(torch.cat([aim, 0.3 * aim[:, :1]], -1) - torch.tensor([0.3, -0.2, 5.0]), dim=-1)
    assert float(seen.opacity.quantile(0.02)) > 0.9
    assert float((seen.distance / seen.opacity - away).abs().max()) < 1e-3
    colours = seen.rgb / seen.opacity[:, None]
    assert float((colours[:, :2] - (aim / 3 + 0.5)).abs().max()) < 0.02


def test_textures(tmp_path: Path) -> None:
    """A texel is seen where its texture coordinates are, and light and dark ones are where the image has them."""
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:], image[4:, :4], image[4:, 4:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (255, 255, 255),
    )
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(image))
    mesh.visual = trimesh.visual.TextureVisuals(uv=corners[:, :2] / 2 + 0.5, material=material)
    for name in ("a.glb", "a.obj"):
        mesh.export(tmp_path / name)
        found = importer.read(tmp_path / name, ScanSettings(), UNMOVED)
        field = ScanField(found.config, found.bounds)
        field.load_state_dict(found.tensors)
        aim = torch.tensor([[-0.5, 0.5, 0], [0.5, 0.5, 0], [-0.5, -0.5, 0], [0.5, -0.5, 0.0]])
        rays = rays_to(aim)
        seen = render(field, Rays(rays.origins, rays.directions, rays.near * 0, rays.far + 10)).rgb
        expected = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
        assert torch.allclose(seen, expected, atol=0.02), name


def test_thinning_keeps_means() -> None:
    points = torch.rand((5000, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    few, rgb = thinned(points, points.float(), 700)
    assert 350 < len(few) <= 700
    assert torch.allclose(few.float(), rgb, atol=1e-5)
    assert thinned(points, None, 5000)[0] is points


def test_a_scan_without_colours_says_so() -> None:
    scan = sphere()
    bare = Scan(scan.points)
    assert any("shape alone" in line for line in imported(bare, "x").found)
    assert not any("shape alone" in line for line in imported(scan, "x").found)
