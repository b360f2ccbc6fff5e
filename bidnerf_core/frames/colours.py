"""The colours of a frame: read as floats in [0, 1], but held as bytes in memory if they were given as bytes."""

from __future__ import annotations

import weakref
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

FULL_BYTE = 255


class Colours:
    """The attribute ``rgb`` of a frame.

    Colours given as bytes stay bytes, a quarter of the memory of floats, and are converted on access. The
    last conversion is returned again while a reference to it exists, so its identity does not change
    meanwhile.
    """

    def __get__(self, frame: Any, owner: type | None = None) -> Any:
        if frame is None:
            return self
        held: Tensor = frame.__dict__[HELD]
        if held.dtype != torch.uint8:
            return held
        last = frame.__dict__.get(LAST)
        found = None if last is None else last()
        if found is None:
            found = as_floats(held)
            frame.__dict__[LAST] = weakref.ref(found)
        return found

    def __set__(self, frame: Any, given: Any) -> None:
        frame.__dict__[HELD] = given
        frame.__dict__.pop(LAST, None)


HELD, LAST = "_rgb", "_rgb_as_floats"
"""Names of the attributes that hold a frame's colours, and a weak reference to their last conversion."""


def as_floats(colours: Shaped[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Convert bytes to floats in [0, 1]; floats are returned unchanged."""
    return colours.float().div_(FULL_BYTE) if colours.dtype == torch.uint8 else colours


def as_bytes(colours: Float[Tensor, "*n"]) -> Shaped[Tensor, "*n"]:
    """Round floats in [0, 1] to bytes."""
    return (colours * FULL_BYTE).round_().clamp_(0, FULL_BYTE).to(torch.uint8)


def are_bytes(colours: Float[Tensor, "*n"]) -> bool:
    """Return whether floats are exactly representable as bytes."""
    return torch.equal(as_floats(as_bytes(colours)), colours)


def colours_at(
    colours: Shaped[Tensor, "h w 3"], rows: Int[Tensor, "*p"], columns: Int[Tensor, "*p"]
) -> Float[Tensor, "*p 3"]:
    """Return the colours in [0, 1] of some pixels of an image of bytes or floats."""
    return as_floats(colours[rows, columns])
