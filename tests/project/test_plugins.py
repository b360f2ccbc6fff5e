"""The distributions under plugins/ are installed as a stranger's would be, and found. ``.ci/wheels`` runs their own tests."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from commands import quietly

pytestmark = pytest.mark.slow


ROOT = Path(__file__).parents[2]
PLUGINS = sorted(file.parent for file in (ROOT / "plugins").glob("*/pyproject.toml"))
BUNDLED = {folder.name for folder in (ROOT / "backends").iterdir()}

every_plugin = pytest.mark.parametrize("plugin", PLUGINS, ids=lambda plugin: plugin.name)


def install(sources: list[Path], target: Path) -> dict[str, str]:
    """Install folders or wheels; the environment in which they are found."""
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index"]
    quietly([*pip, "--target", str(target), *map(str, sources)])
    path = os.pathsep.join(filter(None, [str(target), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}


def copy_plugin(plugin: Path, folder: Path) -> Path:
    junk = shutil.ignore_patterns("__pycache__", ".*", "build", "dist", "*.egg-info")
    return Path(shutil.copytree(plugin, folder / plugin.name, ignore=junk))


def entry_points_of(source: Path) -> set[tuple[str, str]]:
    """Return the group and the name of each entry point."""
    groups = tomllib.loads((source / "pyproject.toml").read_text())["project"]["entry-points"]
    return {(group.removeprefix("bidnerf."), name) for group, names in groups.items() for name in names}


def list_offered(environment: dict[str, str]) -> dict[tuple[str, str], str]:
    """Return the distribution of every plugin that is found and has no fault, by group and name."""
    program = "from bidnerf.cli import main; main(['plugins', '--json'])"
    listed = json.loads(quietly([sys.executable, "-c", program], env=environment))
    return {(e["group"], e["name"]): e["distribution"] for e in listed if e["fault"] is None}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], str]:
    """What is offered where all plugins are installed: the wheels that ``make wheels`` made, or copies of their folders.

    Copies, so that nothing is written into the checkout.
    """
    folder = tmp_path_factory.mktemp("plugins")
    if wheels := os.environ.get("BIDNERF_WHEELS"):
        sources = [*Path(wheels).glob("bidnerf_*.whl")]
    else:
        sources = [copy_plugin(plugin, folder) for plugin in PLUGINS]
    return list_offered(install(sources, folder / "site"))


@every_plugin
def test_a_plugin_is_found(plugin: Path, found: dict[tuple[str, str], str]) -> None:
    points = entry_points_of(plugin)
    assert {point: found.get(point) for point in points} == dict.fromkeys(points, plugin.name)


@every_plugin
def test_a_plugin_is_typed_and_knows_the_core_only(plugin: Path) -> None:
    packages = [file.parent for file in plugin.glob("*/__init__.py")]
    assert packages
    for package in packages:
        assert (package / "py.typed").is_file()
        for file in package.rglob("*.py"):
            assert not imports_of(file) & BUNDLED, file


def imports_of(file: Path) -> set[str]:
    """Top-level names of what a file imports."""
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return {name.partition(".")[0] for name in plain | {n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)}}


def test_the_template_can_be_renamed_as_it_says(tmp_path: Path) -> None:
    """The commands of its README, word for word. ``.ci/wheels`` runs all tests of the template: here, those that build a field."""
    if shutil.which("perl") is None:
        pytest.skip("perl is not installed")
    checkout = tmp_path / "bidnerf"
    template = copy_plugin(ROOT / "plugins" / "bidnerf-template", checkout / "plugins")
    commands = re.findall(r"```sh\n(.*?)```", (template / "README.md").read_text(), re.DOTALL)[0]
    page = (ROOT / "docs" / "extend.md").read_text()
    assert [line for line in commands.splitlines() if line not in page] == []
    quietly(["sh", "-e", "-c", commands], cwd=checkout)
    mine = tmp_path / "bidnerf-mine"
    text = "".join(file.read_text() for file in mine.rglob("*") if file.suffix in (".py", ".toml"))
    assert "template" not in text.lower()
    environment = install([mine], tmp_path / "site")
    (distribution,) = metadata.distributions(path=[str(tmp_path / "site")])
    assert {(point.group, point.name, point.value) for point in distribution.entry_points} == {
        ("bidnerf.backends", "mine", "bidnerf_mine:backend"),
        ("bidnerf.commands", "mine-parameters", "bidnerf_mine.command:count_parameters"),
    }
    pytest_ = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(mine)]
    assert "passed" in quietly([*pytest_, "-k", "build", str(mine / "tests")], cwd=mine, env=environment)
