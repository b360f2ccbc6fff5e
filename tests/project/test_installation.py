"""What is missing or of another version than bidnerf needs is named in one line, before any work is done."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

import pytest

from bidnerf_core import installation
from bidnerf_core.errors import InputError
from bidnerf_core.installation import import_extra, requirements, with_writer
from bidnerf_core.registry import PluginError, registered
from bombs import png_of
from commands import Run, assert_refused, strict

ROOT = Path(__file__).parents[2]
EXTRAS = [name for name in metadata("bidnerf").get_all("Provides-Extra") or () if name != "all"]
HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"
VIDEO = b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom"
COMMANDS = {
    ("plots", "matplotlib"): [
        "info MAP --plot x.png",
        "track MAP DATA --out x.tum --plot x.png",
        "report DATA/r.jsonl --out x",
    ],
    ("cluster", "distributed"): [
        "evaluate MAP DATA --out x.jsonl --dask tcp://127.0.0.1:9",
        "poses PHOTOS --out x --dask tcp://127.0.0.1:9",
        "train PHOTOS --out x --dask tcp://127.0.0.1:9",
    ],
    ("serve", "uvicorn"): ["serve MAP"],
    ("viewer", "uvicorn"): ["view MAP"],
    ("sfm", "pycolmap"): ["train PHOTOS --out x", "poses PHOTOS --out x"],
    ("video", "av"): ["train DATA/clip.mp4 --out x", "track MAP DATA/clip.mp4 --focal 9 --out x.tum"],
    ("heif", "pillow_heif"): ["localize MAP DATA/IMG_1.jpg --focal 9"],  # the content counts, not the name
}


@pytest.fixture
def versions(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A function that makes packages look as if other versions of them were installed."""
    usual = installation.version

    def pretend(**packages: str) -> None:
        requirements.cache_clear()
        monkeypatch.setattr(installation, "version", lambda name: packages.get(name) or usual(name))

    yield pretend
    monkeypatch.undo()
    requirements.cache_clear()


def test_every_extra_adds_to_what_is_required_and_one_adds_all() -> None:
    needed = {requirement.name for requirement in requirements()}
    added = {extra: {requirement.name for requirement in requirements(extra)} for extra in [*EXTRAS, "all"]}
    assert {"torch", "pydantic"} <= needed
    assert all(names and not names & needed for names in added.values())
    assert added.pop("all") == set().union(*added.values())


@pytest.mark.parametrize(
    ("needed", "line"), [(needed, line) for needed, lines in COMMANDS.items() for line in lines], ids=str
)
def test_a_missing_extra_is_named_before_any_work(
    needed: tuple[str, str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bidnerf: Run
) -> None:
    extra, module = needed
    data, photos, described = tmp_path / "data", tmp_path / "photos", tmp_path / "map"
    for folder in (data, photos, described):
        folder.mkdir()
    (described / "map.json").write_text('{"format": "bidnerf map", "version": 1}')
    (data / "clip.mp4").write_bytes(VIDEO)
    (data / "IMG_1.jpg").write_bytes(HEIC)
    (data / "r.jsonl").write_text("")
    (photos / "a.png").write_bytes(png_of(64, 48))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    places = {"MAP": described, "DATA": data, "PHOTOS": photos}
    words = [re.sub(r"^[A-Z]+(?=/|$)", lambda name: str(places[name[0]]), word) for word in line.split()]
    assert_refused(bidnerf(*words), 1, f"needs the extra '{extra}' (pip install 'bidnerf[{extra}]')")
    assert not list(tmp_path.glob("x*"))


def test_an_extra_of_another_version_is_named(versions: Callable[..., None]) -> None:
    versions(av="14.4.0")
    with pytest.raises(InputError, match=r"^reading a video needs the extra 'video' \(.*\): av 14.4.0, expected >=15$"):
        import_extra("json", "video", "reading a video")


@pytest.mark.parametrize("error", [ImportError("cannot import name 'TypeAdapter'"), AttributeError("no 'compile'")])
def test_an_old_dependency_explains_the_failure_that_it_causes(
    error: Exception, versions: Callable[..., None], monkeypatch: pytest.MonkeyPatch, bidnerf: Run
) -> None:
    def fail() -> None:
        """Fail as code does whose dependency is old."""
        raise error

    def missing(name: str) -> None:
        raise PackageNotFoundError(name)

    with monkeypatch.context() as context:
        context.setitem(registered, ("commands", "fail"), fail)
        with pytest.raises(type(error)):  # a defect, if all requirements are met
            bidnerf("fail")
        with context.context() as source:
            source.setattr(installation, "requires", missing)
            requirements.cache_clear()
            with pytest.raises(type(error), match=re.escape(str(error))):  # bidnerf runs from its source
                bidnerf("fail")
        versions(torch="2.4.1")
        assert_refused(bidnerf("fail"), 1, "torch 2.4.1, expected >=2.6; pip install -U bidnerf", error)


def test_doctor_describes_what_a_bug_report_needs(bidnerf: Run, versions: Callable[..., None]) -> None:
    found = strict(bidnerf("doctor", "--json").succeed().out)
    assert found["devices"][0] == "cpu"
    assert found["packages"].keys() == {requirement.name for requirement in requirements()}
    assert found["extras"].keys() == set(EXTRAS)
    assert "torch " in bidnerf("doctor").succeed().out
    versions(torch="2.4.1", av="14.4.0")
    broken = bidnerf("doctor")
    assert (broken.status, broken.err) == (1, "bidnerf doctor: torch 2.4.1, expected >=2.6; pip install -U bidnerf\n")
    assert re.search(r"torch +2\.4\.1\n(.*\n)*extra video +av 14\.4\.0, expected >=15\n", broken.out)


def test_doctor_reports_what_cannot_be_imported(
    bidnerf: Run, versions: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(group: str) -> Any:
        raise PluginError(f"{group}.py:TABLE: the table cannot be imported")

    monkeypatch.setattr("bidnerf.cli.plugins.list_plugins", fail)
    monkeypatch.setitem(sys.modules, "torch", None)
    found = strict(bidnerf("doctor", "--json").succeed().out)
    assert found["devices"] == ["torch cannot be imported (import of torch halted; None in sys.modules)"]
    assert "faults: faults.py:TABLE: the table cannot be imported" in found["plugins"]


@pytest.mark.parametrize(
    ("writers", "expected"),
    [
        (["0.3.0"], "a file of bidnerf 0.1.0 or earlier; bidnerf 0.3.0 wrote it, so upgrade bidnerf"),
        (["0.0.9", "0.10"], "a file of bidnerf 0.1.0 or earlier; bidnerf 0.10 wrote it, so upgrade bidnerf"),
        (["9" * 5000], f"a file of bidnerf 0.1.0 or earlier; bidnerf {'9' * 40} wrote it, so upgrade bidnerf"),
        (["0.1.0", "0.1.0rc1", "0.0.9", None, {}], "a map"),
        ([], "a map"),
    ],
)
def test_a_file_of_a_newer_version_names_both(writers: list[Any], expected: str, versions: Callable[..., None]) -> None:
    versions(bidnerf="0.1.0")
    error = with_writer(InputError("no field 'x'", where="map.json", expected="a map"), *writers)
    assert (error.where, error.found, error.expected) == ("map.json", "no field 'x'", expected)


def test_make_refuses_another_interpreter(tmp_path: Path) -> None:
    old = tmp_path / "python3.10"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    for given, reason in ((old, f"{old} is not that"), ("", "none was found")):
        words = ["make", "-s", "-f", str(ROOT / "Makefile"), "demo", f"PYTHON={given}", f"VENV={tmp_path / 'venv'}"]
        ran = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
        assert ran.returncode == 2
        assert ran.stderr.splitlines()[0] == f"Python 3.11 or later is needed, and {reason}"
