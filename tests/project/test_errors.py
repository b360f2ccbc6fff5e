"""Errors carry their parts, through wrapping, copying and processes."""

import copy
import pickle
import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bidnerf_core.errors import InputError, InputWarning, UsageError
from refusals import contains, refused

PART = st.none() | st.text("ab: ,;1", min_size=1)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InputError(), ""),
        (InputError("no frame"), "no frame"),
        (InputError("no frame", expected="one"), "no frame, expected one"),
        (InputError("2, not 3;", expected="3"), "2, not 3; expected 3"),
        (InputError("nothing to show:", expected="a map"), "nothing to show: expected a map"),
        (InputError(expected="one of a and b"), "expected one of a and b"),
        (InputError(where="a.json", expected="numbers"), "a.json: expected numbers"),
        (InputError("is 1", where="a.json", expected=2), "a.json: is 1, expected 2"),
        (
            InputError(InputError("is 1", where="fx", expected=2), where="a.json"),
            "a.json: fx: is 1, expected 2",
        ),
        (InputError(InputError("is 1"), where="a.json", expected=2), "a.json: is 1, expected 2"),
        (InputError(ValueError("is 1"), where="a.json"), "a.json: is 1"),
        (InputError("is 1", where=""), "is 1"),
        (
            InputError("no \x1b[2J\nmap", where="a\u202e.json", expected="\x9bone"),
            "a\\u202e.json: no \\x1b[2J map, expected \\x9bone",
        ),
    ],
)
def test_the_message_is_made_of_the_parts(error: InputError, message: str) -> None:
    assert str(error) == message


def test_a_warning_repeats_no_control_characters() -> None:
    with pytest.warns(InputWarning) as caught:
        warnings.warn("no \x1b[2J\nmap", InputWarning, stacklevel=1)
    assert str(caught[0].message) == "no \\x1b[2J map"


@given(where=PART, found=st.text("ab: ,;1"), expected=PART)
def test_parts_outlive_copies_processes_and_another_class(where: str | None, found: str, expected: str | None) -> None:
    error = UsageError(found, where=where, expected=expected)
    assert (error.where, error.found, error.expected) == (where, found, expected)
    for same in (pickle.loads(pickle.dumps(error)), copy.copy(error), UsageError(error)):
        assert type(same) is UsageError
        assert str(same) == str(error)
        assert vars(same) == vars(error)


@pytest.mark.parametrize(
    ("text", "token", "held"),
    [
        ("fx is 1, no more", 1, True),
        ("fx is 1.5", 1, False),
        ("fx is 0.1", 1, False),
        ("fx is -1", 1, False),
        ("fx is -1", "-1", True),
        ("of 11 frames", 1, False),
        ("/data/a.json: fx", "a.json", True),
        ("/data/aa.json", "a.json", False),
        ("a.json.bak", "a.json", False),
        ("/data/a.json", "/data", False),
        ("[0, 1] and more", [0, 1], True),
        ("--size-limit", "--size", False),
    ],
)
def test_tests_compare_whole_tokens(text: str, token: object, held: bool) -> None:
    assert contains(text, token) == held


def test_a_refusal_of_another_kind_or_about_something_else_is_noticed() -> None:
    with refused(where="a.json", found="is 1", expected=2) as caught:
        raise UsageError("is 1", where="/data/a.json", expected="2 or 3")
    assert isinstance(caught.error, UsageError)
    for error in (
        InputError("is 1", where="b.json"),
        InputError("is 1"),
    ):
        with pytest.raises(AssertionError), refused(where="a.json"):
            raise error
    with pytest.raises(InputError), refused(error=UsageError):
        raise InputError("is 1")
