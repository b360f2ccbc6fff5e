"""The subject of the contract's tests: a backend, its config, and fields built and trained with them."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import torch
from torch import nn

from bidnerf_core.backend import load_backend
from bidnerf_core.fields import RadianceField, levels
from bidnerf_core.io import from_plain, to_plain
from bidnerf_core.testing import recipes
from bidnerf_core.testing.faults import calling, query, require_that
from bidnerf_core.testing.scene import SCENE_BOUNDS, points, rgbd_views

SUBJECT_STEPS = 40
"""Training steps if the test sets no ``config``."""


class Subject:
    """Selects the backend, and builds and trains its fields."""

    backend: ClassVar[Any] = None
    name: ClassVar[str | None] = None
    config: ClassVar[Any] = None

    def _backend(self) -> Any:
        if self.name is not None:
            return load_backend(self.name)
        require_that(
            self.backend is not None,
            f"{type(self).__name__} has neither backend nor name, expected one of them",
        )
        return self.backend

    def _config(self) -> Any:
        if self.config is not None:
            return self.config
        return dataclasses.replace(self._backend().config_type(), steps=SUBJECT_STEPS)

    def _reread(self, config: Any) -> Any:
        """Return the config as it would be read back from a map on disk."""
        with calling(f"{type(config).__name__} to JSON and back"):
            text = json.dumps(to_plain(config, "config"), allow_nan=False)
            return from_plain(self._backend().config_type, json.loads(text), "config")

    def _build(self, config: Any = None) -> Any:
        with calling(f"{called(self._backend())}.build"):
            return self._backend().build(self._config() if config is None else config, SCENE_BOUNDS)

    def _trained(self) -> Any:
        """Return a field trained on RGB-D views and frozen like that of a loaded map; trained once per test class."""
        kept = type(self).__dict__.get("_kept")
        if kept is None:
            kept = self._build()
            with calling(f"{called(self._backend())}.train"):
                self._backend().train(kept, rgbd_views(), self._config(), recipes.Recorder())
            type(self)._kept = frozen(kept)  # type: ignore[attr-defined]
        return type(self).__dict__["_kept"]

    def _fields(self) -> Iterator[Any]:
        yield frozen(self._build())
        yield self._trained()

    def _each(self, check: Callable[[RadianceField], None]) -> None:
        """Run ``check`` on all levels of an untrained and of a trained field."""
        for field in self._fields():
            for level in levels(field):
                check(level)


def frozen(field: Any) -> Any:
    return field.requires_grad_(False).eval() if isinstance(field, nn.Module) else field


def precise(field: RadianceField) -> tuple[RadianceField, torch.dtype]:
    """Return a copy in float64 if the field supports it, else the field itself, and the dtype."""
    try:
        doubled = copy.deepcopy(field)
        _double(doubled)
        positions, directions = (x.double() for x in points(2))
        if query(doubled, positions, directions, "points").density.dtype == torch.float64:
            return doubled, torch.float64
    except Exception:  # reported by the test of dtypes
        pass
    return field, torch.float32


def _double(field: Any) -> None:
    """Convert a field to float64 in place; for a level that is not a module, convert the modules that it holds."""
    if isinstance(field, nn.Module):
        field.double()
    else:
        for part in vars(field).values():
            if isinstance(part, nn.Module):
                part.double()


def called(backend: Any) -> str:
    return type(backend).__name__
