"""Search by colour alone: compare the query's images with small renderings of the map, coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import moved
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.images import (
    ColourScales,
    FieldRenderer,
    ImageCost,
    SurfaceRenderer,
    Thumbnail,
    ViewRenderer,
    thumbnail,
)
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.search.halving import Distinct, SearchResult, SearchStage, search
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.mapping import Cast, SurfaceMap, cast

APART, TURNED = 0.15, math.radians(20)
"""Distance (fraction of the extent, radians) beyond which two poses are different answers."""
OPEN = 0.2
"""Fraction of the keyframes' rays that hit nothing above which the map counts as having a background."""


@dataclass(frozen=True)
class ImageStage:
    """A stage of the search: steps from all remaining poses, the best ``keep`` of which pass to the next stage."""

    width: int  # pixels of the longer side of thumbnails
    steps: int
    keep: int


IMAGE_STAGES: tuple[ImageStage, ...] = (
    ImageStage(16, 0, 48),
    ImageStage(16, 8, 12),
    ImageStage(24, 8, 4),
    ImageStage(48, 8, 2),
    ImageStage(96, 5, 2),
)
DETAILED_STAGES: tuple[ImageStage, ...] = (
    ImageStage(32, 0, 64),
    ImageStage(32, 6, 16),
    ImageStage(48, 8, 6),
    ImageStage(96, 6, 2),
    ImageStage(192, 4, 2),
)
"""Stages for partly hidden images: in smaller thumbnails, nearly every pixel would contain part of the occluders."""
WIDE_SCALES = ColourScales(gain=1.0, exposure_rounds=5)
"""Scales for finding images exposed twice or half as long."""
DETAILED_SCALES = ColourScales(colour=0.07)
"""Scales for partly hidden images: wider ones favour poses that partly explain the occluders' colours.

They assume approximately the map's exposure, since wider priors would also explain more of the occluders.
"""
COMPARED_SCALES = replace(WIDE_SCALES, colour=0.07, exposure_rounds=10)
"""Scales for comparing a few poses, robust to exposure and occluders."""


@dataclass(frozen=True, eq=False)
class ImageSearch:
    """Search by comparing a query's images with renderings of a map from many poses."""

    views: Sequence[View]
    renderer: ViewRenderer
    middle: Float[Tensor, "3"]  # metres, last camera's frame: the middle of the visible scene; on the CPU
    extent: float  # metres: size of the scene
    scales: ColourScales = field(default_factory=ColourScales)

    @staticmethod
    def on_surface(problem: Problem, surface: SurfaceMap) -> ImageSearch:
        """Return a search on a baked surface.

        Rays cast from the keyframes give the typical distance of the scene, and whether it has a background.
        """
        seen = _from_keyframes(surface, moved(thumbnail(problem.views[-1], 16), surface.device))
        away = float(seen.along[seen.met].median()) if bool(seen.met.any()) else surface.extent
        has_background = float(seen.met.float().mean()) < 1 - OPEN
        renderer = SurfaceRenderer(surface, problem.bounds.background if has_background else None)
        middle = torch.tensor([0.0, 0.0, away])
        return ImageSearch(problem.views, renderer, middle, surface.extent, WIDE_SCALES)

    @staticmethod
    def in_field(problem: Problem, start: SE3) -> ImageSearch:
        """Return a search in a field's coarsest level; a rendering from the start gives the scene's typical distance."""
        renderer = FieldRenderer(problem.level(0), problem.bounds, problem.device)
        small = moved(thumbnail(problem.views[-1], 16), renderer.device)
        T = start.to(small.flat)
        directions = T.rotate(torch.nn.functional.normalize(small.flat, dim=-1))
        away = float(renderer(T.translation.expand_as(directions), directions).along.median())
        extent = float(torch.linalg.vector_norm(torch.tensor(problem.bounds.size)))
        return ImageSearch(problem.views, renderer, torch.tensor([0.0, 0.0, away]), extent)

    def __call__(self, T: SE3, stages: Sequence[ImageStage] = IMAGE_STAGES) -> SearchResult:
        """Search from the hypotheses T (h), by steps on the device of the renderer."""
        distinct = Distinct(self.middle, APART * self.extent, TURNED)
        device = self.renderer.device
        return search(T, self._stages(stages), distinct, keep_runner_up=True, device=device)

    @torch.no_grad()
    def cost(self, T: SE3, width: int) -> float:
        """Return the cost of one pose, on thumbnails whose longer side is ``width`` pixels."""
        return float(self._cost(width)(T[None].to(self.renderer.device)).cost[0])

    def thumbnails(self, width: int) -> list[Thumbnail]:
        return [moved(thumbnail(view, width), self.renderer.device) for view in self.views]

    @property
    def pivot(self) -> Pivot:
        return Pivot.at_point(self.middle)

    def _stages(self, stages: Sequence[ImageStage]) -> Iterator[SearchStage]:
        for stage in stages:
            yield SearchStage(self._cost(stage.width), self.pivot, stage.steps, stage.keep, damping=1e-2)

    def _cost(self, width: int) -> ImageCost:
        middle = self.middle.to(self.renderer.device)
        return ImageCost(self.renderer, self.thumbnails(width), self.scales, middle)


def _from_keyframes(surface: SurfaceMap, small: Thumbnail, most: int = 16) -> Cast:
    """Cast a thumbnail's rays from up to about ``most`` keyframes onto the surface."""
    every = max(1, len(surface.keyframes) // most)
    keyframes = SE3.from_matrix(surface.keyframes[::every]).to(small.flat)
    directions = torch.nn.functional.normalize(small.flat, dim=-1) @ keyframes.rotation.mT
    origins = keyframes.translation[:, None].expand_as(directions)
    return cast(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))
