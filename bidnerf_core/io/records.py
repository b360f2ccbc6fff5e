"""JSON objects in files that users wrote. Values are read by type, and every error names the place."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import read_file
from bidnerf_core.io.serialization import LARGEST_NUMBER


@dataclass(frozen=True)
class Record:
    """A JSON object. A key that is missing or ``null`` is looked up in ``defaults``."""

    where: str  # the beginning of every message: the file, and the part of it
    values: Mapping[str, Any]
    defaults: Record | None = None

    def error(self, finding: str) -> InputError:
        return InputError(f"{self.where}: {finding}")

    def scopes(self) -> Iterator[Record]:
        """Yield this object without its defaults, then the defaults without theirs, and so on."""
        yield Record(self.where, self.values)
        if self.defaults is not None:
            yield from self.defaults.scopes()

    def value(self, key: str) -> Any:
        found = self.values.get(key)
        return self.defaults.value(key) if found is None and self.defaults is not None else found

    def number(self, key: str) -> float | None:
        """Return a finite number, or None where the key is missing."""
        found = self.value(key)
        return None if found is None else self.checked_number(found, key)

    def size(self, key: str) -> int | None:
        """Return a positive whole number of pixels, which some programs write as 800.0, or None where the key is missing."""
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
        if not is_number or not abs(found) < LARGEST_NUMBER:
            raise self.error(f"{what} is {_short(found)}, expected a finite number")
        return float(found)


def read_record(path: Path) -> Record:
    """Read the JSON object in the file ``path``. Raises ``InputError``, with line and column where the JSON is malformed."""
    return parse_record(str(path), read_file(path, "a JSON file"))


def parse_record(where: str, content: bytes) -> Record:
    """Parse a JSON object; ``where`` begins the message of the ``InputError`` that a malformed one raises."""
    try:
        values = json.loads(content.decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        raise InputError(
            f"{where}: broken JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not readable as JSON ({type(error).__name__}: {error})") from error
    if not isinstance(values, dict):
        raise InputError(f"{where}: holds {_short(values)}, expected a JSON object")
    return Record(where, values)


def _short(value: Any) -> str:
    """Return a value as JSON on one line, truncated if it is long."""
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
