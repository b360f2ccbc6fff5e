"""Distances of measured points from the baked surface, and colour differences, as a log likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera import exposure_times
from bidnerf_core.devices import move_to
from bidnerf_core.fields import Observations
from bidnerf_core.frames import View
from bidnerf_core.geometry import MAD_TO_SIGMA, inlier_weight
from bidnerf_core.localization.settings import LEAST_POINTS
from bidnerf_core.localization.terms.exposure import fit_exposure
from bidnerf_core.mapping import (
    DEPTH,
    MOTION,
    Normal,
    Sights,
    States,
    SurfaceMap,
    by_update,
    rays_by_camera,
    rays_through,
)

COLOUR = 0.15
"""Norm of the colour difference (three channels, each in [0, 1]) at which a point's inlier weight is one half."""


def draw_numbers(
    size: int, count: int, generator: torch.Generator, left_out: Bool[Tensor, "n"] | None = None
) -> Int[Tensor, "c"]:
    """Return ``count`` of ``size`` numbers, or all if there are fewer, without those ``left_out``, in random order."""
    if left_out is not None:
        others = (~left_out).nonzero()[:, 0]
        return others[draw_numbers(len(others), count, generator)]
    # Drawing with replacement takes far less time, and hardly any of so many numbers is drawn twice.
    if size > 100 * count:
        return torch.randint(size, (count,), generator=generator)
    return torch.randperm(size, generator=generator)[:count]


def sights_of(view: View, row: Tensor, column: Tensor, may_move: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the fields of ``Sights`` for some pixels of a view; rotation and translation are T_rig_camera.

    ``may_move`` is true if the camera may have moved during the readout, and false for a rig, whose views may be from
    different times.
    """
    pixels, camera = torch.stack([column, row], -1).double() + 0.5, view.frame.intrinsics
    times = exposure_times(pixels, camera) if may_move else torch.zeros_like(pixels[:, 0])
    T, n = view.T_ref_camera.to("cpu", torch.float64), len(pixels)
    return camera.unproject(pixels)[:, :2], times, T.rotation.expand(n, 3, 3), T.translation.expand(n, 3)


@dataclass(frozen=True, eq=False)
class Surface:
    """Distances of measured points from the planes of the nearest surfels (metres), and differences from the surfels' colours.

    All tensors are on the surface's device when the term is evaluated.
    """

    surface: SurfaceMap
    sights: Sights  # (n) pixels of measured depth; rotation and translation are T_rig_camera
    z: Float[Tensor, "n"]  # metres, measured along the optical axis
    fixed: Float[Tensor, "n 3"]  # metres: points of another sensor, relative to that sensor; their z is 0
    rgb: Float[Tensor, "n 3"]
    coloured: Float[Tensor, "n"]  # 1 where a colour was measured, else 0
    noise: float | Float[Tensor, ""]  # metres
    colour_weight: float = 0.0  # of colours, relative to distances
    independent: float = 10.0  # maximum number of independent measurements among the points

    @staticmethod
    def of(
        views: Sequence[View],
        rays: Observations | None,
        surface: SurfaceMap,
        seed: int,
        count: int = 500,
        device: torch.device | str | None = None,
    ) -> Surface | None:
        """Draw measured points of ``views``, whose poses are relative to the last view, in random order; None if there are too few.

        The points are put on ``device``, by default the surface's.
        """
        generator, parts = torch.Generator().manual_seed(seed), []
        for view in views:
            frame = view.frame
            depth = torch.zeros((0, 0)) if frame.depth is None else frame.depth.cpu()
            row, column = ((depth > 0) & depth.isfinite()).nonzero().unbind(-1)
            drawn = draw_numbers(len(row), -(-count // len(views)), generator)
            row, column = row[drawn], column[drawn]
            sights = sights_of(view, row, column, len(views) == 1)
            z, n = depth[row, column].double(), len(row)
            rgb = frame.colours_at(row, column).cpu().float()
            coloured = torch.full((n,), float(frame.has_colour))
            parts.append((*sights, z, torch.zeros((n, 3)).double(), rgb, coloured))
        if rays is not None and len(rays):
            some = rays.drawn(count, generator, torch.float64, "cpu")
            zero, none = torch.zeros_like(some.origins), torch.zeros_like(some.distance)
            eye = torch.eye(3, dtype=torch.float64).expand(len(some), 3, 3)
            points, sights = some.points - some.origins, (zero[:, :2], none, eye, some.origins)
            parts.append((*sights, none, points, zero.float(), none.float()))
        total = sum(len(part[0]) for part in parts)
        if total < LEAST_POINTS:
            return None
        order = torch.randperm(total, generator=generator)
        image, times, R, t, z, fixed, rgb, coloured = (torch.cat(part)[order] for part in zip(*parts, strict=True))
        measured = move_to((Sights(image, times, R, t), z, fixed, rgb, coloured), device or surface.device)
        return Surface(surface, *measured, noise=2 * surface.cell)

    def __len__(self) -> int:
        return len(self.z)

    def first(self, count: int) -> Surface:
        """Return the term of the first ``count`` points, which are a random sample."""
        some = slice(0, count)
        names = ("sights", "z", "fixed", "rgb", "coloured")
        return replace(self, **{name: getattr(self, name)[some] for name in names})

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The measured points in the rig's frame, with the stated camera at rest."""
        image, sights = self.sights.image, self.sights
        local = torch.cat([image, torch.ones_like(image[:, :1])], -1) * self.z[:, None] + self.fixed
        return (sights.rotation @ local[..., None])[..., 0] + sights.translation

    def __call__(self, states: States) -> Normal:
        here = move_to(states, self.surface.device)
        r, squared, normal, index, along, local, rays, rig = self._offsets(here)
        # Geman-McClure: points of an occluder have almost no influence
        inlier = inlier_weight(squared, 2 * self.noise)
        share = self.independent / len(self)
        cost = share * 2 * (1 - inlier).sum(-1)
        weight = share * inlier.square() / self.noise**2
        residuals, slopes, weights = r[..., None], normal[..., None, :], weight[..., None]
        if self.colour_weight:
            difference, slope = self._colours(index, along)
            alike = self._alike(difference)
            cost = cost + share * 2 * self.colour_weight * (1 - inlier * alike).sum(-1)
            by_distance = weight * (1 + self.colour_weight * alike)
            by_colour = 4 * share * self.colour_weight * inlier * alike.square() / COLOUR**2
            residuals = torch.cat([residuals, difference.double()], -1)
            slopes = torch.cat([slopes, slope.double()], -2)
            weights = torch.stack([by_distance, *3 * [by_colour]], -1)
        # The derivatives of the points (world) along the normals, and along the changes of colour, by the unknowns.
        by_rig = (slopes.flatten(1, 2) @ here.T.rotation).view_as(slopes)
        own = by_rig @ self.sights.rotation
        scale = (self.z * here.nuisances[:, DEPTH, None].exp())[..., None, None]
        by_camera = own @ (rays_by_camera(rays, here) * scale)
        by_motion = -by_update(own, local) * self.sights.times[:, None, None] * here.deviation[:, None, None, MOTION]
        by_depth = own @ (local - self.fixed)[..., None] * here.deviation[:, None, None, DEPTH:]
        rows = torch.cat([-by_update(by_rig, rig), by_camera, by_motion, by_depth], -1).flatten(1, 2)
        weighted = (rows * weights.flatten(1)[..., None]).mT
        gradient = (weighted @ residuals.flatten(1)[..., None])[..., 0]
        return move_to(Normal(cost, gradient, weighted @ rows), states.z.device)

    def inliers(self, states: States) -> tuple[Float[Tensor, "h n"], Float[Tensor, "h n"]]:
        """Return each point's inlier weights by distance and by colour."""
        here = move_to(states, self.surface.device)
        _, squared, _, index, along, *_ = self._offsets(here)
        found = inlier_weight(squared, 2 * self.noise), self._alike(self._colours(index, along)[0])
        return move_to(found, states.z.device)

    def costs(self, states: States) -> Float[Tensor, "h n"]:
        """Return each point's cost, from 0 to 1 plus the colour weight."""
        near, alike = self.inliers(states)
        return 1 - near + self.colour_weight * (1 - near * alike)

    def mean_cost(self, states: States) -> Float[Tensor, "h"]:
        return self.costs(states).mean(-1)

    def fitted_noise(self, states: States) -> Surface:
        """Return the term with the noise estimated from the points at the first state."""
        r = self._offsets(move_to(states[:1], self.surface.device))[0].abs()
        found = (MAD_TO_SIGMA * r.median()).clamp(min=0.25 * self.surface.cell)
        return replace(self, noise=found.clamp(max=3 * self.noise))

    def match_exposure(self, states: States) -> Surface:
        """Return the term with colours converted to the map's exposure, using the points on the surface at the first state.

        The colours are left unchanged if the conversion makes hardly any more points match the surface's colour.
        """
        here = move_to(states[:1], self.surface.device)
        _, squared, _, index, along, *_ = self._offsets(here)
        difference, near = self._colours(index, along)[0], inlier_weight(squared, 2 * self.noise)
        known = (near * self.coloured)[..., None].float()
        surface = difference + self.rgb
        gain, offset = fit_exposure(
            surface,
            self.rgb,
            lambda difference: inlier_weight(difference.square(), COLOUR),
            known,
            (0.02 * len(self), 0.0),
            6,
        )
        rgb = ((self.rgb - offset[0]) / gain[0].clamp(min=0.1)).clamp(0, 1)
        changed = replace(self, rgb=rgb)
        gained = near * (changed._alike(surface - rgb) - self._alike(difference)) * self.coloured
        # An exposure must add a twentieth of all points to the colour inliers. Blur also lowers contrast, but restoring that
        # contrast only enlarges the differences.
        return changed if float(gained.mean()) > 0.05 else self  # host

    def _alike(self, difference: Float[Tensor, "h n 3"]) -> Float[Tensor, "h n"]:
        return inlier_weight(difference.double().square().sum(-1), COLOUR)

    def _colours(self, index: Tensor, along: Tensor) -> tuple[Float[Tensor, "h n 3"], Float[Tensor, "h n 3 3"]]:
        """Return the surface's colour at each point minus the measured one, and the derivative with respect to the point (world)."""
        surfels = self.surface.surfels
        slope = surfels.rgb_gradient[index]
        change = (slope @ along.to(slope)[..., None])[..., 0]
        # A surfel's colour is extrapolated within its plane by a change of at most this.
        most = 0.2
        slope = slope * (change.abs() < most)[..., None]
        difference = surfels.rgb[index] + change.clamp(-most, most) - self.rgb
        seen = self.coloured[:, None]
        return difference * seen, slope * seen[..., None]

    def _offsets(self, states: States) -> tuple[Tensor, ...]:
        """Return each point's offset across the nearest surfel's plane, squared distance from the surfel, normal, number and offset along the
        plane; and the point in the camera's frame, the ray through it and the point in the rig's frame.
        """
        rays, sights = rays_through(states, self.sights.image), self.sights
        local = rays * (self.z * states.nuisances[:, DEPTH, None].exp())[..., None] + self.fixed
        v, w = (states.nuisances[:, None, part].expand_as(local) for part in (slice(6, 9), slice(9, 12)))
        local = local + sights.times[:, None] * (v + torch.linalg.cross(w, local))
        rig = (sights.rotation @ local[..., None])[..., 0] + sights.translation
        world = states.T.translation[:, None] + rig @ states.T.rotation.mT
        index = self.surface.nearest(world.float())
        offset = world - self.surface.surfels.positions[index]
        normal = self.surface.surfels.normals[index].double()
        across = (offset * normal).sum(-1)
        along = offset - across[..., None] * normal
        # A point farther from a surfel than its radius, 1.5 cells, does not lie on the surface.
        beyond = (along.norm(dim=-1) - 1.5 * self.surface.cell).clamp(min=0)
        return across, across.square() + beyond.square(), normal, index, along, local, rays, rig
