"""The parser of a command, whose arguments are the parameters of a function and the fields of dataclasses among them.

Each option is named after its parameter, such as ``--depth-unit`` for ``depth_unit``, whichever dataclass declares
the parameter. The help text comes from the ``Option`` or, failing that, from the docstring or comment beside the field.
"""

from __future__ import annotations

import argparse
import ast
import builtins
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from bidnerf.cli.program import option_name
from bidnerf_core.errors import InputError, UsageError, enumeration, spelled, spelling_hint
from bidnerf_core.registry import list_plugins, registered
from bidnerf_core.settings import Allowed, Expert, OneOf

T = TypeVar("T")

HELP, HELP_ALL = "--help", "--help-all"
NEGATIVE = re.compile(r"-[\d.]")
"""Matches the beginning of a value such as -1,0,2, which is not an option."""
FIELD = re.compile(r"^    (\w+): ", re.MULTILINE)
"""Matches the name of a field of a dataclass in its source."""
ESCAPE = "\0"
"""Precedes words that are no options, though they look like one; arguments of a program cannot contain it."""
MISSING_ARGUMENTS = "the following arguments are required: "  # argparse's words
KINDS = {
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
    str: ("TEXT", "text"),
    Path: ("PATH", "a path"),
}


@dataclass(frozen=True)
class Option:
    """The name and description of an argument.

    Without ``help``, the docstring or comment beside the field describes the argument. A function that returns the text is called when
    a help page shows it.
    """

    metavar: str | None = None
    help: str | Callable[[], str] = ""
    default: str | None = None  # in words; None: the value itself; empty: it is not mentioned
    positional: bool = False


class Without(frozenset[str]):
    """The options of a nested dataclass that a command leaves out."""

    def __new__(cls, *names: str) -> Without:
        return super().__new__(cls, names)


@dataclass(frozen=True)
class Group:
    """The title of the options of a nested dataclass on help pages, and a sentence about them for users.

    Options of a dataclass without one stand among those of the dataclass around it.
    """

    title: str
    text: str


@dataclass(frozen=True)
class SettingsGroup(Group):
    """Marks a parameter that takes a dataclass of settings, which depends on other arguments or is slow to import.

    ``load`` returns the default settings, given the values of the options parsed so far, by parameter name, and all
    words of the command line. ``--help-all`` describes the options of the settings; ``--help`` only mentions them by
    the title.
    """

    load: Callable[[Mapping[str, Any], Sequence[str]], Any]


FLAG = "flag"
"""Marks a bool that has an option only for True, and none, such as --no-NAME, for False."""
Flag = Annotated[bool, FLAG]


@dataclass(frozen=True)
class Parameter:
    """A parameter of a command, or a field of its options."""

    name: str
    hint: Any
    notes: tuple[Any, ...]
    default: Any  # MISSING if it is required
    doc: str

    def note(self, kind: type[T]) -> T | None:
        """Return the last annotation of type ``kind``, or None if there is none."""
        return next((note for note in reversed(self.notes) if isinstance(note, kind)), None)

    @property
    def option(self) -> Option:
        """The ``Option`` among the annotations, or else an ``Option`` whose metavar is the first string among them."""
        return self.note(Option) or Option(next((n for n in self.notes if isinstance(n, str) and n != FLAG), None))

    @property
    def flag(self) -> str:
        """The option string, such as --depth-unit."""
        return option_name(self.name)

    @property
    def left_out(self) -> frozenset[str]:
        """The fields that are not options, if the parameter is a dataclass."""
        return frozenset(name for note in self.notes if isinstance(note, Without) for name in note)

    @property
    def description(self) -> str:
        """The help text, with the default."""
        option, default, words = self.option, self.default, self.option.default
        if words is None and default is not MISSING and default not in (None, (), "") and default is not False:
            values = default if isinstance(default, tuple) else (default,)
            words = " ".join(
                f"{x:.4g}" if type(x) is float else f"{x:,}" if type(x) is int and x >= 10_000 else str(x)
                for x in values
            )
        text = option.help if isinstance(option.help, str) else option.help()
        text = spelled(" ".join((text or self.doc).replace("``", "'").split()), option_name)
        if default is MISSING and not option.positional:
            text += " (required)"
        elif words and "(default: " not in text:
            text += f" (default: {words.replace('True', 'yes')})"
        return text.replace("%", "%%")


def parse(command: str, target: Callable[..., T], arguments: Sequence[str]) -> T:
    """Call ``target``, a function or a dataclass, with the parsed arguments.

    Raises ``UsageError`` for invalid arguments, and ``SystemExit`` after printing help.
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    # The names of options may be written with underscores, as in Python.
    words = [re.sub("^--[^=]*", lambda name: name[0].replace("_", "-"), word) for word in arguments[:end]]
    pages, words = {"-h", HELP, HELP_ALL} & set(words), [*words, *arguments[end:]]
    short, loaded = bool(pages) and HELP_ALL not in pages, dict[str, Any]()  # the default settings, by parameter name
    pending = {p.name: note for p, note in leaves(target, {}) if isinstance(note, SettingsGroup)}
    if pending and not short:
        first = _Parser(command, target, {}, options_only=True)
        given = vars(first.parse_known_args(_escape(words))[0])
        if not pages and not first.may_hold_a_setting(words):
            _Parser(command, target, {}).parse_all(words)  # refuses what is missing before settings are loaded
        values = {p.name: p.default for p, _ in leaves(target, {})} | given
        loaded = {name: note.load(values, words) for name, note in pending.items()}
    parser = _Parser(command, target, loaded, short)
    if pages:
        sys.stdout.write(parser.format_help())
        raise SystemExit(0)
    return _build(target, parser.parse_all(words), loaded)


def leaves(
    target: Any,
    loaded: Mapping[str, Any],
    default: Any = None,
    left_out: frozenset[str] = frozenset(),
    group: Group | None = None,
) -> Iterator[tuple[Parameter, Group | None]]:
    """Yield each parameter of ``target``, or in place of nested dataclasses their fields, with its group."""
    for parameter in parameters_of(target):
        if parameter.name in left_out:
            continue
        if default is not None:
            parameter = dataclasses.replace(parameter, default=getattr(default, parameter.name))
        own, nested = parameter.note(Group) or group, loaded.get(parameter.name, parameter.default)
        if dataclasses.is_dataclass(nested):
            yield from leaves(type(nested), loaded, nested, parameter.left_out, own)
        else:
            yield parameter, own


def _build(target: Callable[..., T], given: Mapping[str, Any], loaded: Mapping[str, Any], default: Any = None) -> T:
    """Call ``target`` with the given values for its parameters and for the fields of nested dataclasses."""
    values = dict[str, Any]()
    for parameter in parameters_of(target):
        usual = parameter.default if default is None else getattr(default, parameter.name)
        nested = loaded.get(parameter.name, usual)
        if dataclasses.is_dataclass(nested):
            own = {name: value for name, value in given.items() if name not in parameter.left_out}
            value = _build(type(nested), own, loaded, nested)
            if value is not usual or default is None:
                values[parameter.name] = value
        elif parameter.name in given:
            values[parameter.name] = given[parameter.name]
    if default is None:
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

    def may_hold_a_setting(self, words: Sequence[str]) -> bool:
        """Return whether the first unknown option is more like a setting of an installed package than like the known options.

        The source of these packages is searched, since importing settings takes seconds. The result is True if a script
        registered plugins of its own.
        """
        groups, packages, fields = ("backends", "methods", "importers"), {"bidnerf_core"}, set[str]()
        unknown, known = self.unknown_option(words), self._option_string_actions
        if unknown is None or any(group in groups for group, _ in registered):
            return unknown is not None
        packages |= {re.split("[.:]", info.value)[0] for group in groups for info in list_plugins(group)}
        for spec in filter(None, map(find_spec, packages)):
            folders = map(Path, spec.submodule_search_locations or ())
            for file in [Path(spec.origin or ""), *(file for folder in folders for file in folder.rglob("*.py"))]:
                if file.suffix == ".py" and file.is_file():  # not a namespace or an extension module
                    source = file.read_text(encoding="utf-8", errors="replace")
                    fields |= {option_name(name) for name in FIELD.findall(source)}
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
        message = re.sub(r"^argument \[?([^]: ]+)\S*: ", r"\1 ", message)
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


@functools.cache
def parameters_of(target: Any) -> list[Parameter]:
    """Return the parameters of a function or a dataclass."""
    kinds: Any = [kind for kind in reversed(getattr(target, "__mro__", (target,))) if kind is not object]
    docs = dict[str, str]()
    if dataclasses.is_dataclass(target):
        defaults = {
            field.name: field.default if field.default_factory is MISSING else field.default_factory()
            for field in dataclasses.fields(target)
            if field.init
        }
        for kind in kinds:
            docs |= _field_docs(kind)
    else:
        defaults = {
            name: MISSING if parameter.default is inspect.Parameter.empty else parameter.default
            for name, parameter in inspect.signature(target).parameters.items()
        }
    hints = dict[str, Any]()
    for kind in kinds:
        module = vars(sys.modules[kind.__module__])
        names, annotations = _Names(vars(builtins) | module), inspect.get_annotations(kind).items()
        # typing's own evaluation raises NameError for names that are imported only for type checkers.
        hints |= {name: eval(hint, module, names) if isinstance(hint, str) else hint for name, hint in annotations}
    listed = []
    for name, default in defaults.items():
        hint, notes = _bare(hints[name])
        is_group = default is MISSING and dataclasses.is_dataclass(hint)
        listed.append(Parameter(name, hint, notes, hint() if is_group else default, docs.get(name, "")))
    return listed


class _Names(dict[str, Any]):
    """Names for evaluating annotations; a name that is imported only for type checkers stands for ``object``."""

    def __missing__(self, name: str) -> Any:
        return object


def _field_docs(kind: type) -> dict[str, str]:
    """Return the description of each field of a dataclass: the docstring after it, or the comment on its lines or above it."""
    try:
        source = textwrap.dedent(inspect.getsource(kind))
    except OSError:
        return {}
    lines = source.splitlines()
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    docs = dict[str, str]()
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            docs[node.target.id] = str(after.value.value)
            continue
        first = node.lineno - 1
        if not any("# " in line for line in lines[first : node.end_lineno]):
            while lines[first - 1].lstrip().startswith("#"):
                first -= 1
        comments = (line.partition("# ")[2].strip() for line in lines[first : node.end_lineno])
        docs[node.target.id] = " ".join(filter(None, comments))
    return docs


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without ``Annotated``, and its annotations."""
    if typing.get_origin(hint) is Annotated:  # typing flattens nested annotations
        kind, *notes = typing.get_args(hint)
        return kind, tuple(notes)
    return hint, ()


def conversion(hint: Any, notes: Sequence[Any] = ()) -> tuple[int | str | None, Callable[[str], Any], str]:
    """Return argparse's ``nargs`` for a type (None for one word), the function that converts a word, and the metavar.

    The function checks values against the ranges and names among the annotations of the type and ``notes``.
    """
    hint, own = _bare(hint)
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    parts = [_bare(part) for part in typing.get_args(hint)] if is_union else [(hint, ())]
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
        for kind in plain:
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
