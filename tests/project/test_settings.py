"""Settings: ranges beside the fields, flat names that are unique in each method, and errors that name what is wrong."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest

from bidnerf_core.errors import InputError
from bidnerf_core.localization import METHODS, AutoConfig, BidConfig, BidLmConfig, find_method, settings_of
from bidnerf_core.settings import EXPERT, Above, Count, OneOf, Range, Settings, from_flat, is_expert, to_flat

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


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_both_ends_of_a_range_are_allowed(value: float) -> None:
    assert Inner(share=value).share == value


@pytest.mark.parametrize("value", [-1e-12, 1.0 + 1e-12, math.nan, math.inf, -math.inf])
def test_values_beyond_a_range_are_refused(value: float) -> None:
    with pytest.raises(InputError, match=rf"^share is {value}, expected 0 to 1$"):
        Inner(share=value)


def test_above_leaves_out_its_lower_end_only() -> None:
    assert Inner(scale=5e-324).scale == 5e-324
    assert Inner(scale=10.0).scale == 10.0
    for value in (0.0, -0.0, 10.1, math.nan):
        with pytest.raises(InputError, match=r"expected more than 0, at most 10"):
            Inner(scale=value)


def test_a_message_is_the_same_whichever_equal_range_was_declared_first() -> None:
    """``Annotated`` caches by equality, so that the limits shown may be those of another module's declaration."""
    assert str(Range(0, 1)) == str(Range(0.0, 1.0)) == "0 to 1"
    assert str(Above(0, 0.5)) == "more than 0, at most 0.5"
    assert str(Above(0.25)) == "more than 0.25"
    assert str(Range(1, 1e7)) == "1 to 10,000,000"


def test_a_range_without_an_upper_end_is_finite() -> None:
    assert Inner(any_size=1e300).any_size == 1e300
    for value in (math.inf, math.nan, -1.0, 10**400):
        with pytest.raises(InputError, match=r"^any_size is .*, expected a number from 0 up$"):
            Inner(any_size=value)


def test_names_are_those_of_a_literal_or_of_a_table_that_may_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"^name is 'c', expected one of a, b$"):
        Outer(name="c")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^entry is 'second', expected one of first$"):
        Outer(entry="second")
    monkeypatch.setitem(TABLE, "second", 2)
    assert Outer(entry="second").entry == "second"


@dataclass(frozen=True)
class Numbers(Settings):
    degree: Literal[0, 1, 2, "auto"] = 2
    shift: Literal[-1, 1] | None = None


def test_literals_may_be_numbers_or_mixed() -> None:
    assert Numbers(degree="auto", shift=-1) == from_flat(Numbers, {"degree": "auto", "shift": -1}, "here")
    for wrong in (3, "1", True, [1], 1.0):
        with pytest.raises(
            InputError, match=rf"^degree is {re.escape(repr(wrong))}, expected one of 0, 1, 2, auto$"
        ):
            Numbers(degree=wrong)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=r"^here: degree: found .*, expected 0 or 1 or 2 or 'auto'$"):
            from_flat(Numbers, {"degree": wrong}, "here")
    with pytest.raises(InputError, match=r"^shift is 0, expected one of -1, 1$"):
        Numbers(shift=0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "values",
    [{"rays": "8"}, {"rays": None}, {"entry": None}, {"entry": ["first"]}, {"name": {}}, {"some": "3"}],
)
def test_values_of_another_type_are_refused(values: dict[str, Any]) -> None:
    ((name, value),) = values.items()
    with pytest.raises(InputError, match=rf"^{name} is {re.escape(repr(value))}, expected "):
        Outer(**values)


def test_nothing_is_a_value_where_it_is_declared() -> None:
    assert Outer(level=None, some=None).level is None
    with pytest.raises(InputError, match="rays"):
        from_flat(Outer, {"rays": None}, "here")


def test_flat_names_set_what_is_nested() -> None:
    found = from_flat(Outer, {"share": 0.25, "rays": 3, "level": -1, "free": True}, "here")
    assert found == Outer(Inner(share=0.25), 3, -1, free=True)
    assert to_flat(found) == {
        "share": 0.25, "scale": 1.0, "any_size": 0.0, "rays": 3, "level": -1, "name": "a", "entry": "first", "free": True,
        "some": 3,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"shar": 0.1}, "^here: Outer has no setting 'shar', did you mean 'share'[?]$"),
        ({"zzz": 0.1}, "^here: Outer has no setting 'zzz', expected any of share, scale, .*some$"),
        ({"inner": {}}, "^here: Outer has no setting 'inner'"),
        ({"share": 2.0}, "^here: share is 2.0, expected 0 to 1$"),
        ({"share": "much"}, "^here: share: found 'much', expected float$"),
        ({"rays": 1.5}, "^here: rays: found 1.5, expected int$"),
        ({"rays": 0}, "^here: rays is 0, expected 1 to 10,000,000$"),
        ({"free": 1}, "^here: free: found 1, expected bool$"),
        ({"name": "c"}, "^here: name: found 'c', expected 'a' or 'b'$"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        from_flat(Outer, values, "here")
    assert "\n" not in str(raised.value)


def test_messages_name_settings_as_users_do_and_not_the_groups_that_hold_them() -> None:
    for value, message in ((1, "fine_rays is 1, expected 7 to"), ("x", "fine_rays: found 'x', expected int")):
        with pytest.raises(InputError, match=f"^here: {message}"):
            settings_of("auto", {"fine_rays": value}, "here")


def test_settings_of_earlier_versions_are_renamed() -> None:
    renamed = {"old_share": "share"}
    assert from_flat(Outer, {"old_share": 0.1}, "here", renamed) == Outer(Inner(share=0.1))
    for method in ("auto", "bid-lm", "inerf-lm"):
        assert settings_of(method, {"play": 0.002}).__class__ is find_method(method).config_type
        assert to_flat(settings_of(method, {"play": 0.002}))["surface_sigma"] == 0.002
    with pytest.raises(InputError, match="BidConfig has no setting"):
        settings_of("bid", {"play": 0.002})


def test_settings_for_experts_are_marked() -> None:
    assert is_expert(Inner, "scale")
    assert not is_expert(Inner, "share")


def leaves(config: Any) -> Iterator[tuple[Any, str]]:
    """Yield the group and the name of each setting, however deep."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value)
        else:
            yield config, field.name


@pytest.mark.parametrize("method", METHODS)
def test_flat_names_are_unique_in_each_method(method: str) -> None:
    names = [name for _, name in leaves(find_method(method).config_type())]
    assert len(names) == len(set(names))
    assert set(names) == set(to_flat(find_method(method).config_type()))


@pytest.mark.parametrize("method", METHODS)
def test_defaults_survive_json(method: str) -> None:
    default = find_method(method).config_type()
    stored = json.loads(json.dumps(to_flat(default), allow_nan=False))
    assert settings_of(method, stored) == settings_of(method, {}) == default


@pytest.mark.parametrize("method", METHODS)
def test_every_number_of_every_method_is_limited(method: str) -> None:
    """A number below any meaning is refused by name, whatever the setting."""
    default = find_method(method).config_type()
    refused = 0
    for group, name in leaves(default):
        value = getattr(group, name)
        if type(value) in (int, float) and name != "level":  # levels also count from the finest
            with pytest.raises(InputError, match=f"{name} is "):
                settings_of(method, {name: type(value)(-1)})
            refused += 1
    assert refused > 5


def test_a_method_that_is_unknown_is_named() -> None:
    with pytest.raises(InputError, match="no method 'gauss'; installed: auto, bid, bid-lm, inerf"):
        settings_of("gauss", {})


def test_settings_are_checked_however_they_are_made() -> None:
    with pytest.raises(InputError, match=r"learning_rate is 0.0"):
        dataclasses.replace(BidConfig().adam, learning_rate=0.0)
    with pytest.raises(InputError, match="fine_rays is 6, expected 7 to 10,000,000"):
        dataclasses.replace(BidLmConfig().stages, fine_rays=6)
    with pytest.raises(InputError, match="points is 49, expected 50 to 1,000,000"):
        AutoConfig(points=49)
