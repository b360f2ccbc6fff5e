"""Imported runs compared with what nerfstudio 1.1.5 computes from the same weights; ``make_runs.py`` says how."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from bidnerf import Map
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import FieldValues, levels, render
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain
from bidnerf_core.maps import UNMOVED, MapInfo, build_frozen_field
from bidnerf_nerfstudio.importer import ImportSettings, importer
from bidnerf_nerfstudio.placement import inverse
from stored_runs import RUNS, RunOf

SPACING = 4
OPENGL = torch.tensor([1.0, -1.0, -1.0, 1.0])


def reference(method: str) -> dict[str, Tensor]:
    return load_file(RUNS / method / "reference.safetensors")


def imported(folder: Path) -> Map:
    """Return a map of a run without its cameras, which would be looked for in free space."""
    found = importer.read(folder, ImportSettings(), UNMOVED)
    info = MapInfo(found.backend, to_plain(found.config), found.bounds, found.steps, True, folder.name)
    return Map(info, build_frozen_field(info, found.tensors, None))


def at_points(scene: Map, expected: dict[str, Tensor]) -> FieldValues:
    """Return the values at the reference's points, which are in the coordinates of the training; densities per unit of these."""
    placement: Any = getattr(scene.field, "placement", None) or levels(scene.field)[0].placement  # type: ignore[attr-defined]
    back = inverse(placement.similarity)
    points = back.apply(expected["points"].double()).float()
    directions = back.T_target_source.rotate(expected["directions"].double()).float()
    found = scene.field.query(points, directions)
    return FieldValues(found.density / placement.scale, found.rgb)


@pytest.mark.parametrize("method", ["nerfacto", "instant-ngp", "vanilla-nerf"])
def test_densities_and_colours_at_points(run_of: RunOf, method: str) -> None:
    expected = reference(method)
    found = at_points(imported(run_of(method)), expected)
    assert float(expected["density"].max()) > 3 * float(expected["density"].median()) > 0
    # Frequencies up to 2^8 leave three digits of an angle in single precision.
    tolerance = 1e-3 if method == "vanilla-nerf" else 1e-4
    assert torch.allclose(found.density, expected["density"], rtol=tolerance, atol=1e-6)
    inside = expected["density"] > 0  # colours elsewhere are never seen
    assert torch.allclose(found.rgb[inside], expected["colours"][inside], atol=tolerance)


def test_proposal_networks(run_of: RunOf) -> None:
    expected, field = reference("nerfacto"), imported(run_of("nerfacto")).field
    for number, network in enumerate(field.proposals):  # type: ignore[attr-defined]
        assert torch.allclose(network(expected["points"]), expected[f"proposal{number}"], rtol=1e-4, atol=1e-6)


def test_an_image_from_a_pose_of_the_dataset(run_of: RunOf) -> None:
    """The pose and the camera are those of the dataset's file, so transform, scale, axes and sampling are all in this."""
    expected, scene = reference("nerfacto"), imported(run_of("nerfacto"))
    fx, fy, cx, cy, w, h = expected["lens"].tolist()
    camera = Intrinsics(fx, fy, cx, cy, int(w), int(h))
    T = SE3.from_matrix(expected["pose"] * OPENGL)
    pixels = camera.pixel_centres()[::SPACING, ::SPACING]
    directions = torch.nn.functional.normalize(T.rotate(camera.unproject(pixels)), dim=-1)
    # nerfstudio renders from the camera on, and trains from near_plane on.
    rays = replace(scene.bounds, near=0.0).rays(T.translation.expand_as(directions), directions)
    found = render(scene.field, rays)
    error = (found.rgb - expected["rgb"]).square().mean()
    assert float(expected["rgb"].std()) > 0.05
    assert -10 * float(error.log10()) > 60
    assert float((found.opacity - expected["opacity"]).abs().max()) < 1e-3


def test_rays_of_both_vanilla_networks(run_of: RunOf) -> None:
    expected, scene = reference("vanilla-nerf"), imported(run_of("vanilla-nerf"))
    directions = expected["rays"]
    rays = replace(scene.bounds, contracted=True).rays(-4 * directions, directions)  # not limited to a box
    assert (scene.bounds.near, scene.bounds.far) == (2.0, 6.0)
    for level, name in zip(levels(scene.field), ("rough", "rgb"), strict=True):
        found = render(level, rays, scene.bounds.background)
        assert -10 * float((found.rgb - expected[name]).square().mean().log10()) > 60
    assert torch.allclose(found.opacity, expected["opacity"], atol=1e-3)


def test_the_occupancy_of_instant_ngp(run_of: RunOf) -> None:
    expected, field = reference("instant-ngp"), imported(run_of("instant-ngp")).field
    held = field.grid.holds(expected["points"])  # type: ignore[attr-defined]
    assert torch.equal(held, expected["held"].bool())
    assert 0 < int(held.sum()) < len(held)


def test_instant_ngp_is_sampled_in_occupied_cells_only(run_of: RunOf) -> None:
    scene = imported(run_of("instant-ngp"))
    directions = reference("instant-ngp")["directions"]
    rays = scene.bounds.rays(-directions, directions)
    samples = scene.field.sampler(rays)
    grid = scene.field.grid  # type: ignore[attr-defined]
    assert bool(grid.holds(rays.at(samples.middles))[samples.valid].all())
    length = torch.where(samples.valid, samples.ends - samples.starts, 0)
    fine = torch.linspace(0.05, 4.0, 20_000)
    expected = grid.holds(rays.at(fine.expand(len(directions), -1))).float().mean(-1) * 3.95
    near = (length * (samples.ends < 4.0)).sum(-1)
    assert float((near - expected).abs().median()) < 0.02
