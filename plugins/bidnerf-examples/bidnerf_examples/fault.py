"""A fault: brightness that varies from row to row, as under a flickering lamp with a rolling shutter."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Generator

from bidnerf.evaluation import Fault
from bidnerf_core.frames import Frame
from bidnerf_core.settings import Range

PERIOD = 24.0
"""Number of rows from one bright stripe to the next."""


def striped(frame: Frame, size: float, generator: Generator) -> Frame:
    """Return the frame with stripes of a random phase; ``size`` is their amplitude relative to the brightness."""
    phase = 2 * math.pi * torch.rand((), generator=generator)
    rows = torch.arange(frame.rgb.shape[0]) * (2 * math.pi / PERIOD)
    gain = 1 + size * (rows + phase).sin()
    return replace(frame, rgb=(frame.rgb * gain[:, None, None]).clamp(0, 1))


fault = Fault(
    unit="amplitude, share of the brightness",
    allowed=Range(0.0, 1.0),
    neutral=0.0,
    sizes=(0.1, 0.3),
    change=striped,
    summary="brightness that varies from row to row",
)
