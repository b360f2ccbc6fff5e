"""bidnerf: estimate the 6-DoF pose of RGB-D images in a radiance field of any kind."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

import bidnerf_core as bidnerf_core  # sets what must be set before torch is loaded

# Modules are imported on first use (PEP 562): importing torch takes seconds, and ``bidnerf --help`` does not need it. The
# stub beside this file, which type checkers read, names each public name and the package that defines it.
_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOMES = {each.name: str(node.module) for node in _STUB.body if isinstance(node, ast.ImportFrom) for each in node.names}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _HOMES[name]
    return (
        importlib.import_module(f"{home}.{name}") if home == __name__ else getattr(importlib.import_module(home), name)
    )


def __dir__() -> list[str]:
    return __all__
