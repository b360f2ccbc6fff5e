"""Where a localizer is started from: wrong by a known amount, reproducible from a seed alone.

``PROTOCOLS`` has them by name. A protocol says which frames are tried and with which seeds, and where each trial begins.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import parallel_inversion
from bidnerf_core.se3 import SE3

SMALLEST, LARGEST = 0.5, 3.4
"""Translation lengths of the paper's tables: scene units in which the object fills a 2x2x2 cube, metres in rooms."""


def bid(T_true: SE3, size: float, seed: int) -> SE3:
    """BID-NeRF's: ``T_true exp((e_t u1, e_r u2))`` with random unit u1, u2 and e_t = ``size``.

    The paper does not say which e_r goes with which e_t, but that errors stay under 45 degrees: here e_r grows linearly
    from 0.2 rad at e_t = 0.5 to pi/4 at 3.4.
    """
    return _bid(T_true, size, math.pi / 4, seed)


def bid_hard(T_true: SE3, size: float, seed: int) -> SE3:
    """The same with e_r up to 1.4 rad, the upper end of the range that the paper prints."""
    return _bid(T_true, size, 1.4, seed)


def perturb(T_true: SE3, translation: float, rotation_deg: float, seed: int) -> SE3:
    """A start whose error is exactly ``translation`` (metres) and ``rotation_deg``, in random directions."""
    for what, value in (("translation", translation), ("rotation", rotation_deg)):
        _require_length(what, value)
    u1, u2 = random_units(2, torch.Generator().manual_seed(seed))
    turn = SE3.exp(torch.cat([torch.zeros_like(u2), math.radians(rotation_deg) * u2])).rotation
    return T_true.to(dtype=torch.float64) @ SE3(turn, translation * u1)


def inerf(T_true: SE3, seed: int) -> SE3:
    """iNeRF's (Yen-Chen et al. 2021, IV-A): turned about a random axis by up to 40 degrees either way, moved by up to 0.2.

    The camera turns about its own centre, and each of its axes has its own offset, uniform in -0.2 to 0.2.
    """
    generator = torch.Generator().manual_seed(seed)
    axis = random_units(1, generator)[0]
    chance = 2 * torch.rand(4, generator=generator, dtype=torch.float64) - 1
    turn = SE3.exp(torch.cat([torch.zeros_like(axis), math.radians(40) * chance[0] * axis])).rotation
    return T_true.to(dtype=torch.float64) @ SE3(turn, 0.2 * chance[1:])


def rotation_of_size(size: float, widest: float = math.pi / 4) -> float:
    """e_r (rad) that goes with e_t = ``size``: on the line from (0.5, 0.2) to (3.4, ``widest``)."""
    return 0.2 + (size - SMALLEST) / (LARGEST - SMALLEST) * (widest - 0.2)


def random_units(count: int, generator: Generator) -> Float[Tensor, "n 3"]:
    """Directions, uniform on the sphere (float64)."""
    normal = torch.randn((count, 3), generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(normal, dim=-1)


def _bid(T_true: SE3, size: float, widest: float, seed: int) -> SE3:
    _require_length("size", size)
    u1, u2 = random_units(2, torch.Generator().manual_seed(seed))
    return T_true.to(dtype=torch.float64).retract(
        torch.cat([size * u1, max(0.0, rotation_of_size(size, widest)) * u2])
    )


def _require_length(what: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0):
        raise InputError(f"perturbation: {what} is {value}, expected a finite number, 0 or more")


Size = tuple[float, ...]
FARTHEST = 1e6
"""Metres that a start may be off."""

Case = tuple[int, int]
"""The place of a frame in its split, and the seed of a trial on it."""


@dataclass(frozen=True)
class Protocol:
    """Starts by name. ``start`` takes the true pose, a size, a trial's seed and how many frames the split has."""

    summary: str
    start: Callable[[SE3, Size, int, int], SE3 | None]
    sizes: tuple[Size, ...] = ((),)  # what is tried where nothing else is asked for
    units: tuple[str, ...] = ()  # of the numbers that make a size
    trials: int = 24  # of each size, where no other number is asked for
    seed: int = 0
    plan: Callable[[int, int, int], list[Case]] | None = None  # by frames, trials and seed
    fixed: bool = False  # it chooses from all frames of a split, and of none else

    def cases(self, frames: int, trials: int, seed: int) -> list[Case]:
        """The trials of one size. More of them begin with the same ones."""
        if frames < 1:
            raise InputError("nothing to try: expected at least one frame")
        return (self.plan or each_in_turn)(frames, trials, seed)

    def check_size(self, size: Size) -> None:
        most = [180.0 if "deg" in unit else FARTHEST for unit in self.units]
        if len(size) != len(self.units) or not all(0 <= x <= m for x, m in zip(size, most, strict=True)):
            expected = " : ".join(self.units) or "none, for it has no sizes"
            limits = f", 0 to {' : '.join(f'{m:g}' for m in most)}" if most else ""
            raise InputError(
                f"size is {':'.join(f'{x:g}' for x in size) or 'missing'}, expected {expected}{limits}"
            )


def each_in_turn(frames: int, trials: int, seed: int) -> list[Case]:
    """All frames in a random order, then again; every trial has a seed of its own."""
    order = torch.randperm(frames, generator=torch.Generator().manual_seed(seed)).tolist()
    return [(order[i % frames], seed + i) for i in range(trials)]


def five_of_each(frames: int, trials: int, seed: int) -> list[Case]:
    """Five starts a frame, as iNeRF has it."""
    order = torch.randperm(frames, generator=torch.Generator().manual_seed(seed)).tolist()
    return [(order[i // 5 % frames], seed + i) for i in range(trials)]


def find_protocol(name: str) -> Protocol:
    if name not in PROTOCOLS:
        near = difflib.get_close_matches(name, PROTOCOLS, n=1)
        hint = f", did you mean {near[0]!r}?" if near else f", expected one of {', '.join(PROTOCOLS)}"
        raise InputError(f"no protocol {name!r}{hint}")
    return PROTOCOLS[name]


PROTOCOLS = {
    "bid": Protocol(
        "BID-NeRF's: e_t in a random direction, with it 0.2 rad (at 0.5) to pi/4 (at 3.4)",
        lambda T_true, size, seed, frames: bid(T_true, size[0], seed),
        ((0.5,), (0.8,), (1.2,)),
        ("e_t (m)",),
    ),
    "bid-hard": Protocol(
        "the same with up to 1.4 rad",
        lambda T_true, size, seed, frames: bid_hard(T_true, size[0], seed),
        ((0.5,), (0.8,), (1.2,)),
        ("e_t (m)",),
    ),
    "inerf": Protocol(
        "iNeRF's: up to 40 degrees about a random axis and up to 0.2 along each; five starts a frame",
        lambda T_true, size, seed, frames: inerf(T_true, seed),
        trials=25,
        plan=five_of_each,
    ),
    "parallel": Protocol(
        "Parallel Inversion's 25: up to 15 degrees and 0.25 along each axis; the frames and numbers of their recipe",
        lambda T_true, size, seed, frames: parallel_inversion.start(T_true, seed, frames),
        trials=parallel_inversion.TRIALS,
        seed=parallel_inversion.SEED,
        plan=parallel_inversion.plan,
        fixed=True,
    ),
    "perturb": Protocol(
        "off by exactly so much, in random directions",
        lambda T_true, size, seed, frames: perturb(T_true, size[0], size[1], seed),
        ((0.2, 10.0),),
        ("metres", "degrees"),
    ),
    "none": Protocol("no start is known", lambda T_true, size, seed, frames: None),
}
"""Everything that chooses starts by name looks here."""
