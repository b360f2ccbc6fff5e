"""Centring: a camera that looks past what it saw is shifted back, and stays where nothing is known."""

from __future__ import annotations

import math

import torch

from bidnerf_core.fields import Observations
from bidnerf_core.frames import View, all_pixels, observe
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.images import FieldRenderer
from bidnerf_core.localization.refinement import centred, rendered_middle
from blob_images import BOUNDS, FIELD, FRAME, TRUTH, photograph

SHIFT = torch.tensor([0.4, -0.3, 0.2, 0, 0, 0], dtype=torch.float64)


def observed(depth: bool = True) -> Observations:
    frame = FRAME if depth else photograph(depth=False)
    return observe(View(frame, SE3.identity()), all_pixels(frame))


def test_most_of_a_shift_is_taken_back() -> None:
    start = TRUTH.retract(SHIFT)
    found = start[None]
    for _ in range(3):
        found = centred(FIELD, observed(), BOUNDS, found)
    assert torch.equal(found.rotation[0], start.rotation)
    off = float((found.translation[0] - TRUTH.translation).norm())
    assert off < 0.3 * float(SHIFT.norm())


def test_poses_are_centred_each_on_its_own() -> None:
    starts = SE3.stack([TRUTH, TRUTH.retract(SHIFT)])
    together = centred(FIELD, observed(), BOUNDS, starts)
    for i in range(2):
        alone = centred(FIELD, observed(), BOUNDS, starts[i : i + 1])
        torch.testing.assert_close(together.translation[i], alone.translation[0], rtol=0, atol=1e-5)


def test_a_pose_stays_where_nothing_is_measured_or_rendered() -> None:
    start = TRUTH.retract(SHIFT)[None]
    assert torch.equal(centred(FIELD, observed(depth=False), BOUNDS, start).matrix(), start.matrix())
    away = TRUTH.retract(torch.tensor([0, 0, 0, math.pi, 0, 0], dtype=torch.float64))[None]
    assert bool(rendered_middle(FIELD, observed(), BOUNDS, away).isnan().all())
    assert torch.equal(centred(FIELD, observed(), BOUNDS, away).matrix(), away.matrix())


def test_renderings_of_a_field_are_what_pixels_saw() -> None:
    """The renderer of thumbnails shows the image's own colours and distances from the true pose."""
    seen, T = observed(), TRUTH.to(torch.zeros(1))
    found = FieldRenderer(FIELD, BOUNDS, torch.device("cpu"))(
        T.apply(seen.origins), T.rotate(seen.directions)
    )
    torch.testing.assert_close(found.rgb, seen.rgb, rtol=0, atol=1e-4)
    met = seen.measured
    torch.testing.assert_close(found.along[met], seen.distance[met], rtol=0, atol=0.01)
    assert bool((found.known == 1).all())
