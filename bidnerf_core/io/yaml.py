"""YAML of calibrations, read as text: a few bytes of aliases or merge keys may stand for gigabytes, and tags for code."""

from __future__ import annotations

import re
from typing import Any

import yaml

from bidnerf_core.errors import InputError

LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


def parse_yaml(content: bytes, where: str, expected: str) -> Any:
    """Return the first document of a YAML text, with all its values, numbers too, as text; tags are ignored.

    Raises ``InputError``, whose message begins with ``where``, if it is malformed, too large or too deep, or has aliases.
    """
    # Bytes, of which a calibration with the points of all its images takes some 100,000, and nested lists and mappings
    most, deepest = 2**20, 50
    if len(content) > most:
        found = f"has {len(content):,} bytes of YAML"
        raise InputError(found, where=where, expected=f"{expected} of at most {most:,}")
    try:
        text = re.sub(r"\A\s*%YAML.*\n", "", content.decode("utf-8-sig"))  # OpenCV's is malformed
        depth = 0
        for event in yaml.parse(text, Loader=LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > deepest:
                raise yaml.YAMLError(f"aliases, or more than {deepest} lists and mappings within each other")
        return next(iter(yaml.load_all(text, Loader=LOADER)), None)
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"is not YAML ({reason})", where=where, expected=expected) from error
