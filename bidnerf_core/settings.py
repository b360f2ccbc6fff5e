"""Settings as frozen dataclasses: the range of each field, and the flat names by which users set the fields.

A method's settings are composed of small nested dataclasses with `Annotated` fields, which several methods share.
On the command line and in JSON, every field has a flat name, as in ``{"rays": 512, "depth_weight": 3}``: a name
is unique within a method, whichever dataclass declares it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any, TypeVar, cast

from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.io import LARGEST_NUMBER, from_plain, to_plain

S = TypeVar("S")

LARGEST_SEED = 2**31 - 1
"""Largest seed that commands and requests accept; every language represents it exactly. Python functions accept larger ones."""


@dataclass(frozen=True)
class Range:
    """The range of a setting, from ``least`` to ``most`` inclusive."""

    least: float
    most: float = math.inf

    def __contains__(self, value: object) -> bool:
        if not isinstance(value, Real):
            return False
        number = cast(float, value)
        return abs(number) <= LARGEST_NUMBER and self.least <= number <= self.most

    def __str__(self) -> str:
        if self.most == math.inf:
            return f"a number from {_written(self.least)} up"
        return f"{_written(self.least)} to {_written(self.most)}"


@dataclass(frozen=True)
class Above(Range):
    """The range of a setting that excludes its lower limit ``least`` and includes its upper limit ``most``."""

    def __contains__(self, value: object) -> bool:
        return super().__contains__(value) and value != self.least

    def __str__(self) -> str:
        least = f"more than {_written(self.least)}"
        return least if self.most == math.inf else f"{least}, at most {_written(self.most)}"


class WholeNumbers(Range):
    """The whole numbers from ``least`` to ``most``."""

    def __contains__(self, value: object) -> bool:
        return super().__contains__(value) and float(cast(float, value)).is_integer()

    def __str__(self) -> str:
        return f"a whole number, {super().__str__().removeprefix('a number ')}"


def _written(limit: float) -> str:
    """Format a limit for messages. The result is the same for 1 and 1.0, since ``Annotated`` does not distinguish equal ranges."""
    return f"{int(limit) if float(limit).is_integer() else limit:,}"


# Compared and hashed by identity, since the command-line parser hashes annotations and a table is not hashable.
@dataclass(frozen=True, eq=False)
class OneOf:
    """The names or numbers that a setting accepts: the keys of a table, which users may extend."""

    table: Mapping[Any, Any]

    def __contains__(self, value: object) -> bool:
        return any(
            isinstance(value, type(known))
            and value == known
            and isinstance(value, bool) == isinstance(known, bool)  # True is 1, but not where a number is expected
            for known in self.table
        )

    def __str__(self) -> str:
        return f"one of {', '.join(map(str, self.table))}"


@dataclass(frozen=True)
class Expert:
    """Marks a setting that ``--help`` leaves out and ``--help-all`` shows."""


EXPERT = Expert()

Count = Annotated[int, Range(1, 10**7)]
# The number of layers of a network is limited, since each takes time and memory even on the device "meta".
Layers = Annotated[int, Range(1, 100)]
NotNegative = Annotated[float, Range(0.0)]
Positive = Annotated[float, Above(0.0, 1e6)]


class Settings:
    """Base class of frozen dataclasses whose fields are checked against the ranges or names in their annotations.

    Creating an instance with an invalid value raises ``InputError`` with the setting's name, its value and
    what was expected.
    """

    def __post_init__(self) -> None:
        for name, (allowed, optional) in _allowed(type(self)).items():  # type: ignore[arg-type]
            value = getattr(self, name)
            if value not in allowed and not (optional and value is None):
                raise InputError(f"{name} is {value!r}", expected=allowed)


@functools.cache
def _allowed(kind: Any) -> dict[str, tuple[Range | OneOf, bool]]:
    """Return the allowed values of each field of ``kind`` that has limits, and whether None is allowed as well."""
    found: dict[str, tuple[Range | OneOf, bool]] = {}
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        optional = type(None) in typing.get_args(hint)
        for part in (hint, *typing.get_args(hint)):
            if typing.get_origin(part) is typing.Literal:
                found[name] = OneOf(dict.fromkeys(typing.get_args(part))), optional
            for note in getattr(part, "__metadata__", ()):
                if isinstance(note, Range | OneOf):
                    found[name] = note, optional
    return found


def to_flat(settings: Any) -> dict[str, Any]:
    """Return a dictionary from the flat names of all settings to JSON-serializable values."""
    flat: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        flat |= to_flat(value) if dataclasses.is_dataclass(value) else {field.name: to_plain(value, field.name)}
    return flat


def from_flat(base: S | type[S], values: dict[str, Any], where: str) -> S:
    """Return the settings ``base`` (an instance, or a class for its defaults) updated with ``values`` by flat name.

    Raises ``InputError``, whose message begins with ``where``, for an unknown name, a value of the wrong type, and a value out of
    range.
    """
    default: S = base() if isinstance(base, type) else base
    known = to_flat(default)
    for name in values:
        if name not in known:
            hint = spelling_hint(name, known)
            found = f"{type(default).__name__} has no setting {name!r}{hint}"
            raise InputError(found, where=where, expected=None if hint else f"any of {', '.join(known)}")
    return _with_values(default, values, where)


def _with_values(default: S, flat: dict[str, Any], where: str) -> S:
    """Return the settings ``default`` with the values of ``flat`` put into whichever groups declare their names."""
    kind: Any = type(default)
    hints, values = typing.get_type_hints(kind), dict[str, Any]()
    for field in dataclasses.fields(kind):
        value = getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            values[field.name] = _with_values(value, flat, where)
        elif field.name in flat:
            values[field.name] = from_plain(hints[field.name], flat[field.name], f"{where}: {field.name}")
        else:
            values[field.name] = value
    try:
        return cast(S, kind(**values))
    except ValueError as error:
        raise InputError(error, where=where) from error
