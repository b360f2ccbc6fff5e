"""A fault: a seeded change of a frame, whose size is one number."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.registry import Plugins
from bidnerf_core.settings import Range, WholeNumbers

Change: TypeAlias = Callable[[Frame, float, Generator], Frame]
"""A function that returns the frame with a fault of the given size; all random choices are drawn from the generator."""


SHARE = Range(0.0, 1.0)
SWITCH = WholeNumbers(0, 1)


@dataclass(frozen=True)
class Fault:
    """A kind of fault. Its random choices depend on the seed and the frame, not on the size, so sizes are comparable."""

    unit: str  # of the size, in words
    allowed: Range
    neutral: float | None  # the size at which there is no fault; None if there is no such size
    sizes: tuple[float, ...]  # sizes worth measuring
    change: Change  # it is not called for the neutral size
    needs_depth: bool = False
    T_true_faulty: SE3 | None = None
    """Pose of the faulty camera in the true camera's frame, at any size but the neutral one; None if they coincide."""
    summary: str = field(kw_only=True)

    @property
    def is_switch(self) -> bool:
        """Whether the fault is simply on (size 1) or off (size 0)."""
        return self.allowed is SWITCH


def _defects(fault: Any) -> Iterator[str]:
    if not isinstance(fault, Fault):
        yield f"it is a {type(fault).__name__}, expected a bidnerf_core.evaluation.faults.Fault"


FAULTS: Plugins[Fault] = Plugins("faults", _defects)
"""All faults by name."""


def depth_of(frame: Frame) -> Float[Tensor, "h w"]:
    """Return the measured depth (planar z, metres). Raises ``InputError`` if nothing was measured."""
    if frame.depth is None or not frame.has_depth:
        raise InputError(f"frame {frame.name} has no measured depth for a depth fault to change")
    return frame.depth


def random_direction(generator: Generator) -> tuple[float, float]:
    """Return a unit vector of the image plane, uniformly distributed."""
    angle = 2 * math.pi * uniform_number(generator)
    return math.cos(angle), math.sin(angle)


def uniform_number(generator: Generator, low: float = 0.0, high: float = 1.0) -> float:
    """Return a uniformly distributed number between two limits."""
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def random_pixel(mask: Bool[Tensor, "h w"], generator: Generator) -> tuple[int, int]:
    """Return the row and column of a random pixel of ``mask``, which marks at least one."""
    places = mask.nonzero()
    row, column = places[int(torch.randint(len(places), (), generator=generator))].tolist()
    return row, column
