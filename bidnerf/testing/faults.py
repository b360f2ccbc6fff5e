"""Helpers of the contracts: each failure is one sentence that states what was found and what was expected."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar, TypeVar

import torch
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues, RadianceField, Rays, RaySamples

Made = TypeVar("Made")


def require(who: str, *claims: tuple[object, str]) -> None:
    """Raise ``AssertionError`` with the fault of the first claim (condition, fault) that is false for ``who``.

    An ``assert`` would be skipped under ``python -O``.
    """
    for condition, fault in claims:
        if not condition:
            raise AssertionError(f"{who}: {fault}")


def is_one_line(text: object) -> bool:
    """Return whether ``text`` is a string of one line that is not blank."""
    return isinstance(text, str) and text.strip() != "" and "\n" not in text


@contextmanager
def calling(doing: str, passing: type[Exception] = AssertionError) -> Iterator[None]:
    """Turn an exception in a plugin's code into a contract failure that names the call (``doing``).

    Contract failures and exceptions of the type ``passing`` propagate unchanged.
    """
    try:
        yield
    except (AssertionError, passing):
        raise
    except Exception as error:
        raise AssertionError(f"{doing} raised {type(error).__name__}: {error}") from error


def generator() -> Generator:
    """Return a generator of random numbers that are the same at each call."""
    return torch.Generator().manual_seed(7)


def equal(a: Tensor | None, b: Tensor | None) -> bool:
    """Return whether two optional tensors are equal, or both None."""
    return a is b or (a is not None and b is not None and torch.equal(a, b))


def are_colours(rgb: Tensor) -> bool:
    """Return whether all values are finite and in [0, 1]."""
    return bool(rgb.isfinite().all() and (rgb >= 0).all() and (rgb <= 1).all())


def is_depth(depth: Tensor | None) -> bool:
    """Return whether a depth image, if there is one, is finite and not negative."""
    return depth is None or bool(depth.isfinite().all() and (depth >= 0).all())


def is_refused(call: Callable[[], object]) -> bool:
    """Return whether a call raises ``InputError``."""
    try:
        call()
    except InputError:
        return True
    return False


def once(subject: object, make: Callable[[], Made]) -> Made:
    """Return the result of ``make``, which is called only once for the test class of the instance ``subject``."""
    if "_made" not in vars(type(subject)):
        type(subject)._made = make()  # type: ignore[attr-defined]
    return type(subject)._made  # type: ignore[attr-defined]


class Named:
    """Base class of contracts that load a plugin by the ``name`` under which it is registered."""

    kind: ClassVar[str] = ""
    name: ClassVar[str] = ""

    @property
    def _who(self) -> str:
        return f"{self.kind} {self.name!r}"

    def _part(self, load: Callable[[str], Made]) -> Made:
        require(type(self).__name__, (self.name != "", "no name, expected the one that is registered"))
        return load(self.name)


def query(field: RadianceField, positions: Tensor, directions: Tensor, of: str) -> FieldValues:
    """Return the field's values after checking their shapes. ``of`` describes the points."""
    who = f"{type(field).__name__}.query of {of}"
    with calling(who):
        values = field.query(positions, directions)
    shape = tuple(positions.shape[:-1])
    for what, found, expected in (("density", values.density, shape), ("rgb", values.rgb, (*shape, 3))):
        require(
            who,
            (
                tuple(found.shape) == expected,
                f"{what} has shape {tuple(found.shape)}, expected {expected} for positions of shape"
                f" {tuple(positions.shape)}",
            ),
        )
    return values


def sample(field: RadianceField, rays: Rays, of: str, jitter: Generator | None = None) -> RaySamples:
    """Return the samples of the field's sampler after checking their shapes. ``of`` describes the rays."""
    who = f"sampler {type(field.sampler).__name__} of {of}"
    with calling(who):
        samples = field.sampler(rays, jitter)
    shapes = [tuple(part.shape) for part in (samples.starts, samples.ends, samples.valid)]
    found = tuple(rays.near.shape)
    require(
        who,
        (
            shapes == shapes[:1] * 3 and shapes[0][:-1] == found,
            f"starts, ends and valid have shapes {shapes[0]}, {shapes[1]} and {shapes[2]}, expected the same for all"
            f" three: {found} and one more axis",
        ),
        (samples.valid.dtype == torch.bool, f"valid is {samples.valid.dtype}, expected torch.bool"),
    )
    return samples
