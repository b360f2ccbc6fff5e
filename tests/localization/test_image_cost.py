"""The cost of whole small images: thumbnails, where the cost is least, where its steps lead, and how exposure enters.

Costs and thumbnails are needed here for derivatives and convolutions, which no answer shows.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import convolve1d
from scipy.optimize import minimize
from torch import Generator, Tensor

import baked
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import SceneBounds, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import NormalEquations, SurfaceRenderer

# Inside: derivatives of the cost and of its pyramid, compared with differences
from bidnerf_core.localization.costs.images import (
    UNKNOWN_COST,
    ColourScales,
    FieldRenderer,
    ImageCost,
    RenderedView,
    Thumbnail,
    ViewRenderer,
    exposed,
    render_view,
    slopes,
    smooth,
    thumbnail,
)
from bidnerf_core.localization.search.by_images import WIDE_SCALES
from bidnerf_core.scenes import GaussianBlobs, orbit

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0, (1.0, 1.0, 1.0))
BLOBS = GaussianBlobs.random(density=60.0)
BY_FIELD = FieldRenderer(BLOBS, BOUNDS, torch.device("cpu"))
MIDDLE = torch.tensor([0.0, 0.0, 3.5])
PLAIN = ColourScales(gain=0.0, bias=0.0)


def on_surface() -> SurfaceRenderer:
    return SurfaceRenderer(baked.toy(), baked.BOUNDS.background)


def compared(
    renderer: ViewRenderer, thumbnails: list[Thumbnail], scales: ColourScales, T: SE3
) -> NormalEquations:
    return ImageCost(renderer, thumbnails, scales, MIDDLE)(T)


def of_toy(width: int = 24) -> tuple[Thumbnail, SE3]:
    view = baked.unseen()[0]
    return thumbnail(View(view.frame, SE3.identity()), width), view.T_ref_camera


def of_blobs(width: int = 24) -> tuple[Thumbnail, SE3]:
    T = orbit(3.5, 3, seed=1)[1]
    seen = render_image(BLOBS, baked.CAMERA, T, BOUNDS)
    return thumbnail(View(Frame("blobs", seen.rgb, baked.CAMERA), SE3.identity()), width), T


def steps(count: int, size: float, generator: Generator) -> torch.Tensor:
    xi = torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return size * torch.nn.functional.normalize(xi, dim=-1)


def about(T: SE3, xi: torch.Tensor) -> SE3:
    centre = SE3(torch.eye(3, dtype=torch.float64), MIDDLE.double())
    return (T @ centre).retract(xi) @ centre.inverse()


@pytest.mark.parametrize("scene", ["surface", "field"])
def test_the_cost_is_least_at_the_truth(scene: str, generator: Generator) -> None:
    renderer: ViewRenderer = on_surface() if scene == "surface" else BY_FIELD
    small, T = of_toy() if scene == "surface" else of_blobs()
    xi = torch.cat(
        [torch.zeros((1, 6), dtype=torch.float64), steps(30, 0.2, generator), steps(10, 1.0, generator)]
    )
    cost = compared(renderer, [small], ColourScales(), about(T, xi)).cost
    assert int(cost.argmin()) == 0
    assert float(cost[31:].min()) > 1.5 * float(cost[0])
    assert 0 <= float(cost.min()) <= float(cost.max()) <= 1


def test_a_step_leads_back(generator: Generator) -> None:
    """The rendering of a field from a known place: one undamped step takes most of a small displacement away."""
    small, T = of_blobs(48)
    xi = steps(8, 0.03, generator)
    equations = compared(BY_FIELD, [small], PLAIN, about(T, xi))
    left = xi + equations.solve(torch.zeros(8, dtype=torch.float64))
    assert float(torch.linalg.vector_norm(left, dim=-1).median()) < 0.01


def test_many_as_one_by_one(generator: Generator) -> None:
    small, T = of_toy(16)
    many = about(T, steps(5, 0.3, generator))
    together = compared(on_surface(), [small], ColourScales(), many)
    for i in range(5):
        alone = compared(on_surface(), [small], ColourScales(), many[i : i + 1])
        for part in ("cost", "gradient", "hessian"):
            expected = getattr(together, part)[i]
            torch.testing.assert_close(getattr(alone, part)[0], expected, rtol=1e-3, atol=1e-5)


def test_a_rig_is_the_mean_of_its_views(generator: Generator) -> None:
    one, T = of_toy(16)
    other = thumbnail(View(baked.unseen()[1].frame, T.inverse() @ baked.unseen()[1].T_ref_camera), 16)
    many = about(T, steps(3, 0.2, generator))
    both = compared(on_surface(), [one, other], ColourScales(), many)
    parts = [compared(on_surface(), [small], ColourScales(), many) for small in (one, other)]
    torch.testing.assert_close(both.cost, (parts[0].cost + parts[1].cost) / 2)
    torch.testing.assert_close(both.hessian, (parts[0].hessian + parts[1].hessian) / 2)


def test_holes_of_a_map_have_a_fixed_cost() -> None:
    """Looking away from all that is known costs the same whatever was seen."""
    small, T = of_toy(16)
    away = T.retract(torch.tensor([0, 0, 0, math.pi, 0, 0], dtype=torch.float64))
    found = compared(SurfaceRenderer(baked.toy(), None), [small], ColourScales(), away[None])
    assert float(found.cost[0]) == pytest.approx(UNKNOWN_COST)
    assert not bool(found.hessian.any())
    seen = render_view(SurfaceRenderer(baked.toy(), None), small, T[None])
    assert 0 < float(seen.known.mean()) < 1
    whole = seen.known > 0.999
    same = render_view(on_surface(), small, T[None]).rgb
    torch.testing.assert_close(
        seen.rgb[whole[:, None].expand_as(same)], same[whole[:, None].expand_as(same)], rtol=0, atol=1e-5
    )


def test_a_pose_that_is_not_finite_is_never_best() -> None:
    small, T = of_toy(16)
    broken = SE3(torch.stack([T.rotation, T.rotation * torch.nan]), T.translation.expand(2, 3))
    cost = compared(on_surface(), [small], ColourScales(), broken).cost
    assert math.isfinite(float(cost[0]))
    assert math.isinf(float(cost[1]))


def test_the_exposure_is_what_a_general_solver_finds(generator: Generator) -> None:
    """Two rounds of weighting from the same weights: compared with a minimization of the last of them."""
    scales = ColourScales(colour=100.0, gain=0.3, bias=0.2)  # nothing is an outlier
    rgb = torch.rand((1, 3, 40), generator=generator)
    wanted = 1.2 * rgb[0] - 0.05 + 0.01 * torch.randn((3, 40), generator=generator)
    camera = Intrinsics.from_focal(10.0, 8, 5)
    seen = RenderedView(camera, rgb, torch.ones((1, 40)), torch.zeros((1, 40, 3)), torch.ones((1, 40)))
    found = exposed(seen, wanted, scales)
    x, y = rgb[0, 0].double().numpy(), wanted[0].double().numpy()

    def cost(p: list[float]) -> float:
        misfit = (((1 + p[0]) * x + p[1] - y) ** 2).sum() / scales.colour**2
        return float(misfit + (p[0] / scales.gain) ** 2 + (p[1] / scales.bias) ** 2)

    g, b = minimize(cost, [0.0, 0.0], tol=1e-12).x
    torch.testing.assert_close(found[0, 0].double(), (1 + g) * rgb[0, 0].double() + b, rtol=0, atol=1e-3)
    assert exposed(seen, wanted, PLAIN) is rgb


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_scales_of_the_search_allow_for_twice_and_half_the_exposure(factor: float) -> None:
    frame = baked.unseen()[0].frame
    exposed_frame = replace(frame, rgb=(factor * frame.rgb).clamp(max=1))
    small, T = of_toy(24)
    other = thumbnail(View(exposed_frame, SE3.identity()), 24)
    plain, exact, here = (
        float(compared(on_surface(), [image], scales, T[None]).cost[0])
        for image, scales in ((other, ColourScales()), (small, WIDE_SCALES), (other, WIDE_SCALES))
    )
    assert here < 0.8 * plain
    assert here < 2.6 * exact  # colours that are clipped at twice the exposure tell less


PINHOLE = Intrinsics(100.0, 104.0, 47.0, 33.0, 96, 64)
LENS = Intrinsics(100.0, 104.0, 47.0, 33.0, 96, 64, (-0.2, 0.05, 0.001, -0.002))


def even(camera: Intrinsics) -> Tensor:
    """Colours that change evenly with where a pixel looks."""
    x, y, _ = camera.unproject(camera.pixel_centres()).unbind(-1)
    return torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.3 * y], -1)


def test_smooth_is_scipys_convolution(generator: Generator) -> None:
    image = torch.rand((2, 3, 9, 14), generator=generator)
    kernel = np.array([1, 4, 6, 4, 1]) / 16
    expected = convolve1d(
        convolve1d(image.numpy(), kernel, axis=-1, mode="nearest"), kernel, axis=-2, mode="nearest"
    )
    torch.testing.assert_close(smooth(image), torch.from_numpy(expected), rtol=0, atol=1e-6)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_where_its_pixels_look(camera: Intrinsics) -> None:
    T = orbit(3.0, 2, seed=0)[1]
    small = thumbnail(View(Frame("even", even(camera), camera), T), 24)
    assert (small.camera.width, small.camera.height) == (24, 16)
    assert small.camera.distortion == ()
    seen = small.rgb[:, 3:-3, 3:-3].flatten(1).T
    x, y, _ = small.flat.view(16, 24, 3)[3:-3, 3:-3].reshape(-1, 3).unbind(-1)
    expected = torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.3 * y], -1)
    torch.testing.assert_close(seen, expected, rtol=0, atol=3e-3)
    inner = small.slopes.view(3, 16, 24, 2)[:, 4:-4, 4:-4].flatten(1, 2).mean(1)
    torch.testing.assert_close(inner, torch.tensor([[0.4, 0.0], [0.0, 0.4], [0.2, -0.3]]), rtol=0, atol=0.02)
    turned = T.to(torch.float32).rotate(small.flat * small.directness[:, None])
    torch.testing.assert_close(small.directions, turned)


def test_what_is_small_already_is_not_made_larger() -> None:
    small = thumbnail(View(Frame("even", even(PINHOLE), PINHOLE), SE3.identity()), 500)
    assert (small.camera.width, small.camera.height) == (96, 64)
    assert slopes(small.rgb, small.camera).shape == (3, 96 * 64, 2)
