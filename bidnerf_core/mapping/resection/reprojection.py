"""Reprojection errors of matched landmarks as a log likelihood.

Residuals are those of a Student-t distribution in two dimensions with two degrees of freedom (Cauchy's loss), mixed with outliers that
are uniform over the image. As neighbouring errors are correlated, a term of n residuals is scaled to the number of independent ones (a
composite likelihood, Pauli, Racugno and Ventura 2011).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.geometry import MAD_TO_SIGMA, SE3
from bidnerf_core.mapping.geometry.triangulation import Sightings
from bidnerf_core.mapping.resection.descend import Normal, descend
from bidnerf_core.mapping.resection.states import MOTION, N, Projections, Sights, States, jacobian, project

LEAST_NOISE = 0.05
"""Minimum standard deviation of a keypoint (pixels); no detector is more accurate."""
SCALE = 2.0
"""Residual, in standard deviations, at which the weight of a Student-t residual is one half."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Reprojection errors of matched landmarks, in pixels; a hypothesis uses the matches of its mode."""

    points: Float[Tensor, "g m 3"]  # metres, world; g modes, padded to m matches
    sights: Sights  # (g m)
    valid: Float[Tensor, "g m"]  # 1, or 0 for padding
    variance: Float[Tensor, "g m"]  # square pixels: of the landmarks' projections
    focal: Float[Tensor, "g m"]  # pixels
    correlation: Float[Tensor, "g"]  # number of matches that count as one measurement
    share: Float[
        Tensor, "g"
    ]  # weight of a match's log likelihood, so that the inverse Hessian is the estimate's covariance
    area: float  # of the image, square pixels, over which outliers are spread
    most_noise: float  # pixels: largest noise of keypoints that match

    def __call__(self, states: States) -> Normal:
        cost, rows, pull = self._weighted(states)
        return Normal(cost, (rows @ pull[..., None])[..., 0], rows @ rows.mT)

    def sandwich(self, states: States) -> tuple[Float[Tensor, "h P P"], Float[Tensor, "h P P"], Float[Tensor, "h P P"]]:
        """Return the reweighted Hessian, the curvature, and the scatter of the matches' gradients.

        The covariance of an M-estimator is curvature^-1 scatter curvature^-1 (Huber 1981, 6.3). Matches with more influence often have
        larger errors than the others.

        The scatter of few matches is far too small in some directions, so it is shrunk to that of identically distributed residuals
        (Ledoit and Wolf 2004).
        """
        _, rows, pull = self._weighted(states)
        share, independent = self.share[states.mode], 1 / self.correlation[states.mode]
        scores = (rows * pull[:, None]).unflatten(-1, (-1, 2)).sum(-1) / share[:, None, None]
        hessian = rows @ rows.mT * (independent / share)[:, None, None]
        scatter = scores @ scores.mT * independent[:, None, None]
        curvature = hessian - 2 / SCALE**2 * scatter
        traces = [
            x.diagonal(dim1=-2, dim2=-1)[:, :6] / hessian.diagonal(dim1=-2, dim2=-1)[:, :6].clamp(min=1e-300)
            for x in (scatter, curvature)
        ]
        excess = traces[0].mean(-1) / traces[1].mean(-1).clamp(min=0.1)
        count = 2 * self.valid[states.mode].sum(-1)
        known = (count / (36 + count))[:, None, None]
        alike = (excess * count / (count - 6).clamp(min=1))[:, None, None] * curvature
        return hessian, curvature, known * scatter + (1 - known) * alike

    def _weighted(self, states: States) -> tuple[Float[Tensor, "h"], Float[Tensor, "h P r"], Float[Tensor, "h r"]]:
        """Return the term's cost, and the weighted rows (transposed) and residuals of its least-squares problem."""
        own = self._of(states)
        seen = project(states, own.points, own.sights)
        squared, off, variance = own._residuals(states, seen)
        u, odds = 1 + squared / SCALE**2, own._odds(variance)
        square = u.square()
        share = own.share[:, None] * own.valid
        cost = -(share * torch.where(seen.front, torch.log1p(odds / square), 0)).sum(-1)
        inlier = odds / (odds + square)  # probability
        scale = (share * seen.front * inlier / (u * variance)).sqrt()
        rows = jacobian(states, seen, own.sights) * (own.focal * scale)[:, None, :, None]
        return cost, rows.flatten(2), (off * scale[..., None]).flatten(1)

    def _of(self, states: States) -> Landmarks:
        """Return the term with the matches of each state's mode; the matches of a single mode are broadcast."""
        if len(self.points) == 1:
            return self
        names, g = ("points", "sights", "valid", "variance", "focal", "correlation", "share"), states.mode
        return replace(self, **{name: getattr(self, name)[g] for name in names})

    def evidence(self, states: States) -> Float[Tensor, "h"]:
        """Return the log likelihood relative to that of outliers alone.

        It is computed with the largest noise of any state and without weights, so that it counts matches.
        """
        states = replace(states, noise=states.noise.amax().expand_as(states.noise))
        own = self._of(states)
        squared, _, variance = own._residuals(states)
        gain = torch.log1p(own._odds(variance) / (1 + squared / SCALE**2).square())
        return (own.valid * gain).sum(-1)

    def with_noise(self, states: States) -> States:
        """Return the states with their noise estimated from the residuals."""
        own = self._of(states)
        off, valid = own._residuals(states)[1], own.valid > 0
        sizes = torch.where(valid[..., None], off.abs(), torch.nan).flatten(1)
        by_points = torch.where(valid, own.variance, torch.nan).nanmedian(-1).values
        spread = (MAD_TO_SIGMA * sizes.nanmedian(-1).values).square()
        noise = (spread - by_points).clamp(LEAST_NOISE**2, self.most_noise**2).nan_to_num(1.0).sqrt()
        return replace(states, noise=noise)

    def weighted_for(self, best: States) -> Landmarks:
        """Return the term with the number of independent matches estimated from the residuals at ``best`` (g).

        The weight of a match is proportional to an efficiency: the ratio of the information of an M-estimator to its reweighted Hessian
        (Huber 1981, 6.3).
        """
        squared, valid = self.residuals(best)[0], self.valid[best.mode]
        weight = 1 / (1 + squared / SCALE**2)
        count = valid.sum(-1).clamp(min=1)
        scatter = 0.5 * (valid * weight.square() * squared).sum(-1) / count
        curvature = (valid * (weight - weight.square() * squared / SCALE**2)).sum(-1) / count
        spare = (1 - 3 / count).clamp(min=0.1)  # six unknowns, two residuals of a match
        hessian = (valid * weight).sum(-1) / count
        efficiency = spare * curvature.clamp(min=0.1).square() / (scatter * hessian).clamp(min=1e-3)
        return replace(self, share=efficiency * self.share)

    def distance(self, states: States) -> float:
        """Return the median distance of the matched points from the first state's pose, metres."""
        g = int(states.mode[0])
        away = (self.points[g] - states.T.translation[0]).norm(dim=-1)
        return float(away[self.valid[g] > 0].median())

    def residuals(self, states: States) -> tuple[Tensor, Tensor, Tensor]:
        """Return squared residuals in units of their variance (h m), the residuals and their variance.

        The residuals are projection minus observation (h m 2, pixels), and the variance is that along each axis (h m, square pixels).
        """
        return self._of(states)._residuals(states)

    def _odds(self, variance: Float[Tensor, "h m"]) -> Float[Tensor, "h m"]:
        """Return the density of a zero residual relative to the density of an outlier."""
        return self.area / (math.pi * SCALE**2) / variance

    def _residuals(
        self, states: States, seen: Projections | None = None
    ) -> tuple[Float[Tensor, "h m"], Float[Tensor, "h m 2"], Float[Tensor, "h m"]]:
        """Return the same as ``residuals``, for a term that already holds the matches of the states' modes."""
        seen = project(states, self.points, self.sights) if seen is None else seen
        variance = states.noise[:, None].square() + self.variance
        off = (seen.image - self.sights.image) * self.focal[..., None]
        return torch.where(seen.front, off.square().sum(-1) / variance, 1e6), off, variance


@runtime_checkable
class UncertainPoints(Protocol):
    """World points (n) with the errors of their positions, as in a ``LandmarkMap``."""

    @property
    def positions(self) -> Float[Tensor, "n 3"]: ...
    @property
    def deviations(self) -> Float[Tensor, "n 2"]: ...
    @property
    def directions(self) -> Float[Tensor, "n 3"]: ...


def point_variance(
    landmarks: UncertainPoints, index: Int[Tensor, "m"], states: States, focal: Float[Tensor, "m"]
) -> Float[Tensor, "m"]:
    """Return the variance (square pixels) of landmarks' projections at the first state, averaged over both axes."""
    points, towards = landmarks.positions[index].double(), landmarks.directions[index].double()
    sight = points - states.T.translation[0]
    distance = sight.norm(dim=-1).clamp(min=1e-9)
    cosine = ((sight * towards).sum(-1) / distance).square().clamp(max=1)
    across, along = landmarks.deviations[index].double().square().unbind(-1)
    return (across * (1 + cosine) + along * (1 - cosine)) / 2 * (focal / distance).square()


BATCH = 32
"""Number of images whose poses are estimated at once, to bound the memory; the images of a batch see similar numbers of points."""


def resections(
    sightings: Sightings,
    points: Float[Tensor, "n 3"],
    images: Int[Tensor, "v"],
    correlation: float = 1.0,
    motions: Sequence[MotionPrior] = (STILL,),
) -> Iterator[tuple[Int[Tensor, "b"], States, Normal]]:
    """Estimate the poses of ``images`` (by number) from ``points`` (metres, world), under each of k priors of the motion.

    ``correlation`` is the number of sightings that count as one because their errors are correlated. Yields the numbers of b
    images; their states under the first prior, then under the next, with poses as right updates of the images' given poses; and
    the normal equations at these states. The Hessian is the inverse covariance of an estimate from twenty points or more. All states of
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
        own = order[(first[some, None] + number).clamp(max=len(order) - 1)]  # padded from other images
        valid = (number < count[some, None]).double()
        rotation = torch.eye(3, dtype=torch.float64).expand(b, m, 3, 3)
        times = sightings.exposure_times[own]
        sights = Sights(sightings.image[own], times, rotation, torch.zeros_like(local[own]), single=True)
        correlated, focal = torch.full((b,), correlation, dtype=torch.float64), sightings.focal[own]
        # The area of a view that is 53 degrees wide; what matters is that outliers are rare.
        area = float(focal.max()) ** 2
        variance, h = torch.zeros_like(valid), b * len(motions)
        term = Landmarks(local[own], sights, valid, variance, focal, correlated, 1 / correlated, area, math.inf)
        zero, mode = torch.zeros((h, N), dtype=torch.float64), torch.arange(b).repeat(len(motions))
        states = States(
            SE3(torch.eye(3, dtype=torch.float64).expand(h, 3, 3), zero[:, :3]),
            zero,
            zero,
            deviation.repeat_interleave(b, 0),
            zero[:, 0],
            zero[:, 0],
            mode,
            torch.arange(h) // b,
        )
        for _ in range(3):  # each time, the noise is estimated anew
            states, _ = descend(term.with_noise(states), [term], 10)
        states = term.with_noise(states)
        states = replace(states, noise=states.noise.view(-1, b).amin(0).repeat(len(motions)))
        yield some, *descend(states, [term.weighted_for(states[-b:])], 10)
