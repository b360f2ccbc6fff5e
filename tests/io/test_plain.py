"""Dataclasses to what JSON holds, and back."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bidnerf_core.errors import InputError
from bidnerf_core.io import LARGEST_INTEGER, from_plain, to_plain
from refusals import refused


@dataclass(frozen=True)
class Inner:
    name: str = "x"
    sizes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if "!" in self.name:
            raise InputError(f"name is {self.name}", expected="no exclamation")


@dataclass(frozen=True)
class Outer:
    need: int
    rate: float = 0.5
    flag: bool = True
    kind: Literal["a", "b"] = "a"
    maybe: int | None = None
    either: int | float | str = 0
    pair: tuple[float, str] = (1.0, "y")
    bare: tuple = ()
    inner: Inner = field(default_factory=Inner)
    many: tuple[Inner, ...] = ()
    rows: list[list[float]] = field(default_factory=list)
    table: dict[str, tuple[int, ...]] = field(default_factory=dict)
    anything: Any = None
    derived: int = field(default=0, init=False)


finite = st.floats(allow_nan=False, allow_infinity=False)
integers = st.integers(-LARGEST_INTEGER, LARGEST_INTEGER)
inners = st.builds(Inner, st.text(alphabet="abc"), st.lists(integers).map(tuple))
outers = st.builds(
    Outer,
    integers,
    finite,
    st.booleans(),
    st.sampled_from(["a", "b"]),
    st.none() | integers,
    integers | finite | st.text(),
    st.tuples(finite, st.text()),
    st.lists(integers).map(tuple),
    inners,
    st.lists(inners, max_size=3).map(tuple),
    st.lists(st.lists(finite)),
    st.dictionaries(st.text(), st.lists(integers).map(tuple)),
    st.none() | st.booleans(),
)


@settings(max_examples=20)
@given(outers)
def test_through_json_and_back(value: Outer) -> None:
    text = json.dumps(to_plain(value), allow_nan=False)
    again = from_plain(Outer, json.loads(text), "here")
    assert again == value
    assert repr(again) == repr(value)  # which tells 1 from 1.0 and True


def test_missing_keys_take_their_defaults_and_whole_numbers_serve_as_floats() -> None:
    value = from_plain(Outer, {"need": 1, "rate": 2}, "here")
    assert value == Outer(1, 2.0)
    assert type(value.rate) is float


@pytest.mark.parametrize(
    ("given", "where", "found", "expected"),
    [
        ({}, "here: need", "missing", None),
        ([], "here", "found []", "an object"),
        ({"need": 1, "raet": 2}, "here", "no field 'raet', did you mean 'rate'?", None),
        ({"need": 1, "derived": 2}, "here", "no field 'derived'", None),
        ({"need": 1.5}, "here: need", "found 1.5", "int"),
        ({"need": True}, "here: need", "found True", "int"),
        ({"need": 2**63}, "here", 2**63, "integers of at most 64 bits"),
        ({"need": -(10**400)}, "here", None, "integers of at most 64 bits"),
        ({"need": None}, "here: need", "found None", "int"),
        ({"need": "z" * 999}, "here: need", "...", "int"),
        ({"need": 1, "rate": "2"}, "here: rate", "found '2'", "float"),
        ({"need": 1, "rate": True}, "here: rate", "found True", "float"),
        ({"need": 1, "rate": math.nan}, "here: rate", "found nan", "float"),
        ({"need": 1, "rate": 10**400}, "here", None, "integers of at most 64 bits"),
        ({"need": 1, "flag": 1}, "here: flag", "found 1", "bool"),
        ({"need": 1, "kind": "c"}, "here: kind", "found 'c'", "'a' or 'b'"),
        ({"need": 1, "maybe": "x"}, "here: maybe", "found 'x'", "int"),
        ({"need": 1, "pair": [1.0]}, "here: pair", "found [1.0]", "a longer list"),
        ({"need": 1, "pair": [1.0, 2]}, "here: pair", "found 2", "str"),
        ({"need": 1, "inner": 3}, "here: inner", "found 3", "an object"),
        ({"need": 1, "inner": {"name": "!"}}, "here: inner", "name is !", "no exclamation"),
        ({"need": 1, "many": [{"sizes": ["x"]}]}, "here: many: sizes", "found 'x'", "int"),
        ({"need": 1, "table": {"k": [1.5]}}, "here: table: k", "found 1.5", "int"),
    ],
    ids=lambda value: None if isinstance(value, str) else str(value)[:40],
)
def test_every_mistake_is_named(given: Any, where: str, found: object, expected: str | None) -> None:
    with refused(where=where, found=found, expected=expected) as caught:
        from_plain(Outer, given, "here")
    assert caught.error.where == where
    assert len(str(caught.error)) < 250


class Colour(Enum):
    RED = 1


@pytest.mark.parametrize(
    ("value", "found", "expected"),
    [
        (Outer(1, math.inf), "rate is inf", "a finite number"),
        (Outer(1, rows=[[0.0], [0.0, math.nan]]), "rows[1][1] is nan", "a finite number"),
        (Outer(1, anything=Path()), "anything is a PosixPath", "a JSON-serializable value"),
        (Outer(1, anything={"k": Colour.RED}), "anything.k is a Colour", "a JSON-serializable value"),
        (Outer(1, anything={1: 2}), "anything has the key 1", "text"),
    ],
    ids=lambda value: None if isinstance(value, str) else "",
)
def test_what_json_cannot_hold_is_refused(value: Outer, found: str, expected: str) -> None:
    with refused(found=found, expected=expected):
        to_plain(value)


@pytest.mark.parametrize("kind", [list[float], tuple[float, ...]])
def test_numbers_in_a_list_are_finite_too(kind: type) -> None:
    with refused(where="here", found="found nan", expected="float"):
        from_plain(kind, [1.0, math.nan], "here")
