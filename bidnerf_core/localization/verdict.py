"""Whether an aligned pose is to be believed, and how sure it is. Decided without knowing the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.alignment import Cloud, Scales, alignment, colours, contact, falling, misfit
from bidnerf_core.localization.search import FINEST, JUDGED, Found
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3

INDEPENDENT = 10
"""Measurements of an image that are independent of each other, by the normalised errors on several maps and sensors:
rendered images are surer than this, those of a hand-held Kinect less sure.
"""
WELL_BEFORE = 0.04
"""Share of the extent by which a line of sight must meet the surface too early."""
LEAST_VARIANCE = 1e-9
"""Of a residual, in units of its scale: below is rounding."""


@dataclass(frozen=True)
class Bars:
    """What an answer needs to be believed."""

    on_surface: float = 0.85  # share of the measured points that lie on the surface, at least
    alike: float = 0.42  # share that lies there and has its colour, at least
    crossed: float = 0.15  # share of lines of sight that run through the surface, at most
    lead: float = 0.15  # by how much the next best answer must be worse
    shown: float = 0.9  # share of rendered rays that see what was measured, at least


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose."""

    on_surface: float
    alike: float
    crossed: float
    lead: float
    shown: float = 1.0  # where nothing was rendered, nothing speaks against it

    def doubt(self, bars: Bars) -> str | None:
        """What speaks against it most, in words; None where nothing does."""
        if self.on_surface < bars.on_surface:
            return f"only {self.on_surface:.0%} of the measured points lie on the surface"
        if self.alike < bars.alike:
            return f"only {self.alike:.0%} of the measured points have the colour of the surface"
        if self.crossed > bars.crossed:
            return f"{self.crossed:.0%} of the lines of sight run through the surface"
        if self.lead < bars.lead:
            return "another pose fits about as well"
        if not self.shown >= bars.shown:
            return f"only {self.shown:.0%} of the rays that the field renders see what was measured"
        return None


def evidence(surface: SurfaceMap, cloud: Cloud, found: Found) -> Evidence:
    """Shares over the points of ``cloud``; a point counts by how near it is, so that there is no edge to fall over."""
    scales = Scales(JUDGED * surface.extent)
    touch = contact(surface, cloud, found.T[None])
    near = falling(touch.squared, scales.distance)
    tint, _ = colours(surface, touch, cloud)
    alike = near * falling((tint**2).sum(-1), scales.colour)
    return Evidence(float(near.mean()), float(alike.mean()), crossed(surface, cloud, found.T), found.lead)


def crossed(surface: SurfaceMap, cloud: Cloud, T: SE3, count: int = 300) -> float:
    """Share of lines of sight that meet the surface well before the point that was measured."""
    some = cloud.first(count)
    origins, ends = (T.apply(x.double()).to(some.points) for x in (some.origins, some.points))
    length = torch.linalg.vector_norm(ends - origins, dim=-1)
    met = surface.trace(origins, (ends - origins) / length.clamp(min=1e-9)[:, None])
    slack = max(WELL_BEFORE * surface.extent, 4 * surface.cell)  # grazing lines meet coarse cells early
    return float((met < length - slack).float().mean())


def covariance(surface: SurfaceMap, cloud: Cloud, T: SE3, views: int = 1) -> Float[Tensor, "6 6"]:
    """Of a right update at the camera, metres and radians: the inverse of the weighted normal matrix over the variance of
    the residuals; positive definite.

    Errors of a map and of a sensor are alike over large parts of an image, so that its thousands of pixels count for
    ``INDEPENDENT`` measurements only. What the points do not tell, as the way along a bare wall, is known to the size of
    the scene and to half a turn.
    """
    scales = Scales(FINEST * surface.cell)
    system = alignment(surface, cloud, scales, T[None])
    variance = misfit(surface, cloud, scales, T[None])[0].clamp(min=LEAST_VARIANCE) / (INDEPENDENT * views)
    known = torch.tensor([surface.extent] * 3 + [math.pi] * 3, dtype=torch.float64)
    information = system.hessian[0] / variance + torch.diag(known**-2)
    spread = cloud.pivot.at_camera(T, torch.linalg.inv(information))
    return (spread + spread.mT) / 2
