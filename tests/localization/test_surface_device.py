"""Steps of terms on a simulated device: they neither leave it nor wait for it, and lead where the CPU's do."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import pytest
import torch

# Inside: each term alone, to see at which of them the host waits
from torch import Generator, Tensor

import baked
import module_fields
from bidnerf_core.devices import move_to, without_waiting
from bidnerf_core.fields import RadianceField
from bidnerf_core.frames import Thumbnail, View
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import ColourSettings, DepthLossSettings, Images, draw_rays, rig, states_at
from bidnerf_core.localization.terms.images import surface_renderer
from bidnerf_core.mapping import CostTerm, SurfaceMap, cast, descend, trace
from problems import FieldMap
from simulated_device import DEVICE, Elsewhere


@dataclass(frozen=True)
class Place:
    """Where steps are taken: on the CPU, or on the simulated device while ``mode`` is active."""

    mode: Elsewhere | None = None

    @property
    def device(self) -> torch.device:
        return torch.device("cpu") if self.mode is None else DEVICE

    def checked(self) -> AbstractContextManager[None]:
        return nullcontext() if self.mode is None else self.mode.strict()

    def toy(self) -> SurfaceMap:
        found = baked.toy().to(self.device)
        found.warm_up()
        return found

    def descended(self, terms: list[CostTerm], T: SE3) -> list[Tensor]:
        """Take a step, which fills caches, and two more that are checked, and return all that these lead to."""
        start, about = move_to(states_at(T), self.device), torch.tensor([0.0, 0.0, 3.5]).to(self.device)
        first, _ = descend(start, terms, 1, about)
        with without_waiting(), self.checked():
            done, normal = descend(first, terms, 2, about)
        return [done.T.matrix(), normal.cost, normal.gradient, normal.hessian]


def near(view: View, count: int = 3) -> SE3:
    return SE3.stack([perturb(view.T_ref_camera, 0.05, 2, seed) for seed in range(count)])


def align_points(place: Place) -> list[Tensor]:
    view = baked.unseen()[0]
    points = replace(baked.points(view, count=400, surface=place.toy()), noise=0.1, colour_weight=1.0)
    return place.descended([points], near(view))


def compare_images(place: Place) -> list[Tensor]:
    view = baked.unseen()[0]
    small = move_to(Thumbnail.of(View(view.frame, SE3.identity()), 16), place.device)
    return place.descended([Images(surface_renderer(place.toy(), None), [small])], near(view))


def cast_rays(place: Place) -> list[Tensor]:
    """Half of the rays meet the toy; some never cross the grid."""
    generator, toy = Generator().manual_seed(0), place.toy()
    origins = 3 * torch.nn.functional.normalize(torch.randn((200, 3), generator=generator), dim=-1)
    aims = 0.7 * torch.randn((200, 3), generator=generator)
    rays = move_to((origins, torch.nn.functional.normalize(aims - origins, dim=-1)), place.device)
    trace(toy, *rays)
    with without_waiting(), place.checked():
        found, distance = cast(toy, *rays), trace(toy, *rays)
    return [found.met, found.along, found.index, distance]


def align_points_and_render(place: Place) -> list[Tensor]:
    """The steps of a refinement: rendered rays beside measured points."""
    (view,) = module_fields.shown(1, seed=5)
    field: RadianceField = move_to(module_fields.field(), place.device)
    there = module_fields.surface().to(place.device)
    problem = rig(FieldMap(field, baked.BOUNDS, there), [view], None)
    points = baked.points(view, count=400, surface=there)
    rays = draw_rays(problem, ColourSettings(), DepthLossSettings(), 64, 0)
    return place.descended([points, rays], near(view, 1))


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
    # differ by some 1e-6, and the gradient by that times the Hessian.
    close, steepest = (1e-4 if name != "casting rays" else 0.0), float(expected[-1].abs().max())
    for number, (ours, theirs) in enumerate(zip(found, expected, strict=True)):
        apart = 1e-5 * steepest if close and number >= 2 else close
        torch.testing.assert_close(ours, theirs, rtol=close, atol=apart)
