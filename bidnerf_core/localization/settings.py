"""What the settings of rendering methods are judged by."""

from __future__ import annotations

import math
from typing import Any, get_args

from bidnerf_core.errors import InputError


class Judged:
    """A dataclass of settings that says of each what was expected of it."""

    def _require_one_of(self, **kinds: Any) -> None:
        for name, kind in kinds.items():
            known = get_args(kind)
            self._require(name, getattr(self, name) in known, f"one of {', '.join(known)}")

    def _require_not_negative(self, name: str) -> None:
        value = getattr(self, name)
        self._require(name, math.isfinite(value) and value >= 0, "a number, 0 or more")

    def _require(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(f"{name} is {getattr(self, name)}, expected {expected}")
