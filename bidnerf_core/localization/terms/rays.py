"""Colours and distances of rendered rays as a log likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from bidnerf_core.devices import move_to
from bidnerf_core.fields import (
    Observations,
    RadianceField,
    SceneBounds,
    channels,
    device_of,
    differentiate,
    render,
)
from bidnerf_core.frames import View, averaged
from bidnerf_core.geometry import Robust
from bidnerf_core.localization.terms.exposure import eliminate, fit_exposure
from bidnerf_core.localization.terms.surface import draw_numbers, sights_of
from bidnerf_core.mapping import MOTION, Normal, Sights, States, rays_by_camera, rays_through

ALONE = 10.0
"""Maximum number of independent measurements that rays amount to, if there are no others and the pose may be far off."""
OUTLIER = 3.0
"""Residual, in standard deviations or in scales of its loss, beyond which a measurement disagrees."""


@dataclass(frozen=True, eq=False)
class RenderedRays:
    """Residuals of the colours of rendered rays and, with a ``depth_loss``, of their distances.

    A gain and an offset of the exposure are eliminated per channel (variable projection). All tensors are on the field's device when
    the term is evaluated.
    """

    field: RadianceField
    bounds: SceneBounds
    sights: Sights  # (n) rotation and translation are T_rig_camera
    rgb: Float[Tensor, "n 3"]
    coloured: Float[Tensor, "n"]  # 1 where a colour was measured, else 0
    distance: Float[Tensor, "n"]  # metres along the ray, 0 where none was measured
    noise: float | Float[Tensor, ""] = 0.1  # standard deviation of a channel, for the information of a ray
    independent: float = 300.0  # maximum number of independent measurements in the rays
    # of the norm of a colour difference: wide enough for a wide basin, and narrow enough to reject occluders
    loss: Robust = Robust("geman-mcclure", 0.1)
    depth_loss: Robust | None = None  # of depth differences, metres; None: colours alone
    # of a squared depth difference relative to that of a colour, each in units of its scale
    depth_weight: float = 1.0
    exposure: bool = True
    sigma: float = 0.0  # metres: uncertainty of the map's surfaces; steep residuals have less weight in steps

    @staticmethod
    def of(
        views: Sequence[View],
        field: RadianceField,
        bounds: SceneBounds,
        count: int,
        seed: int,
        blur: int = 1,
        depth_rays: Observations | None = None,
        device: torch.device | str | None = None,
        steep: bool = False,
    ) -> RenderedRays:
        """Draw ``count`` visible pixels of ``views``, and at most as many of ``depth_rays``.

        The poses of ``views`` are relative to the last view; another sensor measured ``depth_rays`` in the last camera's frame.
        Colours are averaged over squares of ``blur`` pixels. If ``steep``, pixels where the image changes are preferred, since
        the others hardly depend on the pose. The tensors are put on ``device``, by default the field's.
        """
        generator, parts = torch.Generator().manual_seed(seed), []
        for view in views:
            frame, camera, most = view.frame, view.frame.intrinsics, -(-count // len(views))
            hidden = None if frame.hidden is None else frame.hidden.cpu().flatten()
            number = draw_numbers(camera.width * camera.height, (16 if steep else 1) * most, generator, hidden)
            column, row = number % camera.width, number // camera.width
            if steep and len(number) > most:
                step = max(1, camera.width // 400)
                neighbours = (
                    frame.colours_at((row + v).clamp(0, camera.height - 1), (column + u).clamp(0, camera.width - 1))
                    for u, v in ((step, 0), (-step, 0), (0, step), (0, -step))
                )
                own = frame.colours_at(row, column)
                change = torch.stack([colour - own for colour in neighbours]).square().sum((0, 2)).sqrt().cpu()
                # Half of the rays are drawn evenly, since a rendering may change where the image does not.
                chosen = torch.multinomial(change + change.mean().clamp(min=1e-6), most, generator=generator)
                column, row = column[chosen], row[chosen]
            sights = sights_of(view, row, column, len(views) == 1)
            depth = torch.zeros(len(row)) if frame.depth is None else frame.depth.cpu()[row, column]
            length = pad(sights[0], (0, 1), value=1.0).norm(dim=-1)
            depth = torch.where(depth.isfinite(), depth.clamp(min=0), 0).double() * length
            rgb = frame.colours_at(row, column).cpu() if blur == 1 else averaged(frame, blur)[row, column]
            coloured = torch.full((len(row),), float(frame.has_colour)).double()
            parts.append((*sights, rgb.double(), coloured, depth))
        if depth_rays is not None:
            # Such a ray is the central pixel of a camera of its own.
            some = depth_rays.drawn(count, generator, torch.float64, "cpu")
            zero, z = torch.zeros_like(some.origins), some.directions
            least = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).to(z)
            x = normalize(torch.linalg.cross(least, z), dim=-1)
            parts.append(
                (
                    zero[:, :2],
                    zero[:, 0],
                    torch.stack([x, torch.linalg.cross(z, x), z], -1),
                    some.origins,
                    zero,
                    zero[:, 0],
                    some.distance,
                )
            )
        image, times, R, t, rgb, coloured, depth = (torch.cat(part) for part in zip(*parts, strict=True))
        seen = Sights(image, times, R, t, single=len(views) == 1 and depth_rays is None)
        measured = move_to((seen, rgb, coloured, depth), device or device_of(field))
        return RenderedRays(field, bounds, *measured)

    def __len__(self) -> int:
        return len(self.rgb)

    def first(self, count: int) -> RenderedRays:
        """Return the term of the first ``count`` rays, which are a random sample of those of a single image."""
        some = slice(0, count)
        return replace(self, **{name: getattr(self, name)[some] for name in ("sights", "rgb", "coloured", "distance")})

    def __call__(self, states: States) -> Normal:
        return move_to(self.at(states).normal(), states.z.device)

    def at(self, states: States, derivatives: bool = True) -> ComparedRays:
        """Render the rays at ``states``, and compare them with the measurements, on the field's device."""
        states = move_to(states, self.rgb.device)
        if derivatives:
            return ComparedRays(self, *self._residuals(states))
        *_, origins, directions = self._sent(states)
        rendering = render(self.field, self.bounds.rays(origins, directions), self.bounds.background)
        seen = channels(rendering, *self._distances(len(states)))
        value, _ = self._differences(seen.double().unflatten(0, (len(states), -1)))
        return ComparedRays(self, value, value[..., None], value)

    def costs(self, states: States) -> Float[Tensor, "h n"]:
        """Return each ray's robust loss, divided by the variance of the noise, without derivatives."""
        found = self.at(states, derivatives=False)
        return (self._robust(found.value)[0] / self.noise**2).to(states.z.device)

    def loss_at(self, states: States) -> Float[Tensor, "h"]:
        """Return the mean robust loss of a ray, in squares of the loss's scale, without derivatives."""
        return self.at(states, derivatives=False).loss().to(states.z)

    def plain_costs(self) -> Float[Tensor, "n"] | None:
        """Return each ray's ``costs``, on the CPU, as if all rays had been rendered in the single colour that fits best.

        Returns None with depth, or without colours.
        """
        with_depth = self.depth_loss is not None and bool((self.distance > 0).any())
        if with_depth or not bool(self.coloured.any()):
            return None
        _, offset = self._exposure(torch.zeros_like(self.rgb)[None], always=True)
        value = (offset - self.rgb) * self.coloured[:, None]
        return (self._robust(value)[0] / self.noise**2)[0].cpu()

    def fitted(self, states: States) -> RenderedRays:
        """Return the term with its noise estimated from the scatter of the rays' gradients at the first state."""
        return replace(self, noise=self.at(states[:1]).fitted_noise())

    @property
    def _depth_unit(self) -> float:
        """Colour difference that counts as much as a depth difference of one metre."""
        assert self.depth_loss is not None
        return math.sqrt(self.depth_weight) * self.loss.scale / self.depth_loss.scale

    def _robust(self, value: Float[Tensor, "h n c"]) -> tuple[Float[Tensor, "h n"], Float[Tensor, "h n c"]]:
        """Return each ray's loss, in squared colours, and the weight of each channel."""
        norm = value[..., :3].norm(dim=-1)
        cost, weight = self.loss(norm), self.loss.weight(norm)[..., None].expand_as(value[..., :3])
        if value.shape[-1] > 3 and self.depth_loss is not None:
            unit = self._depth_unit
            cost = cost + unit**2 * self.depth_loss(value[..., 3] / unit)
            weight = torch.cat([weight, self.depth_loss.weight(value[..., 3:] / unit)], -1)
        return cost, weight

    def _sent(self, states: States) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the sights on the plane z = 1, their lengths and rig-frame directions, and the rays' origins and directions (world)."""
        rays, sights = rays_through(states, self.sights.image), self.sights
        length = rays.norm(dim=-1, keepdim=True)
        sight, times = rays / length, sights.times[:, None]
        v, w = (states.nuisances[:, None, part].expand_as(sight) for part in (slice(6, 9), slice(9, 12)))
        turned = normalize(sight + times * torch.linalg.cross(w, sight), dim=-1)  # when the row was exposed
        unit = (sights.rotation @ turned[..., None])[..., 0]
        directions = unit @ states.T.rotation.mT
        away = (sights.rotation @ (times * v)[..., None])[..., 0] + sights.translation
        origins = states.T.translation[:, None] + away @ states.T.rotation.mT
        return rays, length, unit, origins.float().flatten(0, 1), directions.float().flatten(0, 1)

    def _distances(self, count: int) -> tuple[Float[Tensor, "r"] | None, float]:
        """Return the measured distances of all rays from ``count`` states, and the residual of a ray that hits nothing."""
        if self.depth_loss is None:
            return None, 0.0
        # The residual of a ray that hits nothing is that of an outlier, but less than the whole distance.
        return self.distance.float().repeat(count), 3.0 * self.depth_loss.scale

    def _differences(self, seen: Float[Tensor, "h n c"]) -> tuple[Float[Tensor, "h n c"], Float[Tensor, "h 1 3"]]:
        """Return the rendered minus the measured values, and the gain of the exposure."""
        gain, offset = self._exposure(seen[..., :3])
        value = (gain * seen[..., :3] + offset - self.rgb) * self.coloured[:, None]
        if self.depth_loss is None:
            return value, gain
        return torch.cat([value, self._depth_unit * seen[..., 3:]], -1), gain

    def _exposure(
        self, seen: Float[Tensor, "h n 3"], always: bool = False
    ) -> tuple[Float[Tensor, "h 1 3"], Float[Tensor, "h 1 3"]]:
        if not (self.exposure or always):
            return torch.ones_like(seen[:, :1]), torch.zeros_like(seen[:, :1])
        half = 2 * self.loss.scale
        # The prior of the gain is so weak that it matters only if everything in view has one colour.
        known, precision = self.coloured[None, :, None], 0.001 * len(self)
        gain, offset = fit_exposure(
            seen, self.rgb, lambda off: 1 / (1 + (off / half).square()), known, (precision, 0.0)
        )
        return gain.clamp(0.1, 10), offset

    def _residuals(
        self, states: States
    ) -> tuple[Float[Tensor, "h n c"], Float[Tensor, "h n c P"], Float[Tensor, "h n c"]]:
        """Return the residuals, their derivatives, and the norms of the residuals' gradients with respect to the ray origins."""
        rays, length, unit, origins, directions = self._sent(states)
        found = differentiate(
            self.field,
            self.bounds.rays(origins, directions),
            self.bounds.background,
            *self._distances(len(states)),
        )
        seen, by_origin, by_direction = (part.double().unflatten(0, (len(states), -1)) for part in found)
        value, gain = self._differences(seen)
        R, sights = states.T.rotation, self.sights
        # In the rig's axes. Products of many rows by one matrix are faster than many of few rows.
        by_origin, by_direction = ((part.flatten(1, 2) @ R).view(part.shape) for part in (by_origin, by_direction))

        def by_frame(origin: Tensor, direction: Tensor, at: Tensor, along: Tensor) -> Tensor:
            turning = torch.linalg.cross(along[..., None, :].expand_as(direction), direction)
            lever = torch.linalg.cross(at[..., None, :].expand_as(origin), origin)
            return torch.cat([origin, turning + lever], -1)

        by_pose = by_frame(by_origin, by_direction, sights.translation.expand_as(unit), unit)
        own, turned = by_origin, by_direction  # in the camera's axes
        if not sights.single:
            own, turned = own @ sights.rotation, turned @ sights.rotation
        sight = rays / length
        by_row = by_frame(own, turned, torch.zeros_like(sight), sight)
        across = (turned - (turned @ sight[..., None]) * sight[..., None, :]) / length[..., None]
        by_motion = by_row * sights.times[:, None, None] * states.deviation[:, None, None, MOTION]
        parts = [
            by_pose,
            across @ rays_by_camera(rays, states),
            by_motion,
            torch.zeros_like(by_pose[..., :1]),
        ]
        rows, steepness = torch.cat(parts, -1), by_origin.norm(dim=-1)
        scale = torch.cat([gain * self.coloured[:, None], torch.ones_like(value[..., 3:])], -1)
        if self.depth_loss is not None:
            scale = torch.cat([scale[..., :3], self._depth_unit * scale[..., 3:]], -1)
        rows, steepness = scale[..., None] * rows, scale * steepness
        if self.exposure:
            weight = self._robust(value)[1][..., :3] * self.coloured[:, None]
            colours = eliminate(rows[..., :3, :], seen[..., :3], weight)
            rows = torch.cat([colours, rows[..., 3:, :]], -2)
        return value, rows, steepness


@dataclass(frozen=True, eq=False)
class ComparedRays:
    """Rendered minus measured values of n rays from each of h poses."""

    term: RenderedRays
    value: Float[Tensor, "h n c"]
    rows: Float[Tensor, "h n c P"]  # derivatives
    steepness: Float[Tensor, "h n c"]  # norm of the gradient by the ray's origin, per metre

    def normal(self) -> Normal:
        term = self.term
        cost, weight = term._robust(self.value)
        if term.sigma > 0:  # adds a variance of (steepness x sigma)^2
            confidence = (1 + (term.sigma / term.loss.scale * self.steepness).square()).rsqrt()
            weight = confidence.square() * term._robust(confidence * self.value)[1]
        flat, pull = self.rows.flatten(1, 2), (weight * self.value).flatten(1, 2)
        hessian = (flat * weight.flatten(1)[..., None]).mT @ flat
        share = term.independent / (len(term) + term.independent) / term.noise**2
        return Normal(share * cost.sum(-1), share * (flat * pull[..., None]).sum(1), share * hessian)

    def loss(self) -> Float[Tensor, "h"]:
        """Return the mean robust loss of a ray, in squares of the loss's scale."""
        return self.term._robust(self.value)[0].mean(-1) / self.term.loss.scale**2

    def agreement(self) -> Float[Tensor, "h"]:
        """Return the fraction of the rays whose colours and distances agree with the rendering."""
        term, size = self.term, self.value.abs()
        good = (size[..., :3] <= OUTLIER * term.loss.scale).all(-1)
        if term.depth_loss is not None:
            good = good & (size[..., 3] <= OUTLIER * term._depth_unit * term.depth_loss.scale)
        return good.double().mean(-1)

    def colour_noise(self) -> Float[Tensor, "h"]:
        """Return the root mean square of the colour differences, as ``Problem.colour_noise`` is for the map's own images."""
        coloured = self.term.coloured
        total = self.value[..., :3].square().sum((1, 2)) / 3
        return (total / coloured.sum().clamp(min=1)).sqrt()

    def fitted_noise(self) -> Float[Tensor, ""]:
        """Return the noise, estimated from the scatter of the rays' gradients at the first state."""
        weight = self.term._robust(self.value)[1][0, :, :, None]
        rows = self.rows[0, :, :, :6]
        hessian = (weight * rows).flatten(0, 1).mT @ rows.flatten(0, 1)
        scores = (weight[..., 0] * self.value[0])[..., None] * rows
        scores = (scores - scores.mean(0)).flatten(0, 1)
        unit = hessian.diagonal().clamp(min=1e-12).rsqrt()
        eye = torch.eye(6, dtype=unit.dtype, device=unit.device)
        factor, _ = torch.linalg.cholesky_ex(unit[:, None] * hessian * unit + 1e-9 * eye)
        whitened = torch.linalg.solve_triangular(factor, unit[:, None] * scores.mT, upper=False)
        return (whitened.square().sum() / 6).sqrt().nan_to_num(0.0).clamp(0.005, 0.3)
