"""Help pages and refusals of arguments: every option is described, pages fit the terminal, and a mistake is told in a line."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Annotated, Any

import pytest
import tyro

from bidnerf_core.cli import COMMANDS, main

# Inside: the parser alone, with another version of its library and without the settings for experts
from bidnerf_core.cli.help_page import without_expert_settings
from bidnerf_core.cli.options import parse
from bidnerf_core.localization import METHODS
from bidnerf_core.settings import EXPERT, Settings
from commands import Run

CHOICES = {
    "train": [["--backend", name] for name in ("adanerf", "hashgrid", "vanilla")],
    "localize": [["--method", name] for name in METHODS],
    "evaluate": [[], ["--method", "bid"]],
    "compare": [[], ["--method", "bid-lm"]],
}
"""Options on which other options depend; settings of a method are the same in each command that takes one."""
PAGES = pytest.mark.parametrize(
    "words", [[c, *choice] for c in COMMANDS for choice in CHOICES.get(c, [[]])], ids=" ".join
)
NO_BEGINNING = {
    "about", "among", "and", "as", "at", "between", "by", "for", "from", "in", "of", "on", "or", "over", "per", "than",
    "that", "to", "which", "with", "within", "without", "...",
}  # fmt: skip
"""Words with which a description does not begin: it would go on with the option's name."""


class Shown(Exception):
    """Ends a command once its options are known."""


@pytest.mark.filterwarnings("ignore:get_parser:DeprecationWarning")
@PAGES
def test_every_option_has_a_help_text(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[argparse.Action] = []

    def keep(function: Callable[..., Any], **options: Any) -> None:
        found.extend(tyro.extras.get_parser(function, config=(tyro.conf.OmitArgPrefixes,))._actions)
        raise Shown

    monkeypatch.setattr(tyro, "cli", keep)
    with pytest.raises(Shown):
        main([*words, "--help-all"])
    options = [action for action in found if action.dest != "help"]
    assert options
    for action in options:
        name = action.option_strings[0] if action.option_strings else action.dest
        text = (action.help or "").split("(default")[0].strip()
        assert len(text.split()) > 1, f"{name}: {action.help!r}"
        assert text.split()[0].lower() not in NO_BEGINNING, f"{name}: {text!r}"


@PAGES
def test_pages_fit_the_terminal_and_their_boxes_are_whole(
    words: list[str], bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    for columns, option in ((80, "--help-all"), (120, "--help")):
        monkeypatch.setenv("COLUMNS", str(columns))
        status, page, err = bidnerf(*words, option)
        assert (status, err) == (0, "")
        assert page.startswith(f"usage: bidnerf {words[0]} ")
        assert "``" not in page
        assert "PATH" not in page
        assert max(map(len, page.splitlines())) <= columns
        rows = [line for line in page.splitlines() if line[:1] in "╭│╰╮+|" and line]
        assert rows
        assert [line for line in rows if len(line) != len(rows[0]) or line[-1] not in "╮│╯+|"] == []


def test_arguments_are_named_as_in_the_manual(bidnerf: Run) -> None:
    for command, named in (("train", "DATA"), ("info", "MAP"), ("render", "MAP DATA"), ("localize", "MAP")):
        assert f" {named}" in bidnerf(command, "--help").out.splitlines()[0]
    assert "QUERY..." in bidnerf("localize", "--help").out
    assert "--carve, --no-carve" in bidnerf("train", "--backend", "hashgrid", "--help").out


@pytest.fixture
def _within_a_minute() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise AssertionError("does not end")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("_within_a_minute")
@pytest.mark.parametrize("columns", ["1", "5", "39"])
def test_help_ends_in_a_narrow_terminal(bidnerf: Run, monkeypatch: pytest.MonkeyPatch, columns: str) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    for command in ("localize", "info"):
        status, out, _ = bidnerf(command, "--help")
        assert status == 0
        assert max(map(len, out.splitlines())) <= 40
    status, _, err = bidnerf("info", "--nonsense")
    assert status == 2
    assert "'--nonsense'" in err
    assert os.environ["COLUMNS"] == columns


# Settings for experts.


@dataclasses.dataclass(frozen=True)
class Inner(Settings):
    """What is inside."""

    plain: int = 1  # shown always
    rare: Annotated[int, EXPERT] = 2  # shown to experts


@dataclasses.dataclass(frozen=True)
class Rare(Settings):
    """What only experts touch."""

    first: int = 1  # of two
    second: int = 2  # of two


@dataclasses.dataclass(frozen=True)
class Outer(Settings):
    """What is outside."""

    inner: Inner = Inner()
    group: Annotated[Rare, EXPERT] = Rare()
    other: float = 0.5  # shown, too


def command(config: Outer = Outer()) -> Outer:
    """Take settings."""
    return config


def test_help_hides_what_experts_need(capsys: pytest.CaptureFixture[str]) -> None:
    assert without_expert_settings(command)[1] == 3
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            parse("x", command, [option])
        page = capsys.readouterr().out
        assert all(part in page for part in ("--plain", "shown, too", "inner options"))
        assert "config.inner" not in page
        assert ("--second" in page) == ("--rare" in page) == (option == "--help-all")
        assert ("3 expert settings are not shown; --help-all" in page) == (option == "--help")


def test_experts_settings_are_parsed_though_they_are_not_shown(bidnerf: Run) -> None:
    method = ["localize", "--method", "bid-lm"]
    assert "--search-rays" not in bidnerf(*method, "--help").out
    assert "--search-rays" in bidnerf(*method, "--help-all").out
    status, _, err = bidnerf(*method, "--search-rays", "64", "no-map", "no-query")
    assert status == 1
    assert "needs a start" in err


# Arguments that are wrong.


def assert_told(found: tuple[int, str, str], name: str, message: str) -> None:
    status, out, err = found
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"bidnerf {name}: {message}")
    assert err.endswith(f"; 'bidnerf {name} --help' describes all arguments\n")
    assert err.isascii()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --outt X photos", "no option '--outt', did you mean '--out'?"),
        ("train d --out x --depth_uni=2", "no option '--depth-uni', did you mean '--depth-unit'?"),
        ("train d", "--out (folder for the map) is missing"),
        ("train d --out", "no value for --out (folder for the map)"),
        ("train d --out x --steps a", "--steps is 'a', expected a whole number (steps of the"),
        ("localize m p --focal=abc", "--focal is 'abc', expected a number (focal length in pixels"),
        ("scale m --distance a b", "--distance is 'a b', expected A B METRES (true distance"),
        ("scale m", "one of --distance, --poses and --factor is missing"),
        ("scale m --factor 1 --poses x", "--factor and --poses exclude each other"),
        ("localize m p --mask-hides red", "--mask-hides is 'red', expected one of black, white"),
        ("info m extra", "1 argument too many, from 'extra' on"),
    ],
)
def test_wrong_arguments_are_told_in_a_line(bidnerf: Run, line: str, message: str) -> None:
    assert_told(bidnerf(*line.split()), line.split()[0], message)


def _without_the_hook(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("tyro._errors.on_parse_error")


def _without_the_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("tyro._errors")
    monkeypatch.setitem(sys.modules, "tyro._errors", None)


def _with_other_events(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def registered(hook: Any) -> Iterator[None]:
        yield hook(type("MissingArgs", (), {})())

    monkeypatch.setattr("tyro._errors.on_parse_error", registered)


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize("changed", [_without_the_hook, _without_the_module, _with_other_events])
def test_refusals_are_a_line_with_another_version_of_the_parser_too(
    bidnerf: Run, monkeypatch: pytest.MonkeyPatch, changed: Any, encoding: str
) -> None:
    changed(monkeypatch)
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)  # of which boxes depend
    monkeypatch.setattr(sys, "stdout", stream)
    for line, message in (
        ("info m --jsn", "no option '--jsn', did you mean '--json'?"),
        ("info m extra", "Unrecognized options: extra"),
        ("train d", "Missing from bidnerf train: --out MAP folder for the map"),
        ("localize m p --focal=abc", "Error parsing --focal: "),
    ):
        assert_told(bidnerf(*line.split()), line.split()[0], message)
