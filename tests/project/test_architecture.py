"""The shape of the code: what is annotated, how long a file may be, who imports by name. ``make arrows`` has who imports whom."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = [
    ROOT / "bidnerf",
    ROOT / "bidnerf_core",
    *sorted(f.parent for f in (ROOT / "backends").glob("*/__init__.py")),
]
FILES = sorted(file for package in PACKAGES for file in package.rglob("*.py"))
LONGEST = 500

Function = ast.FunctionDef | ast.AsyncFunctionDef


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    return {f.relative_to(ROOT).as_posix(): ast.parse(f.read_text(encoding="utf-8")) for f in FILES}


def test_every_import_package_is_typed() -> None:
    assert [package.name for package in PACKAGES if not (package / "py.typed").is_file()] == []


def test_files_are_short_and_say_what_they_are(trees: dict[str, ast.Module]) -> None:
    lengths = {f.relative_to(ROOT).as_posix(): len(f.read_text(encoding="utf-8").splitlines()) for f in FILES}
    assert {name: lines for name, lines in lengths.items() if lines > LONGEST} == {}
    assert [name for name, tree in trees.items() if not ast.get_docstring(tree)] == []


def test_public_functions_are_annotated(trees: dict[str, ast.Module]) -> None:
    """Also where mypy would infer a type: annotations are what the run-time checks of the tests read."""
    bare = {name: [part for f in _public(tree) for part in _bare(f)] for name, tree in trees.items()}
    assert {name: parts for name, parts in bare.items() if parts} == {}


def test_classes_and_constants_have_one_home(trees: dict[str, ast.Module]) -> None:
    """Whoever reads a name knows what it is, in both packages. Only the entry points of formats name one object in each module."""
    homes = dict[str, list[str]]()
    for name, tree in trees.items():
        if not name.startswith("backends"):
            for each in {n for node in tree.body for n in _defined(node) if not n.startswith("_") and n != "reader"}:
                homes.setdefault(each, []).append(name)
    assert {each: files for each, files in homes.items() if len(files) > 1} == {}


def _defined(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.ClassDef):
        yield node.name
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    yield from (n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name))


def test_messages_name_settings_and_not_options(trees: dict[str, ast.Module]) -> None:
    """The command line and the service spell the names in backticks their way; whole commands may be quoted anywhere."""
    found = list[tuple[str, str]]()
    for name, tree in trees.items():
        # The guide prints the advice about outcomes; a contract tests the command line itself.
        if not name.startswith(("bidnerf/cli", "bidnerf/testing", "bidnerf_core/localization")):
            nodes = [*ast.walk(tree)]
            docs = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
            texts = [node.value for node in nodes if isinstance(node, ast.Constant) and id(node) not in docs]
            messages = [re.sub(r"'bidnerf [^']*'", "", text) for text in texts if isinstance(text, str) and " " in text]
            found += [(name, text) for text in messages if re.search(r"(?<![\w-])--[a-z]", text)]
    assert found == []


BY_NAME = {
    "bidnerf/__init__.py": {"import_module"},  # what its stub names
    "bidnerf_core/installation.py": {"import_module"},  # what extras install
    "bidnerf_core/registry.py": {"entry_points"},
}


def test_only_the_registry_imports_by_name(trees: dict[str, ast.Module]) -> None:
    """The core reaches a backend through ``load_backend`` alone."""
    found = {name: _names(tree) & {"import_module", "__import__", "entry_points"} for name, tree in trees.items()}
    surplus = {name: calls - BY_NAME.get(name, set()) for name, calls in found.items()}
    assert {name: calls for name, calls in surplus.items() if calls} == {}


def _names(tree: ast.Module) -> set[str]:
    attributes = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    return attributes | {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}


def _public(tree: ast.Module | ast.ClassDef) -> Iterator[Function]:
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from _public(node)
        named = isinstance(node, Function) and (node.name == "__init__" or not node.name.startswith("_"))
        # Triton takes the types of a kernel's parameters from what it is launched with.
        if named and "jit" not in _names(ast.Module(list(map(ast.Expr, node.decorator_list)), [])):
            yield node


def _bare(function: Function) -> Iterator[str]:
    a = function.args
    for argument in (*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))):
        if argument.annotation is None and argument.arg not in ("self", "cls"):
            yield f"{function.name}({argument.arg})"
    if function.returns is None:
        yield f"{function.name} -> ?"
