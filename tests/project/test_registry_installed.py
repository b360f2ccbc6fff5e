"""Faults of plugins that pip really installed, as the command line tells them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow


GOOD = """from dataclasses import dataclass

@dataclass(frozen=True)
class Config:
    steps: int = 1

class Kind:
    summary, config_type = "fog", Config
    def build(self, config, bounds): ...
    def train(self, field, views, config, report): ...

backend = Kind()
"""
MARK = "'''A field of fog.'''\nimport pathlib; pathlib.Path(__file__).with_suffix('.imported').touch()\n"


@dataclass(frozen=True)
class Plugin:
    """One distribution, one entry point, one module."""

    dist: str
    name: str
    target: str = "backend"
    source: str = GOOD
    version: str = "1.0"

    @property
    def module(self) -> str:
        return self.dist.replace("-", "_")

    def wheel(self, folder: Path) -> Path:
        """Made by hand: a wheel is a zip file, and a build takes seconds."""
        path, info = (
            folder / f"{self.module}-{self.version}-py3-none-any.whl",
            f"{self.module}-{self.version}.dist-info",
        )
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(f"{self.module}.py", MARK + self.source)
            archive.writestr(
                f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {self.dist}\nVersion: {self.version}\n"
            )
            archive.writestr(
                f"{info}/WHEEL",
                "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
            )
            archive.writestr(
                f"{info}/entry_points.txt", f"[bidnerf.backends]\n{self.name} = {self.module}:{self.target}\n"
            )
            archive.writestr(f"{info}/RECORD", "")
        return path


PLUGINS = [
    Plugin("stranger-sound", "sound"),
    Plugin("stranger-broken", "broken", source="raise RuntimeError('no driver')\n"),
    Plugin("stranger-lacking", "lacking", target="bakend"),
    Plugin("stranger-odd", "odd", source="backend = 3\n"),
    Plugin("stranger-one", "twice"),
    Plugin("stranger-two", "twice", version="4.0"),
    Plugin("stranger-thief", "hashgrid"),
    Plugin("stranger-renewed", "renewed", version="2.0"),
]
OLD = Plugin("stranger-renewed", "renewed", source="raise RuntimeError('the old one')\n", version="1.0")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders with all of them, an older version behind, and a malformed stranger among them."""
    wheels, site, behind = (tmp_path_factory.mktemp(name) for name in ("wheels", "site", "behind"))
    for target, plugins in ((site, PLUGINS), (behind, [OLD])):
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile"]
        subprocess.run(
            [*pip, "--target", target, *(p.wheel(wheels) for p in plugins)],
            check=True,
            stdin=subprocess.DEVNULL,
        )
    unrelated = site / "unrelated-1.0.dist-info"
    unrelated.mkdir()
    (unrelated / "METADATA").write_text("Metadata-Version: 2.1\nName: unrelated\nVersion: 1.0\n")
    (unrelated / "entry_points.txt").write_text("[console_scripts]\nnonsense\n")
    return site


FAULTS = {
    "broken": ["stranger_broken:backend", "stranger-broken 1.0", "RuntimeError", "no driver"],
    "lacking": ["stranger_lacking:bakend", "stranger-lacking 1.0", "no attribute 'bakend'"],
    "odd": ["stranger_odd:backend", "stranger-odd 1.0", "not a backend"],
    "twice": ["stranger-one 1.0", "stranger-two 4.0", "uninstall one"],
    "hashgrid": ["bidnerf", "stranger-thief 1.0", "uninstall one"],
}
COMMANDS = {
    "json": ["backends", "--json"],
    "text": ["backends"],
    **{name: ["train", "nowhere", "--backend", name, "--out", "map"] for name in (*FAULTS, "renewed")},
}
PROGRAM = """
import contextlib, io, json, pathlib, sys
from bidnerf_core.cli import main
site, told = pathlib.Path(sys.argv[1]), {}
for name, words in json.loads(sys.argv[2]).items():
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = main(words)
    imported = [path.stem for path in site.glob("*.imported")]
    told[name] = {"status": status, "out": out.getvalue(), "err": err.getvalue(), "imported": imported}
print(json.dumps(told))
"""
Told = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def told(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """What each command says where the plugins are installed, and which of these are imported after it. One process runs all."""
    behind = next(site.parent.glob("behind*"))
    path = [str(site), str(behind), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, site, json.dumps(COMMANDS)], cwd=tmp_path_factory.mktemp("empty"),
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path)}, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return dict(json.loads(done.stdout))


def test_the_healthy_are_listed_the_broken_marked_and_none_imported(told: Told) -> None:
    done = told["json"]
    assert done["status"] == 0, done["err"]
    found: dict[str, list[dict[str, str | None]]] = {}
    for entry in json.loads(done["out"]):
        found.setdefault(entry["name"], []).append(entry)
    assert [e["fault"] for e in found["vanilla"]] == [None]
    (sound,) = found["sound"]
    assert (sound["summary"], sound["distribution"], sound["fault"]) == (
        "A field of fog.",
        "stranger-sound",
        None,
    )
    for name, owners in {
        "twice": ["stranger-one", "stranger-two"],
        "hashgrid": ["bidnerf", "stranger-thief"],
    }.items():
        assert [e["distribution"] for e in found[name]] == owners
        assert all("also claimed by" in str(e["fault"]) for e in found[name])
    (renewed,) = found["renewed"]
    assert (renewed["version"], renewed["fault"]) == ("2.0", None)
    assert {"broken", "lacking", "odd"} <= found.keys()  # nothing but an import can tell
    assert told["text"]["status"] == 0
    assert (done["imported"], told["text"]["imported"]) == ([], [])


def test_a_fault_is_told_in_one_line_when_that_backend_is_asked_for(told: Told) -> None:
    for name, parts in FAULTS.items():
        assert (told[name]["status"], told[name]["err"].count("\n")) == (1, 1), told[name]
        for part in [f"'{name}'", *parts]:
            assert part in told[name]["err"]


def test_of_two_versions_the_one_that_import_would_take_is_loaded(told: Told) -> None:
    # It was loaded, and then there was no data.
    assert "nowhere: no such folder" in told["renewed"]["err"]
    assert "stranger_renewed" in told["renewed"]["imported"]
