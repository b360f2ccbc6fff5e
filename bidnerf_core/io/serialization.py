"""Conversion of frozen dataclasses to JSON values, and back with an error that names every mistake."""

from __future__ import annotations

import dataclasses
import math
import sys
import types
import typing
from typing import Any, TypeVar

from bidnerf_core.errors import InputError, spelling_hint

_T = TypeVar("_T")

LARGEST_NUMBER = sys.float_info.max  # JSON can hold NaN, 1e999 and integers that no float can
LARGEST_INTEGER = 2**63 - 1  # that tensors and files can hold


def to_plain(value: Any, where: str = "") -> Any:
    """Convert dataclasses to dicts and tuples to lists. Raises ``InputError`` for values that strict JSON cannot hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f.name for f in dataclasses.fields(value) if f.init]
        return {name: to_plain(getattr(value, name), _inside(where, name)) for name in fields}
    if isinstance(value, dict):
        return {_key(key, where): to_plain(item, _inside(where, key)) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item, f"{where}[{place}]") for place, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{where or 'value'} is {value}, expected a finite number")
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise InputError(f"{where or 'value'} is a {type(value).__name__}, expected what JSON can hold")


def from_plain(kind: type[_T], value: Any, where: str) -> _T:
    """Return an instance of the dataclass ``kind``; missing keys take their defaults. Errors begin with ``where``.

    Raises ``InputError`` for an unknown key, for a required one that is missing, for a value of a type other than the declared
    one, and for values that ``kind`` itself rejects.
    """
    if not isinstance(value, dict):
        raise InputError(
            f"{where}: found {_shown(value)}, expected an object with the fields of {kind.__name__}"
        )
    _check_keys(kind, value, where)
    hints = typing.get_type_hints(kind)
    fields = {key: converted(hints[key], item, f"{where}: {key}") for key, item in value.items()}
    try:
        return kind(**fields)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error


def _check_keys(kind: type, value: dict[str, Any], where: str) -> None:
    known = {f.name: _is_required(f) for f in dataclasses.fields(kind) if f.init}
    for key in value:
        if key not in known:
            hint = spelling_hint(key, known, f", expected some of {', '.join(known)}")
            raise InputError(f"{where}: {kind.__name__} has no field {key!r}{hint}")
    missing = [key for key, required in known.items() if required and key not in value]
    if missing:
        raise InputError(
            f"{where}: no {', '.join(map(repr, missing))}, expected all fields of {kind.__name__}"
        )


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def converted(kind: Any, value: Any, where: str) -> Any:
    """Convert ``value``, as read from JSON, to the type ``kind``. Errors begin with ``where``."""
    origin, arguments = typing.get_origin(kind) or kind, typing.get_args(kind)
    if kind is Any or (origin is typing.Literal and value in arguments):
        return value
    if dataclasses.is_dataclass(kind):
        return from_plain(typing.cast(type, kind), value, where)
    if origin in (typing.Union, types.UnionType):
        return _first_fit(arguments, value, where)
    if origin in (tuple, list) and isinstance(value, list | tuple):
        kinds = _kinds_of_items(origin, arguments, len(value))
        if len(kinds) == len(value):
            return origin(converted(k, v, where) for k, v in zip(kinds, value, strict=True))
    elif origin is dict and isinstance(value, dict):
        inner = arguments[1] if arguments else Any
        return {key: converted(inner, item, f"{where}.{key}") for key, item in value.items()}
    elif kind is float and type(value) in (int, float):
        if abs(value) <= LARGEST_NUMBER:
            return float(value)
    elif kind is int and type(value) is int:
        if abs(value) <= LARGEST_INTEGER:
            return value
        raise InputError(f"{where}: found {_shown(value)}, expected an integer of at most 64 bits")
    elif type(value) is kind or (value is None and kind is type(None)):
        return value
    raise InputError(f"{where}: found {_shown(value)}, expected {_name(kind)}")


def _kinds_of_items(origin: type, arguments: tuple[Any, ...], count: int) -> tuple[Any, ...]:
    if not arguments:
        return (Any,) * count
    return arguments[:1] * count if origin is list or arguments[-1:] == (Ellipsis,) else arguments


def _first_fit(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    for kind in sorted(
        kinds, key=lambda kind: type(value) is not kind
    ):  # an exact match comes first: 1 is an int
        try:
            return converted(kind, value, where)
        except InputError:
            continue
    raise InputError(f"{where}: found {_shown(value)}, expected {' or '.join(map(_name, kinds))}")


def _name(kind: Any) -> str:
    if typing.get_origin(kind) is typing.Literal:
        return " or ".join(map(repr, typing.get_args(kind)))
    if kind is type(None):
        return "null"
    return kind.__name__ if isinstance(kind, type) else str(kind)


def _shown(value: Any) -> str:
    """Return a value as text on one line, truncated if it is long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _inside(where: str, name: Any) -> str:
    return f"{where}.{name}" if where else str(name)


def _key(key: Any, where: str) -> str:
    if not isinstance(key, str):
        raise InputError(f"{where or 'value'} has the key {key!r}, expected text")
    return key
