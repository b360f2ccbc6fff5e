"""The parser of a command, whose arguments are the parameters of a function and the fields of dataclasses among them.

Each option is named after its parameter, such as ``--depth-unit`` for ``depth_unit``, whichever dataclass declares
the parameter. The help text comes from the ``Option`` or, failing that, from the docstring or comment beside the field.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import dataclasses
import difflib
import functools
import inspect
import itertools
import math
import re
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

from bidnerf.cli.parameters import FLAG, Check, Group, Parameter, SettingsGroup, bare, leaves, parameters_of
from bidnerf.cli.program import option_name
from bidnerf_core.errors import InputError, UsageError, enumeration, spelling_hint
from bidnerf_core.registry import list_plugins, registered
from bidnerf_core.settings import Allowed, Expert, OneOf

T = TypeVar("T")

HELP, HELP_ALL = "--help", "--help-all"
NEGATIVE = re.compile(r"-[\d.]")
"""Matches the beginning of a value such as -1,0,2, which is not an option."""
DATACLASS = re.compile(r"^@[\w.]*dataclass\b.*\nclass .*\n(?:(?:[ \t].*)?\n)+", re.MULTILINE)
"""Matches a dataclass in its source."""
ESCAPE = "\0"
"""Precedes words that are no options, though they look like one; arguments of a program cannot contain it."""
MISSING_ARGUMENTS = "the following arguments are required: "  # argparse's words
KINDS = {
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
    str: ("TEXT", "text"),
    Path: ("PATH", "a path"),
}


def parse(command: str, target: Callable[..., T], arguments: Sequence[str]) -> T:
    """Call ``target``, a function or a dataclass, with the parsed arguments.

    Raises ``UsageError`` for invalid arguments, and ``SystemExit`` after printing help.
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    # The names of options may be written with underscores, as in Python.
    words = [re.sub("^--[^=]*", lambda name: name[0].replace("_", "-"), word) for word in arguments[:end]]
    pages, words = {"-h", HELP, HELP_ALL} & set(words), [*words, *arguments[end:]]
    short, loaded = bool(pages) and HELP_ALL not in pages, dict[str, Any]()  # the default settings, by parameter name
    usual = {parameter.name: parameter.default for parameter, _ in leaves(target, {})}
    pending = {parameter.name: note for parameter, note in leaves(target, {}) if isinstance(note, SettingsGroup)}
    parser = _Parser(command, target, {}, short)
    if (
        pending
        and not short
        and (pages or parser.may_hold_a_setting(words, {note.plugins for note in pending.values()}))
    ):
        options = _Parser(command, target, {}, options_only=True)
        values = usual | vars(options.parse_known_args(_escape(words))[0])
        loaded = {name: note.load(values, words) for name, note in pending.items()}
        parser = _Parser(command, target, loaded)
    if pages:
        sys.stdout.write(parser.format_help())
        raise SystemExit(0)
    given = parser.parse_all(words)

    def settings(name: str) -> Any:
        default = loaded[name] if name in loaded else pending[name].load(usual | given, words)
        return None if default is None else _build(type(default), given, [], default)

    for name in loaded:  # a wrong setting is reported before any file is examined
        settings(name)
    return _build(target, given | {name: functools.partial(settings, name) for name in pending}, [])


def _build(
    target: Callable[..., T], given: Mapping[str, Any], checks: list[Callable[[], object]], default: Any = None
) -> T:
    """Call ``target`` with the given values for its parameters and for the fields of nested dataclasses.

    Their checks are added to ``checks``, all of which are made before a command is called: then no arguments contradict each other.
    """
    values = dict[str, Any]()
    for parameter in parameters_of(target):
        usual = parameter.default if default is None else getattr(default, parameter.name)
        if dataclasses.is_dataclass(usual):
            own = {name: value for name, value in given.items() if name not in parameter.left_out}
            value = _build(type(usual), own, checks, usual)
            if value is not usual or default is None:
                values[parameter.name] = value
        elif parameter.name in given:
            values[parameter.name] = given[parameter.name]
        if (check := parameter.note(Check)) is not None and parameter.name in values:
            checks.append(functools.partial(check.function, values[parameter.name]))
    if default is None:
        for check_value in checks:
            check_value()
        return target(**values)
    try:
        return dataclasses.replace(default, **values) if values else default
    except InputError as error:
        raise as_usage_error(error) from error


def as_usage_error(error: InputError) -> UsageError:
    """Return the error about a setting as one about the option of its name."""
    if error.where not in (None, "config"):
        return UsageError(error)
    text = re.sub(r"^(\w+)(?= is )", r"`\1`", error.found)
    return UsageError(text, expected=error.expected)


class _Parser(argparse.ArgumentParser):
    """The argument parser of a command.

    ``loaded`` holds the settings that depend on other arguments. If ``short`` is set, help pages leave out what is rarely needed. If
    ``options_only`` is set, positional arguments are unknown.
    """

    def __init__(
        self,
        command: str,
        target: Callable[..., Any],
        loaded: Mapping[str, Any],
        short: bool = False,
        options_only: bool = False,
    ) -> None:
        self.width = max(40, shutil.get_terminal_size().columns)  # 40 columns even in narrower terminals
        super().__init__(
            f"bidnerf {command}",
            add_help=False,
            allow_abbrev=False,
            argument_default=argparse.SUPPRESS,
            description=self._fill(inspect.getdoc(target) or ""),
            formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, 2, 24, self.width),
        )
        self._positionals.title = "arguments"
        usage = {True: list[str](), False: list[str]()}  # positional arguments, and required options
        self._required = dict[str, bool]()  # the arguments in messages, and whether they are options
        groups, others = dict[Group | None, Any](), dict[str, None]()
        groups[None] = self.add_argument_group("options")
        for parameter, group in leaves(target, loaded):
            if isinstance(group, SettingsGroup) and parameter.note(SettingsGroup) is group:  # not loaded
                others[f"the {group.title}"] = None
            elif short and parameter.note(Expert) is not None:
                others["rarely needed options"] = None
            elif not (options_only and parameter.option.positional):
                if group not in groups:
                    assert group is not None
                    groups[group] = self.add_argument_group(group.title, self._fill(group.text, 2))
                usage[parameter.option.positional] += self._add(parameter, groups[group])
        if short and others:
            self.epilog = self._fill(f"'{self.prog} {HELP_ALL}' also describes {enumeration(sorted(others))}.")
        else:
            for name in ("-h", HELP, HELP_ALL):  # known to the parser, whose pages do not repeat them
                self.add_argument(name, action="store_true", help=argparse.SUPPRESS)
        self.usage = textwrap.fill(
            " ".join([f"{self.prog} [OPTIONS]", *usage[True], *usage[False]]),
            self.width - len("usage: "),
            subsequent_indent="  ",
            break_on_hyphens=False,
        ).replace("%", "%%")

    def _fill(self, text: str, indent: int = 0) -> str:
        """Return the paragraphs of ``text``, wrapped to the width of the terminal less ``indent`` columns."""
        paragraphs = (" ".join(part.replace("``", "'").split()) for part in text.split("\n\n"))
        fill = functools.partial(textwrap.fill, width=self.width - indent, break_on_hyphens=False)
        return "\n\n".join(map(fill, paragraphs))

    def _add(self, parameter: Parameter, group: Any) -> list[str]:
        """Add an argument, and return its words in the usage, if any."""
        option, flag, required = parameter.option, parameter.flag, parameter.default is MISSING
        nargs, convert, metavar = conversion(parameter.hint, parameter.notes)
        shown = option.metavar or metavar
        common: dict[str, Any] = {"type": convert, "metavar": shown, "help": parameter.description}
        if required:
            self._required[shown if option.positional else flag] = not option.positional
        if option.positional:
            nargs = nargs if required else {None: "?", "+": "*"}[nargs]  # type: ignore[index]
            self.add_argument(parameter.name, nargs=nargs, **common)
            return [shown]
        if parameter.hint is bool:
            action = "store_true" if FLAG in parameter.notes else argparse.BooleanOptionalAction
            group.add_argument(flag, action=action, dest=parameter.name, help=common["help"])
            return []
        common["metavar"] = tuple(shown.split()) if isinstance(nargs, int) else shown.removesuffix("...")
        action = "extend" if nargs == "+" else "store"
        group.add_argument(flag, action=action, nargs=nargs, dest=parameter.name, **common)
        return [f"{flag} {shown}"] if required else []

    def unknown_option(self, words: Sequence[str]) -> str | None:
        """Return the first word before ``--`` that looks like an option but is none."""
        names = (word.split("=")[0] for word in itertools.takewhile("--".__ne__, words))
        return next((n for n in names if n.startswith("--") and n not in self._option_string_actions), None)

    def may_hold_a_setting(self, words: Sequence[str], groups: Collection[str | None]) -> bool:
        """Return whether the first unknown option is more like a setting of an installed package than like the known options.

        The dataclasses in the source of bidnerf's core, and of the plugins of these ``groups``, are searched for fields, since
        importing settings takes seconds. Settings have defaults. The result is True if a script registered plugins of its own.
        """
        packages, fields = {"bidnerf_core"}, set[str]()
        unknown, known = self.unknown_option(words), self._option_string_actions
        if unknown is None or any(group in groups for group, _ in registered):
            return unknown is not None
        packages |= {re.split("[.:]", info.value)[0] for group in groups if group for info in list_plugins(group)}
        for spec in filter(None, map(find_spec, packages)):
            folders = map(Path, spec.submodule_search_locations or ())
            for file in [Path(spec.origin or ""), *(file for folder in folders for file in folder.rglob("*.py"))]:
                if file.suffix == ".py" and file.is_file():  # not a namespace or an extension module
                    for source in DATACLASS.findall(file.read_text(encoding="utf-8", errors="replace")):
                        with contextlib.suppress(SyntaxError):  # of a later version of Python
                            declared = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.AnnAssign)]
                            if all(node.value is not None for node in declared):
                                fields |= {option_name(ast.unparse(node.target)) for node in declared}
        near = difflib.get_close_matches(re.sub("^--no-", "--", unknown), fields.union(known), n=1, cutoff=0.8)
        return not fields.difference(known).isdisjoint(near)

    def parse_all(self, words: Sequence[str]) -> dict[str, Any]:
        """Parse words, and return the values of the arguments given, by parameter name. Raises ``UsageError``."""
        self._words = words
        given, more = self.parse_known_intermixed_args(_escape(words))
        if self._missing_options():
            self.error(MISSING_ARGUMENTS)
        if more:
            self.error(f"unexpected argument {more[0].removeprefix(ESCAPE)!r}")
        return {name: tuple(value) if isinstance(value, list) else value for name, value in vars(given).items()}

    def _missing_options(self) -> list[str]:
        given = {word.partition("=")[0] for word in self._words}
        return [name for name, is_option in self._required.items() if is_option and name not in given]

    def error(self, message: str) -> NoReturn:
        """Raise ``UsageError``. An unknown option is reported instead of ``message``, since it explains the other errors."""
        words, options = getattr(self, "_words", ()), self._option_string_actions
        message = re.sub(r"^argument \[?([^]: ]+)\S*: ", r"\1 ", message).replace(
            "ignored explicit argument", "takes no value, got"
        )
        if (name := self.unknown_option(words)) is not None:
            message = f"no option {name!r}{spelling_hint(name, options)}"
        elif message.startswith(MISSING_ARGUMENTS):
            missing = [name for name in message.removeprefix(MISSING_ARGUMENTS).split(", ") if name in self._required]
            lists = [word for word in words if word in options and options[word].nargs == "+" and missing]
            hint = f"; {lists[-1]} takes all words after it, so give it last" if lists else ""
            message = f"{MISSING_ARGUMENTS}{', '.join([*missing, *self._missing_options()])}{hint}"
        raise UsageError(f"{message}; '{self.prog} {HELP}' describes all arguments")


def _escape(words: Sequence[str]) -> list[str]:
    """Return the words without ``--``, and with ``ESCAPE`` before those that argparse would wrongly take for options.

    These are values like -1,0,2, and all words after ``--``.
    """
    end = words.index("--") if "--" in words else len(words)
    before = [ESCAPE + word if NEGATIVE.match(word) else word for word in words[:end]]
    return [*before, *(ESCAPE + word for word in words[end + 1 :])]


def conversion(hint: Any, notes: Sequence[Any] = ()) -> tuple[int | str | None, Callable[[str], Any], str]:
    """Return argparse's ``nargs`` for a type (None for one word), the function that converts a word, and the metavar.

    The function checks values against the ranges and names among the annotations of the type and ``notes``.
    """
    hint, own = bare(hint)
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    parts = [bare(part) for part in typing.get_args(hint)] if is_union else [(hint, ())]
    limits = [n for group in (notes, own, *(more for _, more in parts)) for n in group if isinstance(n, Allowed)]
    members = [kind for kind, _ in parts]
    optional = type(None) in members
    tuples = [part for part in members if typing.get_origin(part) is tuple]
    words = [part for part in members if part in KINDS or typing.get_origin(part) is Literal]
    if tuples and not words:
        elements = typing.get_args(tuples[0])
        _, convert, metavar = conversion(elements[0], limits)
        if elements[-1] is Ellipsis:
            return "+", convert, metavar
        return len(elements), convert, " ".join([metavar] * len(elements))
    kinds = sorted(words, key=lambda kind: 1 if kind is str else 2 if kind is Path else 0) or [str]
    choices = {str(c): c for kind in kinds if typing.get_origin(kind) is Literal for c in typing.get_args(kind)}
    plain = [kind for kind in kinds if kind in KINDS]
    metavar = KINDS[plain[0]][0] if plain else f"{{{','.join(choices)}}}"
    metavar = "NAME" if metavar == "TEXT" and any(isinstance(limit, OneOf) for limit in limits) else metavar
    names = [f"one of {', '.join(choices)}"] if choices else []
    expected = " or ".join([*names, *(KINDS[kind][1] for kind in plain)])

    def convert_word(word: str) -> Any:
        word = word.removeprefix(ESCAPE)
        if word is argparse.SUPPRESS:  # argparse converts its own default of an optional positional argument
            return word
        if word in choices:
            return choices[word]
        if optional and word == "None":
            return None
        # An empty word, such as that of an unset variable, is no name of a file; Python takes it for the current folder.
        for kind in plain if word or Path not in plain else ():
            try:
                value = kind(word)
            except ValueError:
                continue
            if isinstance(value, float) and not math.isfinite(value):
                continue
            for limit in (limit for limit in limits if value not in limit):
                hint = spelling_hint(word, [*map(str, limit.table)]) if isinstance(limit, OneOf) else ""
                shown = repr(word) if isinstance(value, str) else word
                raise argparse.ArgumentTypeError(f"is {shown}{hint or f', expected {limit}'}")
            return value
        raise argparse.ArgumentTypeError(f"is {word!r}{spelling_hint(word, choices, f', expected {expected}')}")

    return None, convert_word, metavar
