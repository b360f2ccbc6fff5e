"""The unit of lengths in a scene: metres, or a unit of its own whose length is not known."""

from __future__ import annotations

from typing import Literal

LengthUnit = Literal["metres", "units"]
"""``"units"`` where nothing says how long the unit of the poses is, as after structure from motion."""


def symbol(unit: LengthUnit) -> str:
    """Return what is printed after a length: ``"m"`` or ``"units"``."""
    return "m" if unit == "metres" else "units"
