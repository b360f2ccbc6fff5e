"""The documentation is true: its programs run, its commands parse, its tables are complete, and it builds without a warning."""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib.util
import json
import re
import shlex
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import pytest

import bidnerf
import docs_workspace
import tiny
from bidnerf import Localization, Localizer, Map, Outcome
from bidnerf.cli import COMMANDS, main
from bidnerf.results import pose_error
from bidnerf.scenes import demo_object
from bidnerf.testing import BackendContract
from bidnerf_bid import DEPTH_RESIDUALS
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import ADVICE, METHODS, AutoConfig, Problem, settings_of
from bidnerf_core.maps import MapInfo
from bidnerf_core.registry import registered
from bidnerf_core.training import Silent
from optional import require

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

NOT_RUN: dict[tuple[str, str], str] = {
    (
        "embedding.md",
        "from bidnerf import ServiceClient",
    ): "asks a running service; tests/service/test_service.py does",
    ("maps.md", "from bidnerf import find_poses"): "needs photos that overlap, and seconds for each",
}
"""Python blocks that are not executed, by page and first line, each with the reason."""
TOO_SLOW = {
    "train",
    "poses",
    "demo",
    "evaluate",
    "compare",
    "report",
    "import",
    "serve",
    "view",
    "extend",
    "scale",
}
"""Commands that are only parsed: they take minutes, or the results of one that does, files of a plugin's, or run until stopped."""
FIRST = {("info", "MAP", "--plot", "capture.png"): ("bake", "MAP", "--data", "DATA")}
"""Commands that need another one first, whose result the page's reader has from training."""
OTHER_PROGRAMS = {"dask", "export", "git", "cd", "cp", "mv", "perl", "pytest", "curl"}
"""Programs beside bidnerf, make and pip that the documentation runs; a test follows the template's commands elsewhere."""
LANGUAGES = {"python", "sh", "toml", "bibtex", "text"}


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    line: int  # of its first line in the page


def blocks(page: Path, language: str | None = None) -> list[Block]:
    """Return the fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    found = [Block(m[1], m[2], text[: m.start(2)].count("\n") + 1) for m in FENCE.finditer(text)]
    return [block for block in found if language is None or block.language == language]


def commands(page: Path) -> Iterator[list[str]]:
    """Yield the words of each command in the page's shell blocks, without comments."""
    for block in blocks(page, "sh"):
        for line in block.text.replace("\\\n", " ").splitlines():
            for part in line.split("&&"):
                if words := shlex.split(part, comments=True):
                    yield words


def each(pages: list[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("page", pages, ids=[page.stem for page in pages])


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    docs_workspace.fill(folder)
    return folder


@pytest.fixture
def inside(workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the workspace as the current folder, so that no page depends on the files of another."""
    copy = shutil.copytree(workspace, tmp_path / "workspace")
    monkeypatch.chdir(copy)
    monkeypatch.syspath_prepend(ROOT / "plugins" / "bidnerf-ros2")  # of which a page uses the corrector
    return Path(copy)


@pytest.fixture
def quick_auto(monkeypatch: pytest.MonkeyPatch, no_processes: None) -> None:
    """Method ``auto`` with few hypotheses and one round: that it finds poses is tested elsewhere."""
    auto = METHODS["auto"]

    def quick(problem: Problem, config: AutoConfig, seed: int = 0) -> Localization:
        few = dataclasses.replace(
            config,
            points=200,
            hypotheses=8,
            rounds=1,
            refine_rays=64,
            fine_steps=1,
            fine_rays=64,
        )
        return auto.solve(problem, few, seed)

    monkeypatch.setattr("bidnerf_core.localization.by_surface.IMAGE_STAGES", ((8, 1, 2, 0.0), (8, 1, 1, 0.0)))
    monkeypatch.setitem(registered, ("methods", "auto"), dataclasses.replace(auto, solve=quick))


def names_of_reader(page: Path) -> dict[str, Any]:
    """Return what a page says that its reader has: for the loop, a sensor and its camera."""
    if page.stem != "embedding":
        return {}
    moments = [
        (v.frame.rgb, (v.frame.depth * 1000).int().numpy().astype("uint16"), SE3.identity()) for v in tiny.views(2)
    ]
    return {"sensor": moments, "camera": tiny.CAMERA}


def execute(page: Path, *containing: str) -> dict[str, Any]:
    """Run the page's Python blocks, or those that contain one of these texts, one after the other in one namespace, and return it."""
    module = ModuleType(f"docs_{page.stem.replace('-', '_')}")
    sys.modules[module.__name__] = module  # where dataclasses look for the names of annotations
    namespace = vars(module)
    namespace.update(names_of_reader(page))
    for block in blocks(page, "python"):
        if (page.name, block.text.splitlines()[0]) not in NOT_RUN and any(
            text in block.text for text in containing or [""]
        ):
            padded = "\n" * (block.line - 1) + block.text  # errors then name the line of the page
            exec(compile(padded, str(page), "exec"), namespace)
    return namespace


@each([page for page in PAGES if "```text" in page.read_text(encoding="utf-8")])
def test_outputs_on_a_page_are_worded_as_the_program_words_them(page: Path) -> None:
    """Each run of words in them, between numbers and names, is in the source of the program."""
    files = [file for package in ("bidnerf", "bidnerf_core") for file in (ROOT / package).rglob("*.py")]
    trees = (ast.walk(ast.parse(file.read_text(encoding="utf-8"))) for file in files)
    texts = (node.value for tree in trees for node in tree if isinstance(node, ast.Constant))
    program = "\n".join(" ".join(text.split()) for text in texts if isinstance(text, str))
    outputs = [block.text for block in blocks(page, "text") if not block.text.startswith("bidnerf")]
    phrases = re.split(r"\S*[\d_=/]\S*|[:;,()\n]|\.\.\.", "\n".join(outputs))
    runs = [phrase.split() for phrase in phrases if len(phrase.split()) > 1]

    def is_known(words: list[str]) -> bool:
        """Return whether the program has these words in one text or, where it inserts a name or a number of things, in two."""
        halves = ((" ".join(words[:n]), " ".join(words[n:])) for n in range(len(words)))
        return any(first in program and second in program for first, second in halves)

    assert [words for words in runs if not is_known(words)] == []


@pytest.mark.slow
@each([page for page in PAGES if blocks(page, "python")])
@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.usefixtures("quick_auto")
def test_python_blocks_run(page: Path, inside: Path) -> None:
    with patch.dict(DEPTH_RESIDUALS), patch.dict(registered):  # what a page registers ends with it
        execute(page)


def test_blocks_are_of_known_languages_and_those_that_are_not_run_exist() -> None:
    every = [(page.name, block) for page in PAGES for block in blocks(page)]
    assert [(name, block.language) for name, block in every if block.language not in LANGUAGES] == []
    assert set(NOT_RUN) <= {(name, block.text.splitlines()[0]) for name, block in every if block.language == "python"}
    assert all(tomllib.loads(block.text) for _, block in every if block.language == "toml")


@pytest.mark.slow
@each([page for page in PAGES if any(words[0] == "bidnerf" for words in commands(page))])
@pytest.mark.usefixtures("quick_auto")
def test_bidnerf_commands_work(page: Path, inside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that are quick are run on tiny files; the others are parsed."""
    for program, *words in commands(page):
        arguments = ["hashgrid" if word == "mine" else word for word in words]  # instead of the reader's own backend
        if program == "bidnerf":
            with monkeypatch.context() as patch:
                if arguments[0] in TOO_SLOW:
                    parser = importlib.import_module("bidnerf.cli.parser")
                    patch.setattr(parser, "parse", parsed_only(parser.parse))
                for command in (FIRST.get(tuple(arguments)), arguments):
                    assert command is None or main([*command]) == 0, shlex.join([program, *command])


def parsed_only(parse: Callable[..., Any]) -> Callable[..., None]:
    """Return a function that parses the arguments of a command, and ends it."""

    def parsed(command: str, target: Any, arguments: list[str]) -> None:
        parse(command, functools.wraps(target)(lambda **_: None), arguments)
        raise SystemExit(0)

    return parsed


def test_other_commands_name_what_exists() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    unknown = [f"{page.name}: {shlex.join(c)}" for page in PAGES for c in commands(page) if not exists(c, targets)]
    assert unknown == []


def exists(command: list[str], targets: set[str]) -> bool:
    """Return whether a command of the documentation names a target, an extra or a file that there is."""
    program, *arguments = command
    if program == "make":
        return set(arguments) <= targets
    if program == "pip":
        extras = ",".join(re.findall(r"\[([\w,]+)\]", " ".join(arguments))).split(",")
        return {*extras} <= {"", *PROJECT["optional-dependencies"], "test"}
    if program == "cp":
        return (ROOT / arguments[1]).exists()
    if program == "python":
        return (ROOT / arguments[0]).is_file()
    return program in {"bidnerf", *OTHER_PROGRAMS}


@pytest.mark.slow
@pytest.mark.usefixtures("quick_auto")
def test_the_backend_of_the_documentation_trains_and_localizes(inside: Path) -> None:
    namespace = execute(ROOT / "docs" / "extend.md", "backend = Fog()")
    field = next(block for block in blocks(ROOT / "README.md", "python") if "FogField" in block.text)
    assert field.text.partition("def query")[2].split("\n", 1)[1].strip() in (ROOT / "docs" / "extend.md").read_text()
    backend, scene, views = namespace["backend"], demo_object(), tiny.views(16)
    config = namespace["FogConfig"](cells=24, steps=120)
    field = backend.build(config, scene.bounds)
    backend.train(field, views, config, Silent())
    stored = Map(MapInfo("fog", {}, scene.bounds, config.steps, complete=True), field.requires_grad_(False))
    (unseen,) = tiny.views(1, seed=5)
    start = perturb(unseen.T_ref_camera, 0.3, 8.0, seed=0)
    settings = settings_of("bid", {"rays": 512, "max_steps": 80})
    found = Localizer(stored, "bid", settings)(unseen.frame, start)
    before, after = (float(pose_error(T, unseen.T_ref_camera).translation) for T in (start, found.T_world_camera))
    assert after < 0.5 * before


PAGE = execute(ROOT / "docs" / "extend.md", "backend = Fog()", "Mlp")


@pytest.mark.slow
class TestFog(BackendContract):
    """The first backend of the documentation, as it stands there, keeps the contract."""

    backend, config = PAGE["backend"], PAGE["FogConfig"](cells=16, steps=40)


@pytest.mark.slow
class TestMlp(PAGE["TestMlp"]):  # type: ignore[misc]
    """So does the second one, with the test and the config of the documentation."""


def test_readme_is_short() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 120
    assert max(map(len, text.splitlines())) <= 140
    assert len(re.findall(r"[^\s|]*\w[^\s|]*", text)) <= 900
    assert len(blocks(ROOT / "README.md", "python")[0].text.splitlines()) <= 8


def test_the_modules_of_the_table_of_methods_exist() -> None:
    section = (ROOT / "docs" / "methods.md").read_text().partition("{ #code }")[2].partition("\n## ")[0]
    names = re.findall(r"`([a-z_/]+(?:\.py|/))`", section)
    assert len(names) > 10
    folders = (ROOT, ROOT / "bidnerf_core", ROOT / "bidnerf_core" / "localization")
    assert [name for name in names if not any((folder / name).exists() for folder in folders)] == []


@each([*PAGES, ROOT / "benchmarks" / "results" / "README.md"])
def test_links_of_pages_lead_somewhere_in_the_repository(page: Path) -> None:
    targets = re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text())
    assert [target for target in targets if not (page.parent / target).exists()] == []


def test_every_outcome_has_advice_in_the_words_of_the_code() -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text()
    assert {*Outcome} - {Outcome.CONVERGED} == {*ADVICE}
    for outcome, advice in ADVICE.items():
        section = " ".join(text.partition(f"\n### {outcome}\n")[2].partition("\n##")[0].split())
        assert advice.first in section, outcome
        assert advice.meaning.rstrip(".") in section, outcome


def test_commands_and_methods_are_documented() -> None:
    table = set(re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "reference.md").read_text(), re.MULTILINE))
    assert set(COMMANDS) <= table
    methods = (ROOT / "docs" / "methods.md").read_text()
    assert [name for name in METHODS if f"<!-- settings of {name} -->" not in methods] == []


@pytest.fixture(scope="module")
def tables() -> Any:
    """The module that makes tables from records; the documentation's folder is no package."""
    spec = require(importlib.util.spec_from_file_location("docs_tables", ROOT / "docs" / "tables.py"))
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    require(spec.loader).exec_module(module)
    return module


def test_tables_are_those_of_the_records(tables: Any) -> None:
    outdated = [page.name for page in tables.PAGES if tables.render_page(page.read_text()) != page.read_text()]
    assert outdated == [], "run python docs/tables.py"


def test_every_table_is_on_a_page(tables: Any) -> None:
    shown = {found[2] for page in tables.PAGES for found in tables.BLOCK.finditer(page.read_text())}
    assert shown == set(tables.TABLES)


def test_every_record_is_among_all_measurements(tables: Any) -> None:
    page = tables.MEASUREMENTS.read_text()
    assert {path.stem for path in tables.RECORDS.glob("*.json")} == {*re.findall(r"^## (\w+)$", page, re.MULTILINE)}
    assert "| Lego, RGB, all | 25 |" in page.partition("## answers_unchanged\n")[2].partition("\n## ")[0]


def test_tables_follow_their_records(tables: Any, tmp_path: Path) -> None:
    record = json.loads((tables.RECORDS / "landmark_peers.json").read_text())
    record["results"]["scenes"]["room_living"]["RGB"]["peers"]["auto"]["accepted"] = 17
    (tmp_path / "landmark_peers.json").write_text(json.dumps(record))
    for other in tables.RECORDS.glob("*.json"):
        if not (tmp_path / other.name).exists():
            (tmp_path / other.name).symlink_to(other)
    page = (ROOT / "README.md").read_text()
    (changed,) = set(tables.render_page(page, tmp_path).splitlines()) - set(page.splitlines())
    assert changed.startswith("| room | RGB | `auto` |")
    assert "| 17, 0 wrong |" in changed


@pytest.mark.slow
def test_site_builds_strictly_and_needs_no_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In this process, which has imported what the pages describe."""
    program = pytest.importorskip("mkdocs.__main__", reason="the documentation's tools are not installed")
    monkeypatch.chdir(ROOT)
    # Not with --quiet, which drops the warnings before they are counted.
    with pytest.raises(SystemExit) as ended:
        program.cli(["build", "--strict", "--site-dir", str(tmp_path / "site")])
    assert ended.value.code == 0, capfd.readouterr()
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) >= len(PAGES)
    fetched = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=\"?(?:https?:)?//[^\s\">]+")
    assert {hit for page in pages for hit in fetched.findall(page.read_text())} == set()
    methods = (tmp_path / "site" / "methods.html").read_text()
    assert "<!-- settings of" not in methods
    assert "<code>fused_rays</code>" in methods
    reference = (tmp_path / "site" / "reference.html").read_text()
    described = set(re.findall(r'id="bidnerf(?:_core)?\.\w+\.(\w+)"', reference))
    names = {name for name in bidnerf.__all__ if not isinstance(getattr(bidnerf, name), ModuleType)}
    assert sorted(names - described) == []
