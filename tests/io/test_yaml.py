"""YAML is read as plain values, in time and memory that grow with its size."""

from __future__ import annotations

import pytest

from bidnerf_core.io import parse_yaml
from refusals import refused

BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (BOMB, r"aliases (*a) are not read"),
        ("a: &a 1\nb: *a\n", "aliases"),
        ("base: {x: 1}\nb:\n  <<: {x: 2}\n", "merge keys (<<) are not read"),
        ("a: " + "[" * 1000, "more than 50 lists and mappings within each other"),
        ("{a: " * 100_000, "more than 50"),
        ("a: " + "9" * 5000, "4300 digits"),
        ("a: [1, 2", "flow sequence"),
        ("? [1, 2]\n: 3", "while constructing a mapping"),
        ("a: \udcff", "is not YAML"),
    ],
)
def test_what_costs_more_than_it_is_long_is_refused(content: str, found: str) -> None:
    with refused(where="here", found=found, expected="a camera"):
        parse_yaml(content.encode("utf-8", "surrogateescape"), "here", "a camera")


def test_the_size_of_the_text_is_bounded() -> None:
    with refused(where="here", found="has 1,048,577 bytes of YAML", expected="a camera of at most 1,048,576"):
        parse_yaml(b" " * (2**20 + 1), "here", "a camera")


def test_values_are_plain_and_tags_are_ignored() -> None:
    text = (
        "%YAML:1.0\n---\na: [1, 2.5, -3e2, .5]\nb: !!opencv-matrix {rows: 2}\nc: 1:2:3\nd: !!python/none x\n"
        "e: 0x1f\nf: true\ng: null\nh: !!set {x}\ni: 2001-01-01\nj: 1:30.5\n"
    )
    assert parse_yaml(text.encode(), "here", "a camera") == {
        "a": [1, 2.5, "-3e2", 0.5], "b": {"rows": 2}, "c": "1:2:3", "d": "x", "e": 31, "f": True, "g": None,
        "h": {"x": None}, "i": "2001-01-01", "j": "1:30.5",
    }  # fmt: skip


def test_numbers_in_base_60_take_no_time() -> None:
    text = "a: " + ":".join(["59"] * 300_000)
    assert len(parse_yaml(text.encode(), "here", "a camera")["a"]) == 899_999
