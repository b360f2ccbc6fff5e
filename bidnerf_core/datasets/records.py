"""JSON objects from files that people wrote: every value is asked for by type, every error names the place."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError

LARGEST = sys.float_info.max  # JSON knows NaN, 1e999 and integers that no float holds


@dataclass(frozen=True)
class Record:
    """A JSON object; what it lacks is sought in ``defaults``. A value of ``null`` counts as lacking."""

    where: str  # opens every message: the file and, for a part of it, which
    values: Mapping[str, Any]
    defaults: Record | None = None

    def error(self, finding: str) -> InputError:
        return InputError(f"{self.where}: {finding}")

    def scopes(self) -> Iterator[Record]:
        """This object by itself, then its defaults by themselves."""
        yield Record(self.where, self.values)
        if self.defaults is not None:
            yield from self.defaults.scopes()

    def value(self, key: str) -> Any:
        found = self.values.get(key)
        return self.defaults.value(key) if found is None and self.defaults is not None else found

    def number(self, key: str) -> float | None:
        """A finite number, or None where there is none."""
        found = self.value(key)
        return None if found is None else self.checked_number(found, key)

    def size(self, key: str) -> int | None:
        """A number of pixels: whole and positive, though some programs write it as 800.0."""
        found = self.number(key)
        if found is not None and (found < 1 or found != int(found)):
            raise self.error(f"{key} is {found:g}, expected a positive whole number of pixels")
        return None if found is None else int(found)

    def text(self, key: str) -> str | None:
        found = self.value(key)
        if found is not None and not isinstance(found, str):
            raise self.error(f"{key} is {_short(found)}, expected text")
        return found

    def items(self, key: str) -> list[Any] | None:
        found = self.value(key)
        if found is not None and not isinstance(found, list):
            raise self.error(f"{key} is {_short(found)}, expected a list")
        return found

    def checked_number(self, found: Any, what: str) -> float:
        is_number = isinstance(found, int | float) and not isinstance(found, bool)
        if not is_number or not abs(found) < LARGEST:
            raise self.error(f"{what} is {_short(found)}, expected a finite number")
        return float(found)


def read_record(path: Path) -> Record:
    """The JSON object in the file ``path``. Raises ``InputError`` with line and column where it is not one."""
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}: broken JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({type(error).__name__}: {error})") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds {_short(values)}, expected a JSON object with frames")
    return Record(str(path), values)


def _short(value: Any) -> str:
    """A found value for a message: as JSON, on one line, cut where it is long."""
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
