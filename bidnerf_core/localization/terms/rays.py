"""Colours of rendered rays as a log likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import exposure_times
from bidnerf_core.fields import RadianceField, RaySamples, SceneBounds, render, render_samples
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.descend import Normal
from bidnerf_core.localization.states import MOTION, Sights, States, rays_by_camera, rays_through

RAYS = 1024
INDEPENDENT = 300.0
"""Largest number of independent measurements among rendered rays, as far as their own noise is concerned."""
FIELD_ERRORS = 10.0
"""Variance of the rays' gradients relative to that by their noise: neighbouring rays share the errors of the field."""
LEAST_WEIGHT = 0.01
"""Rendering weight of a sample below which its derivatives are neglected."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Colours of rendered rays; a gain and an offset of the exposure are eliminated per channel (variable projection)."""

    field: RadianceField
    bounds: SceneBounds
    sights: Sights  # (n) rotation and translation are T_rig_camera
    rgb: Float[Tensor, "n 3"]
    noise: float = 0.1  # of a channel, in the information of a ray
    scale: float = 0.1  # of the robust loss: large enough for a wide basin, small enough to reject occluders

    @staticmethod
    def of(views: Sequence[View], field: RadianceField, bounds: SceneBounds, count: int, seed: int) -> Rays:
        """Draw ``count`` visible pixels of ``views``, whose poses are relative to the last."""
        generator, parts = torch.Generator().manual_seed(seed), []
        for view in views:
            frame, camera = view.frame, view.frame.intrinsics
            number = torch.randperm(camera.width * camera.height, generator=generator)
            if frame.hidden is not None:
                number = number[~frame.hidden.cpu().flatten()[number]]
            number = number[: -(-count // len(views))]
            column, row = number % camera.width, number // camera.width
            pixels = torch.stack([column, row], -1).double() + 0.5
            times = exposure_times(pixels, camera) if len(views) == 1 else torch.zeros(len(pixels)).double()
            flat, T = camera.unproject(pixels)[:, :2], view.T_ref_camera.to("cpu", torch.float64)
            n = len(pixels)
            parts.append(
                (
                    flat,
                    times,
                    T.rotation.expand(n, 3, 3),
                    T.translation.expand(n, 3),
                    frame.rgb[row, column].double(),
                )
            )
        image, times, R, t, rgb = (torch.cat(part) for part in zip(*parts, strict=True))
        return Rays(field, bounds, Sights(image, times, R, t), rgb)

    def __call__(self, states: States) -> Normal:
        value, rows = self._residuals(states)
        cost, weight = self._robust(value)
        flat, pull = rows.flatten(1, 2), (weight[..., None] * value).flatten(1, 2)
        share = INDEPENDENT / (value.shape[1] + INDEPENDENT) / self.noise**2
        hessian = (flat * weight.repeat_interleave(3, 1)[..., None]).mT @ flat
        return Normal(share * cost.sum(-1), share * (flat * pull[..., None]).sum(1), share * hessian)

    def costs(self, states: States) -> Float[Tensor, "h n"]:
        """Return each ray's robust loss, without derivatives, in units of the noise."""
        rgb, _ = self._seen(states)
        gain, offset, _ = self._exposure(rgb)
        return self._robust(gain[:, None] * rgb + offset[:, None] - self.rgb)[0] / self.noise**2

    def fitted(self, states: States) -> Rays:
        """Return the term with the noise that follows from the scatter of the rays' gradients at the first state."""
        value, rows = self._residuals(states[:1])
        weight = self._robust(value)[1][0, :, None, None]
        rows = rows[0, :, :, :6]
        hessian = (weight * rows).flatten(0, 1).mT @ rows.flatten(0, 1)
        scores = (weight[..., 0] * value[0])[..., None] * rows
        scores = (scores - scores.mean(0)).flatten(0, 1)
        unit = hessian.diagonal().clamp(min=1e-12).rsqrt()
        whitened = torch.linalg.pinv(unit[:, None] * hessian * unit, hermitian=True)
        ratio = whitened @ (unit[:, None] * (scores.mT @ scores) * unit)
        return replace(self, noise=min(max(math.sqrt(max(float(ratio.trace()), 0) / 6), 0.005), 0.3))  # host

    def _robust(self, value: Float[Tensor, "h n 3"]) -> tuple[Float[Tensor, "h n"], Float[Tensor, "h n"]]:
        """Return Geman and McClure's loss of each ray, in squared colours, and its weight."""
        squared, half = value.square().sum(-1), (2 * self.scale) ** 2
        return 0.5 * half * squared / (squared + half), (half / (squared + half)).square()

    def _seen(self, states: States):
        """Return the rendered colours (h n 3), and what their derivatives need."""
        rays, sights = rays_through(states, self.sights.image), self.sights
        length = rays.norm(dim=-1, keepdim=True)
        unit = (sights.rotation @ (rays / length)[..., None])[..., 0]  # in the rig's frame
        directions = (unit @ states.T.rotation.mT).float()
        origins = (states.T.translation[:, None] + sights.translation @ states.T.rotation.mT).float()
        leaves = [x.expand_as(directions).flatten(0, 1).contiguous() for x in (origins, directions)]
        rendering = render(self.field, self.bounds.rays(*leaves), self.bounds.background)
        seen = rendering.rgb.detach().double().unflatten(0, directions.shape[:2])
        return seen, (rays, length, unit, leaves, rendering)

    def _residuals(self, states: States):
        seen, (rays, length, unit, leaves, rendering) = self._seen(states)
        # Of the samples that matter: most lie in empty space.
        kept = rendering.samples.valid & (rendering.weights > LEAST_WEIGHT)
        order = (~kept).sort(dim=-1, stable=True).indices[:, : max(1, int(kept.sum(-1).amax()))]  # host
        samples = RaySamples(
            *(x.gather(-1, order) for x in (rendering.samples.starts, rendering.samples.ends, kept))
        )
        leaves = [x.requires_grad_() for x in leaves]
        with torch.enable_grad():
            moving = render_samples(
                self.field, self.bounds.rays(*leaves), samples, self.bounds.background
            ).rgb
            parts = [torch.autograd.grad(moving[:, c].sum(), leaves, retain_graph=c < 2) for c in range(3)]
        gain, offset, basis = self._exposure(seen)
        value = gain[:, None] * seen + offset[:, None] - self.rgb
        by_origin, by_direction = (
            torch.stack([p[k] for p in parts], 1).double().unflatten(0, seen.shape[:2]) for k in (0, 1)
        )
        R, sights = states.T.rotation[:, None], self.sights
        by_origin, by_direction = by_origin @ R, by_direction @ R  # in the rig's axes

        def by_frame(origin, direction, at, along):
            turning = torch.linalg.cross(along[..., None, :].expand_as(direction), direction)
            lever = torch.linalg.cross(at[..., None, :].expand_as(origin), origin)
            return torch.cat([origin, turning + lever], -1)

        by_pose = by_frame(by_origin, by_direction, sights.translation.expand_as(unit), unit)
        own, turned = by_origin @ sights.rotation, by_direction @ sights.rotation  # in the camera's axes
        sight = rays / length
        by_row = by_frame(own, turned, torch.zeros_like(sight), sight)
        across = (turned - (turned @ sight[..., None]) * sight[..., None, :]) / length[..., None]
        by_motion = by_row * sights.times[:, None, None] * states.deviation[:, None, None, MOTION]
        rows = [by_pose, across @ rays_by_camera(rays, states), by_motion, torch.zeros_like(by_pose[..., :1])]
        rows = gain[:, None, :, None] * torch.cat(rows, -1)
        rows = rows - rows.mean(1, keepdim=True)
        return value, rows - basis[..., None] * (basis[..., None] * rows).sum(1, keepdim=True)

    def _exposure(self, seen: Float[Tensor, "h n 3"]):
        """Return gain and offset (h 3) by reweighted least squares, and the unit vector (h n 3) of the gain."""
        weight = torch.ones_like(seen)
        for _ in range(3):
            total = weight.sum(1)
            mean, target = (weight * seen).sum(1) / total, (weight * self.rgb).sum(1) / total
            centred = seen - mean[:, None]
            square = (weight * centred.square()).sum(1)
            gain = ((weight * centred * (self.rgb - target[:, None])).sum(1) / square.clamp(min=1e-9)).clamp(
                0.1, 10
            )
            offset = target - gain * mean
            weight = 1 / (1 + ((gain[:, None] * seen + offset[:, None] - self.rgb) / (2 * self.scale)) ** 2)
        basis = seen - seen.mean(1, keepdim=True)
        return gain, offset, basis / basis.norm(dim=1, keepdim=True).clamp(min=1e-9)
