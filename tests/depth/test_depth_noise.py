"""Noise of depth, estimated from single images, against images whose noise is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset
from bidnerf_core.depth import DepthNoise, estimate_depth_noise, find_depth_sensor
from optional import require

CAMERA = Intrinsics.from_hfov(60.0, 320, 240)
LENS = Intrinsics(280.0, 280.0, 158.0, 121.0, 320, 240, (0.1, -0.05, 0.001, 0.002))


def corridor(camera: Intrinsics = CAMERA, slant: float = 1.0) -> Float[Tensor, "h w"]:
    """Return exact depth (metres) of two walls; with a ``slant`` of 0 they face the camera, else it goes from 1.2 to 5 m."""
    x, y, _ = camera.unproject(camera.pixel_centres(torch.float64)).unbind(-1)
    left, right = 1 / (0.4 - slant * (0.6 * x + 0.1 * y)), 1 / (0.4 + slant * (0.6 * x + 0.13 * y))
    return torch.where(x < 0, left, right)


def noisy(
    depth: Float[Tensor, "h w"], deviation: Callable[[Tensor], Tensor], generator: Generator
) -> Float[Tensor, "h w"]:
    return depth + deviation(depth) * torch.randn(depth.shape, generator=generator, dtype=depth.dtype)


def relative(noise: DepthNoise | None, z: float) -> float:
    return require(noise).deviation(z) / z


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("share", [0.001, 0.01, 0.03])
def test_relative_noise_is_found_on_slanted_walls(share: float, camera: Intrinsics, generator: Generator) -> None:
    found = estimate_depth_noise(noisy(corridor(camera), lambda z: share * z, generator), camera)
    for z in (1.5, 2.5, 3.5):
        assert relative(found, z) == pytest.approx(share, rel=0.2)


@pytest.mark.parametrize("quadratic", [find_depth_sensor("kinect").noise.quadratic, 0.005])
def test_noise_that_grows_with_the_square_of_the_distance_is_found(quadratic: float, generator: Generator) -> None:
    found = estimate_depth_noise(noisy(corridor(), lambda z: quadratic * z**2, generator), CAMERA)
    for z in (1.5, 2.5, 3.5):
        assert relative(found, z) == pytest.approx(quadratic * z, rel=0.25)


@pytest.mark.parametrize("slant", [0.0, 1.0], ids=["facing", "slanted"])
def test_exact_depth_has_no_noise(slant: float) -> None:
    found = estimate_depth_noise(corridor(slant=slant), CAMERA)
    assert relative(found, 2.0) < 1e-4


def test_walls_that_face_the_camera_show_the_rounding_though_their_depths_are_all_the_same() -> None:
    depth = torch.full((240, 320), 2.0, dtype=torch.float64)
    depth[:, 160:] = torch.linspace(1.0, 3.0, 41).repeat_interleave(4)[:160]
    found = estimate_depth_noise(depth, CAMERA)
    assert relative(found, 2.0) == pytest.approx(0.05 / 12**0.5 / 2.0, rel=0.3)


def test_rounding_on_slanted_walls_counts_once() -> None:
    step = 0.02
    found = estimate_depth_noise((corridor() / step).round() * step, CAMERA)
    assert relative(found, 2.0) == pytest.approx(step / 12**0.5 / 2.0, rel=0.5)


def test_gross_errors_and_edges_do_not_count_as_noise(generator: Generator) -> None:
    depth = noisy(corridor(), lambda z: 0.005 * z, generator)
    depth = torch.where(torch.rand(depth.shape, generator=generator) < 0.02, depth * 1.05, depth)
    depth[60:120, 100:180] *= 0.7
    assert relative(estimate_depth_noise(depth, CAMERA), 2.0) == pytest.approx(0.005, rel=0.3)


@pytest.mark.parametrize("size", [(960, 720), (720, 540)], ids=["threefold", "not a whole factor"])
def test_depth_of_a_lower_resolution_than_its_image_has_the_noise_of_its_own_pixels(
    size: tuple[int, int], generator: Generator
) -> None:
    own = noisy(corridor(), lambda z: 0.01 * z, generator)
    rows, columns = ((torch.arange(n) + 0.5) * m / n for n, m in zip(size[::-1], own.shape, strict=True))
    found = estimate_depth_noise(own[rows.long()][:, columns.long()], Intrinsics.from_hfov(60.0, *size))
    assert relative(found, 2.0) == pytest.approx(0.01, rel=0.2)


def test_images_with_little_depth_give_no_estimate() -> None:
    assert estimate_depth_noise(torch.ones(4, 4), CAMERA.scaled(1 / 80)) is None
    depth = torch.zeros((240, 320))
    assert estimate_depth_noise(depth, CAMERA) is None
    depth[:24, :24] = 1.0
    assert estimate_depth_noise(depth, CAMERA) is None
    depth = corridor()
    depth[::4] = 0
    assert estimate_depth_noise(depth, CAMERA) is None


@pytest.mark.parametrize(
    ("name", "distance", "least", "most"),
    [
        ("tum_fr1_xyz", 1.0, 0.001, 0.003),  # Khoshelham and Elberink: 0.14 % at 1 m
        ("iphone_corridor", 2.5, 0.001, 0.006),
        ("room_living", 3.0, 0.0, 0.001),  # rendered, in whole millimetres
    ],
)
def test_real_sensors_have_the_noise_that_the_literature_states(
    name: str, distance: float, least: float, most: float, data_dir: Path
) -> None:
    if name == "iphone_corridor":
        pytest.importorskip("bidnerf_scanner_app", reason="reads scans of this plugin's format")
    dataset = open_dataset(data_dir / name)
    frames = dataset.frame_names("test")
    for view in dataset.views("test", [frames[1], frames[6]]):
        assert (
            least <= relative(estimate_depth_noise(require(view.frame.depth), view.frame.intrinsics), distance) <= most
        )


def test_noise_does_not_depend_on_the_unit_of_length(generator: Generator) -> None:
    depth = noisy(corridor(), lambda z: 0.004 * z**2, generator)
    metres, feet = estimate_depth_noise(depth, CAMERA), estimate_depth_noise(depth / 0.3048, CAMERA)
    assert relative(feet, 2.0 / 0.3048) == pytest.approx(relative(metres, 2.0), rel=1e-3)
