"""Counts of what a localization does: how often functions of the core are called, and how many of its files are entered."""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import Any

import bidnerf_core

CORE = Path(bidnerf_core.__file__).parent
ROOMS = ("localization", "mapping")


class CallCounts:
    """Counts calls by the qualified names of functions, wherever they are defined, while ``running`` something."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = set(names)
        self.calls: Counter[str] = Counter()
        self.described: Counter[bytes] = Counter()  # images, by content, whose keypoints were detected
        self.files: set[Path] = set()  # of the rooms
        self._known: dict[Any, tuple[str | None, Path | None]] = {}  # by code

    def running(self, act: Callable[[], Any]) -> CallCounts:
        sys.setprofile(self._called)
        try:
            act()
        finally:
            sys.setprofile(None)
        return self

    def _called(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call":
            return
        known = self._known.get(frame.f_code)
        if known is None:
            known = self._known[frame.f_code] = self._of(frame.f_code)
        name, file = known
        if file is not None:
            self.files.add(file)
        if name is not None:
            self.calls[name] += 1
            if "rgb" in frame.f_locals:
                self.described[frame.f_locals["rgb"].numpy().tobytes()] += 1

    def _of(self, code: Any) -> tuple[str | None, Path | None]:
        path = Path(code.co_filename)
        if not path.is_relative_to(CORE):
            return None, None
        name = code.co_qualname if code.co_qualname in self._names else None
        return name, path if path.relative_to(CORE).parts[0] in ROOMS else None


def functions() -> set[str]:
    """Return the qualified names of the functions and methods of the rooms."""
    found = set()
    for file in (file for room in ROOMS for file in (CORE / room).rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef):
                found.add(node.name)
            if isinstance(node, ast.ClassDef):
                found |= {
                    f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)
                }
    return found
