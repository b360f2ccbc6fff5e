"""Settings as frozen dataclasses: the range of each field, and the flat names by which users set the fields.

A method's settings are composed of small nested dataclasses with `Annotated` fields, which several methods share.
On the command line and in JSON, every field has a flat name, as in ``{"rays": 512, "depth_weight": 3}``: a name
is unique within a method, whichever dataclass declares it.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast

from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.io import LARGEST_NUMBER, NOT_ALLOWED, check_fields, expected_kinds, from_plain, to_plain

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema

S = TypeVar("S")

LARGEST_SEED = 2**31 - 1
"""Largest seed that commands and requests accept; every language represents it exactly. Python functions accept larger ones."""
WIDEST_HFOV = 170.0
"""Largest horizontal field of view (degrees): beyond it, the inner half of the angles fills less than 1/12 of a pinhole image."""

LARGEST_LENGTH = 1e15
"""Largest length (metres): squares of larger lengths approach the largest single-precision number."""
NARROWEST_HFOV = 3.0
"""Largest horizontal field of view (degrees) that users cannot state: each of up to ``WIDEST_HFOV`` is less than this in radians."""

FARTHEST = 1e9
"""Largest depth (metres) that counts as measured: no sensor reaches farther."""


class Allowed(Container[object]):
    """An annotation that limits a setting to the values in it; ``str()`` describes them for messages and help pages."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's validator of the annotated type, followed by the check that the value is allowed."""
        from pydantic import ValidationError
        from pydantic_core import PydanticCustomError, core_schema

        def validate(value: Any, validate_type: Callable[[Any], Any]) -> Any:
            kind = ""
            try:
                if (valid := validate_type(value)) in self:
                    return valid
            except ValidationError as error:
                kind = f"{expected_kinds(error.errors(include_url=False))}, "
            raise PydanticCustomError(NOT_ALLOWED, "{expected}", {"expected": f"{kind}{self}"})

        return core_schema.no_info_wrap_validator_function(validate, handler(source))


@dataclass(frozen=True)
class Range(Allowed):
    """The range of a setting, from ``least`` to ``most`` inclusive."""

    least: float
    most: float = math.inf

    def __contains__(self, value: object) -> bool:
        if not isinstance(value, Real):
            return False
        number = cast(float, value)
        return abs(number) <= LARGEST_NUMBER and self.least <= number <= self.most

    def __str__(self) -> str:
        least, most = _limits(self)
        return f"{least} to {most}" if most else f"a number from {least} up"


@dataclass(frozen=True)
class Above(Range):
    """The range of a setting that excludes its lower limit ``least`` and includes its upper limit ``most``."""

    def __contains__(self, value: object) -> bool:
        return super().__contains__(value) and value != self.least

    def __str__(self) -> str:
        least, most = _limits(self)
        return f"more than {least}" + (f", at most {most}" if most else "")


class WholeNumbers(Range):
    """The whole numbers from ``least`` to ``most``."""

    def __contains__(self, value: object) -> bool:
        return super().__contains__(value) and float(cast(float, value)).is_integer()

    def __str__(self) -> str:
        return f"a whole number, {super().__str__().removeprefix('a number ')}"


def check_hfov(degrees: Any) -> None:
    """Raise ``InputError`` unless ``degrees`` is a horizontal field of view that no one can have stated in radians."""
    if not isinstance(degrees, Real) or not NARROWEST_HFOV < cast(float, degrees) <= WIDEST_HFOV:
        expected = f"degrees, more than {NARROWEST_HFOV:g} and at most {WIDEST_HFOV:g}"
        if isinstance(degrees, Real) and 0 < cast(float, degrees) <= NARROWEST_HFOV:
            expected += (
                f" (radians? then {math.degrees(degrees):.4g} degrees; for a telescope, the focal length: `focal`)"
            )
        raise InputError(f"`hfov` is {degrees!r:.60}", expected=expected)


def _limits(allowed: Range) -> list[str]:
    """Format both limits; an infinite one is empty. The text is the same for 1 and 1.0: ``Annotated`` takes such ranges for equal."""
    return [
        "" if math.isinf(x) else f"{int(x) if x.is_integer() else x:,}"
        for x in (float(allowed.least), float(allowed.most))
    ]


# Compared and hashed by identity, since the command-line parser hashes annotations and a table is not hashable.
@dataclass(frozen=True, eq=False)
class OneOf(Allowed):
    """The names or numbers that a setting accepts: the keys of a table, which users may extend."""

    table: Mapping[Any, Any]

    def __contains__(self, value: object) -> bool:
        return value in self.table

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
WholeNumber = Annotated[int, Range(0)]
Share = Annotated[float, Range(0.0, 1.0)]
Degrees = Annotated[float, Range(0.0, 180.0)]
Length = Annotated[float, Range(0.0, LARGEST_LENGTH)]
Coordinate = Annotated[float, Range(-LARGEST_LENGTH, LARGEST_LENGTH)]


class Settings:
    """Base class of frozen dataclasses whose fields pydantic checks against their annotations, however they are made.

    Types are strict (text is not a number, nor True an integer), and numbers are finite. Creating an instance with an invalid
    value raises ``InputError`` with the setting's name, its value and what was expected.
    """

    def __post_init__(self) -> None:
        check_fields(self)


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
            raise InputError(
                f"{type(default).__name__} has no setting {name!r}{hint}",
                where=where,
                expected=None if hint else f"any of {', '.join(known)}",
            )
    return _with_values(default, values, where)


def _with_values(default: S, flat: dict[str, Any], where: str) -> S:
    """Return the settings ``default`` with the values of ``flat`` put into whichever groups declare their names."""
    kind: Any = type(default)
    hints, values = typing.get_type_hints(kind, include_extras=True), dict[str, Any]()
    for field in dataclasses.fields(kind):
        value = getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            values[field.name] = _with_values(value, flat, where)
        elif field.name in flat:
            values |= from_plain(cast(Any, dict)[str, hints[field.name]], {field.name: flat[field.name]}, where)
        else:
            values[field.name] = value
    try:
        return cast(S, kind(**values))
    except ValueError as error:
        raise InputError(error, where=where) from error
