"""Frozen dataclasses to what JSON holds, and back with every mistake named."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from typing import Any, TypeVar

from bidnerf_core.errors import InputError

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Dataclasses as dicts, tuples as lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    return value


def from_plain(kind: type[T], value: Any, where: str) -> T:
    """An instance of the dataclass ``kind``; missing keys take their defaults. ``where`` opens the error's line.

    Raises ``InputError`` for a key that ``kind`` does not have and for a value of another type than declared.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where}: found {value!r}, expected an object with the fields of {kind.__name__}")
    hints = typing.get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(kind) if f.init]  # type: ignore[arg-type]
    for key in value:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f", did you mean {near[0]!r}?" if near else f", expected some of {', '.join(known)}"
            raise InputError(f"{where}: {kind.__name__} has no field {key!r}{hint}")
    try:
        return kind(**{key: _converted(hints[key], item, f"{where}: {key}") for key, item in value.items()})
    except TypeError as error:  # a field without default is missing
        raise InputError(f"{where}: {error}") from error


def _converted(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return from_plain(typing.cast(type, kind), value, where)
    if origin in (typing.Union, types.UnionType):
        return _first_fit(arguments, value, where)
    if origin is tuple and isinstance(value, list | tuple):
        kinds = arguments[:1] * len(value) if arguments[-1:] == (Ellipsis,) else arguments
        if len(kinds) == len(value):
            return tuple(_converted(k, v, where) for k, v in zip(kinds, value, strict=True))
    elif origin is typing.Literal:
        if value in arguments:
            return value
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif origin is dict and isinstance(value, dict):
        return value
    elif kind is Any or (isinstance(kind, type) and type(value) is kind):
        return value
    raise InputError(f"{where}: found {value!r}, expected {getattr(kind, '__name__', kind)}")


def _first_fit(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    for kind in kinds:
        try:
            return _converted(kind, value, where)
        except InputError:
            continue
    names = " or ".join(getattr(kind, "__name__", str(kind)) for kind in kinds)
    raise InputError(f"{where}: found {value!r}, expected {names}")
