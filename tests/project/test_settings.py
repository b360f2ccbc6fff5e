"""Settings: ranges beside the fields, flat names that are unique in each method, and errors that name what is wrong."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bidnerf_bid import BidConfig
from bidnerf_core.localization import METHODS, AutoConfig, find_method, settings_of
from bidnerf_core.settings import EXPERT, Above, Count, OneOf, Range, Settings, from_flat, to_flat
from refusals import refused

TABLE: dict[str, int] = {"first": 1}


@dataclass(frozen=True)
class Inner(Settings):
    share: Annotated[float, Range(0.0, 1.0)] = 0.5
    scale: Annotated[float, Above(0.0, 10.0), EXPERT] = 1.0
    any_size: Annotated[float, Range(0.0)] = 0.0


@dataclass(frozen=True)
class Outer(Settings):
    inner: Inner = Inner()
    rays: Count = 8
    level: int | None = None
    name: Literal["a", "b"] = "a"
    entry: Annotated[str, OneOf(TABLE)] = "first"
    free: bool = False
    some: Annotated[int, Range(0, 9)] | None = 3


OUT_OF_RANGE: list[tuple[type[Settings], str, str, list[Any]]] = [
    (Inner, "share", "0 to 1", [-1e-12, 1.0 + 1e-12, math.nan, math.inf, -math.inf]),
    (Inner, "scale", "more than 0, at most 10", [0.0, -0.0, 10.1, math.nan]),
    (Inner, "any_size", "a number from 0 up", [math.inf, math.nan, -1.0]),
    (Outer, "rays", "1 to 10,000,000", [0, "8", None]),
    (Outer, "some", "0 to 9", [10, "3"]),
    (Outer, "name", "'a' or 'b'", ["c", {}]),
    (Outer, "entry", "one of first", ["second", None, ["first"]]),
]


@pytest.mark.parametrize(("kind", "name", "expected", "values"), OUT_OF_RANGE)
def test_values_beyond_a_range_or_of_another_type_are_refused(
    kind: type[Settings], name: str, expected: str, values: list[Any]
) -> None:
    for value in values:
        with refused(found=f"{name} is {value!r}", expected=expected):
            kind(**{name: value})


def test_both_ends_of_a_range_are_allowed_and_above_leaves_out_its_lower_one() -> None:
    for name, values in {"share": (0.0, 0.3, 1.0), "scale": (5e-324, 10.0), "any_size": (0.0, 1e300)}.items():
        assert [getattr(Inner(**{name: value}), name) for value in values] == list(values)


def test_a_message_is_the_same_whichever_equal_range_was_declared_first() -> None:
    """``Annotated`` caches by equality, so that the limits shown may be those of another module's declaration."""
    assert str(Range(0, 1)) == str(Range(0.0, 1.0)) == "0 to 1"
    assert str(Above(0, 0.5)) == "more than 0, at most 0.5"
    assert str(Above(0.25)) == "more than 0.25"
    assert str(Range(1, 1e7)) == "1 to 10,000,000"


def test_a_table_of_names_may_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TABLE, "second", 2)
    assert Outer(entry="second").entry == "second"


@dataclass(frozen=True)
class Numbers(Settings):
    degree: Literal[0, 1, 2, "auto"] = 2
    shift: Literal[-1, 1] | None = None


def test_literals_may_be_numbers_or_mixed() -> None:
    assert Numbers(degree="auto", shift=-1) == from_flat(Numbers, {"degree": "auto", "shift": -1}, "here")
    for wrong in (3, "1", [1]):
        with refused(found=f"degree is {wrong!r}", expected="0, 1, 2 or 'auto'"):
            Numbers(degree=wrong)  # type: ignore[arg-type]
        with refused(where="here: degree", found=repr(wrong), expected="0, 1, 2 or 'auto'"):
            from_flat(Numbers, {"degree": wrong}, "here")
    with refused(found="shift is 0", expected="-1 or 1"):
        Numbers(shift=0)  # type: ignore[arg-type]


OUTERS = st.builds(
    Outer,
    st.builds(Inner, st.floats(0, 1), st.floats(0, 10, exclude_min=True), st.floats(0, 1e308)),
    st.integers(1, 10_000_000),
    st.none() | st.integers(-(2**63), 2**63 - 1),
    st.sampled_from(["a", "b"]),
    st.just("first"),
    st.booleans(),
    st.none() | st.integers(0, 9),
)


@given(OUTERS)
def test_settings_come_back_from_flat_names_and_from_json(settings: Outer) -> None:
    flat = to_flat(settings)
    assert list(flat) == ["share", "scale", "any_size", "rays", "level", "name", "entry", "free", "some"]
    assert from_flat(Outer, json.loads(json.dumps(flat, allow_nan=False)), "here") == settings
    for name, value in flat.items():  # each name sets one setting, wherever it is nested
        assert to_flat(from_flat(Outer, {name: value}, "here")) == to_flat(Outer()) | {name: value}


@pytest.mark.parametrize(
    ("values", "where", "found", "expected"),
    [
        ({"shar": 0.1}, "here", "Outer has no setting 'shar', did you mean 'share'?", None),
        ({"zzz": 0.1}, "here", "Outer has no setting 'zzz'", "any of share, scale"),
        ({"inner": {}}, "here", "Outer has no setting 'inner'", None),
        ({"share": 2.0}, "here", "share is 2.0", "0 to 1"),
        ({"share": "much"}, "here", "share is 'much'", "float, 0 to 1"),
        ({"rays": 1.5}, "here", "rays is 1.5", "int, 1 to 10,000,000"),
        ({"rays": None}, "here", "rays is None", "int"),
        ({"rays": 0}, "here", "rays is 0", "1 to 10,000,000"),
        ({"free": 1}, "here: free", "found 1", "bool"),
        ({"name": "c"}, "here: name", "found 'c'", "'a' or 'b'"),
    ],
)
def test_what_is_wrong_is_named(values: dict[str, Any], where: str, found: str, expected: str | None) -> None:
    with refused(where=where, found=found, expected=expected):
        from_flat(Outer, values, "here")


def test_messages_name_settings_as_users_do_and_not_the_groups_that_hold_them() -> None:
    with refused(where="here", found="fine_rays is 1", expected="7 to 10,000,000"):
        settings_of("auto", {"fine_rays": 1}, "here")
    with refused(where="here", found="fine_rays is 'x'", expected="int"):
        settings_of("auto", {"fine_rays": "x"}, "here")


def leaves(config: Any) -> Iterator[tuple[Any, str]]:
    """Yield the group and the name of each setting, however deep."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value)
        else:
            yield config, field.name


@pytest.mark.parametrize("method", METHODS)
def test_flat_names_are_unique_and_survive_json_and_every_number_is_limited(method: str) -> None:
    """A number below any meaning is refused by name, whatever the setting."""
    default, limited = find_method(method).config_type(), 0
    assert sorted(name for _, name in leaves(default)) == sorted(to_flat(default))
    stored = json.loads(json.dumps(to_flat(default), allow_nan=False))
    assert settings_of(method, stored) == settings_of(method, {}) == default
    for group, name in leaves(default):
        value = getattr(group, name)
        if type(value) in (int, float) and name != "level":  # levels also count from the finest
            with refused(found=f"{name} is"):
                settings_of(method, {name: type(value)(-1)})
            limited += 1
    assert limited >= 5


def test_a_method_that_is_unknown_is_named() -> None:
    with refused(found="no method 'gauss'; installed: auto, bid, inerf"):
        settings_of("gauss", {})


def test_settings_are_checked_however_they_are_made() -> None:
    with refused(found="learning_rate is 0.0", expected="more than 0"):
        dataclasses.replace(BidConfig().adam, learning_rate=0.0)
    with refused(found="fine_rays is 6", expected="7 to 10,000,000"):
        AutoConfig(fine_rays=6)
    with refused(found="points is 49", expected="50 to 1,000,000"):
        AutoConfig(points=49)
