"""Steps on a surface that lies on a simulated device: they neither leave it nor wait for it, and lead where the CPU's do.

The stages of both searches are needed here, as a whole method waits for the device between its stages.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Generator, Tensor

import baked
import module_fields
from bidnerf_core.devices import moved, without_waiting
from bidnerf_core.evaluation import perturb
from bidnerf_core.fields import RadianceField
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, USUAL
from bidnerf_core.localization import (
    ColourSettings,
    Cost,
    DepthSettings,
    Pivot,
    PointCloud,
    RefinementSettings,
    RefinementStage,
    RenderedCostSettings,
    Scaled,
    Sum,
    descend,
    rig,
)

# Inside: each stage of a method alone, to see at which of them the host waits
from bidnerf_core.localization.covariance import finest_cost, weight
from bidnerf_core.localization.search.by_images import IMAGE_STAGES, ImageSearch
from bidnerf_core.localization.search.by_points import POINT_STAGES, PointSearch
from bidnerf_core.mapping import SurfaceMap, Surfels, cast, trace
from bidnerf_core.testing import DEVICE, DeviceFault, Elsewhere
from problems import FieldMap


@dataclass(frozen=True)
class Place:
    """Where steps are taken: on the CPU, or on the simulated device while ``mode`` is active."""

    mode: Elsewhere | None = None
    surface: Callable[[SurfaceMap], SurfaceMap] = lambda surface: (
        surface
    )  # what is done to it once it lies there

    @property
    def device(self) -> torch.device:
        return torch.device("cpu") if self.mode is None else DEVICE

    def checked(self) -> AbstractContextManager[None]:
        return nullcontext() if self.mode is None else self.mode.strict()

    def toy(self) -> SurfaceMap:
        found = self.surface(baked.toy().to(self.device))
        found.warm_up()
        return found

    def descended(
        self, cost: Cost, pivot: Pivot, T: SE3, score: Callable[[SE3], Tensor] | None = None
    ) -> list[Tensor]:
        """Take a step, which fills caches, and two more that are checked, and return all that these lead to."""
        about, first = pivot.to(self.device), descend(cost, T.to(self.device), 1, pivot.to(self.device).moved)
        score = score or (lambda T: cost(T).cost)
        score(first.T)
        with without_waiting(), self.checked():
            done = descend(cost, first.T, 2, about.moved, stop=1e-4)
            scores = score(done.T)
        parts = (done.T.matrix(), done.costs, done.equations.gradient, done.equations.hessian, done.converged)
        return [*parts, done.accepted, scores]


def near(view: View, count: int = 3) -> SE3:
    return SE3.stack([perturb(view.T_ref_camera, 0.05, 2, seed) for seed in range(count)])


def align_points(place: Place) -> list[Tensor]:
    view = baked.unseen()[0]
    search, found = PointSearch(place.toy(), baked.cloud(view, count=400)), []
    for stage in search._stages(POINT_STAGES):
        found += place.descended(stage.cost, stage.pivot, near(view), stage.score)
    return found


def compare_images(place: Place) -> list[Tensor]:
    view, toy = baked.unseen()[0], place.toy()
    search, found = ImageSearch.on_surface(baked.problem(view, surface=toy).without_depth(), toy), []
    for stage in search._stages(IMAGE_STAGES[1:2]):
        found += place.descended(stage.cost, stage.pivot, near(view), stage.score)
    return found


def cast_rays(place: Place) -> list[Tensor]:
    """Half of the rays meet the toy; some never cross the grid."""
    generator, toy = Generator().manual_seed(0), place.toy()
    origins = 3 * torch.nn.functional.normalize(torch.randn((200, 3), generator=generator), dim=-1)
    aims = 0.7 * torch.randn((200, 3), generator=generator)
    rays = moved((origins, torch.nn.functional.normalize(aims - origins, dim=-1)), place.device)
    trace(toy, *rays)
    with without_waiting(), place.checked():
        found, distance = cast(toy, *rays), trace(toy, *rays)
    return [found.met, found.along, found.index, distance]


def align_points_and_render(place: Place) -> list[Tensor]:
    """The steps of a refinement: rendered rays beside measured points."""
    (view,) = module_fields.shown(1, seed=5)
    field: RadianceField = moved(module_fields.field(), place.device)
    there = place.surface(module_fields.surface().to(place.device))
    problem, T = rig(FieldMap(field, baked.BOUNDS, there), [view], None), near(view, 1)
    generator = Generator().manual_seed(0)
    points = finest_cost(there, PointCloud.measured(problem.views, None, 400, generator))
    settings = RenderedCostSettings(ColourSettings(), DepthSettings(), RefinementSettings(exposure=True))
    about = points.cloud.pivot
    rays = settings.drawn(problem.on_device(), RefinementStage(2, 64), about.to(place.device), generator)
    by_rays = Scaled(rays, weight(USUAL.rays, float(rays.cost(T)[0])))
    by_points = Scaled(points, weight(USUAL.points, float(points.residual_variance(T)[0])))
    return place.descended(Sum((by_rays, by_points)), about, T)


GRADIENT = 2
"""Place of the gradient in what ``Place.descended`` returns; the Hessian follows it."""
STEPS = {
    "aligning points": align_points,
    "comparing images": compare_images,
    "casting rays": cast_rays,
    "aligning points and rendering": align_points_and_render,
}


@pytest.mark.parametrize("name", STEPS)
def test_steps_stay_on_the_device_and_lead_where_those_of_the_cpu_do(name: str) -> None:
    expected = STEPS[name](Place())
    with Elsewhere() as mode:
        found = STEPS[name](Place(mode))
        assert {part.device for part in found} == {DEVICE}
        found = [part.cpu() for part in found]
    # A field renders more samples where the host must not wait for their number, which changes how sums are rounded: poses
    # differ by some 1e-7, and the gradient by that times the Hessian.
    rendered = name == "aligning points and rendering"
    close, steepest = (1e-4 if rendered else 0.0), float(expected[3].abs().max())
    for number, (ours, theirs) in enumerate(zip(found, expected, strict=True)):
        apart = 1e-6 * steepest if rendered and number == GRADIENT else close
        torch.testing.assert_close(ours, theirs, rtol=close, atol=apart)


@pytest.mark.parametrize("name", ["positions", "rgb_gradient"])
def test_a_part_of_the_surface_that_does_not_move_is_found(name: str) -> None:
    def forgotten(there: SurfaceMap) -> SurfaceMap:
        here: Surfels = replace(there.surfels, **{name: getattr(there.surfels, name).cpu()})
        return replace(there, surfels=here)

    with Elsewhere() as mode, pytest.raises(DeviceFault):
        align_points(Place(mode, forgotten))
