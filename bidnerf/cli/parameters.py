"""The parameters of a command: what annotations say about each, read from functions and from dataclasses among their parameters."""

from __future__ import annotations

import ast
import builtins
import dataclasses
import functools
import inspect
import sys
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from typing import Annotated, Any, TypeVar

from bidnerf.cli.program import option_name
from bidnerf_core.errors import spelled

Note = TypeVar("Note")


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
    words of the command line. ``plugins`` is the group of the plugins whose settings these are, if any.

    The value of the parameter is a function that returns the settings. The command calls it after its checks, since nothing is loaded
    before unless a setting is given. ``--help-all`` describes the options of the settings; ``--help`` only mentions them by the title.
    """

    load: Callable[[Mapping[str, Any], Sequence[str]], Any]
    plugins: str | None = None


@dataclass(frozen=True)
class Check:
    """Marks an argument that a function checks before anything is loaded.

    The function gets a value that was given, or a nested dataclass, and raises ``InputError`` if the command cannot use it. It must not
    import torch, so that the answer takes no time.
    """

    function: Callable[[Any], object]


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

    def note(self, kind: type[Note]) -> Note | None:
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
        hint, notes = bare(hints[name])
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


def bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without ``Annotated``, and its annotations."""
    if typing.get_origin(hint) is Annotated:  # typing flattens nested annotations
        kind, *notes = typing.get_args(hint)
        return kind, tuple(notes)
    return hint, ()


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
