"""Contract failures, each in one sentence that states what was found and what was expected."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar, TypeVar

import torch
from torch import Generator, Tensor

from bidnerf_core.fields import FieldValues, RadianceField, Rays, RaySamples

T = TypeVar("T")


def require_that(condition: bool, fault: str) -> None:
    """Raise ``AssertionError`` unless ``condition`` holds. An ``assert`` would be skipped under ``python -O``."""
    if not condition:
        raise AssertionError(fault)


@contextmanager
def calling(doing: str) -> Iterator[None]:
    """Turn an exception in the backend's code into a contract failure that names the call (``doing``)."""
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{doing} raised {type(error).__name__}: {error}") from error


class Named:
    """The base of contracts of parts that are registered by ``name``."""

    name: ClassVar[str] = ""

    def _part(self, load: Callable[[str], T]) -> T:
        require_that(
            self.name != "", f"{type(self).__name__} has no name, expected the one that is registered"
        )
        return load(self.name)


def query(field: RadianceField, positions: Tensor, directions: Tensor, of: str) -> FieldValues:
    """Return the field's values after checking their shapes. ``of`` describes the points."""
    who = f"{type(field).__name__}.query of {of}"
    with calling(who):
        values = field.query(positions, directions)
    shape = tuple(positions.shape[:-1])
    for what, found, expected in (
        ("density", values.density, shape),
        ("rgb", values.rgb, (*shape, 3)),
    ):
        require_that(
            tuple(found.shape) == expected,
            f"{who}: {what} has shape {tuple(found.shape)}, expected {expected} for positions of shape"
            f" {tuple(positions.shape)}",
        )
    return values


def sample(field: RadianceField, rays: Rays, of: str, jitter: Generator | None = None) -> RaySamples:
    """Return the samples of the field's sampler after checking their shapes. ``of`` describes the rays."""
    who = f"sampler {type(field.sampler).__name__} of {of}"
    with calling(who):
        samples = field.sampler(rays, jitter)
    shape, found = samples.starts.shape, tuple(rays.near.shape)
    require_that(
        tuple(shape[:-1]) == found and samples.ends.shape == shape and samples.valid.shape == shape,
        f"{who}: starts, ends and valid have shapes {tuple(shape)}, {tuple(samples.ends.shape)} and"
        f" {tuple(samples.valid.shape)}, expected the same for all three: {found} and one more axis",
    )
    require_that(
        samples.valid.dtype == torch.bool, f"{who}: valid is {samples.valid.dtype}, expected torch.bool"
    )
    return samples
