"""Faults: seeded changes of a frame, each with a size in one number; and faults as text, alone or composed."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.registry import Plugins
from bidnerf_core.settings import Range, WholeNumbers

Change: TypeAlias = Callable[[Frame, float, Generator], Frame]
"""A function that returns the frame with a fault of the given size; all random choices are drawn from the generator."""


SHARE = Range(0.0, 1.0)
SWITCH = WholeNumbers(0, 1)


@dataclass(frozen=True)
class Fault:
    """A kind of fault. Its random choices depend on the seed and the frame, not on the size, so results of different sizes are comparable."""

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
        yield f"it is a {type(fault).__name__}, expected a bidnerf.evaluation.faults.Fault"


FAULTS: Plugins[Fault] = Plugins("faults", _defects)
"""All installed faults, by name."""


def depth_of(frame: Frame) -> Float[Tensor, "h w"]:
    """Return the measured depth (planar z, metres). Raises ``InputError`` if nothing was measured."""
    if frame.depth is None or not frame.has_depth:
        raise InputError(f"frame {frame.name} has no measured depth for a depth fault to change")
    return frame.depth


# Faults as text, alone or composed.

NO_FAULT = "none"
"""The name for the absence of faults, which leaves a view unchanged."""


class AppliedFault(NamedTuple):
    """The name and size of a fault."""

    name: str
    size: float

    def __str__(self) -> str:
        return f"{self.name}:{self.size:.12g}"


def expand_faults(words: Iterable[str]) -> tuple[str, ...]:
    """Expand a command's words to all the faults they name, in canonical form.

    A word is ``none``, ``NAME:SIZE``, ``NAME:SIZE,SIZE...`` for several faults, or faults with one size each
    joined by ``+``, which are applied together, from left to right. A fault that is simply on or off needs no
    size. Raises ``InputError`` for anything else, and for duplicate faults.
    """
    faults: list[str] = []
    for word in words:
        name, colon, sizes = word.partition(":")
        for part in [name + colon + size for size in sizes.split(",")] if "+" not in word else [word]:
            fault = "+".join(map(str, parse_faults(part))) or NO_FAULT
            if fault in faults:
                raise InputError(f"fault {fault} is given twice", expected="different ones")
            faults.append(fault)
    return tuple(faults)


def parse_faults(text: str) -> tuple[AppliedFault, ...]:
    """Parse a text such as ``depth-scale:1.02+exposure:0.7``; the result is empty for ``NO_FAULT``.

    Raises ``InputError`` for an unknown name, a missing or out-of-range size, and a fault that occurs twice.
    """
    faults: list[AppliedFault] = []
    for part in [] if text == NO_FAULT else text.split("+"):
        name, colon, size = part.partition(":")
        fault = FAULTS.load(name)
        if not size and (colon or not fault.is_switch):
            example = "NAME:SIZE such as depth-scale:1.02"
            raise InputError(f"fault {name} has no size", expected=f"{example}; its unit is: {fault.unit}")
        try:
            number = float(size or 1)
        except ValueError:
            number = math.nan
        if number not in fault.allowed:
            shown = f"{number:.12g}" if math.isfinite(number) else repr(size)
            raise InputError(f"size is {shown}", where=f"fault {name}", expected=fault.allowed)
        if name in (other.name for other in faults):
            raise InputError(f"fault {text} has {name} twice", expected="each once")
        faults.append(AppliedFault(name, number))
    return tuple(faults)


def faulty(view: View, faults: str, seed: int) -> View:
    """Apply all faults to a view, in order, and return the result.

    The ``T_ref_camera`` of the result is the true pose of the faulty image. The random choices of a fault
    depend only on the seed, the frame and the fault, regardless of other faults. Raises ``InputError`` for a
    depth fault on a frame without measured depth.
    """
    for applied in parse_faults(faults):
        fault, T_ref_camera = FAULTS.load(applied.name), view.T_ref_camera
        if applied.size == fault.neutral:
            continue
        # Each fault has a separate seed on each frame for its random choices.
        text = f"{seed}\n{view.frame.name}\n{applied.name}".encode(errors="surrogatepass")
        stream = int.from_bytes(hashlib.blake2b(text, digest_size=7).digest(), "big")
        changed: Any = fault.change(view.frame, applied.size, torch.Generator().manual_seed(stream))
        if not isinstance(changed, Frame):
            raise InputError(f"returned a {type(changed).__name__}", where=f"fault {applied}", expected="a Frame")
        if fault.T_true_faulty is not None:
            T_ref_camera = T_ref_camera.to(dtype=torch.float64) @ fault.T_true_faulty
        view = View(changed, T_ref_camera)
    return view


def check_depth(faults: Iterable[str], depth: bool) -> None:
    """Raise ``InputError`` for an unknown fault and, without ``depth``, for a fault that changes depth."""
    for part in (part for text in faults for part in parse_faults(text)):
        if FAULTS.load(part.name).needs_depth and not depth:
            raise InputError(f"fault {part} changes the measured depth, which the method does not receive")
