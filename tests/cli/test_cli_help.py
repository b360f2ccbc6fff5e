"""Help pages: every option of every command is described, and no description is a fragment."""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import tyro

from bidnerf_core.cli import COMMANDS, main, options
from bidnerf_core.localization import METHODS
from commands import Run

CHOICES = {
    "train": [["--backend", name] for name in ("adanerf", "hashgrid", "vanilla")],
    "localize": [["--method", name] for name in METHODS],
    "evaluate": [["--method", name] for name in METHODS],
    "compare": [["--method", name] for name in METHODS],
}
"""Options on which other options depend."""
NO_BEGINNING = {
    "about", "among", "and", "as", "at", "between", "by", "for", "from", "in", "of", "on", "or", "over", "per", "than",
    "that", "to", "which", "with", "within", "without", "...",
}  # fmt: skip
"""Words with which a description does not begin: it would go on with the option's name."""


class Shown(Exception):
    """Ends a command once its options are known."""


def options_of(words: list[str], monkeypatch: pytest.MonkeyPatch) -> list[argparse.Action]:
    """Return the options of a command, as its parser describes them."""
    found: list[argparse.Action] = []

    def keep(command: str, function: Callable[..., Any], arguments: list[str]) -> None:
        parser = tyro.extras.get_parser(function, config=(tyro.conf.OmitArgPrefixes,))
        found.extend(action for action in parser._actions if action.dest != "help")
        raise Shown

    monkeypatch.setattr(options, "_called", keep)
    with pytest.raises(Shown):
        main([*words, "--help-all"])
    return found


@pytest.mark.filterwarnings("ignore:get_parser:DeprecationWarning")
@pytest.mark.parametrize(
    "words", [[c, *choice] for c in COMMANDS for choice in CHOICES.get(c, [[]])], ids=" ".join
)
def test_every_option_has_a_help_text(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    options = options_of(words, monkeypatch)
    assert options
    for action in options:
        name = action.option_strings[0] if action.option_strings else action.dest
        text = (action.help or "").split("(default")[0].strip()
        assert len(text.split()) > 1, f"{name}: {action.help!r}"
        assert text.split()[0].lower() not in NO_BEGINNING, f"{name}: {text!r}"


@pytest.mark.parametrize(
    "words", [[c, *choice] for c in COMMANDS for choice in CHOICES.get(c, [[]])], ids=" ".join
)
def test_boxes_are_whole_on_a_terminal_of_80_columns(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*words, "--help-all"]) == 0
    page = capsys.readouterr().out
    assert "``" not in page
    rows = [line for line in page.splitlines() if line[:1] in "╭│╰╮+|" and line]
    assert rows
    assert len(rows[0]) <= 80
    assert [line for line in rows if len(line) != len(rows[0]) or line[-1] not in "╮│╯+|"] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "--outt", "X", "photos"], "no option '--outt', did you mean '--out'?"),
        (
            ["train", "d", "--out", "x", "--depth_uni=2"],
            "no option '--depth-uni', did you mean '--depth-unit'?",
        ),
        (["train", "d"], "--out (folder for the map) is missing"),
        (["train", "d", "--out"], "no value for --out (folder for the map)"),
        (
            ["train", "d", "--out", "x", "--steps", "a"],
            "--steps is 'a', expected a whole number (steps of the",
        ),
        (
            ["localize", "m", "p", "--focal=abc"],
            "--focal is 'abc', expected a number (focal length in pixels",
        ),
        (["scale", "m", "--distance", "a", "b"], "--distance is 'a b', expected A B METRES (true distance"),
        (["scale", "m"], "one of --distance, --poses and --factor is missing"),
        (["scale", "m", "--factor", "1", "--poses", "x"], "--factor and --poses exclude each other"),
        (
            ["localize", "m", "p", "--mask-hides", "red"],
            "--mask-hides is 'red', expected one of black, white",
        ),
        (["info", "m", "extra"], "1 argument too many, from 'extra' on"),
    ],
)
def test_wrong_arguments_are_told_in_a_line(bidnerf: Run, words: list[str], message: str) -> None:
    status, out, err = bidnerf(*words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"bidnerf {words[0]}: {message}")
    assert err.endswith(f"; 'bidnerf {words[0]} --help' describes all arguments\n")


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
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["info", "m", "--jsn"], "no option '--jsn', did you mean '--json'?"),
        (["info", "m", "extra"], "Unrecognized options: extra"),
        (["train", "d"], "Missing from bidnerf train: --out MAP folder for the map"),
        (["localize", "m", "p", "--focal=abc"], "Error parsing --focal: "),
    ],
)
def test_refusals_are_a_line_with_another_version_of_the_parser_too(
    bidnerf: Run, monkeypatch: pytest.MonkeyPatch, changed: Any, words: list[str], message: str, encoding: str
) -> None:
    changed(monkeypatch)
    monkeypatch.setattr(
        sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    )  # of which boxes depend
    status, out, err = bidnerf(*words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"bidnerf {words[0]}: {message}")
    assert err.endswith(f"; 'bidnerf {words[0]} --help' describes all arguments\n")
    assert err.isascii()


def test_settings_that_contradict_are_told_in_a_line(bidnerf: Run) -> None:
    status, out, err = bidnerf("serve", "m", "--timeout", "0")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "timeout is 0.0, expected a positive number" in err
