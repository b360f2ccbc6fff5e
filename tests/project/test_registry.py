"""Backends are found by name, listed without being imported, and refused with the culprit's name."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bidnerf_core.backend import Backend, load_backend
from bidnerf_core.cli import _warnings_as_lines
from bidnerf_core.datasets import Dataset, Reader, ReadOptions, find_reader, open_dataset, open_sequence
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.localization import find_method
from bidnerf_core.mapping import find_features
from bidnerf_core.mapping.landmarks.features import FEATURES
from bidnerf_core.registry import (
    GROUPS,
    ONLY_STRANGERS,
    UNREADABLE,
    PluginError,
    PluginInfo,
    list_plugins,
    load_plugin,
    register,
)
from bidnerf_core.results import write_poses

GOOD = '''"""A field of {word}.

More of it.
"""
from dataclasses import dataclass

@dataclass(frozen=True)
class Config:
    size: int = 1
    parts: tuple = ()

class Kind:
    summary = "a field of {word}"
    config_type = Config
    def build(self, config, bounds): ...
    def train(self, field, views, config, report): ...

backend = Kind()
'''


class Site:
    """A folder on ``sys.path`` to which throw-away distributions are installed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def module(self, path: str, source: str) -> None:
        file = self.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source, encoding="utf-8")

    def metadata(self, name: str, version: str, points: str, summary: str = "Made for a test") -> Path:
        """A distribution with the given text of ``entry_points.txt``."""
        info = self.folder / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir(parents=True)
        header = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nSummary: {summary}\n"
        (info / "METADATA").write_text(header, encoding="utf-8")
        (info / "entry_points.txt").write_text(points, encoding="utf-8")
        return info

    def plugin(self, name: str, value: str, dist: str = "stranger", version: str = "1.0") -> None:
        self.metadata(dist, version, f"[bidnerf.backends]\n{name} = {value}\n")


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
    for name in set(sys.modules) - before:
        if name.startswith("stranger"):
            del sys.modules[name]


@pytest.fixture
def site(new_site: Callable[[str], Site]) -> Site:
    return new_site("site")


def listed(name: str) -> list[PluginInfo]:
    return [info for info in list_plugins("backends") if info.name == name]


def refusal(name: str) -> str:
    with pytest.raises(PluginError) as caught:
        load_backend(name)
    assert isinstance(caught.value, InputError)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_strangers_backend_is_listed_and_loaded(site: Site) -> None:
    site.module("stranger_fog.py", GOOD.format(word="fog"))
    site.plugin("fog", "stranger_fog:backend", version="2.3")
    assert listed("fog") == [
        PluginInfo("backends", "fog", "stranger_fog:backend", "stranger", "2.3", "A field of fog.")
    ]
    backend = load_backend("fog")
    assert isinstance(backend, Backend)
    assert backend.summary == "a field of fog"


@pytest.mark.parametrize(
    "value", ["stranger_pkg.sub.kind:backend", "stranger_pkg.sub.kind:Holder.backend [fast]"]
)
def test_an_object_may_lie_deep(site: Site, value: str) -> None:
    for package in ("stranger_pkg", "stranger_pkg/sub"):
        site.module(f"{package}/__init__.py", "")
    site.module("stranger_pkg/sub/kind.py", GOOD.format(word="fog") + "class Holder:\n    backend = Kind()\n")
    site.plugin("deep", value)
    (info,) = listed("deep")
    assert (info.summary, info.fault) == ("A field of fog.", None)
    assert "stranger_pkg" not in sys.modules
    assert isinstance(load_backend("deep"), Backend)


def test_a_module_may_itself_be_the_backend(site: Site) -> None:
    lines = ["from dataclasses import make_dataclass", "summary = 'a module'"]
    lines += ["config_type = make_dataclass('Config', [], frozen=True)"]
    lines += ["def build(config, bounds): ...", "def train(field, views, config, report): ..."]
    site.module("stranger_module.py", "\n".join(lines))
    site.plugin("module", "stranger_module")
    assert load_backend("module").summary == "a module"


@pytest.mark.parametrize("source", ["", "x = 1\n", "def broken(:\n", "'''  '''\n", "\0"])
def test_without_a_docstring_the_distribution_speaks(site: Site, source: str) -> None:
    site.module("stranger_silent.py", source)
    site.plugin("silent", "stranger_silent:backend")
    assert listed("silent")[0].summary == "Made for a test"


def test_listing_imports_nothing(site: Site) -> None:
    """The listing runs in a process of its own, where an import of any of the modules would show, whether it fails or not."""
    site.module("stranger_loud/__init__.py", "raise SystemExit('imported')")
    site.module("stranger_loud/kind.py", GOOD.format(word="noise"))
    site.plugin("loud", "stranger_loud.kind:backend")
    program = (
        "import json, sys\n"
        "from bidnerf_core.registry import list_plugins\n"
        "infos = {i.name: i.summary for i in list_plugins('backends')}\n"
        "foreign = [m for m in sys.modules if m.startswith(('stranger', 'bidnerf_')) and 'core' not in m]\n"
        "print(json.dumps([infos, foreign]))"
    )
    path = os.pathsep.join([str(site.folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    infos, foreign = json.loads(done.stdout)
    assert infos["loud"] == "A field of noise."
    assert "hashgrid" in infos
    assert foreign == []


def test_the_bundled_backends_come_through_the_same_door() -> None:
    (info,) = listed("hashgrid")
    assert (info.value, info.distribution, info.fault) == ("bidnerf_hashgrid:backend", "bidnerf", None)
    assert info.summary
    assert isinstance(load_backend("hashgrid"), Backend)


def test_an_unknown_name_gets_the_nearest_and_the_installed(site: Site) -> None:
    site.plugin("fog", "stranger_fog:backend")
    message = refusal("hash-grid")
    assert "no backend 'hash-grid'" in message
    assert "did you mean 'hashgrid'?" in message
    assert re.search(r"installed: .*\bfog, .*hashgrid", message)
    assert "did you mean" not in refusal("zzz")


@pytest.mark.parametrize(
    ("source", "causes"),
    [
        ("raise RuntimeError('no driver')", ["RuntimeError", "no driver"]),
        ("import stranger_missing", ["ModuleNotFoundError", "stranger_missing"]),
        ("raise SystemExit(3)", ["SystemExit", "3"]),
        ("def broken(:\n", ["SyntaxError"]),
    ],
)
def test_a_module_that_does_not_import_is_told_with_its_cause(
    site: Site, source: str, causes: list[str]
) -> None:
    site.module("stranger_broken.py", source)
    site.plugin("broken", "stranger_broken:backend", dist="stranger-broken", version="0.7")
    assert listed("broken")[0].fault is None  # its fault surfaces when it is asked for, and only then
    message = refusal("broken")
    for part in ["'broken'", "stranger_broken:backend", "stranger-broken 0.7", *causes]:
        assert part in message
    with pytest.raises(PluginError) as caught:
        load_backend("broken")
    assert caught.value.__cause__ is not None


def test_a_missing_object_is_told(site: Site) -> None:
    site.module("stranger_fog.py", GOOD.format(word="fog"))
    site.plugin("fog", "stranger_fog:bakend")
    assert "no attribute 'bakend'" in refusal("fog")


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
        ('summary = "a field of fog"', "summary = 3", "summary is 3, expected text"),
        ("config_type = Config", "config_type = dict", "expected a frozen dataclass"),
        ("config_type = Config", "config_type = Config()", "expected a frozen dataclass"),
        ("@dataclass(frozen=True)", "@dataclass", "config_type Config is a dataclass that is not frozen"),
        ("size: int = 1", "size: int", "config_type Config has no default for size"),
        ("self, config, bounds", "self, config", "build does not take (config, bounds)"),
        ("self, field, views, config, report", "self", "train does not take (field, views, config, report)"),
        ("def build(self, config, bounds): ...", "build = 1", "build does not take (config, bounds)"),
        ("config_type = Config", "config_type = property(lambda self: 1 // 0)", "ZeroDivisionError"),
    ],
)
def test_an_object_that_is_no_backend_is_told_what_it_lacks(
    site: Site, old: str, new: str, expected: str
) -> None:
    source = GOOD.format(word="fog")
    assert old in source
    site.module("stranger_fog.py", source.replace(old, new))
    site.plugin("fog", "stranger_fog:backend")
    message = refusal("fog")
    assert message.startswith("backend 'fog' (stranger_fog:backend, from stranger 1.0): not a backend: ")
    assert expected in message


def test_a_name_claimed_twice_is_nobodys(site: Site) -> None:
    site.module("stranger_fog.py", GOOD.format(word="fog"))
    site.plugin("fog", "stranger_fog:backend", dist="stranger-one")
    site.plugin("fog", "stranger_fog:backend", dist="stranger-two", version="4.0")
    assert [info.distribution for info in listed("fog")] == ["stranger-one", "stranger-two"]
    assert all("also claimed by" in (info.fault or "") for info in listed("fog"))
    message = refusal("fog")
    assert "stranger-one 1.0" in message
    assert "stranger-two 4.0" in message
    assert "stranger_fog" not in sys.modules


def test_of_two_versions_the_first_on_the_path_wins_as_for_import(new_site: Callable[[str], Site]) -> None:
    new_site("later").plugin("fog", "stranger_old:backend", dist="Stranger.Fog", version="1.0")
    first = new_site("first")
    first.module("stranger_new.py", GOOD.format(word="fog"))
    first.plugin("fog", "stranger_new:backend", dist="stranger-fog", version="2.0")
    (info,) = listed("fog")
    assert (info.value, info.version) == ("stranger_new:backend", "2.0")
    assert isinstance(load_backend("fog"), Backend)


def test_an_entry_point_that_only_a_hidden_version_has_is_not_offered(
    new_site: Callable[[str], Site],
) -> None:
    new_site("later").plugin("fog", "stranger_old:backend", version="1.0")
    new_site("first").metadata("stranger", "2.0", "")
    assert listed("fog") == []


def test_a_folder_that_is_on_the_path_twice_hides_nothing(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.module("stranger_fog.py", GOOD.format(word="fog"))
    site.plugin("fog", "stranger_fog:backend")
    monkeypatch.setattr(sys, "path", [str(site.folder), *sys.path])
    (info,) = listed("fog")
    assert info.fault is None


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ("not a module!", "'module:object'"),
        ("stranger_absent:backend", "module 'stranger_absent' is not installed"),
        ("stranger_absent.sub:backend", "module 'stranger_absent.sub' is not installed"),
        ("json.stranger:backend", "module 'json.stranger' is not installed"),
        ("sys.stranger:backend", "module 'sys.stranger' is not installed"),
        ("sys.json:backend", "module 'sys.json' is not installed"),
    ],
)
def test_a_value_that_leads_nowhere_is_a_fault_of_that_backend_alone(
    site: Site, value: str, fault: str
) -> None:
    site.plugin("nowhere", value)
    assert fault in (listed("nowhere")[0].fault or "")
    assert fault in refusal("nowhere")
    assert listed("hashgrid")[0].fault is None


@pytest.mark.parametrize("text", ["[console_scripts]\nnonsense\n", "nonsense\n[", "\udcff"])
def test_malformed_metadata_of_others_breaks_nothing(site: Site, text: str) -> None:
    info = site.metadata("unrelated", "1.0", "")
    (info / "entry_points.txt").write_bytes(text.encode("utf-8", "surrogateescape"))
    (site.folder / "nameless-1.0.dist-info").mkdir()
    (site.folder / "garbage-1.0.dist-info").mkdir()
    (site.folder / "garbage-1.0.dist-info" / "METADATA").write_bytes(b"\xff\xfe\x00")
    (site.folder / "odd.egg-info").write_text("Name")
    assert listed("hashgrid")[0].fault is None
    assert isinstance(load_backend("hashgrid"), Backend)
    assert listed(UNREADABLE) == []


def test_malformed_metadata_that_names_our_group_is_reported(site: Site) -> None:
    site.metadata("stranger-fog", "1.0", "[bidnerf.backends]\nfog\n")
    (info,) = listed(UNREADABLE)
    assert info.distribution == "stranger-fog"
    assert "entry_points.txt cannot be read" in (info.fault or "")
    assert "stranger-fog 1.0" in refusal("fog")
    assert "no backend" in refusal(UNREADABLE)
    assert listed("hashgrid")[0].fault is None


def test_distributions_without_a_name_do_not_hide_each_other(site: Site) -> None:
    site.module("stranger_fog.py", GOOD.format(word="fog"))
    for name in ("fog", "mist"):
        points = f"[bidnerf.backends]\n{name} = stranger_fog:backend\n"
        site.module(f"{name}-1.0.dist-info/entry_points.txt", points)
    assert all("unnamed distribution" in listed(name)[0].distribution for name in ("fog", "mist"))
    assert isinstance(load_backend("mist"), Backend)


def test_a_distribution_installed_by_pip_is_found(new_site: Callable[[str], Site], tmp_path: Path) -> None:
    project = Site(tmp_path / "project")
    project.module("stranger_real/__init__.py", GOOD.format(word="stone"))
    project.module(
        "pyproject.toml",
        '[build-system]\nrequires = ["hatchling"]\nbuild-backend = "hatchling.build"\n'
        '[project]\nname = "stranger-real"\nversion = "3.1"\n'
        '[project.entry-points."bidnerf.backends"]\nstone = "stranger_real:backend"\n',
    )
    target = new_site("installed").folder
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    subprocess.run([*pip, "--target", str(target), str(project.folder)], check=True, stdin=subprocess.DEVNULL)
    (info,) = listed("stone")
    assert (info.distribution, info.version, info.summary) == ("stranger-real", "3.1", "A field of stone.")
    assert load_backend("stone").summary == "a field of stone"


def test_the_backport_may_answer_in_place_of_the_library() -> None:
    """Some packages import ``importlib_metadata``, which then finds all distributions, with classes of its own."""
    pytest.importorskip("importlib_metadata")
    code = (
        "import importlib_metadata, bidnerf_core as bn; print(*(b.name for b in bn.list_plugins('backends')))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert {"adanerf", "hashgrid", "vanilla"} <= set(shown.split())


every_group = pytest.mark.parametrize("group", GROUPS)
with_bundled = pytest.mark.parametrize("group", [group for group in GROUPS if group not in ONLY_STRANGERS])
ANYTHING = '"""Something that is registered."""\n\nthing = object()\n'


@every_group
def test_every_group_is_listed_and_loaded_alike(site: Site, group: str) -> None:
    site.module("stranger_thing.py", ANYTHING)
    site.metadata("stranger", "1.0", f"[bidnerf.{group}]\nthing = stranger_thing:thing\n")
    (info,) = [info for info in list_plugins(group) if info.name == "thing"]
    assert (info.summary, info.fault) == ("Something that is registered.", None)
    assert "stranger_thing" not in sys.modules
    assert type(load_plugin(group, "thing")) is object


@with_bundled
def test_bundled_plugins_are_registered_as_a_strangers_are(group: str) -> None:
    infos = [info for info in list_plugins(group) if info.is_bundled]
    assert infos
    for info in infos:
        assert (info.fault, info.distribution) == (None, "bidnerf")
        assert info.summary
        assert load_plugin(group, info.name) is not None


@with_bundled
def test_who_takes_a_bundled_name_is_refused_by_both_names(site: Site, group: str) -> None:
    bundled = next(info.name for info in list_plugins(group) if info.is_bundled)
    site.module("stranger_thing.py", ANYTHING)
    site.metadata("stranger", "1.0", f"[bidnerf.{group}]\n{bundled} = stranger_thing:thing\n")
    with pytest.raises(PluginError) as caught:
        load_plugin(group, bundled)
    assert re.search(r"\bbidnerf \d", str(caught.value))
    assert "stranger 1.0" in str(caught.value)
    assert "stranger_thing" not in sys.modules


@every_group
def test_a_broken_plugin_names_itself_and_the_cause(site: Site, group: str) -> None:
    site.module("stranger_broken.py", "raise RuntimeError('no driver')")
    site.metadata("stranger", "1.0", f"[bidnerf.{group}]\nbroken = stranger_broken:thing\n")
    with pytest.raises(PluginError, match=r"'broken' .*stranger_broken:thing, from stranger 1\.0.*no driver"):
        load_plugin(group, "broken")


@pytest.mark.parametrize("kind", ["SystemExit", "GeneratorExit", "type('Odd', (BaseException,), {})"])
def test_whatever_an_import_raises_is_an_error_of_that_plugin(site: Site, kind: str) -> None:
    site.module("stranger_rude.py", f"raise ({kind})('goodbye')")
    site.plugin("rude", "stranger_rude:backend")
    assert "goodbye" in refusal("rude")


def test_ctrl_c_during_an_import_stays_an_interruption(site: Site) -> None:
    site.module("stranger_slow.py", "raise KeyboardInterrupt")
    site.plugin("slow", "stranger_slow:backend")
    with pytest.raises(KeyboardInterrupt):
        load_backend("slow")


@pytest.fixture
def nothing_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.registry.registered", {})


@pytest.mark.usefixtures("nothing_registered")
def test_a_script_registers_what_it_has() -> None:
    detector = find_features("sift")
    register("features", "mine", detector)
    assert find_features("mine") is detector
    (info,) = [info for info in list_plugins("features") if info.name == "mine"]
    assert str(info) == "detector 'mine' (Sift, registered in this process)"
    assert "mine" in FEATURES
    register("features", "mine", detector)  # the same cell of a notebook, run again


@pytest.mark.usefixtures("nothing_registered")
def test_a_taken_name_is_replaced_on_purpose_only() -> None:
    mine = replace(find_method("auto"), summary="mine")
    with pytest.raises(InputError, match=r"taken by method 'auto' .* from bidnerf .* replace=True"):
        register("methods", "auto", mine)
    register("methods", "auto", mine, replace=True)
    assert find_method("auto") is mine
    assert [info.summary for info in list_plugins("methods") if info.name == "auto"] == ["mine"]
    with pytest.raises(InputError, match="registered in this process"):
        register("methods", "auto", replace(mine, summary="another"))


@pytest.mark.usefixtures("nothing_registered")
def test_what_is_registered_is_checked_when_it_is_asked_for() -> None:
    register("methods", "three", 3)
    with pytest.raises(
        PluginError, match=r"method 'three' \(int, registered .*\): not a method: it is a int"
    ):
        find_method("three")


@pytest.mark.parametrize(
    ("group", "name", "says"),
    [
        ("method", "mine", r"no group of plugins 'method', did you mean 'methods'\?"),
        ("methods", "a b", "name is 'a b', expected letters"),
        ("methods", "", "name is '', expected letters"),
        ("methods", 3, "name is 3, expected letters"),
    ],
)
def test_an_unusable_registration_is_refused(group: str, name: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        register(group, name, object())


def test_summaries_come_from_what_the_entry_point_names(site: Site) -> None:
    source = '"""A module."""\n\ndef f():\n    """A function.\n\n    More."""\n\n\nclass C:\n    """A class."""\n\n\nmade = C()\n"""Made."""\n'
    site.module("stranger_four.py", source + "called = C(summary='called')\nbare = C()\n")
    points = "\n".join(f"{name} = stranger_four:{name}" for name in ("f", "C", "made", "called", "bare"))
    site.metadata("stranger", "1.0", f"[bidnerf.faults]\n{points}\n")
    found = {i.name: i.summary for i in list_plugins("faults") if i.distribution == "stranger"}
    assert found == {
        "f": "A function.",
        "C": "A class.",
        "made": "Made.",
        "called": "called",
        "bare": "A module.",
    }


def test_metadata_without_the_bundled_plugins_is_to_be_renewed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.registry._declared", lambda group: ())
    with pytest.raises(PluginError, match="lists no methods; reinstall bidnerf"):
        find_method("auto")


class Claiming(Reader):
    """A reader that claims every folder, or fails at it."""

    expected = "anything"

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error

    def recognises(self, path: Path) -> bool:
        if self.error is not None:
            raise self.error
        return True

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        raise NotImplementedError


@pytest.mark.usefixtures("nothing_registered")
def test_two_readers_that_claim_a_folder_are_named(tmp_path: Path) -> None:
    register("readers", "first", Claiming())
    assert find_reader(tmp_path) is load_plugin("readers", "first")
    register("readers", "second", Claiming())
    with pytest.raises(InputError, match="is recognized by the readers first and second"):
        find_reader(tmp_path)


@pytest.mark.usefixtures("nothing_registered")
def test_bundled_readers_come_before_others(tmp_path: Path) -> None:
    register("readers", "first", Claiming(RuntimeError("must not be asked")))
    (tmp_path / "transforms.json").write_text("{}")
    assert find_reader(tmp_path) is load_plugin("readers", "transforms")


@pytest.mark.usefixtures("nothing_registered")
def test_a_reader_that_fails_is_named_and_passed_over(site: Site, tmp_path: Path) -> None:
    site.module("stranger_broken.py", "raise RuntimeError('no driver')")
    site.metadata("stranger", "1.0", "[bidnerf.readers]\nbroken = stranger_broken:reader\n")
    register("readers", "failing", Claiming(OSError("no disk")))
    with pytest.warns(InputWarning) as told:
        assert find_reader(tmp_path) is None
    said = " ".join(str(warning.message) for warning in told)
    assert "reader 'failing' failed to examine it: OSError: no disk" in said
    assert "reader 'broken' (stranger_broken:reader, from stranger 1.0): cannot be imported" in said
    register("readers", "sound", Claiming())
    with pytest.warns(InputWarning):
        assert find_reader(tmp_path) is load_plugin("readers", "sound")


@pytest.mark.usefixtures("nothing_registered")
def test_a_command_reports_a_broken_plugin_once(
    site: Site, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site.module("stranger_broken.py", "raise RuntimeError('no driver')")
    site.metadata("stranger", "1.0", "[bidnerf.readers]\nbroken = stranger_broken:reader\n")
    with _warnings_as_lines("bidnerf localize"):
        for name in ("first", "second", "third"):
            (tmp_path / name).mkdir()
            assert find_reader(tmp_path / name) is None
        warnings.warn("another remark", InputWarning, stacklevel=1)
    told = capsys.readouterr().err.splitlines()
    assert (
        sum("reader 'broken' (stranger_broken:reader, from stranger 1.0): cannot be" in line for line in told)
        == 1
    )
    assert len(set(told)) == len(told)
    assert told[-1] == "bidnerf localize: another remark"


@pytest.mark.usefixtures("nothing_registered", "unchecked")
@pytest.mark.parametrize(
    ("opens", "said"),
    [
        (lambda: {}["poses"], "failed to open it: KeyError: 'poses'"),
        (lambda: None, "(returned a NoneType, expected a Dataset|failed to open it: AttributeError)"),
    ],
)
def test_a_reader_that_cannot_open_what_it_recognised_is_named(
    opens: Callable[[], Any], said: str, tmp_path: Path
) -> None:
    class Stranger(Reader):
        expected = "anything"

        def recognises(self, path: Path) -> bool:
            return True

        def open(self, path: Path, options: ReadOptions) -> Any:
            return opens()

    register("readers", "stranger", Stranger())
    for ask in (open_dataset, open_sequence):
        with pytest.raises(InputError, match=f"{tmp_path}: reader Stranger {said}"):
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
    with pytest.raises(InputError, match=r"expected a name that ends with .*\.poses\.json"):
        write_poses(tmp_path / "a.csv", [])
