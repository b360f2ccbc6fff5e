"""Where a search without depth begins: where the map was seen from, and what a start adds to that."""

from __future__ import annotations

import math

import torch
from torch import Generator

from bidnerf_core.localization.rgb_search import Sight
from bidnerf_core.se3 import SE3

ASIDE = 0.05
"""Share of the scene's extent by which poses are moved along each axis: a standard deviation, as the next one."""
TURNED = 0.15
"""Radians by which they are turned about each."""
ASTRAY = 0.25
"""The same for a start."""


def hypotheses(sight: Sight, keyframes: SE3, start: SE3 | None, count: int, generator: Generator) -> SE3:
    """``count`` poses: a start's neighbourhood, if there is a start, is a quarter of all; of the rest, half are keyframes
    as they are, as far as there are so many, and the others keyframes that were moved about what they look at, every
    fourth of them with the camera rolled by any angle.
    """
    near = [] if start is None else [around(sight, start, max(1, count // 4), generator)]
    left = count - sum(len(T.translation) for T in near)
    known = len(keyframes.translation)
    plain = keyframes[torch.randperm(known, generator=generator)[: left // 2]]
    left -= len(plain.translation)
    moved = _moved(sight, keyframes[torch.randint(known, (left,), generator=generator)], TURNED, generator)
    roll = torch.zeros((left, 6), dtype=torch.float64)
    roll[::4, 5] = math.pi * (2 * torch.rand(len(roll[::4]), generator=generator, dtype=torch.float64) - 1)
    return SE3.cat([*near, plain, moved.retract(roll)])


def around(sight: Sight, start: SE3, count: int, generator: Generator) -> SE3:
    """The start, and poses about it: half of them turn where they are, half about what they look at."""
    many = SE3(start.rotation.expand(count, 3, 3), start.translation.expand(count, 3))
    half = count // 2
    there = SE3(start.rotation[None], start.translation[None])
    turns = torch.randn((half, 6), generator=generator, dtype=torch.float64)
    turns = turns * _spread(sight, ASTRAY)
    moved = _moved(sight, many[half + 1 :], ASTRAY, generator)
    return SE3.cat([there, many[:half].retract(turns), moved])


def _moved(sight: Sight, T: SE3, angle: float, generator: Generator) -> SE3:
    shifts = torch.randn((len(T.translation), 6), generator=generator, dtype=torch.float64)
    return sight.pivot.moved(T, shifts * _spread(sight, angle))


def _spread(sight: Sight, angle: float) -> torch.Tensor:
    return torch.tensor([ASIDE * sight.extent] * 3 + [angle] * 3, dtype=torch.float64)
