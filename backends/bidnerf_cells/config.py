"""Settings of fields by cell."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Annotated, Any

from bidnerf_core.backend import Backend, load_backend
from bidnerf_core.errors import InputError
from bidnerf_core.settings import Above, Count, Range, Settings, from_flat

WHERE = "settings of the cells"


@dataclass(frozen=True)
class CellsConfig(Settings):
    """How a scene is divided into cells, and how their fields are made and trained."""

    # number of cells along the longest side of the scene; those along the others are about as long
    cells: Annotated[int, Range(1, 100)] = 2
    # width of the zone in which two neighbours are blended, as a fraction of a cell
    overlap: Annotated[float, Above(0, 1)] = 0.2
    inner: str = "hashgrid"  # name of the backend of the cells' fields
    inner_settings: tuple[str, ...] = ()  # its settings, each as NAME=VALUE
    steps: Count = 12800  # steps of the optimizer, over all cells
    # fraction of the steps for the field over all, which shows where the others are not trained
    overview_share: Annotated[float, Range(0.01, 1)] = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.settings_of(1)

    @property
    def backend(self) -> Backend:
        """The backend of the cells' fields."""
        return load_backend(self.inner, WHERE)

    def settings_of(self, steps: int) -> Any:
        """Return the settings of a cell's field that is trained for a number of steps.

        Raises ``InputError`` for settings that its backend does not have.
        """
        values = dict[str, Any]()
        for text in self.inner_settings:
            name, equals, value = text.partition("=")
            if not equals or name == "steps":
                raise InputError(f"{text!r}", where=WHERE, expected="NAME=VALUE, and `steps` on its own")
            try:
                values[name] = json.loads(value)
            except ValueError:
                values[name] = value
        return replace(from_flat(self.backend.config_type, values, WHERE), steps=max(1, steps))

    def ends(self, cells: int) -> list[int]:
        """Return the step at which the training of the overview ends, and that of each cell."""
        first = min(self.steps, max(1, round(self.overview_share * self.steps)))
        return [first + (self.steps - first) * number // cells for number in range(cells + 1)]
