"""Comparison of whole small photos with renderings of a map from many poses.

Thumbnails are small, smoothed photos. Renderers quickly render the same views, without derivatives, from the baked surface or a
field. The derivative of a rendered image with respect to the pose follows from the image's gradient and its depth, for any renderer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from bidnerf_core.devices import constant, move_to
from bidnerf_core.fields import RadianceField, SceneBounds, render
from bidnerf_core.frames import Thumbnail, slopes, smooth
from bidnerf_core.geometry import SE3, inlier_weight
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.terms.exposure import fit_exposure
from bidnerf_core.mapping import CAMERA, Normal, P, States, SurfaceMap, cast, descend, true_intrinsics

Renderer = Callable[[Float[Tensor, "r 3"], Float[Tensor, "r 3"]], tuple[Tensor, Tensor, Tensor]]
"""Renders rays, given their origins and unit directions (world). Returns their colours (r 3); a mask (r), 1 where the map renders the ray
and 0 where it has nothing, by which the colours are multiplied; and the distances (r, metres) of the visible points or, for the background,
of the points where rays pass closest to the scene."""


def surface_renderer(surface: SurfaceMap, background: tuple[float, float, float] | None) -> Renderer:
    """Return a renderer of the colours of a surface's surfels.

    Without a ``background``, a ray that hits nothing counts as passing through a hole in the map.
    """

    def rendered(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = cast(surface, origins, directions)
        met = found.met[:, None].to(origins)
        behind = constant(background or (0.0, 0.0, 0.0), origins)
        rgb = met * surface.surfels.rgb[found.index] + (1 - met) * behind
        known = met[:, 0] if background is None else torch.ones_like(found.along)
        return rgb, known, found.along.clamp(min=surface.cell)

    return rendered


def field_renderer(field: RadianceField, bounds: SceneBounds) -> Renderer:
    """Return a renderer of a field with its background."""

    @torch.no_grad()
    def rendered(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = render(field, bounds.rays(origins, directions), bounds.background)
        passing = ((constant(bounds.centre, origins) - origins) * directions).sum(-1)
        met = seen.distance / seen.opacity.clamp(min=0.5)
        along = torch.where(seen.opacity > 0.5, met, passing).clamp(min=bounds.near)
        return seen.rgb, torch.ones_like(along), along

    return rendered


@dataclass(frozen=True, eq=False)
class Images:
    """Cost of small images: the mean over pixels of ``1 - 1 / (1 + c^2 / s^2)``, times ``INDEPENDENT``.

    Here, c is the difference between rendered and measured colour, and s is ``COLOUR_SCALE``.

    Colours are linearized with second-order accuracy, using the mean of both images' gradients (Benhimane and Malis 2004, "Real-time
    image-based tracking of planes using efficient second-order minimization"). Only the pose has derivatives. The cost is infinite for
    poses that are not finite. Everything is computed on the device of the thumbnails, which is also that of the renderer.
    """

    INDEPENDENT: ClassVar[float] = 60.0
    """Number of independent measurements in a small image."""
    COLOUR_SCALE: ClassVar[float] = 0.2
    """Norm of a pixel's colour difference (three channels) at which its inlier weight is one half."""

    renderer: Renderer
    thumbnails: Sequence[Thumbnail]
    # Standard deviation of the prior of the exposure's gain about 1; that of the offset about 0 is 0.1.
    gain: float = 0.2
    rounds: int = 2  # of reweighting for the exposure

    @torch.no_grad()
    def __call__(self, states: States) -> Normal:
        parts = [self._of_thumbnail(small, states.T) for small in self.thumbnails]
        cost, gradient, hessian = (
            self.INDEPENDENT * torch.stack(values).mean(0).to(states.z) for values in zip(*parts, strict=True)
        )
        sound = states.T.translation.isfinite().all(-1) & states.T.rotation.isfinite().all(-1).all(-1)
        extra = P - 6
        return Normal(
            torch.where(sound, cost, torch.inf), pad(gradient, (0, extra)), pad(hessian, (0, extra, 0, extra))
        )

    def _of_thumbnail(self, small: Thumbnail, T: SE3) -> tuple[Tensor, Tensor, Tensor]:
        """Return the cost, its gradient and its Hessian of one image."""
        camera, count = small.camera, len(T.translation)
        local = small.T_last_camera.to(small.flat).rotate(normalize(small.flat, dim=-1))
        origin = small.T_last_camera.translation.to(local)
        directions = local @ T.rotation.to(local).mT
        origins = (T.rotation.to(local) @ origin + T.translation.to(local))[:, None].expand_as(directions)
        rgb, known, along = self.renderer(origins.reshape(-1, 3), directions.reshape(-1, 3))
        rgb, known = (
            smooth(part.reshape(count, camera.height, camera.width, -1).permute(0, 3, 1, 2)) for part in (rgb, known)
        )
        rgb, along = rgb / known.clamp(min=1e-3), along.view(count, -1)
        # The visible points in the last camera's frame, and their depths in the thumbnail's camera.
        points, depth = origin + along[..., None] * local, along / torch.linalg.vector_norm(small.flat, dim=-1)
        seen, measured, sure = rgb.flatten(2).mT, small.rgb.flatten(1).mT, known.flatten(1)[..., None]

        def inlier(off: Tensor) -> Tensor:
            return inlier_weight(off.square().sum(-1, keepdim=True), self.COLOUR_SCALE)

        gain, offset = fit_exposure(
            seen,
            measured,
            lambda off: inlier(off).square().expand_as(off),
            sure,
            ((self.COLOUR_SCALE / self.gain) ** 2, (self.COLOUR_SCALE / 0.1) ** 2),
            self.rounds,
        )
        corrected = gain * seen + offset
        error = corrected.clamp(0, 1) - measured
        near = inlier(error)
        # A pixel for which the map renders nothing costs 0.7 times as much as one that disagrees.
        cost = (sure * (1 - near) + (1 - sure) * 0.7)[..., 0].mean(-1)
        # Where the camera clips, the colour does not depend on the pose.
        inside = (corrected - 0.5).abs() < 0.5
        weight = inside * (sure * near.square() * (2 / self.COLOUR_SCALE**2 / error.shape[1]))
        slope = (slopes(rgb, camera) + small.slopes) / 2
        # A point (X, Y, Z) is seen at x = X / Z, y = Y / Z, and moves there by (dX - x dZ, dY - y dZ) / Z.
        by_z = -(slope * small.flat[:, :2]).sum(-1, keepdim=True)
        rotation = small.T_last_camera.rotation.to(slope)
        by_point = torch.cat([slope, by_z], -1) @ rotation.mT / depth[:, None, :, None]
        arm = points[:, None].expand_as(by_point)
        rows = torch.cat([by_point, torch.linalg.cross(arm, by_point)], -1)
        weighted = (weight.mT[..., None] * rows).flatten(1, 2)
        gradient = (weighted.mT @ error.mT.flatten(1)[..., None])[..., 0]
        return cost, gradient, weighted.mT @ rows.flatten(1, 2)


def refine_on_small_images(problem: Problem, state: States, blur: float) -> States:
    """Refine a state on small renderings of the field, from coarse to fine, if it is off by more than rays can mend.

    ``blur`` is the uncertainty of the projection of the scene, pixels. Widths are such that it is about one pixel at first. The
    camera is held.
    """
    frames = [view.frame for view in problem.views]
    cameras = [true_intrinsics(frame.intrinsics, state.nuisances[0, CAMERA]) for frame in frames]
    views = [
        replace(view, frame=frame.replace(intrinsics=camera))
        for view, frame, camera in zip(problem.views, frames, cameras, strict=True)
    ]
    renderer = field_renderer(problem.field, problem.bounds)
    width = max(32.0, max(max(camera.width, camera.height) for camera in cameras) / blur)
    while width <= 96:
        thumbnails = [move_to(Thumbnail.of(view, round(width)), problem.device) for view in views]
        state, _ = descend(state, [Images(renderer, thumbnails)], 3)
        width *= 2
    return state
