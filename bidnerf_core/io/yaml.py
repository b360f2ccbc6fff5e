"""YAML of calibrations: plain values only, since a few bytes of aliases or merge keys may stand for gigabytes."""

from __future__ import annotations

import re
from typing import Any

import yaml

from bidnerf_core.errors import InputError

TAG = "tag:yaml.org,2002:"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Loader of plain values: tags are ignored, and numbers with colons, in base 60, are text as in YAML 1.2."""

    def flatten_mapping(self, node: Any) -> None:
        if any(key.tag == f"{TAG}merge" for key, _ in node.value):
            raise yaml.YAMLError("merge keys (<<) are not read")


def _plain(loader: Any, suffix: str, node: Any) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


def _number(loader: Any, node: Any) -> Any:
    text = loader.construct_scalar(node)
    if ":" in text:
        return text
    return loader.construct_yaml_int(node) if node.tag.endswith("int") else loader.construct_yaml_float(node)


_Loader.yaml_constructors = {
    f"{TAG}null": yaml.SafeLoader.construct_yaml_null,
    f"{TAG}bool": yaml.SafeLoader.construct_yaml_bool,
    f"{TAG}int": _number,
    f"{TAG}float": _number,
}
_Loader.yaml_multi_constructors = {"": _plain}


def parse_yaml(content: bytes, where: str, expected: str) -> Any:
    """Return the first document of a YAML text.

    Raises ``InputError``, whose message begins with ``where``, if it is malformed, too large or too deep, or has aliases or merge
    keys.
    """
    # Bytes, of which a calibration with the points of all its images takes some 100,000, and nested lists and mappings
    most, deepest = 2**20, 50
    if len(content) > most:
        found = f"has {len(content):,} bytes of YAML"
        raise InputError(found, where=where, expected=f"{expected} of at most {most:,}")
    try:
        text = re.sub(r"\A\s*%YAML.*\n", "", content.decode("utf-8-sig"))  # OpenCV's is malformed
        depth = 0
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, yaml.AliasEvent):
                raise yaml.YAMLError(f"aliases (*{event.anchor}) are not read")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > deepest:
                raise yaml.YAMLError(f"more than {deepest} lists and mappings within each other")
        return next(iter(yaml.load_all(text, Loader=_Loader)), None)
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"is not YAML ({reason})", where=where, expected=expected) from error
