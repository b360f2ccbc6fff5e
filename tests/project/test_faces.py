"""Packages are imported by their faces: what each offers is named in the stub of its ``__init__``, the rest is its own affair."""

from __future__ import annotations

import ast
import functools
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STOREYS = ("bidnerf_core", "bidnerf")
PACKAGES = sorted(f"{name}.{face.parent.name}" for name in STOREYS for face in (ROOT / name).glob("*/__init__.py"))
OUTSIDE = ("backends", "plugins", "benchmarks", "examples", "docs", "tests")
REASON = re.compile(r"^ *# Inside: .{10,}", re.MULTILINE)
"""How a test file says why it needs parts that its package does not offer."""

EXCEPTIONS = {
    "tests/conftest.py": "does in this process what a process of a comparison does",
    "tests/formats/test_scan_readers.py": "pictures that are no files, which every reader may have",
    "tests/frames/test_pixel_store.py": "the memory that reading photos takes, which five packages share",
    "tests/maps/test_interrupted_saves.py": "interrupts every writer of files, in whichever package",
    "tests/maps/test_map_collections.py": "a worker of the service searches the collection that its maps form",
    "tests/robustness/harness.py": "loads the commands before it forks processes that run them",
    "tests/structure/test_structure.py": "training from photos without poses calls what is tested here",
}
"""Files that may import from within packages of which they are no part, with the reason."""


def sources() -> Iterator[Path]:
    for folder in (*STOREYS, *OUTSIDE):
        for file in sorted((ROOT / folder).rglob("*.py")):
            if not any(part.startswith(".") for part in file.relative_to(ROOT).parts):
                yield file


def statements(code: str) -> Iterator[ast.stmt]:
    """Yield the statements of a program, at all depths; expressions, which are most of it, hold none."""
    remaining: list[ast.AST] = [ast.parse(code)]
    while remaining:
        node = remaining.pop()
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            remaining += getattr(node, part, [])
        if isinstance(node, ast.stmt):
            yield node


@functools.cache
def deep_imports(file: Path) -> set[tuple[str, str]]:
    """Return the package and the module of each import from within a package."""
    found = set()
    for node in statements(file.read_text(encoding="utf-8")):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom) and (node.module or "").count(".") == 1:
            names = [f"{node.module}.{name.name}" for name in node.names if _is_module(node.module, name.name)]
        if isinstance(node, ast.Import):
            names = [name.name for name in node.names]
        for name in names:
            storey, package, *inner = [*name.split("."), "", ""]
            if f"{storey}.{package}" in PACKAGES and any(inner):
                found.add((package, name))
    return found


def _is_module(package: str | None, name: str) -> bool:
    place = ROOT.joinpath(*(package or "").split("."), name)
    return name not in _names_in_face(str(package)) and (place.with_suffix(".py").exists() or place.is_dir())


def _names_in_face(package: str) -> set[str]:
    stub = ROOT.joinpath(*package.split("."), "__init__.pyi")
    return set(re.findall(r" as (\w+)$", stub.read_text(), re.MULTILINE)) if stub.exists() else set()


def test_other_packages_plugins_and_tests_import_from_faces() -> None:
    """A package's own modules import each other, and its tests may, if they say why; nobody else does."""
    found = {}
    for file in sources():
        name = file.relative_to(ROOT).as_posix()
        own = name.split("/")[1] if name.startswith(("bidnerf/", "bidnerf_core/", "tests/")) else None
        deep = sorted({module for package, module in deep_imports(file) if package != own})
        if deep and name not in EXCEPTIONS:
            found[name] = deep
    assert found == {}


def test_tests_say_why_they_need_parts_that_are_not_offered() -> None:
    silent = [
        file.relative_to(ROOT).as_posix()
        for file in sorted((ROOT / "tests").rglob("*.py"))
        if deep_imports(file) and not REASON.search(file.read_text(encoding="utf-8"))
    ]
    assert silent == []


def test_exceptions_are_needed() -> None:
    assert [name for name in EXCEPTIONS if not deep_imports(ROOT / name)] == []


@pytest.mark.parametrize("package", [*PACKAGES, "bidnerf"])
def test_what_a_face_names_is_there(package: str) -> None:
    face = importlib.import_module(package)
    assert [name for name in face.__all__ if not hasattr(face, name)] == []
    assert set(face.__all__) == _names_in_face(face.__name__)
    with pytest.raises(AttributeError, match="missing"):
        _ = face.missing
