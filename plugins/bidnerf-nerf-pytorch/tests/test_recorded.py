"""Checkpoints trained by others, compared with the images that they were trained on."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from bidnerf_core.datasets import open_dataset
from bidnerf_core.fields import SceneBounds, render
from bidnerf_core.frames import View
from bidnerf_nerf_pytorch import NerfPytorchConfig, NerfPytorchField, backend, read_checkpoint
from bidnerf_nerf_pytorch.network import NetworkConfig

BOUNDS = SceneBounds((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5), 2.0, 6.0, (1.0, 1.0, 1.0))
FILES = ("lego-lowres/checkpoint199999.ckpt", "chair-lowres/checkpoint155000.ckpt")
SPACING = 4  # every fourth pixel of a row and column is compared


def field_of(path: Path) -> NerfPytorchField:
    found = read_checkpoint(path)
    field = backend.build(NerfPytorchConfig(**asdict(found.network)), BOUNDS)
    field.load_state_dict(found.tensors)
    return field.requires_grad_(False)


@pytest.mark.parametrize("file", FILES)
def test_the_architecture_is_that_of_the_weights(nerf_pytorch_data: Path, file: str) -> None:
    found = read_checkpoint(nerf_pytorch_data / "nerf_pytorch" / file)
    assert found.network == NetworkConfig(layers=4, width=128)
    assert found.steps > 100_000


def test_lego_is_seen_where_it_is(nerf_pytorch_data: Path) -> None:
    """Axes, encoding and density: an error in one of them costs more than ten decibels."""
    dataset = open_dataset(nerf_pytorch_data / "blender_lego", BOUNDS.background)
    field = field_of(nerf_pytorch_data / "nerf_pytorch" / FILES[0])
    names = dataset.frame_names("test")
    errors = [squared_error(field, view) for view in dataset.views("test", names[:: max(1, len(names) // 3)])]
    assert -10 * torch.cat(errors).mean().log10() > 25


def squared_error(field: NerfPytorchField, view: View) -> torch.Tensor:
    """Return squared errors of colour at a lattice of pixels, against the image averaged over 2 x 2 of its own."""
    rgb, intrinsics = view.frame.rgb, view.frame.intrinsics
    small = torch.nn.functional.avg_pool2d(rgb.movedim(-1, 0), 2).movedim(0, -1)[::SPACING, ::SPACING]
    camera, T_world_camera = intrinsics.scaled(0.5), view.T_ref_camera.to(torch.float32)
    pixels = camera.pixel_centres()[::SPACING, ::SPACING].reshape(-1, 2)
    directions = torch.nn.functional.normalize(T_world_camera.rotate(camera.unproject(pixels)), dim=-1)
    origins = T_world_camera.translation.expand_as(directions)
    found = render(field, BOUNDS.rays(origins, directions), BOUNDS.background)
    return (found.rgb - small.reshape(-1, 3)) ** 2
