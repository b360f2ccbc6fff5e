"""The parser of a command, whose arguments are the parameters of a function and the fields of dataclasses among them.

Each option is named after its parameter, such as ``--depth-unit`` for ``depth_unit``, whichever dataclass declares
the parameter. The help text comes from the ``Option`` or, failing that, from the docstring or comment beside the field.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import math
import re
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from bidnerf_core.errors import InputError, UsageError, spelling_hint
from bidnerf_core.settings import Expert, Range

T = TypeVar("T")

HELP, HELP_ALL = "--help", "--help-all"
NEGATIVE = re.compile(r"-[\d.]")
"""Matches the beginning of a value such as -1,0,2, which is not an option."""
KINDS = {
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
    str: ("TEXT", "text"),
    Path: ("PATH", "a path"),
}


@dataclass(frozen=True)
class Option:
    """The name and description of an argument; without ``help``, the docstring or comment beside the field describes it."""

    metavar: str | None = None
    help: str = ""
    default: str | None = None  # in words; None: the value itself; empty: it is not mentioned
    positional: bool = False


class Without(frozenset[str]):
    """The options of a nested dataclass that a command leaves out."""

    def __new__(cls, *names: str) -> Without:
        return super().__new__(cls, names)


@dataclass(frozen=True)
class Settings:
    """Marks a parameter that takes a dataclass of settings, which depends on other arguments or is slow to import.

    ``load`` returns the default settings, given the values of the options parsed so far, by parameter name, and all
    words of the command line. ``--help-all`` describes the options of the settings; ``--help`` only mentions them by
    ``summary``.
    """

    load: Callable[[Mapping[str, Any], Sequence[str]], Any]
    summary: str


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
        """Return the first annotation of type ``kind``, or None if there is none."""
        return next((note for note in self.notes if isinstance(note, kind)), None)

    @property
    def option(self) -> Option:
        """The ``Option`` among the annotations, or else an ``Option`` whose metavar is the first string among them."""
        return self.note(Option) or Option(next((n for n in self.notes if isinstance(n, str) and n != FLAG), None))

    @property
    def flag(self) -> str:
        """The option string, such as --depth-unit."""
        return f"--{self.name.rstrip('_').replace('_', '-')}"

    @property
    def left_out(self) -> frozenset[str]:
        """The fields that are not options, if the parameter is a dataclass."""
        return self.note(Without) or frozenset()


def parse(command: str, target: Callable[..., T], arguments: Sequence[str]) -> T:
    """Call ``target``, a function or a dataclass, with the parsed arguments.

    Raises ``UsageError`` for invalid arguments, and ``SystemExit`` after printing help.
    """
    # The names of options may be written with underscores, as in Python.
    words = [re.sub("^--[^=]*", lambda name: name[0].replace("_", "-"), word) for word in arguments]
    if {"-h", HELP, HELP_ALL} & set(words):
        loaded = _loaded(command, target, words) if HELP_ALL in words else None
        sys.stdout.write(_Parser(command, target, loaded).format_help())
        raise SystemExit(0)
    loaded = _loaded(command, target, words)
    return _built(target, _Parser(command, target, loaded).values(words), loaded)


def _loaded(command: str, target: Callable[..., Any], words: Sequence[str]) -> dict[str, Any]:
    """Return the default settings that depend on other arguments, by parameter name."""
    pending = {p.name: note for p, _ in _walk(target, {}) if (note := p.note(Settings)) is not None}
    if not pending:
        return {}
    given = _Parser(command, target, {}, options_only=True).parse_known_args(_escaped(words))[0]
    values = {p.name: p.default for p, _ in _walk(target, {})} | vars(given)
    return {name: note.load(values, words) for name, note in pending.items()}


def _walk(
    target: Any, loaded: Mapping[str, Any], default: Any = None, left_out: frozenset[str] = frozenset()
) -> Iterator[tuple[Parameter, Any]]:
    """Yield each parameter of ``target`` and of nested dataclasses, with its default instance if it is a dataclass, else None."""
    for parameter in parameters_of(target):
        if parameter.name in left_out:
            continue
        if default is not None:
            parameter = dataclasses.replace(parameter, default=getattr(default, parameter.name))
        group = loaded.get(parameter.name, parameter.default)
        group = group if dataclasses.is_dataclass(group) else None
        yield parameter, group
        if group is not None:
            yield from _walk(type(group), loaded, group, parameter.left_out)


def _built(target: Callable[..., T], given: Mapping[str, Any], loaded: Mapping[str, Any], default: Any = None) -> T:
    """Call ``target`` with the given values for its parameters and for the fields of nested dataclasses."""
    values = dict[str, Any]()
    for parameter in parameters_of(target):
        usual = parameter.default if default is None else getattr(default, parameter.name)
        group = loaded.get(parameter.name, usual)
        if dataclasses.is_dataclass(group):
            own = {name: value for name, value in given.items() if name not in parameter.left_out}
            value = _built(type(group), own, loaded, group)
            if value is not usual or default is None:
                values[parameter.name] = value
        elif parameter.name in given:
            value = values[parameter.name] = given[parameter.name]
            allowed = parameter.note(Range)
            if allowed is not None and value is not None and value not in allowed:
                raise UsageError(f"{parameter.flag} is {value}", expected=allowed)
    if default is None:
        return target(**values)
    try:
        return dataclasses.replace(default, **values) if values else default
    except InputError as error:
        raise UsageError(error) from error


class _Parser(argparse.ArgumentParser):
    """The argument parser of a command.

    ``loaded`` holds the settings that depend on other arguments; if it is None, help only mentions that these
    settings exist.
    """

    def __init__(
        self,
        command: str,
        target: Callable[..., Any],
        loaded: Mapping[str, Any] | None,
        options_only: bool = False,
    ) -> None:
        self.width = max(40, shutil.get_terminal_size().columns)  # 40 columns even in narrower terminals
        super().__init__(
            f"bidnerf {command}",
            add_help=False,
            allow_abbrev=False,
            argument_default=argparse.SUPPRESS,
            description=self._filled(inspect.getdoc(target) or ""),
            formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, 2, 24, self.width),
        )
        self._is_short, self._options_only = loaded is None, options_only
        self._positional, self._required = list[str](), list[str]()  # for the usage
        own = self.add_argument_group("options")
        announced, groups = list[str](), dict[str, Any]()  # group of each parameter
        for parameter, default in _walk(target, loaded or {}):
            settings = parameter.note(Settings)
            if default is not None:
                kind: Any = type(default)
                text = settings.summary if settings else (inspect.getdoc(kind) or "").split("\n\n")[0]
                group = self.add_argument_group(parameter.name.replace("_", " "), self._filled(text, 2))
                groups |= {inner.name: group for inner in parameters_of(kind)}
            elif settings is not None:
                announced.append(settings.summary)
            else:
                self._add(parameter, groups.get(parameter.name, own))
        own.add_argument("-h", HELP, action="store_true", help="show the usual options")
        more = "show all options" + (f", also {' and '.join(announced)}" if announced else "")
        own.add_argument(HELP_ALL, action="store_true", help=more)
        usage = " ".join([f"bidnerf {command} [OPTIONS]", *self._positional, *self._required])
        self.usage = textwrap.fill(usage, self.width - len("usage: "), subsequent_indent="  ").replace("%", "%%")

    def _filled(self, text: str, indent: int = 0) -> str:
        """Return the paragraphs of ``text``, wrapped to the width of the terminal less ``indent`` columns."""
        paragraphs = (" ".join(part.replace("``", "'").split()) for part in text.split("\n\n"))
        fill = functools.partial(textwrap.fill, width=self.width - indent, break_on_hyphens=False)
        return "\n\n".join(map(fill, paragraphs))

    def _add(self, parameter: Parameter, group: Any) -> None:
        option, default = parameter.option, parameter.default
        nargs, convert, metavar = conversion(parameter.hint)
        shown, is_required = option.metavar or metavar, default is MISSING
        expert = any(isinstance(note, Expert) for note in parameter.notes) and self._is_short
        common: dict[str, Any] = {
            "type": convert,
            "metavar": shown,
            "help": argparse.SUPPRESS if expert else _description(parameter),
        }
        if option.positional:
            if not self._options_only:
                self._positional.append(shown)
                nargs = nargs if is_required else {None: "?", "+": "*"}[nargs]  # type: ignore[index]
                self.add_argument(parameter.name, nargs=nargs, **common)
            return
        flag = parameter.flag
        if parameter.hint is bool:
            action = "store_true" if FLAG in parameter.notes else argparse.BooleanOptionalAction
            group.add_argument(flag, action=action, dest=parameter.name, help=common["help"])
            return
        if is_required:
            self._required.append(f"{flag} {shown}")
        common["metavar"] = tuple(shown.split()) if isinstance(nargs, int) else shown.removesuffix("...")
        group.add_argument(
            flag,
            action="extend" if nargs == "+" else "store",
            nargs=nargs,
            dest=parameter.name,
            required=is_required and not self._options_only,
            **common,
        )

    def values(self, words: Sequence[str]) -> dict[str, Any]:
        """Parse words, and return the values of the arguments given, by parameter name. Raises ``UsageError``."""
        self._words = words
        found, more = self.parse_known_intermixed_args(_escaped(words))
        if more:
            self.error(f"unexpected argument {more[0].strip()!r}")
        return {name: tuple(value) if isinstance(value, list) else value for name, value in vars(found).items()}

    def error(self, message: str) -> NoReturn:
        """Raise ``UsageError``. An unknown option is reported instead of ``message``, since it explains the other errors."""
        message = re.sub(r"^argument (\S+): ", r"\1 ", message)
        for word in getattr(self, "_words", ()):
            name = word.split("=")[0]
            if name.startswith("--") and len(name) > 2 and name not in self._option_string_actions:
                message = f"no option {name!r}{spelling_hint(name, self._option_string_actions)}"
                break
        raise UsageError(f"{message}; '{self.prog} {HELP}' describes all arguments")


def _description(parameter: Parameter) -> str:
    """Return the help text of a parameter, with its default."""
    option, default = parameter.option, parameter.default
    words = option.default
    if words is None and default is not MISSING and default not in (None, (), "") and default is not False:
        words = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
    text = " ".join((option.help or parameter.doc).replace("``", "'").split())
    if default is MISSING and not option.positional:
        text += " (required)"
    return (f"{text} (default: {words})" if words else text).replace("%", "%%")


def _escaped(words: Sequence[str]) -> list[str]:
    """Return the words with a space before values like -1,0,2, since argparse would otherwise take these values for options."""
    return [f" {word}" if NEGATIVE.match(word) else word for word in words]


@functools.cache
def parameters_of(target: Any) -> list[Parameter]:
    """Return the parameters of a function or a dataclass."""
    kinds: Any = [kind for kind in getattr(target, "__mro__", (target,)) if kind is not object]
    names = _Names()
    for kind in reversed(kinds):
        names |= vars(sys.modules[kind.__module__])
    hints = typing.get_type_hints(target, localns=names, include_extras=True)
    docs = dict[str, str]()
    if dataclasses.is_dataclass(target):
        defaults = {
            field.name: field.default if field.default_factory is MISSING else field.default_factory()
            for field in dataclasses.fields(target)
            if field.init
        }
        for kind in reversed(kinds):
            docs |= _field_docs(kind)
    else:
        defaults = {
            name: MISSING if parameter.default is inspect.Parameter.empty else parameter.default
            for name, parameter in inspect.signature(target).parameters.items()
        }
    found = []
    for name, default in defaults.items():
        hint, notes = _bare(hints[name])
        is_group = default is MISSING and dataclasses.is_dataclass(hint)
        found.append(Parameter(name, hint, notes, hint() if is_group else default, docs.get(name, "")))
    return found


class _Names(dict[str, Any]):
    """Names for resolving annotations; a name that is imported only for type checkers resolves to ``object``."""

    def __missing__(self, name: str) -> Any:
        builtins = self["__builtins__"]
        found = builtins if isinstance(builtins, dict) else vars(builtins)
        return found.get(name, object)


def _field_docs(kind: type) -> dict[str, str]:
    """Return the description of each field of a dataclass: the docstring after it, or the comment on its lines or above it."""
    try:
        source = textwrap.dedent(inspect.getsource(kind))
    except OSError:
        return {}
    lines = source.splitlines()
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    found = dict[str, str]()
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            found[node.target.id] = str(after.value.value)
            continue
        first = node.lineno - 1
        if not any("# " in line for line in lines[first : node.end_lineno]):
            while lines[first - 1].lstrip().startswith("#"):
                first -= 1
        comments = (line.partition("# ")[2].strip() for line in lines[first : node.end_lineno])
        found[node.target.id] = " ".join(filter(None, comments))
    return found


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without ``Annotated``, and its annotations."""
    if typing.get_origin(hint) is Annotated:  # typing flattens nested annotations
        kind, *notes = typing.get_args(hint)
        return kind, tuple(notes)
    return hint, ()


def conversion(hint: Any) -> tuple[int | str | None, Callable[[str], Any], str]:
    """Return argparse's ``nargs`` for a type (None for one word), the function that converts a word, and the metavar."""
    hint, _ = _bare(hint)
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    members = [_bare(part)[0] for part in typing.get_args(hint)] if is_union else [hint]
    optional = type(None) in members
    tuples = [part for part in members if typing.get_origin(part) is tuple]
    words = [part for part in members if part in KINDS or typing.get_origin(part) is Literal]
    if tuples and not words:
        parts = typing.get_args(tuples[0])
        several = parts[-1] is Ellipsis
        _, convert, metavar = conversion(parts[0])
        return ("+", convert, metavar) if several else (len(parts), convert, " ".join([metavar] * len(parts)))
    kinds = sorted(words, key=lambda kind: 1 if kind is str else 2 if kind is Path else 0) or [str]
    choices = {str(c): c for kind in kinds if typing.get_origin(kind) is Literal for c in typing.get_args(kind)}
    plain = [kind for kind in kinds if kind in KINDS]
    metavar = KINDS[plain[0]][0] if plain else f"{{{','.join(choices)}}}"
    expected = " or ".join(
        [*([f"one of {', '.join(choices)}"] if choices else []), *(KINDS[kind][1] for kind in plain)]
    )

    def convert_word(word: str) -> Any:
        word = word[1:] if word.startswith(" ") and NEGATIVE.match(word[1:]) else word
        if word in choices:
            return choices[word]
        if optional and word == "None":
            return None
        for kind in plain:
            try:
                value = kind(word)
            except ValueError:
                continue
            if not isinstance(value, float) or math.isfinite(value):
                return value
        raise argparse.ArgumentTypeError(f"is {word!r}, expected {expected}")

    return None, convert_word, metavar
