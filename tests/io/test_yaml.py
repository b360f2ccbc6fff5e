"""YAML is read as plain values, in time and memory that grow with its size."""

from __future__ import annotations

import pytest

from bidnerf_core.io import parse_json, parse_xml, parse_yaml
from refusals import refused

BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (BOMB, "aliases"),
        ("a: &a 1\nb: *a\n", "aliases"),
        ("a: " + "[" * 1000, "more than 50 lists and mappings within each other"),
        ("{a: " * 100_000, "more than 50"),
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


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"<!DOCTYPE a [<!ENTITY e 'x'>]><a>&e;</a>", "declares a document type"),
        ("<!DOCTYPE a [<!ENTITY e 'x'>]><a>&e;</a>".encode("utf-16"), "declares a document type"),
        (b"<a><b></a>", "is no XML"),
        (b"", "is no XML"),
        (b"<a>" + b"<b/>" * 4_000_001, "has more than 4,000,000 tags"),
    ],
)
def test_xml_without_a_document_type_is_read(content: bytes, found: str) -> None:
    assert parse_xml("<?xml version='1.0' encoding='utf-16'?><a b='c'/>".encode("utf-16"), "", "").get("b") == "c"
    with refused(where="here", found=found, expected="cameras"):
        parse_xml(content, "here", "cameras")


def test_the_memory_of_json_is_bounded() -> None:
    with refused(where="here", found="unpacks to 1,602 MiB", expected="a list of at most 1,024 MiB in memory"):
        parse_json(b"{}," * 6_000_000, "here", "a list")


def test_values_are_text_and_tags_are_ignored() -> None:
    text = "%YAML:1.0\n---\na: [1, 2.5, -3e2]\nb: !!opencv-matrix {rows: 2}\nc: 1:2:3\nd: !!python/none x\n"
    assert parse_yaml(text.encode(), "here", "a camera") == {
        "a": ["1", "2.5", "-3e2"],
        "b": {"rows": "2"},
        "c": "1:2:3",
        "d": "x",
    }
