"""Help pages and refusals of arguments: every option has its own description, pages fit the terminal and take no time."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pytest

# Inside: the parser alone, and the options of all commands by name
from bidnerf.cli import COMMANDS, parser
from bidnerf.cli.parameters import FLAG, Group, Option, SettingsGroup, Without
from bidnerf.cli.parser import parse
from bidnerf.evaluation import PROTOCOLS
from bidnerf_core.errors import UsageError
from bidnerf_core.localization import METHODS
from bidnerf_core.registry import PluginInfo, list_plugins
from bidnerf_core.settings import EXPERT, Settings
from commands import Run, assert_refused

if TYPE_CHECKING:
    from decimal import Decimal

CHOICES = {
    "train": [["--backend", info.name] for info in list_plugins("backends") if info.distribution == "bidnerf"],
    "localize": [["--method", name] for name in METHODS],
    "compare": [["--method", "bid"]],
}
"""Options on which other options depend; settings of a method are the same in each command that takes one."""
PAGES = pytest.mark.parametrize(
    "words", [[c, *choice] for c in COMMANDS for choice in CHOICES.get(c, [[]])], ids=" ".join
)
NO_BEGINNING = {
    "about",
    "among",
    "and",
    "as",
    "at",
    "between",
    "by",
    "for",
    "from",
    "in",
    "of",
    "on",
    "or",
    "over",
    "per",
    "than",
    "that",
    "to",
    "which",
    "with",
    "within",
    "without",
    "...",
}
"""Words with which a description does not begin: it would go on with the option's name."""


@PAGES
def test_every_option_has_a_help_text_of_its_own(
    words: list[str], bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = dict[str, str]()
    add = parser._Parser.add_argument

    def add_and_keep(self: Any, name: str, *rest: Any, **more: Any) -> Any:
        texts[name] = more["help"]
        return add(self, name, *rest, **more)

    monkeypatch.setattr(parser._Parser, "add_argument", add_and_keep)
    monkeypatch.setattr(parser.argparse._ArgumentGroup, "add_argument", add_and_keep)
    assert bidnerf(*words, "--help-all").status == 0
    for name in ("-h", "--help", "--help-all"):  # not shown
        texts.pop(name)
    assert texts
    for name, text in texts.items():
        assert len(text.split()) > 1, f"{name}: {text!r}"
        assert text.split()[0].lower() not in NO_BEGINNING, f"{name}: {text!r}"
        assert text.count("(") == text.count(")"), f"{name}: {text!r}"
    described = Counter(text.partition(" (default")[0] for text in texts.values())
    assert [text for text, times in described.items() if times > 1] == []


def test_the_help_of_a_setting_is_that_beside_it(bidnerf: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    page = {line.split()[0]: line for line in bidnerf("train", "--help-all").out.splitlines() if "--" in line}
    assert "weight of depth" in page["--depth-weight"]
    assert "weight of depth" not in page["--distortion-weight"]
    assert "--carve, --no-carve" in page["--carve,"]


@PAGES
def test_pages_fit_the_terminal(words: list[str], bidnerf: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for columns, option in ((80, "--help-all"), (120, "--help")):
        monkeypatch.setenv("COLUMNS", str(columns))
        status, page, err = bidnerf(*words, option)
        assert (status, err) == (0, "")
        assert page.startswith(f"usage: bidnerf {words[0]} ")
        assert "``" not in page
        assert "PATH" not in page
        assert max(map(len, page.splitlines())) <= columns
        assert option == "--help-all" or page.count("\n") < 80


MOST = 170
"""Largest number of arguments on all pages of ``--help``; what is rarely needed belongs on those of ``--help-all``."""


def test_help_is_short_and_describes_groups_in_sentences_for_users(bidnerf: Run) -> None:
    arguments = 0
    for command in (name for name in COMMANDS if COMMANDS[name].__module__.startswith("bidnerf.")):
        page = bidnerf(command, "--help").out
        arguments += len(re.findall(r"^  (?:-|\[?[A-Z]{2})", page, re.MULTILINE))
        for title, text in re.findall(r"^([a-z].*):\n  (.*(?:\n  \S.*)*)\n", page, re.MULTILINE):
            if title in ("arguments", "options"):
                continue
            assert re.fullmatch(r"[A-Z][^:]*\.", text), (command, title, text)
            assert "option" not in text.lower(), (command, title, text)
    assert 100 < arguments <= MOST


def test_help_names_what_is_installed(bidnerf: Run) -> None:
    page = " ".join(bidnerf("evaluate", "--help").out.split())
    assert page.partition("how starts are chosen: ")[2].startswith(
        f"{', '.join([*PROTOCOLS][:-1])} or {[*PROTOCOLS][-1]} "
    )
    for words, group in (("localize", "writers"), ("track", "writers"), ("export", "exporters")):
        page = " ".join(bidnerf(words, "--help").out.split())
        assert ", ".join(info.name for info in list_plugins(group)) in page
    presets = "; ".join(f"{name}: {', '.join(METHODS.load(name).presets)}" for name in ("bid", "inerf"))
    assert f"settings to begin with; {presets} (" in " ".join(bidnerf("localize", "--help-all").out.split())


WRITTEN = {"--out", "--data"}
"""Options whose placeholder says what the command writes, or how many it reads."""
WITHOUT = {
    "--json": {"completion", "demo", "report", "serve", "view"},  # whose result is a page, a service or pictures
    "--device": {
        "backends",
        "completion",
        "demo",
        "doctor",
        "export",
        "info",
        "plugins",
        "poses",
        "report",
        "scale",
    },  # which compute no field
    "--overwrite": {
        "backends",
        "bake",
        "completion",
        "doctor",
        "evaluate",
        "extend",
        "plugins",
        "report",
        "serve",
    },  # which go on, or add
}


def test_an_option_means_one_thing_and_is_wherever_it_makes_sense() -> None:
    bundled = [name for name in COMMANDS if COMMANDS[name].__module__.startswith("bidnerf.")]
    meanings, commands = dict[str, set[Any]](), dict[str, set[str]]()
    for name in bundled:
        assert len(inspect.signature(COMMANDS[name]).parameters) <= 8, name
        for parameter, _ in parser.leaves(COMMANDS[name], {}):
            if not parameter.option.positional and parameter.note(SettingsGroup) is None:
                many, _, placeholder = parser.conversion(parameter.hint, parameter.notes)
                meanings.setdefault(parameter.flag, set()).add((many, parameter.option.metavar or placeholder))
                commands.setdefault(parameter.flag, set()).add(name)
    assert {flag: each for flag, each in meanings.items() if len(each) > 1 and flag not in WRITTEN} == {}
    assert {flag: {*bundled} - commands[flag] for flag in WITHOUT} == WITHOUT
    assert commands["--focal"] == commands["--hfov"] == {"extend", "localize", "poses", "track", "train", "view"}
    assert commands["--frame"] == {"compare", "evaluate", "localize", "render", "view"}
    assert commands["--camera"] - {"poses"} == commands["--split"]


def test_a_shell_completes_commands_and_options(bidnerf: Run) -> None:
    script = bidnerf("completion", "bash").succeed().out
    for words, expected in ((["bidnerf", "loc"], ["localize"]), (["bidnerf", "track", "--ri"], ["--risk"])):
        asked = f'COMP_WORDS=({" ".join(words)}); COMP_CWORD={len(words) - 1}; _bidnerf; echo "${{COMPREPLY[@]}}"'
        done = subprocess.run(["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True)
        assert (done.stdout.split(), done.stderr) == (expected, "")
    assert bidnerf("completion", "zsh").succeed().out.endswith(script)
    fish = bidnerf("completion", "fish").succeed().out
    assert "'__fish_seen_subcommand_from track' -l risk\n" in fish


@pytest.mark.parametrize("columns", ["1", "39"])
def test_help_ends_in_a_narrow_terminal(bidnerf: Run, monkeypatch: pytest.MonkeyPatch, columns: str) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    for command in ("localize", "info"):
        out = bidnerf(command, "--help").succeed().out
        assert max(map(len, out.splitlines())) <= 40
    assert os.environ["COLUMNS"] == columns


def test_no_help_page_waits_for_torch() -> None:
    run = "import sys; from bidnerf.cli import COMMANDS, main\nfor name in COMMANDS: main([name, '--help'])"
    program = f"{run}\nmain(['--version']), main(['frobnicate'])\nprint(*{{'torch', 'kornia', 'scipy', 'cv2', 'pydantic'}} & {{*sys.modules}}, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1].split() == []


# Options of nested dataclasses.


@dataclasses.dataclass(frozen=True)
class Inner(Settings):
    """What is inside."""

    plain: int = 1  # shown always
    rare: Annotated[int, EXPERT] = 2  # shown to experts
    other: float = 0.5
    """shown,
    too"""


@dataclasses.dataclass(frozen=True)
class Outer:
    """Take settings.

    All of them.
    """

    place: Annotated[Path, Option("PLACE", "where it is", positional=True)]
    more: Annotated[tuple[str, ...], Option("MORE...", "more places", positional=True)] = ()
    names: Annotated[tuple[str, ...], Option("NAME...", "several names")] = ()
    point: Annotated[tuple[float, float] | None, Option("X Y", "a point")] = None
    share: Annotated[float | None, Option("SHARE", "a fraction")] = 0.5
    loud: Annotated[bool, FLAG, Option(None, "whether it is loud")] = False
    other: Annotated[int | None, Option("N", "another number")] = None
    inner: Annotated[Inner, Without("other"), Group("inside", "These are inside.")] = Inner()
    unseen: Decimal | None = None


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("here", Outer(Path("here"))),
        ("here there -1,2 --loud", Outer(Path("here"), ("there", "-1,2"), loud=True)),
        ("--names a b --rare=5 here --names c", Outer(Path("here"), names=("a", "b", "c"), inner=Inner(rare=5))),
        ("here --point -1.5 -2e3 there --plain 3", Outer(Path("here"), ("there",), point=(-1.5, -2e3), inner=Inner(3))),
        ("- --share None", Outer(Path("-"), share=None)),
        ("here --other 2", Outer(Path("here"), other=2)),  # and not the inner one
        ("--other 2 -- --my_photo.jpg -1", Outer(Path("--my_photo.jpg"), ("-1",), other=2)),
        ("here --unseen 2.5", Outer(Path("here"), unseen="2.5")),  # type: ignore[arg-type]
    ],
)
def test_arguments_are_fields(line: str, expected: Outer) -> None:
    assert parse("x", Outer, line.split()) == expected


@pytest.mark.parametrize(
    "line",
    ["", "here --another 1", "here --point 1", "here --share nan", "here --plain 1.5", "--lou here", "here --plain"],
)
def test_what_no_field_takes_is_refused(line: str) -> None:
    with pytest.raises(UsageError, match="'bidnerf x --help' describes all arguments"):
        parse("x", Outer, line.split())


def test_help_hides_what_experts_need(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            parse("x", Outer, [option])
        page = capsys.readouterr().out
        for part in (
            "usage: bidnerf x [OPTIONS] PLACE MORE...\n",
            "All of them.",
            "--plain",
            "inside:\n  These are inside.\n",
        ):
            assert part in page
        assert page.count("--other") == 1
        assert "What is inside" not in page
        assert ("--rare" in page) == (option == "--help-all")
        assert ("'bidnerf x --help-all' also describes rarely needed options." in page) == (option == "--help")


def test_values_are_refused_before_settings_are_loaded() -> None:
    """The settings of a method take long to import."""

    def load(*_: object) -> None:
        raise AssertionError("loaded")

    def command(
        where: Path, out: Path, size: float = 1.0, config: Annotated[Any, SettingsGroup("x", "It.", load)] = None
    ) -> None:
        """Do something."""

    for words in (["here", "--out", "x", "--size", "a"], ["here"]):
        with pytest.raises(UsageError, match=r"--size is 'a', expected a number|required: --where, --out"):
            parse("x", command, words)


@pytest.mark.parametrize("package", ["namespace/part.py", "compiled.so"])
def test_an_unknown_option_is_named_whatever_packages_plugins_consist_of(
    package: str, bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / package
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"\x7fELF\xff\xfe")
    name = package.partition("/")[0].removesuffix(".so")
    monkeypatch.syspath_prepend(tmp_path)
    plugin = PluginInfo("methods", "other", f"{name}:Method", "other", "1")
    monkeypatch.setattr("bidnerf.cli.parser.list_plugins", lambda group: [plugin])
    assert_refused(bidnerf("localize", "map", "a.jpg", "--nonsense"), 2, "no option '--nonsense'")
