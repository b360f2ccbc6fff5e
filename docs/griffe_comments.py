"""Griffe extension: the comments beside the fields of a class become the table of its attributes.

The code says units and shapes of a field in the comment beside it. Attributes that have no comment are part of the signature,
or are set in ``__init__``, and are left out of the reference.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe

COMMENT = re.compile(r"\s#\s?(.*)$")


class Comments(griffe.Extension):
    """Adds a section "Attributes" to docstrings, and hides the attributes as members."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Visit all classes of the package, after other extensions have made their signatures."""
        self._visit(pkg)

    def _visit(self, found: griffe.Module | griffe.Class) -> None:
        for member in list(found.members.values()):
            if member.is_alias:
                continue
            if isinstance(member, griffe.Class):
                _describe(member)
            if isinstance(member, griffe.Module | griffe.Class):
                self._visit(member)


def _describe(kind: griffe.Class) -> None:
    """Add the attributes of ``kind`` that have a comment to its docstring."""
    fields = [m for m in kind.members.values() if isinstance(m, griffe.Attribute) and "property" not in m.labels]
    for member in kind.members.values():
        if member.name == "__post_init__":  # it checks values, and is of no use to a caller
            member.public = False
    rows = []
    for field in fields:
        text = " ".join([*_comments(field), *([field.docstring.value] if field.docstring else [])])
        field.docstring, field.public = None, False
        if text:
            rows.append(f"    {field.name}: {text}")
    if rows and kind.docstring is not None:
        kind.docstring.value += "\n\nAttributes:\n" + "\n".join(rows) + "\n"


def _comments(field: griffe.Attribute) -> list[str]:
    """Return the comments on the lines of a field, or, where there are none, in the lines right above it."""
    if field.lineno is None or not isinstance(field.filepath, Path):
        return []
    lines = field.filepath.read_text(encoding="utf-8").splitlines()
    beside = lines[field.lineno - 1 : field.endlineno]
    above: list[str] = []
    for line in reversed(lines[: field.lineno - 1]):
        if not line.lstrip().startswith("#"):
            break
        above.insert(0, line)
    return _texts(beside) or _texts(above)


def _texts(lines: list[str]) -> list[str]:
    return [found[1].strip() for line in lines if (found := COMMENT.search(line))]
