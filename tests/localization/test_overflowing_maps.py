"""Maps whose numbers are finite and overflow in computations: an image is localized or rejected, or the file is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf.testing import textured_map
from bidnerf_core.errors import InputError
from bidnerf_core.mapping import surface_from_tensors, surface_tensors
from bidnerf_core.maps import Localizer, Tracker
from flights import flight
from optional import require


@pytest.mark.parametrize("value", [1e30, -1e30, 3.4e38])
@pytest.mark.parametrize("part", ["rgb", "normals", "positions"])
def test_a_surface_of_overflowing_numbers_ends_no_tracking(part: str, value: float) -> None:
    known = textured_map(surface=True)
    tensors = surface_tensors(require(known.surface))
    try:
        overflowing = tensors | {part: torch.full_like(tensors[part], value)}
        scene = replace(known, surface=surface_from_tensors(overflowing))
    except (InputError, ValueError):
        return
    tracker = Tracker(Localizer(scene, warm_up=False))
    answers = [tracker(frame, time) for time, frame, _ in flight()[:2]]
    assert all(answer.reason for answer in answers if not answer.converged)
