"""What an entry point of the group ``bidnerf.backends`` points at."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from bidnerf_core.field import RadianceField, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.training import Report


@runtime_checkable
class Backend(Protocol):
    """A kind of field: how it is configured, built and trained."""

    @property
    def summary(self) -> str:
        """One line for ``bidnerf backends``."""
        ...

    @property
    def config_type(self) -> type:
        """A frozen dataclass, every field defaulted, of what JSON can hold."""
        ...

    def build(self, config: Any, bounds: SceneBounds) -> RadianceField:
        """An untrained field: an ``nn.Module`` with ``query`` and ``sampler``, whose ``state_dict`` is all that is saved."""
        ...

    def train(self, field: RadianceField, views: Sequence[View], config: Any, report: Report) -> None:
        """Fit the field to views whose reference frame is the world, telling ``report`` of every step."""
        ...
