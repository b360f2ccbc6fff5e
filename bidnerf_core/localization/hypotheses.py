"""Where a search begins: poses that the map itself makes likely, and what a start adds to them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Generator, Tensor

from bidnerf_core.localization.alignment import Cloud
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3


def hypotheses(surface: SurfaceMap, cloud: Cloud, start: SE3 | None, count: int, generator: Generator) -> SE3:
    """``count`` poses T_world_camera.

    Half are keyframes of the map, moved a little; half are orientations, three quarters of them about those of keyframes
    and a quarter uniformly random, each put where the middle of what was measured lies on the middle of the map, as it
    does where cameras look at an object. A start adds itself and its neighbourhood: a quarter of all.
    """
    keyframes = SE3.from_matrix(surface.keyframes)
    pools = [] if start is None else [around(start, surface, cloud, max(1, count // 4), generator)]
    left = count - sum(len(pool.translation) for pool in pools)
    half = left // 2
    pools.append(scattered(drawn(keyframes, left - half, generator), surface, generator))
    turns = random_rotations(half // 4, generator)
    alike = scattered(drawn(keyframes, half - len(turns), generator), surface, generator)
    rotations = torch.cat([alike.rotation, turns])
    pools.append(centred(rotations, surface, cloud))
    return SE3.cat(pools)


def centred(rotations: Float[Tensor, "h 3 3"], surface: SurfaceMap, cloud: Cloud) -> SE3:
    """Poses of these orientations from which the middle of the cloud lies on the middle of the map."""
    middle = surface.surfels.positions.median(0).values.double()
    return SE3(rotations, middle - (rotations @ cloud.middle.double()[:, None])[..., 0])


def around(start: SE3, surface: SurfaceMap, cloud: Cloud, count: int, generator: Generator) -> SE3:
    """The start, and poses up to about a quarter of the scene and 30 degrees from it."""
    shifts = torch.randn((count, 6), generator=generator, dtype=torch.float64)
    scale = torch.tensor([0.1 * surface.extent] * 3 + [0.25] * 3, dtype=torch.float64)
    return cloud.pivot.moved(start, shifts * scale * (torch.arange(count) > 0)[:, None])


def drawn(poses: SE3, count: int, generator: Generator) -> SE3:
    """Without repetition as far as they go."""
    rounds = max(1, -(-count // len(poses.translation)))
    order = [torch.randperm(len(poses.translation), generator=generator) for _ in range(rounds)]
    return poses[torch.cat(order)[:count]]


def scattered(poses: SE3, surface: SurfaceMap, generator: Generator) -> SE3:
    """Moved a little, so that repeated ones differ and the same frames do not fail twice."""
    shifts = torch.randn((len(poses.translation), 6), generator=generator, dtype=torch.float64)
    scale = torch.tensor([0.02 * surface.extent] * 3 + [0.05] * 3, dtype=torch.float64)
    return poses.retract(shifts * scale)


def random_rotations(count: int, generator: Generator) -> Float[Tensor, "h 3 3"]:
    """Uniform over all orientations: normal quaternions."""
    quaternions = torch.randn((count, 4), generator=generator, dtype=torch.float64)
    return quaternion_to_rotation_matrix(torch.nn.functional.normalize(quaternions, dim=-1))
