"""Hypotheses: the initial poses of a search."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Generator, Tensor
from torch.quasirandom import SobolEngine

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.solvers.pivots import Pivot


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The input for hypotheses: the map's keyframes, the size of the scene, and the middle of the query's view."""

    keyframes: SE3  # (k) T_world_camera of the images from which the map was made
    extent: float  # metres: size of the scene
    scene_middle: Float[Tensor, "3"]  # metres, world
    seen_middle: Float[Tensor, "3"]  # metres, last camera's frame: the middle of the query's view

    @property
    def pivot(self) -> Pivot:
        return Pivot.at_point(self.seen_middle)


def hypotheses_for_points(known: Surroundings, start: SE3 | None, count: int, generator: Generator) -> SE3:
    """Return ``count`` poses at which measured points may fit the surface.

    Half are slightly perturbed keyframes. The other half place the middle of the measured points at the middle of the scene,
    which suits cameras around an object; three quarters of their orientations are near those of keyframes, and a quarter are
    uniformly random. If there is a start, a quarter of all poses are the start and poses near it.
    """
    spread = _deviation(0.1 * known.extent, 0.25)
    near = [] if start is None else [_about(start, known.pivot, max(1, count // 4), spread, generator)]
    left = count - sum(len(T.translation) for T in near)
    half = left // 2
    moved = _scattered(_without_repetition(known.keyframes, left - half, generator), known.extent, generator)
    turns = random_rotations(half // 4, generator)
    alike = _without_repetition(known.keyframes, half - len(turns), generator)
    alike = _scattered(alike, known.extent, generator)
    rotations = torch.cat([alike.rotation, turns])
    placed = known.scene_middle.double() - (rotations @ known.seen_middle.double()[:, None])[..., 0]
    return SE3.cat([*near, moved, SE3(rotations, placed)])


def hypotheses_for_images(known: Surroundings, start: SE3 | None, count: int, generator: Generator) -> SE3:
    """Return ``count`` poses at which the map may look like the query's images.

    Up to half are unchanged keyframes. The others are keyframes perturbed about the point at which they look; every fourth of
    them is also rolled by a random angle. If there is a start, a quarter of all poses are the start and poses near it.
    """
    near = [] if start is None else [_turned_and_moved(known, start, max(1, count // 4), generator)]
    left = count - sum(len(T.translation) for T in near)
    total = len(known.keyframes.translation)
    plain = known.keyframes[torch.randperm(total, generator=generator)[: left // 2]]
    left -= len(plain.translation)
    others = known.keyframes[torch.randint(total, (left,), generator=generator)]
    moved = _moved(others, known.pivot, _deviation(0.05 * known.extent, 0.15), generator)
    roll = torch.zeros((left, 6), dtype=torch.float64)
    roll[::4, 5] = math.pi * (2 * torch.rand(len(roll[::4]), generator=generator, dtype=torch.float64) - 1)
    return SE3.cat([*near, plain, moved.retract(roll)])


def neighbours(T: SE3, count: int, translation: float, rotation: float, seed: int) -> SE3:
    """Return ``T`` and ``count`` - 1 right updates of it, quasi-random samples of a normal distribution.

    ``translation`` (metres) and ``rotation`` (radians) are its standard deviations along and about each axis of the camera;
    the samples are a Sobol sequence, scrambled with ``seed``. Shape (count).
    """
    even = SobolEngine(6, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    xi = _deviation(translation, rotation) * torch.special.ndtri(even.clamp(1e-6, 1 - 1e-6))
    xi[0] = 0
    return SE3(T.rotation[None], T.translation[None]).retract(xi)


def random_rotations(count: int, generator: Generator) -> Float[Tensor, "h 3 3"]:
    """Return uniformly distributed orientations, from normalised Gaussian quaternions."""
    quaternions = torch.randn((count, 4), generator=generator, dtype=torch.float64)
    return quaternion_to_rotation_matrix(torch.nn.functional.normalize(quaternions, dim=-1))


def _about(start: SE3, pivot: Pivot, count: int, spread: Float[Tensor, "6"], generator: Generator) -> SE3:
    """Return the start and poses near it."""
    shifts = torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return pivot.moved(start, shifts * spread * (torch.arange(count) > 0)[:, None])


def _turned_and_moved(known: Surroundings, start: SE3, count: int, generator: Generator) -> SE3:
    """Return the start and poses near it: half are perturbed about the camera, half about the middle of its view."""
    many = SE3(start.rotation.expand(count, 3, 3), start.translation.expand(count, 3))
    half, spread = count // 2, _deviation(0.05 * known.extent, 0.25)
    turns = torch.randn((half, 6), generator=generator, dtype=torch.float64) * spread
    moved = _moved(many[half + 1 :], known.pivot, spread, generator)
    return SE3.cat([SE3(start.rotation[None], start.translation[None]), many[:half].retract(turns), moved])


def _moved(T: SE3, pivot: Pivot, spread: Float[Tensor, "6"], generator: Generator) -> SE3:
    shifts = torch.randn((len(T.translation), 6), generator=generator, dtype=torch.float64)
    return pivot.moved(T, shifts * spread)


def _scattered(T: SE3, extent: float, generator: Generator) -> SE3:
    """Return slightly perturbed poses, so that repeated ones differ and a frame does not fail twice in the same way."""
    shifts = torch.randn((len(T.translation), 6), generator=generator, dtype=torch.float64)
    return T.retract(shifts * _deviation(0.02 * extent, 0.05))


def _without_repetition(T: SE3, count: int, generator: Generator) -> SE3:
    """Draw ``count`` poses, with no pose repeated before all have been drawn."""
    rounds = max(1, -(-count // len(T.translation)))
    order = [torch.randperm(len(T.translation), generator=generator) for _ in range(rounds)]
    return T[torch.cat(order)[:count]]


def _deviation(translation: float, rotation: float) -> Float[Tensor, "6"]:
    """Return standard deviations of an update: metres along, radians about each axis."""
    return torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64)
