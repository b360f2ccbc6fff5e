"""Blurred photos weigh less in training: which photos, how much less, and that every backend's recipe heeds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from bidnerf.testing import Recorder, ground
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import render
from bidnerf_core.frames import Frame, View
from bidnerf_core.training import Supervision, SupervisionConfig, relative_detail
from landmark_scene import looking_in
from optional import require
from small_backends import BACKENDS, BOUNDS, train_field

COUNT, BLURRED = 12, 5
CAMERA = Intrinsics(100.0, 100.0, 48.0, 36.0, 96, 72)


def photos(blur: float = 0.0) -> list[View]:
    """Photos of random texture from a ring, of which one is blurred along its rows (pixels)."""
    random, views = np.random.default_rng(0), []
    for i in range(COUNT):
        noise = cv2.GaussianBlur(random.normal(size=(CAMERA.height, CAMERA.width, 3)), (0, 0), 1.0)
        if i == BLURRED and blur:
            noise = cv2.GaussianBlur(noise, (0, 0), sigmaX=blur, sigmaY=0.01)
        rgb = torch.from_numpy(0.5 + 0.5 * noise).float().clamp(0, 1)
        views.append(View(Frame(f"{i}", rgb, CAMERA), looking_in(0.3 * i)))
    return views


def test_only_the_blurred_photo_weighs_less() -> None:
    kept = relative_detail(photos(2.0))
    others = torch.arange(COUNT) != BLURRED
    assert torch.equal(kept[others], torch.ones(COUNT - 1, dtype=kept.dtype))
    assert 0 < float(kept[BLURRED]) < 2**-0.5  # half an octave is the least that counts


def test_the_loss_is_that_of_weighted_squares() -> None:
    supervision = Supervision(photos(3.0), BOUNDS, replace(SupervisionConfig(), exposure=False))
    weight = require(supervision.image_weight)
    batch = supervision.draw(400, torch.Generator().manual_seed(1))
    rendering = render(ground(), batch.rays, batch.background)
    loss, mse = supervision.loss(rendering, batch)
    squares = (rendering.rgb - batch.observed.rgb).square().mean(-1)
    assert float(loss) == pytest.approx(float((weight[batch.image] * squares).mean()), rel=1e-5)
    assert mse == pytest.approx(float(squares.mean()), rel=1e-5)


@pytest.mark.parametrize("name", BACKENDS)
def test_every_backend_weighs_blurred_photos_less(name: str) -> None:
    def first_loss(blur: float, **changes: object) -> float:
        report = Recorder()
        train_field(name, photos(blur), report, steps=1, **changes)
        return report.steps[0].loss

    assert first_loss(3.0) < 0.99 * first_loss(3.0, sharpness=False)
    assert first_loss(0.0) == first_loss(0.0, sharpness=False)


def test_the_more_a_photo_is_blurred_the_less_it_weighs() -> None:
    weights = [float(relative_detail(photos(blur))[BLURRED]) for blur in (0.0, 1.5, 3.0)]
    assert weights[0] == 1
    assert weights[0] > weights[1] > weights[2]


@pytest.mark.parametrize("views", [photos(), photos()[:1]])
def test_captures_without_blurred_photos_have_no_weights(views: Sequence[View]) -> None:
    assert Supervision(views, BOUNDS, SupervisionConfig()).image_weight is None
    off = replace(SupervisionConfig(), sharpness=False)
    assert Supervision(photos(3.0), BOUNDS, off).image_weight is None
