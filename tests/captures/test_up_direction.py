"""The upward direction of a scene: whatever way cameras look, it is across the floor and level for the cameras."""

from __future__ import annotations

import math

import pytest
import torch

from bidnerf_core.captures import up_direction, up_from_gravity
from bidnerf_core.geometry import SE3

WORLD = SE3.exp(torch.tensor([0.0, 0, 0, 0.7, -1.1, 0.4], dtype=torch.float64)).rotation
UP = WORLD @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def looking(azimuths: torch.Tensor, down_deg: float, roll_deg: float = 0.0, sideways: bool = False) -> list[SE3]:
    """Cameras that look down by an angle in a world whose vertical is ``UP``."""
    generator, poses = torch.Generator().manual_seed(4), []
    for azimuth in azimuths.tolist():
        down = math.radians(down_deg)
        ahead = torch.tensor(
            [math.cos(azimuth) * math.cos(down), math.sin(azimuth) * math.cos(down), -math.sin(down)]
        ).double()
        right = torch.tensor([math.sin(azimuth), -math.cos(azimuth), 0.0]).double()
        axes = torch.stack([right, torch.linalg.cross(ahead, right), ahead], dim=1)
        roll = math.radians(roll_deg) * float(torch.randn((), generator=generator)) + sideways * math.pi / 2
        turn = SE3.exp(torch.tensor([0, 0, 0, 0, 0, roll], dtype=torch.float64)).rotation
        poses.append(SE3(WORLD @ axes @ turn, torch.zeros(3, dtype=torch.float64)))
    return SE3.stack(poses)


def normals(floor: int, wall: int, clutter: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    axes = torch.eye(3)[[2] * floor + [0] * wall]
    directions = torch.cat(
        [axes + 0.03 * torch.randn(axes.shape, generator=generator), torch.randn((clutter, 3), generator=generator)]
    )
    directions = torch.nn.functional.normalize(directions, dim=-1)
    flipped = directions * torch.randn((len(directions), 1), generator=generator).sign()
    return flipped @ WORLD.float().mT


def off_deg(direction: tuple[float, float, float]) -> float:
    return math.degrees(math.acos(min(1.0, float(torch.tensor(direction, dtype=torch.float64) @ UP))))


AROUND, ONE_WAY = torch.linspace(0, 5.5, 24), torch.linspace(0.0, 0.3, 24)


@pytest.mark.parametrize("sideways", [False, True])
@pytest.mark.parametrize("azimuths", [AROUND, ONE_WAY])
def test_a_desk_seen_from_above(azimuths: torch.Tensor, sideways: bool) -> None:
    """The mean of the cameras' upward axes would be off by 44 degrees where all look one way."""
    found = up_direction(looking(azimuths, 44, 3, sideways), normals(3000, 1500, 8000))
    assert found.source == "planes"
    assert off_deg(found.direction) < 1


def test_without_planes_level_cameras_tell() -> None:
    found = up_direction(looking(AROUND, 60, 2), normals(0, 0, 5000))
    assert found.source == "cameras"
    assert off_deg(found.direction) < 2
    assert up_direction(looking(AROUND, 60, 2)) == found
    assert off_deg(up_direction(looking(ONE_WAY[:1], 10)).direction) < 12  # one photo: its own axis


@pytest.mark.parametrize("down", [80, 95])
def test_cameras_that_look_along_the_vertical_look_down(down: float) -> None:
    assert off_deg(up_direction(looking(AROUND, down, 3)).direction) < 2


def test_walls_do_not_count_as_floors() -> None:
    found = up_direction(looking(AROUND, 5, 3), normals(800, 6000, 4000))
    assert off_deg(found.direction) < 1


def test_gravity_is_taken_as_it_is() -> None:
    assert up_from_gravity((0, 9.81, 0)).direction == (0, 1, 0)
    assert up_from_gravity((0, 9.81, 0)).source == "gravity"
