"""What is built and installed is what was meant: not the checkout, but the wheel."""

from __future__ import annotations

import json
import os
import re
import sys
import tarfile
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from commands import quietly

pytestmark = pytest.mark.slow


ROOT = Path(__file__).parents[2]
DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = DECLARED["project"]
BACKENDS, METHODS = (PROJECT["entry-points"][f"bidnerf.{group}"] for group in ("backends", "methods"))
STOREYS = ["bidnerf", "bidnerf_core"]
PACKAGES = [*STOREYS, *sorted({re.split("[.:]", value)[0] for value in (BACKENDS | METHODS).values()} - {*STOREYS})]


@dataclass(frozen=True)
class Built:
    sdist: Path
    wheel: Path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """A source archive, and the wheel that is built from that archive alone: by ``make wheels``, or now."""
    made = os.environ.get("BIDNERF_WHEELS")
    out = Path(made or tmp_path_factory.mktemp("dist"))
    if not made:
        quietly([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)])
    (sdist,), (wheel,) = out.glob("bidnerf-*.tar.gz"), out.glob("bidnerf-*.whl")
    return Built(sdist, wheel)


@pytest.fixture(scope="module")
def installed(built: Built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which the wheel was installed, not editable."""
    target = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-compile"]
    quietly([*pip, "--target", str(target), str(built.wheel)])
    return target


def _sources(package: str) -> set[str]:
    """Files of an import package as the wheel should hold them."""
    folder = next(f for f in (ROOT / package, ROOT / "backends" / package) if f.is_dir())
    files = (f for f in folder.rglob("*") if f.is_file() and "__pycache__" not in f.parts)
    return {f.relative_to(folder.parent).as_posix() for f in files}


def test_the_wheel_holds_the_import_packages_and_nothing_else(built: Built) -> None:
    with zipfile.ZipFile(built.wheel) as archive:
        names = archive.namelist()
    code = {name for name in names if ".dist-info/" not in name}
    assert {name.partition("/")[0] for name in code} == set(PACKAGES)
    assert code == set().union(*map(_sources, PACKAGES))
    assert any(name.endswith("/LICENSE") for name in names)


def test_the_source_archive_can_be_worked_with(built: Built) -> None:
    with tarfile.open(built.sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    expected = ["README.md", "LICENSE", "CHANGELOG.md", "Makefile", "constraints.txt", "tests/conftest.py"]
    assert names.issuperset(expected)
    assert names.issuperset(name for package in PACKAGES[:2] for name in _sources(package))
    assert names.issuperset(f"backends/{name}" for package in PACKAGES[2:] for name in _sources(package))


def test_an_installed_wheel_offers_and_loads_its_backends_and_has_the_command(installed: Path) -> None:
    """Python runs with the installed wheel and the dependencies, but not the checkout.

    ``-S`` leaves out the ``.pth`` file by which an editable install puts the checkout on the path.
    """
    program = (
        "import json, runpy, sys\n"
        "from importlib.util import find_spec\n"
        "from bidnerf_core import registry\n"
        "from bidnerf_core.backend import load_backend\n"
        "from bidnerf_core.localization import METHODS\n"
        "mine = [i for i in registry.list_plugins('backends') if i.distribution == 'bidnerf']\n"
        "loaded = {i.name: type(load_backend(i.name)).__module__ for i in mine}\n"
        "assert METHODS['bid'].needs_start and not METHODS['auto'].needs_start\n"
        "others = [n for n in ('backends', 'tests', 'plugins') if find_spec(n)]\n"
        "print(json.dumps([registry.__file__, [[i.name, i.value, i.fault] for i in mine], loaded, others]))\n"
        "sys.argv = ['bidnerf', 'backends', '--json']\n"
        "runpy.run_path('bin/bidnerf', run_name='__main__')"
    )
    dependencies = [entry for entry in sys.path if entry.endswith(("site-packages", "dist-packages"))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), *dependencies])}
    printed = quietly([sys.executable, "-S", "-c", program], cwd=installed, env=environment)
    found, _, by_command = printed.partition("\n")
    place, listed, loaded, others = json.loads(found)
    assert Path(place).is_relative_to(installed)
    assert listed == [[name, value, None] for name, value in sorted(BACKENDS.items())]
    assert set(loaded) == set(BACKENDS)
    assert others == []  # which would hide folders of the user's
    assert set(BACKENDS) <= {entry["name"] for entry in json.loads(by_command)}


def test_every_bundled_backend_is_packaged_and_declared() -> None:
    """A new folder under backends/ needs an entry point and a line under the wheel's packages; both are easily forgotten."""
    folders = {f.parent.name for f in (ROOT / "backends").glob("*/__init__.py")}
    assert folders == set(PACKAGES[2:])


def test_what_is_required_is_pinned() -> None:
    """``constraints.txt`` has an exact version of each requirement, of the extras' and of the development's."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.partition("==")[0].lower().replace("_", "-") for line in lines if "==" in line}
    groups = [entry for group in DECLARED["dependency-groups"].values() for entry in group if isinstance(entry, str)]
    extras = [entry for group in PROJECT["optional-dependencies"].values() for entry in group]
    required = [entry for entry in [*PROJECT["dependencies"], *extras, *groups] if not entry.startswith("bidnerf[")]
    names = {re.split(r"[\[>=]", entry)[0] for entry in required}
    assert {name.lower().replace("_", "-") for name in names} <= pinned
