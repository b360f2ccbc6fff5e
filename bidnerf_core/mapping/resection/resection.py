"""Resection: the poses of many images, each from the known points that it sees.

The motion of a camera during a rolling shutter's readout may be estimated along with its pose, under a prior.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.geometry.observations import Sightings
from bidnerf_core.mapping.resection.descend import Normal, descend
from bidnerf_core.mapping.resection.reprojection import Landmarks
from bidnerf_core.mapping.resection.states import MOTION, N, Sights, States

BATCH = 32
"""Number of images whose poses are estimated at once, which bounds the memory; they see similar numbers of points."""


def resections(
    sightings: Sightings,
    points: Float[Tensor, "n 3"],
    images: Int[Tensor, "v"],
    correlation: float = 1.0,
    motions: Sequence[MotionPrior] = (STILL,),
) -> Iterator[tuple[Int[Tensor, "b"], States, Normal]]:
    """Estimate the poses of ``images`` (by number) from ``points`` (metres, world), under each of k priors of the motion.

    ``correlation`` is the number of sightings that count as one because their errors are correlated. Yields the numbers of b
    images; their states under the first prior, then under the next, whose poses are right updates of the images' given ones; and
    the normal equations there. The Hessian is the inverse covariance of an estimate from twenty points or more. All states of
    an image share the noise of the best, so that their evidence can be compared; the last prior should be the widest.
    """
    local, order = sightings.in_camera(points), sightings.view.argsort(stable=True)
    count = torch.bincount(sightings.view)
    first = count.cumsum(0) - count
    deviation = torch.zeros((len(motions), N), dtype=torch.float64)
    deviation[:, MOTION] = torch.stack([motion.deviations for motion in motions])
    images = images[count[images].argsort()]
    for start in range(0, len(images), BATCH):
        some = images[start : start + BATCH]
        b, m = len(some), int(count[some].max())
        number = torch.arange(m)
        own = order[(first[some, None] + number).clamp(max=len(order) - 1)]  # ends with those of other images
        valid = (number < count[some, None]).double()
        rotation = torch.eye(3, dtype=torch.float64).expand(b, m, 3, 3)
        times = sightings.exposure_times[own]
        sights = Sights(sightings.image[own], times, rotation, torch.zeros_like(local[own]), single=True)
        correlated, focal = torch.full((b,), correlation, dtype=torch.float64), sightings.focal[own]
        # The area of a view that is 53 degrees wide; what matters is that outliers are rare.
        area = float(focal.max()) ** 2
        term = Landmarks(
            local[own],
            sights,
            valid,
            torch.zeros_like(valid),
            focal,
            correlated,
            1 / correlated,
            area,
            math.inf,
        )
        h = b * len(motions)
        zero, mode = torch.zeros((h, N), dtype=torch.float64), torch.arange(b).repeat(len(motions))
        states = States(
            SE3(torch.eye(3, dtype=torch.float64).expand(h, 3, 3), zero[:, :3]), zero, zero,
            deviation.repeat_interleave(b, 0), zero[:, 0], zero[:, 0], mode, torch.arange(h) // b,
        )  # fmt: skip
        for _ in range(3):  # each time, the noise is estimated anew
            states, _ = descend(term.with_noise(states), [term], 10)
        states = term.with_noise(states)
        noise = states.noise.view(-1, b).amin(0).repeat(len(motions))
        states = replace(states, noise=noise)
        yield some, *descend(states, [term.weighted_for(states[-b:])], 10)
