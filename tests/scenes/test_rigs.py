"""Rigs: cameras are where they should be and look where they should look."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bidnerf.scenes import demo_room, look_around, orbit
from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import look_at
from refusals import refused

CAMERA = Intrinsics(70.0, 75.0, 31.0, 24.5, 64, 48)


def test_orbit_looks_at_its_centre_from_its_radius() -> None:
    centre = (0.3, -1.0, 2.0)
    for T in orbit(2.5, 40, centre=centre, elevation=(-90, 90), seed=3):
        assert bool(T.is_rigid(1e-12))
        middle = T.inverse().apply(torch.tensor(centre, dtype=torch.float64))
        torch.testing.assert_close(middle, middle.new_tensor([0, 0, 2.5]), atol=1e-12, rtol=0)
        torch.testing.assert_close(CAMERA.project(middle), middle.new_tensor([CAMERA.cx, CAMERA.cy]))


def test_orbit_is_even_and_reproducible() -> None:
    def places(count: int, seed: int, **kwargs: tuple[float, float]) -> Tensor:
        return torch.stack([T.translation for T in orbit(1.0, count, seed=seed, **kwargs)])

    assert torch.equal(places(30, 1), places(30, 1))
    assert torch.cdist(places(30, 1), places(30, 2)).min() > 1e-3
    elevation = torch.rad2deg(places(100, 0)[:, 2].asin())
    assert elevation.min() >= 5
    assert elevation.max() <= 80
    nearest = torch.cdist(places(200, 0, elevation=(-90, 90)), places(200, 0, elevation=(-90, 90)))
    nearest = nearest.fill_diagonal_(9).amin(-1)
    assert nearest.min() > 0.5 * nearest.max()
    assert orbit(1.0, 0) == []


@pytest.mark.parametrize("seed", range(4))
def test_look_around_stands_clear_of_the_furniture(seed: int) -> None:
    room = demo_room()
    poses = look_around(room.bounds, 12, seed)
    everywhere = orbit(1.0, 200, elevation=(-90, 90))
    directions = torch.stack([T.translation for T in everywhere])
    for T in poses:
        assert bool(T.is_rigid(1e-12))
        assert T.rotation[2, 1] < -0.8  # y of the image points down
        assert room.intersect(T.translation, directions)[0].min() > 0.15
    azimuth = torch.stack([torch.atan2(T.rotation[1, 2], T.rotation[0, 2]) for T in poses]).sort().values
    assert azimuth.diff().max() < 2 * math.pi / 5


def test_look_at_straight_down_and_at_itself() -> None:
    for eye in ((0.0, 0.0, 3.0), (0.0, 0.0, -3.0)):
        T = look_at(eye, (0.0, 0.0, 0.0))
        assert bool(T.is_rigid(1e-12))
    with refused(where="look_at", found="[1.0, 2.0, 3.0] equals its target"):
        look_at((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))
