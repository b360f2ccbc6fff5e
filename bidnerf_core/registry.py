"""Registration of third-party parts by name: backends, readers, methods, features, faults, writers,
importers and exporters.

A distribution provides an object through an entry point of the group ``bidnerf.GROUP``; the bundled ones are
provided in the same way. A script or a notebook adds one with ``register``. Listing reads only metadata and
source text, so a broken plugin cannot break the list: the failure surfaces when that plugin is loaded, in an
error that names the plugin, its distribution and the cause.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from email import message_from_string
from functools import reduce
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, distribution, distributions
from itertools import pairwise
from typing import Any, Generic, TypeAlias, TypeVar

from bidnerf_core.errors import InputError, spelling_hint, unknown_name

GROUPS: Mapping[str, str] = {
    "backends": "backend",
    "readers": "reader",
    "methods": "method",
    "features": "detector",
    "faults": "fault",
    "writers": "writer",
    "importers": "importer",
    "exporters": "exporter",
}
"""The kinds of object that can be registered, and the noun for each. The entry-point group has the prefix
``bidnerf.``."""

ONLY_STRANGERS = frozenset({"importers"})
"""Groups without bundled plugins."""

BUNDLED = "bidnerf"
"""The distribution whose plugins are bundled."""
UNREADABLE = "?"
"""Placeholder for the name of entry points that cannot be read."""
NAME = re.compile(r"[\w.-]+")

Defects: TypeAlias = Callable[[Any], Iterator[str]]
"""A function that yields the reasons why an object is not of its kind, the most informative one first."""
AnyDistribution: TypeAlias = Any
"""A distribution of ``importlib.metadata``, left open: once anything imports the backport ``importlib_metadata``, look-ups
return its own classes, which are not subclasses of the standard library's."""

Plugin = TypeVar("Plugin")

registered: dict[tuple[str, str], Any] = {}
"""Objects passed to ``register``, by group and name."""


class PluginError(InputError):
    """A plugin cannot be loaded, or violates the contract of its kind; the message names the plugin and the
    cause.
    """


@dataclass(frozen=True)
class PluginInfo:
    """Information about a plugin that is available without importing it."""

    group: str
    name: str
    value: str  # "module:object", as declared; the object's type if it was registered in this process
    distribution: str
    version: str
    summary: str = ""
    fault: str | None = None  # why it cannot be loaded, as far as the metadata shows

    @property
    def is_bundled(self) -> bool:
        return _normalized(self.distribution) == BUNDLED

    def __str__(self) -> str:
        origin = f"from {self.distribution} {self.version}" if self.version else "registered in this process"
        return f"{GROUPS[self.group]} '{self.name}' ({self.value}, {origin})"


def register(group: str, name: str, value: Any, replace: bool = False) -> None:
    """Make ``value`` available under ``name`` in this process, for scripts and notebooks; other processes do
    not see it.

    ``group``: one of ``GROUPS``, such as "methods". ``replace``: whether ``value`` may replace a plugin of
    that name, whether registered before, installed or bundled. Raises ``InputError`` for an unknown group, an
    invalid name, and a name that is taken.
    """
    _check_group(group)
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise InputError(f"name is {name!r}", where="register", expected="letters, digits, '.', '-' and '_'")
    taken = [info for info in list_plugins(group) if info.name == name]
    if taken and not replace and registered.get((group, name)) is not value:
        raise InputError(
            f"the name is taken by {taken[0]}; choose another name, or pass replace=True to replace it",
            where="register",
        )
    registered[group, name] = value


def registered_names() -> list[tuple[str, str]]:
    """Return the group and name of every object passed to ``register`` in this process."""
    return list(registered)


def require_registered(names: Iterable[tuple[str, str]]) -> None:
    """Raise ``PluginError`` for a group and name that another process registered and this one did not.

    An installed plugin may have the same name, but it is not the one the other process refers to.
    """
    for group, name in names:
        if (group, name) not in registered:
            raise PluginError(
                f"{GROUPS[group]} {name!r} was registered in one process but is unknown in another that"
                " needs it; provide it through an entry point, register it where the main module is"
                " imported, or do everything in one process (workers=1)"
            )


def list_plugins(group: str) -> list[PluginInfo]:
    """Return all plugins of a group, sorted by name, without importing any.

    A name declared by two distributions is listed twice, with a fault: neither can be loaded.
    """
    _check_group(group)
    own = [_registered_info(group, name) for of, name in list(registered) if of == group]
    replaced = {info.name for info in own}
    sources: dict[str, ast.Module | None] = {}
    found = [_described_info(info, sources) for info in _declared(group) if info.name not in replaced]
    return sorted([*own, *found], key=lambda info: (info.name, info.distribution, info.value))


def plugin_names(group: str, first: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a group's plugins: those in ``first``, in that order, then the remaining bundled ones, then all others.

    The last two parts are sorted alphabetically. Names in ``first`` that no plugin has are omitted.
    """
    _check_group(group)
    known = {info.name: info.is_bundled for info in _declared(group) if info.name != UNREADABLE}
    known |= {name: known.get(name, False) for of, name in list(registered) if of == group}
    ranks = {name: rank for rank, name in enumerate(first)}
    return tuple(sorted(known, key=lambda name: (ranks.get(name, len(ranks)), not known[name], name)))


def load_plugin(group: str, name: str, defects: Defects | None = None, wanted_by: str = "") -> Any:
    """Return the plugin of that name, imported and, if ``defects`` is given, checked with it.

    Raises ``PluginError``, which names the plugin and, if given, what needs it (``wanted_by``).
    """
    try:
        return _loaded(group, name, defects)
    except PluginError as error:
        raise PluginError(error, where=wanted_by) from error.__cause__


class Plugins(Mapping[str, Plugin], Generic[Plugin]):
    """The plugins of a group by name. Iterating imports nothing; a plugin is imported and checked on look-up."""

    def __init__(self, group: str, defects: Defects, first: Sequence[str] = ()) -> None:
        """``first``: names to list first, in this order, before the other bundled ones and the rest."""
        self._group, self._defects, self._first = group, defects, first

    def load(self, name: str, wanted_by: str = "") -> Plugin:
        """Return a plugin as ``load_plugin`` does."""
        found: Plugin = load_plugin(self._group, name, self._defects, wanted_by)
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(plugin_names(self._group, self._first))

    def __len__(self) -> int:
        return len(plugin_names(self._group))

    def __contains__(self, name: object) -> bool:
        return name in plugin_names(self._group)

    def __getitem__(self, name: str) -> Plugin:
        if name not in self:
            raise KeyError(name)
        return self.load(name)


def _loaded(group: str, name: str, defects: Defects | None) -> Any:
    _check_group(group)
    if (group, name) in registered:
        return _checked(_registered_info(group, name), registered[group, name], defects)
    found = [info for info in _declared(group) if info.name == name and name != UNREADABLE]
    if not found:
        raise PluginError(_unknown(group, name))
    info = _described_info(found[0], {})
    if info.fault is not None:
        raise PluginError(info.fault, where=info)
    return _checked(info, _imported(info), defects)


def _check_group(group: str) -> None:
    if group not in GROUPS:
        raise unknown_name("group of plugins", group, GROUPS)


def _registered_info(group: str, name: str) -> PluginInfo:
    value = registered[group, name]
    summary = getattr(value, "summary", None) or inspect.getdoc(value) or ""
    return PluginInfo(group, name, _type_name(value), "this process", "", str(summary).partition("\n")[0])


# Reading metadata. Any metadata file of any distribution may be malformed.

_cache: tuple[object, dict[str, tuple[PluginInfo, ...]]] = (None, {})


def _declared(group: str) -> tuple[PluginInfo, ...]:
    """Return what installed distributions declare in a group; re-read whenever a folder of ``sys.path`` has
    changed.
    """
    global _cache
    key = tuple((path, _modified(path)) for path in sys.path)
    if _cache[0] != key:
        found = [info for dist in _installed() for info in _entries(dist)]
        _cache = key, {of: tuple(_with_rivals([i for i in found if i.group == of])) for of in GROUPS}
    return _cache[1][group]


def _modified(path: str) -> int:
    try:
        return os.stat(path or os.curdir).st_mtime_ns
    except OSError:
        return 0


def _installed() -> Iterator[AnyDistribution]:
    """Yield the distributions related to bidnerf; of several versions, only the one that ``import`` would
    use.
    """
    seen = set()
    for dist in distributions():
        if "bidnerf." not in _text(dist, "entry_points.txt"):
            continue
        name = _label(dist)
        if _normalized(name) not in seen and not _is_hidden(dist, name):
            seen.add(_normalized(name))
            yield dist


def _is_hidden(dist: AnyDistribution, name: str) -> bool:
    try:
        first = distribution(name)
    except Exception:  # it has no name by which it could be hidden
        return False
    return [_text(first, f) for f in ("METADATA", "entry_points.txt")] != [
        _text(dist, f) for f in ("METADATA", "entry_points.txt")
    ]


def _entries(dist: AnyDistribution) -> Iterator[PluginInfo]:
    about = PluginInfo(
        "", UNREADABLE, UNREADABLE, _label(dist), _metadata(dist, "Version") or "of unknown version"
    )
    about = replace(about, summary=_metadata(dist, "Summary") or "")
    for group in GROUPS:
        try:
            for point in dist.entry_points.select(group=f"bidnerf.{group}"):
                yield replace(about, group=group, name=point.name, value=point.value)
        except Exception as error:
            if f"bidnerf.{group}" in _text(dist, "entry_points.txt"):
                fault = f"entry_points.txt cannot be read ({_described(error)})"
                yield replace(about, group=group, summary="", fault=fault)


def _with_rivals(infos: list[PluginInfo]) -> Iterator[PluginInfo]:
    """Yield plugins, with a fault for each name that is declared more than once and therefore ambiguous."""
    for info in infos:
        rivals = [x for x in infos if x.name == info.name and x is not info]
        if rivals and info.name != UNREADABLE:
            also = ", ".join(f"{x.distribution} {x.version} ({x.value})" for x in rivals)
            yield replace(info, fault=f"the name is also claimed by {also}; uninstall one of them")
        else:
            yield info


def _text(dist: AnyDistribution, file: str) -> str:
    try:
        return dist.read_text(file) or ""
    except Exception:
        return ""


def _metadata(dist: AnyDistribution, key: str) -> str | None:
    try:
        head, _, readme = _text(dist, "METADATA").partition("\n\n")
        # The README after the headers would take nearly all of the parsing time.
        values = (message_from_string(head) if readme else dist.metadata).get_all(key)
    except Exception:
        return None
    return str(values[0]) if values else None


def _label(dist: AnyDistribution) -> str:
    return _metadata(dist, "Name") or f"unnamed distribution {getattr(dist, '_path', id(dist))}"


def _normalized(name: str) -> str:
    return name.lower().replace("-", "_").replace(".", "_")


# Summaries: the first line of a docstring, from the source as text.


def _described_info(info: PluginInfo, sources: dict[str, ast.Module | None]) -> PluginInfo:
    """Return the information from an entry point's module: its summary, or why it cannot be resolved."""
    if info.name == UNREADABLE:
        return info
    point = EntryPoint(info.name, info.value, "")
    try:
        module = point.module  # fails unless the value has the form module:object
    except Exception:
        return replace(info, fault=info.fault or "expected a value of the form 'module:object'")
    try:
        spec = _spec(module)
    except Exception as error:
        return replace(info, fault=info.fault or f"module '{module}' cannot be found ({_described(error)})")
    if spec is None:
        return replace(info, fault=info.fault or f"module '{module}' is not installed")
    if module not in sources:
        sources[module] = _parsed(spec)
    return replace(info, summary=_summary(sources[module], point.attr) or info.summary)


def _spec(module: str) -> ModuleSpec | None:
    """Return the spec of a module. ``find_spec`` alone would import the parents of a dotted name."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top)
    for part in rest:
        if spec is None or spec.submodule_search_locations is None:
            return None
        spec = PathFinder.find_spec(f"{spec.name}.{part}", spec.submodule_search_locations)
    return spec


def _parsed(spec: ModuleSpec) -> ast.Module | None:
    read = getattr(spec.loader, "get_source", None)
    try:
        return ast.parse(read(spec.name) or "") if read else None
    except Exception:  # the source is not valid Python, which loading the plugin will report
        return None


def _summary(tree: ast.Module | None, attr: str | None) -> str:
    """Return the first line of the docstring of the object an entry point names, or else of its module.

    The docstring of an assigned object is the text below the assignment, or ``summary="..."`` in the call
    that creates it.
    """
    if tree is None:
        return ""
    own: str | None = None
    for node, below in pairwise([*tree.body, ast.Pass()]):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == attr:
            own = ast.get_docstring(node)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(target, ast.Name) and target.id == attr for target in targets):
                words = node.value.keywords if isinstance(node.value, ast.Call) else []
                given = [word.value for word in words if word.arg == "summary"]
                own = next(filter(None, map(_constant_text, [*given, getattr(below, "value", None)])), None)
    return _first_line(own) or _first_line(ast.get_docstring(tree))


def _constant_text(node: Any) -> str | None:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _first_line(text: str | None) -> str:
    return text.strip().splitlines()[0] if text and text.strip() else ""


# Loading.


def _imported(info: PluginInfo) -> Any:
    point = EntryPoint(info.name, info.value, "")
    try:
        module = importlib.import_module(point.module)
    except KeyboardInterrupt:
        raise  # the user interrupted the import
    except (
        BaseException
    ) as error:  # including SystemExit and the like, which must not end the caller's program
        raise PluginError(f"cannot be imported: {_described(error)}", where=info) from error
    try:
        return reduce(getattr, filter(None, (point.attr or "").split(".")), module)
    except Exception as error:
        raise PluginError(f"there is no such object: {_described(error)}", where=info) from error


def _checked(info: PluginInfo, plugin: Any, defects: Defects | None) -> Any:
    noun = GROUPS[info.group]
    kind = f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"
    try:
        wrong = None if defects is None else next(defects(plugin), None)
    except Exception as error:  # a property may raise anything
        raise PluginError(f"not {kind}: {_described(error)}", where=info) from error
    if wrong is not None:
        raise PluginError(f"not {kind}: {wrong}", where=info)
    return plugin


def interface_defects(
    plugin: Any, attributes: Sequence[str], methods: Mapping[str, Sequence[str]]
) -> Iterator[str]:
    """Yield the reasons why an object lacks an interface: ``attributes`` by name, ``methods`` by name with
    their parameters.

    If ``summary`` is one of the attributes, it must be text; ``config_type`` must be a frozen dataclass with
    defaults. A plain function counts as an object with the method ``__call__``.
    """
    missing = [name for name in (*attributes, *methods) if not hasattr(plugin, name)]
    if missing:
        who = f"class {plugin.__name__}" if isinstance(plugin, type) else _type_name(plugin)
        yield f"{who} has no {', '.join(missing)}"
        return
    if isinstance(plugin, type):
        yield f"it is the class {plugin.__name__} itself, expected an instance of it"
    if "summary" in attributes and not isinstance(plugin.summary, str):
        yield f"summary is {plugin.summary!r}, expected text"
    if "config_type" in attributes:
        yield from _config_defects(plugin.config_type)
    for name, parameters in methods.items():
        if not _accepts(plugin if name == "__call__" else getattr(plugin, name), len(parameters)):
            yield f"{'it' if name == '__call__' else name} does not take ({', '.join(parameters)})"


def _config_defects(config_type: Any) -> Iterator[str]:
    if not (isinstance(config_type, type) and dataclasses.is_dataclass(config_type)):
        yield f"config_type is {config_type!r}, expected a frozen dataclass"
        return
    if not config_type.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        yield f"config_type {config_type.__name__} is a dataclass that is not frozen"
    nothing = dataclasses.MISSING
    fields = [field for field in dataclasses.fields(config_type) if field.init]
    bare = [field.name for field in fields if field.default is field.default_factory is nothing]
    if bare:
        yield f"config_type {config_type.__name__} has no default for {', '.join(bare)}"


def _accepts(method: Any, count: int) -> bool:
    if not callable(method):
        return False
    try:
        inspect.signature(method).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # compiled code may have no signature
        return True
    return True


def _type_name(value: Any) -> str:
    return type(value).__name__


def _described(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _unknown(group: str, name: str) -> str:
    infos, noun = _declared(group), GROUPS[group]
    names = plugin_names(group)
    if group not in ONLY_STRANGERS and not any(info.is_bundled for info in infos):
        return (
            f"no {noun} {name!r}: the metadata of the installed bidnerf lists no {group}; reinstall bidnerf"
        )
    hint = spelling_hint(str(name).lower(), names)
    message = f"no {noun} {name!r}{hint}; installed: {', '.join(sorted(names)) or 'none'}"
    unread = [f"{x.distribution} {x.version}: {x.fault}" for x in infos if x.name == UNREADABLE]
    return "; ".join([message, *unread])
