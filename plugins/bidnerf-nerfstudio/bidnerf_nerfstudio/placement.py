"""The placement of a map's world in the coordinates in which a field was trained."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import constant
from bidnerf_core.errors import InputError
from bidnerf_core.fields import Rays, RaySamples, SceneBounds
from bidnerf_core.geometry import SE3, Similarity


@dataclass(frozen=True)
class Placement:
    """The similarity transform from the world of a map to training coordinates, as plain numbers."""

    scale: float  # training units per unit of the world
    rotation: tuple[float, ...]  # 3x3, row by row; the world's axes in training coordinates
    translation: tuple[float, ...]  # training units

    @staticmethod
    def of(numbers: tuple[float, ...], bounds: SceneBounds) -> Placement:
        """Return the placement in a config, see ``numbers``; without any, the cube around the box becomes
        [-1, 1].

        Raises ``InputError`` for the wrong number of values.
        """
        if not numbers:
            scale = 2 / bounds.side
            x, y, z = bounds.centre
            return Placement(scale, (1, 0, 0, 0, 1, 0, 0, 0, 1), (-scale * x, -scale * y, -scale * z))
        if len(numbers) != 13:
            raise InputError(f"placement has {len(numbers)} numbers", expected="a scale, 9 of a rotation, 3 of a shift")
        return Placement(numbers[0], numbers[1:10], numbers[10:])

    @staticmethod
    def from_similarity(world_to_trained: Similarity) -> Placement:
        """Return the placement of a similarity transform from the world to training coordinates."""
        T = world_to_trained.T_target_source.to(dtype=torch.float64)
        return Placement(world_to_trained.scale, tuple(T.rotation.reshape(-1).tolist()), tuple(T.translation.tolist()))

    @property
    def numbers(self) -> tuple[float, ...]:
        """The scale, the rotation and the translation, as a config stores them."""
        return (self.scale, *self.rotation, *self.translation)

    @property
    def similarity(self) -> Similarity:
        """The transform from the world to training coordinates."""
        rotation = torch.tensor(self.rotation, dtype=torch.float64).reshape(3, 3)
        return Similarity(self.scale, SE3(rotation, torch.tensor(self.translation, dtype=torch.float64)))

    def points(self, positions: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        """Return positions (world) in training coordinates."""
        return self.scale * self.directions(positions) + constant(self.translation, positions)

    def directions(self, directions: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        """Return unit directions (world) in training coordinates."""
        return directions @ constant(self.rotation, directions).reshape(3, 3).mT

    def rays(self, rays: Rays) -> Rays:
        """Return rays of the world in training coordinates."""
        return Rays(
            self.points(rays.origins),
            self.directions(rays.directions),
            self.scale * rays.near,
            self.scale * rays.far,
        )

    def samples(self, samples: RaySamples) -> RaySamples:
        """Convert samples of rays from training coordinates to the world."""
        return RaySamples(samples.starts / self.scale, samples.ends / self.scale, samples.valid)


def inverse(similarity: Similarity) -> Similarity:
    """Return the transform that undoes ``similarity``."""
    back = similarity.T_target_source.inverse()
    return Similarity(1 / similarity.scale, SE3(back.rotation, back.translation / similarity.scale))


def after(second: Similarity, first: Similarity) -> Similarity:
    """Return the transform that applies ``first`` and then ``second``."""
    T, inner = second.T_target_source, first.T_target_source
    rotation = T.rotation.double() @ inner.rotation.double()
    return Similarity(second.scale * first.scale, SE3(rotation, second.apply(inner.translation.double())))
