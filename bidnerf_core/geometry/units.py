"""The length unit of a scene: metres, or an arbitrary unit of unknown length."""

from __future__ import annotations

from typing import Literal

LengthUnit = Literal["metres", "units"]
"""``"units"`` if the length of the poses' unit is unknown, as after structure from motion."""


def symbol(unit: LengthUnit) -> str:
    """Return the symbol printed after a length: ``"m"`` or ``"units"``."""
    return "m" if unit == "metres" else "units"
