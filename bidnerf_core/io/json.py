"""JSON: one parser, objects with typed access to values, and conversion of frozen dataclasses to and from
plain values; and the YAML and XML of calibrations and cameras.

All code that reads JSON uses ``parse_json``, so that damaged text of any origin gives the same one-line error.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import re
import sys
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import GenericAlias
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar, cast

from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.io.allowance import Allowance
from bidnerf_core.io.files import library_errors, read_file

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from pydantic import TypeAdapter
    from torch import Tensor

_T = TypeVar("_T")

LARGEST_NUMBER = sys.float_info.max  # JSON can hold NaN, 1e999 and integers too large for a float
LARGEST_INTEGER = 2**63 - 1  # the largest integer that tensors and files can hold
EXPECTED = {
    "bool_type": "bool",
    "int_type": "int",
    "float_type": "float",
    "finite_number": "float",
    "string_type": "str",
    "dict_type": "an object",
    "dataclass_type": "an object",
    "list_type": "a list",
    "tuple_type": "a list",
    "missing": "a longer list",
    "sequence_str": "a list, such as [{input!r}]",
}
"""What messages state as expected, by pydantic's error type; other types use pydantic's own text."""
BYTES = {"{": 240, "[": 64, ",": 40}
"""The memory that an object, a list and a value take, by the character that stands for one."""
NOT_ALLOWED = "not_allowed"
"""The error type of values that an annotation of ``settings.Allowed`` refuses."""


def read_json(path: Path, expected: str) -> Any:
    """Return the JSON value in the file ``path``. Raises ``InputError`` as ``read_file`` and ``parse_json`` do."""
    return parse_json(read_file(path, expected), str(path), expected)


def parse_json(content: bytes | str, where: str, expected: str) -> Any:
    """Parse JSON text (UTF-8). Raises ``InputError`` for text that is not JSON, or whose value could not be written as JSON again.

    The message begins with ``where`` (the file, or nothing) and ends with ``expected``, a brief description of what should
    be there.
    """
    allowance = Allowance(where, expected, 2**30)
    try:
        text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
        allowance.take(sum(bytes * text.count(mark) for mark, bytes in BYTES.items()))
        found = json.loads(text)
        if "\\ud" in text.lower():  # half of a surrogate pair, which no file or terminal can represent
            json.dumps(found, ensure_ascii=False).encode()
    except json.JSONDecodeError as error:
        raise InputError(
            f"not JSON ({error.msg} at line {error.lineno}, column {error.colno})", where=where, expected=expected
        ) from error
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON ({getattr(error, 'reason', error)})", where=where, expected=expected) from error
    return found


@dataclass(frozen=True)
class Record:
    """A JSON object. A key that is missing or ``null`` is looked up in ``defaults``."""

    where: str  # the beginning of every message: the file, and the part of it
    values: Mapping[str, Any]
    defaults: Record | None = None

    def error(self, found: object, expected: object = None) -> InputError:
        return InputError(found, where=self.where, expected=expected)

    def scopes(self) -> Iterator[Record]:
        """Yield this object without its defaults, then the defaults without theirs, and so on."""
        yield Record(self.where, self.values)
        if self.defaults is not None:
            yield from self.defaults.scopes()

    def value(self, key: str) -> Any:
        found = self.values.get(key)
        return self.defaults.value(key) if found is None and self.defaults is not None else found

    def number(self, key: str) -> float | None:
        """Return a finite number, or None if the key is missing."""
        found = self.value(key)
        return None if found is None else self.checked_number(found, key)

    def size(self, key: str) -> int | None:
        """Return a positive integer number of pixels (800.0, as some programs write it, is accepted), or None if
        the key is missing.
        """
        found = self.number(key)
        if found is not None and (found < 1 or found != int(found)):
            raise self.error(f"{key} is {found:g}", expected="a positive whole number of pixels")
        return None if found is None else int(found)

    def text(self, key: str) -> str | None:
        return cast(str | None, self._of_type(key, str, "text"))

    def items(self, key: str) -> list[Any] | None:
        return cast(list[Any] | None, self._of_type(key, list, "a list"))

    def _of_type(self, key: str, kind: type, expected: str) -> Any:
        found = self.value(key)
        if found is not None and not isinstance(found, kind):
            raise self.error(f"{key} is {_shown(found, as_json=True)}", expected=expected)
        return found

    def checked_number(self, found: Any, what: str) -> float:
        is_number = isinstance(found, int | float) and not isinstance(found, bool)
        if not is_number or not abs(found) < LARGEST_NUMBER:
            raise self.error(f"{what} is {_shown(found, as_json=True)}", expected="a finite number")
        return float(found)

    def homogeneous(self, key: str, rows: list[Any] | None) -> tuple[list[list[float]], float]:
        """Return the first three of a matrix's 3 or 4 ``rows`` divided by w, and w, the last entry of a fourth row 0 0 0 w.

        Without a fourth row, or if w is 1 up to rounding, w is 1. ``key`` is the matrix's key, for messages.
        """
        if rows is None:
            raise self.error(f"no {key}", expected="a 4x4 matrix of a pose")
        if len(rows) not in (3, 4) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
            raise self.error(f"{key} is not 3x4 or 4x4", expected="a 4x4 matrix")
        numbers = [[self.checked_number(x, f"an entry of {key}") for x in row] for row in rows]
        last = numbers[3] if len(numbers) == 4 else [0.0, 0.0, 0.0, 1.0]
        if not last[3] > 0 or max(map(abs, last[:3])) > 1e-6 * last[3]:
            raise self.error(f"the last row of {key} is {last}", expected="[0, 0, 0, 1]")
        scale = last[3] if abs(last[3] - 1) > 1e-6 else 1.0
        return [[x / scale for x in row] for row in numbers[:3]], scale

    def matrix(self, key: str, rows: list[Any] | None) -> list[list[float]]:
        """Return the first three rows of a 3x4 or 4x4 matrix of finite numbers; a fourth row must be 0 0 0 1."""
        found, scale = self.homogeneous(key, rows)
        if scale != 1.0:
            raise self.error(f"the last row of {key} is [0, 0, 0, {scale:g}]", expected="[0, 0, 0, 1]")
        return found


def read_record(path: Path, expected: str = "a JSON object") -> Record:
    """Read the JSON object in the file ``path``. Raises ``InputError``, with line and column if the JSON is malformed."""
    return parse_record(str(path), read_file(path, "a JSON file"), expected)


def parse_record(where: str, content: bytes | str, expected: str = "a JSON object") -> Record:
    """Parse a JSON object. Malformed text raises ``InputError``, whose message begins with ``where``."""
    values = parse_json(content, where, expected)
    if not isinstance(values, dict):
        raise InputError(f"holds {_shown(values, as_json=True)}", where=where, expected=expected)
    return Record(where, values)


def _shown(value: Any, as_json: bool = False) -> str:
    """Return a value as text on one line, truncated if it is long."""
    text = json.dumps(value) if as_json else repr(value)
    if _is_tensor(value):
        text = f"{value.dtype} {list(value.shape)}"
    return text if len(text) <= 60 else text[:57] + "..."


def _is_tensor(value: Any) -> TypeGuard[Tensor]:
    """Return whether a value is a tensor, without importing torch: commands that compute nothing need not load it."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def to_plain(value: Any, where: str = "", tensors: dict[str, Tensor] | None = None) -> Any:
    """Return a value with all dataclasses in it converted to dicts, and all tuples to lists.

    Raises ``InputError`` for values that strict JSON cannot represent; the message names the value by its path, which begins
    with ``where``. Tensors are moved to ``tensors``, if given, under the names of their fields, such as ``motion.noise``;
    ``with_tensors`` puts them back.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
    if isinstance(value, dict):
        if odd := [key for key in value if not isinstance(key, str)]:
            raise InputError(f"{where or 'value'} has the key {odd[0]!r}", expected="text")
        return {key: to_plain(item, f"{where}.{key}" if where else key, tensors) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item, f"{where}[{index}]", tensors) for index, item in enumerate(value)]
    if _is_tensor(value) and tensors is not None:
        tensors[where] = value
        return {"tensor": where}
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{where or 'value'} is {value}", expected="a finite number")
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise InputError(f"{where or 'value'} is a {type(value).__name__}", expected="a JSON-serializable value")


def with_tensors(plain: Any, tensors: Mapping[str, Tensor], where: str) -> Any:
    """Put the tensors that ``to_plain`` moved back into its result; ``from_plain`` checks their shapes.

    Raises ``InputError`` for a missing tensor.
    """
    if not isinstance(plain, dict):
        return plain
    name = plain.get("tensor")
    if len(plain) > 1 or not isinstance(name, str):
        return {key: with_tensors(item, tensors, where) for key, item in plain.items()}
    if name not in tensors:
        raise InputError(f"no tensor {name!r}", where=where)
    return tensors[name]


def from_plain(kind: type[_T] | GenericAlias, value: Any, where: str) -> _T:
    """Convert ``value``, as read from JSON, to the type ``kind``: a dataclass, or a list, tuple or dict of these and of plain values.

    Missing keys take their defaults, and lists become tuples where ``kind`` has tuples. Raises ``InputError``, whose message begins with
    ``where``, for an unknown key, a missing required key, a value of the wrong type, and values that ``kind`` itself
    rejects. A value with parts that JSON cannot hold (tensors, see ``with_tensors``) is checked less strictly:
    text may stand for a number.
    """
    from pydantic import ValidationError  # imported here, since many commands read no JSON

    def check_size(digits: str) -> None:
        if abs(int(digits)) > LARGEST_INTEGER:
            raise InputError(f"holds {digits[:30]}", where=where, expected="integers of at most 64 bits")

    try:
        text = json.dumps([value], ensure_ascii=False).encode()
        if re.search(rb"\d{19}", text):  # a second parse takes as much memory as the value
            json.loads(text, parse_int=check_size)
    except (TypeError, UnicodeEncodeError):  # tensors, and file names of bytes that are not UTF-8
        text = b""
    adapter = _adapter(cast(Any, kind))
    try:
        # Strict pydantic takes lists for tuples, and dicts for dataclasses, only in JSON.
        rows = adapter.validate_json(text) if text else adapter.validate_python([value], strict=False)
    except ValidationError as error:
        raise _first_error(error.errors(include_url=False), where, kind, value) from None
    except (TypeError, OverflowError) as error:  # raised by a dataclass itself
        raise InputError(error, where=where) from error
    return cast(_T, rows[0])


def check_fields(instance: Any) -> None:
    """Check the fields of a dataclass against their annotations. Raises ``InputError`` for the first invalid value."""
    fields = dataclasses.fields(instance)
    values = {field.name: getattr(instance, field.name) for field in fields}
    if all(values[field.name] is field.default for field in fields):
        return  # most settings are the defaults, and the next line takes a tenth of a second
    from pydantic import ValidationError

    try:
        _adapter(_fields_type(cast(Any, type(instance)))).validate_python([values])
    except ValidationError as error:
        errors = error.errors(include_url=False)
        name = errors[0]["loc"][1]
        raise InputError(
            f"{name} is {_shown(values[str(name)])}",
            expected=expected_kinds([e for e in errors if e["loc"][1] == name]),
        ) from None


@functools.cache
def _fields_type(kind: Any) -> Any:
    """Return the type of a dict of the fields of a dataclass; dataclasses in it have checked their own fields."""
    from pydantic import InstanceOf
    from typing_extensions import TypedDict

    hints, plain = typing.get_type_hints(kind, include_extras=True), typing.get_type_hints(kind)
    types = {
        name: cast(Any, InstanceOf)[of] if dataclasses.is_dataclass(of) else hints[name] for name, of in plain.items()
    }
    return cast(Any, TypedDict)(kind.__name__, {field.name: types[field.name] for field in dataclasses.fields(kind)})


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[list[Any]]:
    """Return a validator of lists of ``kind``: pydantic accepts a configuration only for dataclasses nested in other types."""
    from pydantic import ConfigDict, TypeAdapter

    return TypeAdapter(
        list[kind], config=ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)
    )


def _first_error(errors: Sequence[Any], where: str, of: Any, value: Any) -> InputError:
    """Convert the first of pydantic's ``errors`` about ``value``, which was to become an ``of``."""
    first, path = errors[0], _path(errors[0], value)
    kind, keys = first["type"], [where, *(key for key in path if isinstance(key, str))]
    if "error" in first.get("ctx", {}):  # what a dataclass raised
        return InputError(first["ctx"]["error"], where=": ".join(keys))
    if kind == "unexpected_keyword_argument":
        known = [f.name for f in dataclasses.fields(of) if f.init] if len(path) == 2 else []
        hint = spelling_hint(keys[-1], known)
        expected = f"any of {', '.join(known)}" if known and not hint else None
        return InputError(f"no field {keys[-1]!r}{hint}", where=": ".join(keys[:-1]), expected=expected)
    if kind == "missing" and isinstance(path[-1], str):
        return InputError("missing", where=": ".join(keys))
    expected = expected_kinds([error for error in errors if _path(error, value) == path])
    if kind == NOT_ALLOWED and isinstance(path[-1], str):
        return InputError(f"{path[-1]} is {_shown(first['input'])}", where=": ".join(keys[:-1]), expected=expected)
    return InputError(f"found {_shown(first['input'])}", where=": ".join(keys), expected=expected)


def _path(error: Any, value: Any) -> list[str | int]:
    """Return the keys and indices by which an error of pydantic is reached in ``[value]``, without the members of unions."""
    path, part = list[str | int](), cast(Any, [value])
    for key in error["loc"]:
        with contextlib.suppress(LookupError, TypeError):
            path, part = [*path, key], part[key]
    return [*path, error["loc"][-1]] if error["type"] == "missing" else path


def expected_kinds(errors: Sequence[Any]) -> str:
    """Return the types or values that pydantic expected, given its errors about one value: one for each member of a union."""
    own = ((error, EXPECTED.get(error["type"])) for error in errors)
    texts = (text.format(**error) if text else error["msg"].removeprefix("Input should be ") for error, text in own)
    return " or ".join(dict.fromkeys(texts))


def parse_yaml(content: bytes, where: str, expected: str) -> dict[str, Any]:
    """Return the first document of a YAML text, a mapping, with all values, including numbers, as text. Tags, which may run code, are ignored.

    Raises ``InputError``, whose message begins with ``where``, if the text is malformed, too large or too deep, has aliases, or
    is no mapping.
    """
    import yaml  # imported here, since few commands read YAML

    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    # Limits on bytes (a calibration with the points of all its images takes some 100,000) and on the depth of nesting
    most, deepest = 2**20, 50
    if len(content) > most:
        raise InputError(f"has {len(content):,} bytes of YAML", where=where, expected=f"{expected} of at most {most:,}")
    with library_errors(where, "is not YAML", expected, yaml.YAMLError, ValueError, TypeError, RecursionError):
        text = re.sub(r"\A\s*%YAML.*\n", "", content.decode("utf-8-sig"))  # OpenCV's is malformed
        depth = 0
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > deepest:
                raise yaml.YAMLError(f"aliases, or more than {deepest} lists and mappings within each other")
        found = next(iter(yaml.load_all(text, Loader=loader)), None)
    if not isinstance(found, dict):
        raise InputError("has no entries", where=where, expected=expected)
    return found


def parse_xml(content: bytes, where: str, expected: str) -> Element:
    """Return the root element of an XML text. Raises ``InputError``, whose message begins with ``where``, if the text is malformed,
    too large, or declares a document type, whose entities expand to any size.
    """
    from xml.etree import ElementTree  # imported here, since few commands read XML
    from xml.parsers import expat

    most = 4_000_000  # tags: 300 bytes for each element and its end

    def refuse(*_: object) -> None:
        raise InputError("declares a document type", where=where, expected=expected)

    def begin(*_: object) -> None:
        raise StopIteration

    if content.count(b"<") > most:
        raise InputError(f"has more than {most:,} tags", where=where, expected=f"{expected} of fewer")
    prolog = expat.ParserCreate()
    prolog.StartDoctypeDeclHandler, prolog.StartElementHandler = refuse, begin
    with library_errors(where, "is no XML", expected, expat.ExpatError, ElementTree.ParseError, ValueError):
        with contextlib.suppress(StopIteration):
            prolog.Parse(content, True)
        return ElementTree.fromstring(content)
