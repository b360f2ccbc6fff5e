"""Values that are optional in general and given in a test."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def require(value: T | None) -> T:
    """Return a value that must not be None."""
    assert value is not None
    return value
