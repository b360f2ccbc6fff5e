"""The interface of backends (named by entry points of ``bidnerf.backends``), and ``RecipeBackend``, which implements it.

The module also re-exports what backends need: the interfaces of fields and samplers, rendering, and supervision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, Generic, Protocol, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor, nn

from bidnerf_core.fields import DifferentiatedField as DifferentiatedField
from bidnerf_core.fields import FieldDerivatives as FieldDerivatives
from bidnerf_core.fields import FieldValues as FieldValues
from bidnerf_core.fields import HitField as HitField
from bidnerf_core.fields import Observations as Observations
from bidnerf_core.fields import RadianceField as RadianceField
from bidnerf_core.fields import RayHits as RayHits
from bidnerf_core.fields import Rays as Rays
from bidnerf_core.fields import RaySampler as RaySampler
from bidnerf_core.fields import RaySamples as RaySamples
from bidnerf_core.fields import SceneBounds as SceneBounds
from bidnerf_core.fields import Stratified as Stratified
from bidnerf_core.fields import device_of as device_of
from bidnerf_core.fields import levels as levels
from bidnerf_core.fields import render as render
from bidnerf_core.fields import render_image as render_image
from bidnerf_core.frames import View as View
from bidnerf_core.registry import Plugins, interface_defects
from bidnerf_core.training import Report as Report
from bidnerf_core.training import StepOutcome as StepOutcome
from bidnerf_core.training import Supervision as Supervision
from bidnerf_core.training import SupervisionConfig as SupervisionConfig


@runtime_checkable
class Backend(Protocol):
    """A kind of radiance field: how it is configured, built and trained."""

    @property
    def summary(self) -> str:
        """One-line description for ``bidnerf backends``."""
        ...

    @property
    def config_type(self) -> type:
        """A frozen dataclass of JSON-serializable values, with a default for every field.

        One of its fields is ``steps``, an int above 0: the number of training steps. A map is complete once
        its field has been trained for that many steps, and the command line shows progress as a fraction of
        ``steps``.
        """
        ...

    def build(self, config: Any, bounds: SceneBounds) -> RadianceField:
        """Return an untrained field: an ``nn.Module`` with ``query`` and ``sampler``, whose ``state_dict`` is saved."""
        ...

    def train(self, field: RadianceField, views: Sequence[View], config: Any, report: Report) -> None:
        """Fit the field to views whose reference frame is the world, and report each step's progress to ``report``.

        Photos of the same scene differ in exposure, some are blurred, and landmarks provide depth where no
        sensor did; ``training.Supervision`` handles all of this.
        """
        ...


def backend_defects(backend: Any) -> Iterator[str]:
    """Yield the reasons why an object does not implement ``Backend``."""
    parameters = {"build": ("config", "bounds"), "train": ("field", "views", "config", "report")}
    yield from interface_defects(backend, ("summary", "config_type"), parameters)
    kind = backend.config_type
    steps = getattr(kind(), "steps", None)
    if type(steps) is not int or steps < 1:
        found = "no field steps" if steps is None else f"steps = {steps!r}"
        yield f"config_type {kind.__name__} has {found}, expected the number of training steps, such as 'steps: int = 1000'"


BACKENDS: Plugins[Backend] = Plugins("backends", backend_defects)
"""All backends by name; a backend is imported when it is looked up."""


def load_backend(name: str, wanted_by: str = "") -> Backend:
    """Import the backend registered under ``name``, check it, and return it.

    Raises ``PluginError``, an ``InputError`` that names the entry point and, if given, the map that needs it
    (``wanted_by``).
    """
    return BACKENDS.load(name, wanted_by)


@runtime_checkable
class UpgradingField(Protocol):
    """Optional interface of a field that accepts states stored by earlier versions of its backend."""

    def upgraded_state(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a state dict that this or an earlier version stored, converted to the current version."""
        ...


def quick_config(backend: Backend) -> Any:
    """Return the config with which a backend trains a small and simple scene in about a minute, as in ``bidnerf demo``.

    This is the result of the backend's optional method ``quick_config``, or else the backend's default config.
    """
    return getattr(backend, "quick_config", backend.config_type)()


Config = TypeVar("Config")
Field = TypeVar("Field", bound=nn.Module)

_seeding = Lock()
"""Lock held while torch's global generator is temporarily reseeded, since several threads may build fields."""


@dataclass(frozen=True)
class RecipeBackend(Generic[Config, Field]):
    """A ``Backend`` composed of a config class, a field class and a training recipe.

    The config must have a ``seed``, an int, which makes the initial weights reproducible.
    """

    summary: str
    config_type: type
    field_type: Callable[[Config, SceneBounds], Field]
    recipe: Callable[[Field, Sequence[View], Config, Report], None]
    quick: Config | None = None  # for small and simple scenes

    def quick_config(self) -> Any:
        return self.config_type() if self.quick is None else self.quick

    def build(self, config: Config, bounds: SceneBounds) -> Field:
        with _seeding, torch.random.fork_rng(devices=[]):
            torch.manual_seed(cast(Any, config).seed)
            return self.field_type(config, bounds)

    def train(self, field: Field, views: Sequence[View], config: Config, report: Report) -> None:
        self.recipe(field, views, config, report)
