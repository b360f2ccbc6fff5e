"""Plugins are found by name, listed without being imported, and refused with the culprit's name."""

from __future__ import annotations

import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bidnerf.results import write_poses
from bidnerf_core.backend import Backend, load_backend
from bidnerf_core.datasets import Capture, DatasetOptions, Reader, find_reader, open_dataset, open_sequence
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.localization import find_method
from bidnerf_core.mapping import FEATURES, find_features
from bidnerf_core.registry import (
    GROUPS,
    PluginError,
    PluginInfo,
    _declared,
    list_plugins,
    load_plugin,
    register,
)
from commands import Run, quietly
from refusals import refused

FOG = '''"""A field of fog.

More of it.
"""
from dataclasses import dataclass

@dataclass(frozen=True)
class Config:
    size: int = 1
    steps: int = 1
    parts: tuple = ()

class Kind:
    summary = "a field of fog"
    config_type = Config
    def build(self, config, bounds): ...
    def train(self, field, views, config, report): ...

backend = Kind()
class Holder:
    backend = backend
'''
ANYTHING = '"""Something that is registered."""\n\nthing = object()\n'
BROKEN = "raise RuntimeError('no driver')"


class Site:
    """A folder on ``sys.path`` to which throw-away distributions are installed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def module(self, path: str, source: str) -> None:
        _declared.cache_clear()
        file = self.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source, encoding="utf-8")

    def metadata(self, name: str, version: str, points: str) -> Path:
        """A distribution with the given text of ``entry_points.txt``."""
        info = self.folder / f"{name.replace('-', '_')}-{version}.dist-info"
        header = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nSummary: Made for a test\n"
        self.module(f"{info.name}/METADATA", header)
        self.module(f"{info.name}/entry_points.txt", points)
        return info

    def plugin(
        self, name: str, value: str, dist: str = "stranger", version: str = "1.0", group: str = "backends"
    ) -> None:
        self.metadata(dist, version, f"[bidnerf.{group}]\n{name} = {value}\n")

    def backend(self, source: str = FOG, name: str = "fog", **more: str) -> None:
        """A plugin of one module, whose backend is named ``name``."""
        self.module(f"stranger_{name}.py", source)
        self.plugin(name, f"stranger_{name}:backend", **more)


@pytest.fixture
def new_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Site]]:
    """Makes folders on ``sys.path``, each new one before the others; what is imported from them is forgotten."""
    before = set(sys.modules)

    def make(name: str) -> Site:
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.syspath_prepend(str(folder))
        return Site(folder)

    yield make
    _declared.cache_clear()
    for name in set(sys.modules) - before:
        if name.startswith("stranger"):
            del sys.modules[name]


@pytest.fixture
def site(new_site: Callable[[str], Site]) -> Site:
    return new_site("site")


def listed(name: str, group: str = "backends") -> list[PluginInfo]:
    return [info for info in list_plugins(group) if info.name == name]


def refusal(name: str, caused: bool = False) -> str:
    with pytest.raises(PluginError) as caught:
        load_backend(name)
    assert isinstance(caught.value, InputError)
    assert "\n" not in str(caught.value)
    assert not caused or caught.value.__cause__ is not None
    return str(caught.value)


# Plugins that work.


@pytest.mark.parametrize(
    "value",
    ["stranger_fog:backend", "stranger_pkg.sub.kind:backend", "stranger_pkg.sub.kind:Holder.backend [fast]"],
)
def test_a_strangers_backend_is_listed_and_loaded(site: Site, value: str) -> None:
    """An object may lie deep in a package."""
    for path in ("stranger_pkg/__init__.py", "stranger_pkg/sub/__init__.py"):
        site.module(path, "")
    for path in ("stranger_fog.py", "stranger_pkg/sub/kind.py"):
        site.module(path, FOG)
    site.plugin("fog", value, version="2.3")
    (info,) = listed("fog")
    assert info == PluginInfo("backends", "fog", value, "stranger", "2.3", "Made for a test")
    assert info.summary == "Made for a test"
    assert not {"stranger_fog", "stranger_pkg"} & set(sys.modules)
    backend = load_backend("fog")
    assert isinstance(backend, Backend)
    assert backend.summary == "a field of fog"


def test_a_module_may_itself_be_the_backend(site: Site) -> None:
    lines = ["from dataclasses import make_dataclass", "summary = 'a module'"]
    lines += ["config_type = make_dataclass('Config', [('steps', int, 1)], frozen=True)"]
    lines += ["def build(config, bounds): ...", "def train(field, views, config, report): ..."]
    site.module("stranger_module.py", "\n".join(lines))
    site.plugin("module", "stranger_module")
    assert load_backend("module").summary == "a module"


def test_listing_imports_nothing(site: Site) -> None:
    """The listing runs in a process of its own, where an import of any of the modules would show, whether it fails or not."""
    site.module("stranger_loud/__init__.py", "raise SystemExit('imported')")
    site.module("stranger_loud/kind.py", FOG)
    site.plugin("loud", "stranger_loud.kind:backend")
    program = (
        "import json, sys\n"
        "from bidnerf_core.registry import list_plugins\n"
        "infos = {i.name: i.summary if i.name == 'loud' else None for i in list_plugins('backends')}\n"
        "infos = {name: infos[name] for name in ('loud', 'hashgrid')}\n"
        "foreign = [m for m in sys.modules if m.startswith(('stranger', 'bidnerf_')) and 'core' not in m]\n"
        "print(json.dumps([infos, foreign]))"
    )
    path = os.pathsep.join([str(site.folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    printed = quietly([sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": path})
    assert json.loads(printed) == [{"loud": "Made for a test", "hashgrid": None}, []]


# Groups.


@pytest.mark.parametrize("group", GROUPS)
def test_every_group_is_listed_loaded_and_refused_alike(site: Site, group: str) -> None:
    site.module("stranger_thing.py", ANYTHING)
    site.module("stranger_broken.py", BROKEN)
    points = "thing = stranger_thing:thing\nbroken = stranger_broken:thing"
    site.metadata("stranger", "1.0", f"[bidnerf.{group}]\n{points}\n")
    (info,) = listed("thing", group)
    assert (info.summary, info.fault) == ("Made for a test", None)
    assert "stranger_thing" not in sys.modules
    assert type(load_plugin(group, "thing")) is object
    where = "'broken' (stranger_broken:thing, from stranger 1.0)"
    with refused(where=where, found="RuntimeError: no driver", error=PluginError):
        load_plugin(group, "broken")


@pytest.mark.parametrize("group", [group for group in GROUPS if group not in ("importers", "services")])
def test_bundled_plugins_are_registered_as_a_strangers_are_and_their_names_are_taken(site: Site, group: str) -> None:
    infos = [info for info in list_plugins(group) if info.is_bundled]
    assert infos
    summaries = dict[int, str]()
    for info in infos:
        assert (info.fault, info.distribution) == (None, "bidnerf")
        plugin = load_plugin(group, info.name)
        says = getattr(plugin, "summary", None) or plugin.__doc__
        assert (info.summary, "\n" in info.summary) == (says.partition("\n")[0], False)
        summaries[id(plugin)] = info.summary
    assert len(set(summaries.values())) == len(summaries)
    site.module("stranger_thing.py", ANYTHING)
    site.plugin(infos[0].name, "stranger_thing:thing", group=group)
    found = "also claimed by stranger 1.0 (stranger_thing:thing)"
    with refused(where=infos[0], found=found, error=PluginError):
        load_plugin(group, infos[0].name)
    assert "stranger_thing" not in sys.modules


# Faults.


def test_an_unknown_name_gets_the_nearest_and_the_installed(site: Site) -> None:
    site.backend()
    assert re.search(r"'hash-grid'.*did you mean 'hashgrid'\?.*installed: .*\bfog, .*hashgrid", refusal("hash-grid"))
    assert "did you mean" not in refusal("zzz")


@pytest.mark.parametrize(
    ("source", "causes"),
    [
        (BROKEN, ["RuntimeError", "no driver"]),
        ("import stranger_missing", ["ModuleNotFoundError", "stranger_missing"]),
        ("raise SystemExit(3)", ["SystemExit", "3"]),
        ("raise GeneratorExit('goodbye')", ["goodbye"]),
        ("raise type('Odd', (BaseException,), {})('goodbye')", ["goodbye"]),
        ("def broken(:\n", ["SyntaxError"]),
    ],
)
def test_a_module_that_does_not_import_is_told_with_its_cause(site: Site, source: str, causes: list[str]) -> None:
    site.backend(source, dist="stranger-broken", version="0.7")
    assert listed("fog")[0].fault is None  # its fault surfaces when it is asked for, and only then
    message = refusal("fog", caused=True)
    assert [
        part for part in ("'fog'", "stranger_fog:backend", "stranger-broken 0.7", *causes) if part not in message
    ] == []


def test_ctrl_c_during_an_import_stays_an_interruption(site: Site) -> None:
    site.backend("raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        load_backend("fog")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('    summary = "a field of fog"\n', "", "Kind has no summary"),
        ("    config_type = Config\n", "", "Kind has no config_type"),
        ("def build", "def construct", "Kind has no build"),
        ("def train", "def fit", "Kind has no train"),
        ("backend = Kind()", "backend = None", "NoneType has no summary, config_type, build, train"),
        ("backend = Kind()", "backend = Config", "class Config has no summary, config_type, build, train"),
        ("backend = Kind()", "backend = Kind", "it is the class Kind itself, expected an instance of it"),
        ('summary = "a field of fog"', "summary = 3", "summary is 3, expected one line of text"),
        ("config_type = Config", "config_type = dict", "expected a frozen dataclass"),
        ("config_type = Config", "config_type = Config()", "expected a frozen dataclass"),
        ("@dataclass(frozen=True)", "@dataclass", "expected a frozen dataclass"),
        ("size: int = 1", "size: int", "config_type Config has no default for size"),
        ("size: int = 1", "size = 1", "config_type Config has no type for size, expected 'size: int = 1'"),
        ("steps: int = 1", "times: int = 1", "config_type Config has no field steps"),
        ("self, config, bounds", "self, config", "build does not take (config, bounds)"),
        ("self, field, views, config, report", "self", "train does not take (field, views, config, report)"),
        ("def build(self, config, bounds): ...", "build = 1", "build does not take (config, bounds)"),
        ("config_type = Config", "config_type = property(lambda self: 1 // 0)", "ZeroDivisionError"),
    ],
)
def test_an_object_that_is_no_backend_is_told_what_it_lacks(site: Site, old: str, new: str, expected: str) -> None:
    assert old in FOG
    site.backend(FOG.replace(old, new))
    message = refusal("fog")
    assert message.startswith("backend 'fog' (stranger_fog:backend, from stranger 1.0): not a backend: ")
    assert expected in message


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ("not a module!", "'module:object'"),
        ("stranger_absent:backend", "No module named 'stranger_absent'"),
        ("json.stranger:backend", "No module named 'json.stranger'"),
        ("json:bakend", "no attribute 'bakend'"),
    ],
)
def test_a_value_that_leads_nowhere_is_a_fault_of_that_backend_alone(site: Site, value: str, fault: str) -> None:
    site.plugin("nowhere", value)
    assert fault in refusal("nowhere")
    assert load_backend("hashgrid").summary


def test_a_name_claimed_twice_is_nobodys(site: Site) -> None:
    site.backend(dist="stranger-one")
    site.backend(dist="stranger-two", version="4.0")
    assert [info.distribution for info in listed("fog")] == ["stranger-one", "stranger-two"]
    assert all("also claimed by" in (info.fault or "") for info in listed("fog"))
    assert re.search(r"stranger-one 1\.0.*stranger-two 4\.0", refusal("fog"))
    assert "stranger_fog" not in sys.modules


def test_of_two_versions_the_first_on_the_path_wins_as_for_import(
    new_site: Callable[[str], Site], monkeypatch: pytest.MonkeyPatch
) -> None:
    later = new_site("later")
    old = "fog = stranger_old:backend\nmist = stranger_old:backend"
    later.metadata("Stranger.Fog", "1.0", f"[bidnerf.backends]\n{old}\n")
    first = new_site("first")
    first.backend(dist="stranger-fog", version="2.0")
    monkeypatch.setattr(sys, "path", [str(first.folder), *sys.path])  # twice, which hides nothing
    (info,) = listed("fog")
    assert (info.value, info.version, info.fault) == ("stranger_fog:backend", "2.0", None)
    assert isinstance(load_backend("fog"), Backend)
    assert listed("mist") == []  # which only the hidden version has


@pytest.mark.parametrize("file", ["entry_points.txt", "METADATA"])
def test_a_package_with_malformed_metadata_is_named_in_one_line(site: Site, file: str) -> None:
    info = site.metadata("unrelated", "1.0", "[bidnerf.backends]\nbroken = unrelated:backend\n")
    (info / file).write_bytes(b"[bidnerf.backends]\nnonsense\nName: \xff\n")
    site.backend()
    with refused(found="metadata of an installed package cannot be read", error=PluginError):
        load_backend("fog")


def test_metadata_without_the_bundled_plugins_is_to_be_renewed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.registry._declared", lambda group: ())
    with refused(found="lists no plugins at all; reinstall bidnerf", error=PluginError):
        find_method("auto")


# What a program registers itself.


@pytest.fixture
def nothing_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.registry.registered", {})


@pytest.mark.usefixtures("nothing_registered")
def test_a_script_registers_what_it_has() -> None:
    detector = find_features("sift")
    register("features", "mine", detector)
    assert find_features("mine") is detector
    (info,) = listed("mine", "features")
    assert str(info) == "detector 'mine' (Sift, registered in this process)"
    assert "mine" in FEATURES
    register("features", "mine", detector)  # the same cell of a notebook, run again
    register("methods", "three", 3)  # it is checked when it is asked for
    where = "method 'three' (int, registered in this process)"
    with refused(where=where, found="not a method: it is a int", error=PluginError):
        find_method("three")


@pytest.mark.usefixtures("nothing_registered")
def test_a_taken_name_is_replaced_on_purpose_only() -> None:
    mine = replace(find_method("auto"), summary="mine")
    taken = "taken by method 'auto' (bidnerf_core.localization.auto:AUTO, from bidnerf"
    with refused(where="register", found=taken) as caught:
        register("methods", "auto", mine)
    assert "replace=True" in caught.error.found
    register("methods", "auto", mine, replace=True)
    assert find_method("auto") is mine
    assert [info.summary for info in listed("auto", "methods")] == ["mine"]
    with refused(where="register", found="taken by method 'auto' (Method, registered in this process)"):
        register("methods", "auto", replace(mine, summary="another"))


@pytest.mark.parametrize(
    ("group", "name", "found", "expected"),
    [
        ("method", "mine", "'method', did you mean 'methods'?", None),
        ("methods", "a b", "name is 'a b'", "letters, digits, '.', '-' and '_'"),
        ("methods", "", "name is ''", "letters, digits, '.', '-' and '_'"),
        ("methods", 3, "name is 3", "letters, digits, '.', '-' and '_'"),
    ],
)
def test_an_unusable_registration_is_refused(group: str, name: Any, found: str, expected: str | None) -> None:
    with refused(found=found, expected=expected):
        register(group, name, object())


class Claiming(Reader):
    """A reader that claims every folder, or fails at it, and returns what ``opens`` does."""

    expected = "anything"

    def __init__(self, error: Exception | None = None, opens: Callable[[], Any] = dict) -> None:
        self.error, self.opens = error, opens

    def recognises(self, path: Path) -> bool:
        if self.error is not None:
            raise self.error
        return True

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        return self.opens()  # type: ignore[no-any-return]


@pytest.mark.usefixtures("nothing_registered")
def test_two_readers_that_claim_a_folder_are_named(tmp_path: Path) -> None:
    register("readers", "first", Claiming())
    assert find_reader(tmp_path) is load_plugin("readers", "first")
    register("readers", "second", Claiming())
    with refused(where=tmp_path, found="by the readers first and second", expected="one"):
        find_reader(tmp_path)


@pytest.mark.usefixtures("nothing_registered")
def test_readers_are_tried_in_the_order_of_their_precedence(tmp_path: Path) -> None:
    """Bundled readers come before those that state none."""
    register("readers", "failing", Claiming(RuntimeError("must not be called")))
    for name in ("rgb.txt", "transforms.json"):
        (tmp_path / name).write_text("{}")
    transforms, tum, own = load_plugin("readers", "transforms"), load_plugin("readers", "tum"), Claiming()
    assert find_reader(tmp_path) is transforms
    register("readers", "own", own)
    for precedence, first in ((tum.precedence - 1, transforms), (transforms.precedence + 1, own)):
        own.precedence = precedence
        assert find_reader(tmp_path) is first
    own.precedence = transforms.precedence
    with refused(where=tmp_path, found="by the readers transforms and own", expected="one"):
        find_reader(tmp_path)
    (tmp_path / "transforms.json").unlink()
    assert find_reader(tmp_path) is own


@pytest.mark.usefixtures("nothing_registered")
def test_a_reader_that_fails_is_named_once_and_passed_over(site: Site, tmp_path: Path, bidnerf: Run) -> None:
    site.module("stranger_broken.py", BROKEN)
    site.plugin("broken", "stranger_broken:reader", group="readers")
    register("readers", "failing", Claiming(OSError("no disk")))

    def look() -> None:
        """Look for readers of three folders."""
        for name in ("first", "second", "third"):
            (tmp_path / name).mkdir()
            assert find_reader(tmp_path / name) is None
        warnings.warn("another remark", InputWarning, stacklevel=1)

    register("commands", "look", look)
    lines = bidnerf("look").err.splitlines()
    assert sum("'broken' (stranger_broken:reader, from stranger 1.0)" in line for line in lines) == 1
    assert any("'failing'" in line and "OSError: no disk" in line for line in lines)
    assert len(set(lines)) == len(lines)
    assert lines[-1] == "bidnerf look: another remark"
    register("readers", "sound", Claiming())
    with pytest.warns(InputWarning):
        assert find_reader(tmp_path) is load_plugin("readers", "sound")


@pytest.mark.usefixtures("nothing_registered", "unchecked")
@pytest.mark.parametrize(
    ("opens", "ask", "found", "expected"),
    [
        (lambda: {}["poses"], open_dataset, "failed to open it: KeyError: 'poses'", None),
        (lambda: {}["poses"], open_sequence, "failed to open it: KeyError: 'poses'", None),
        (lambda: None, open_dataset, "returned a NoneType", "a Capture"),
        (lambda: None, open_sequence, "returned a NoneType", "a Capture"),
    ],
)
def test_a_reader_that_cannot_open_what_it_recognised_is_named(
    opens: Callable[[], Any], ask: Callable[[Path], Any], found: str, expected: str | None, tmp_path: Path
) -> None:
    register("readers", "stranger", Claiming(opens=opens))
    with refused(where=tmp_path, found=f"reader Claiming {found}", expected=expected):
        ask(tmp_path)


@pytest.mark.usefixtures("nothing_registered")
def test_a_registered_writer_is_chosen_by_the_ending(tmp_path: Path) -> None:
    def write(path: Path, images: Any) -> None:
        path.write_text(f"{len(images)} poses")

    register("writers", ".poses.json", write)
    write_poses(tmp_path / "a.poses.json", [])
    write_poses(tmp_path / "a.json", [])
    assert (tmp_path / "a.poses.json").read_text() == "0 poses"
    assert json.loads((tmp_path / "a.json").read_text()) == []
    with refused(where=tmp_path / "a.csv", expected=".poses.json"):
        write_poses(tmp_path / "a.csv", [])
