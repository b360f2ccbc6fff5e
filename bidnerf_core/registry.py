"""Plugins by name: backends, readers, posers, methods, features, faults, writers, importers, exporters, service protocols and commands.

A distribution provides an object through an entry point of the group ``bidnerf.GROUP``, as bidnerf itself does
for the bundled objects. A script or a notebook adds an object with ``register``. Listing reads only metadata (and
tables, see ``TABLE``), so a broken plugin does not break the list: it fails when it is loaded, with an error that
names the plugin, its distribution and the cause.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, entry_points
from types import CodeType, FunctionType
from typing import Any, Generic, TypeAlias, TypeVar, cast

from bidnerf_core.errors import InputError, spelling_hint, unknown_name

GROUPS: Mapping[str, str] = {
    "backends": "backend",
    "readers": "reader",
    "posers": "poser",
    "methods": "method",
    "features": "detector",
    "faults": "fault",
    "writers": "writer",
    "importers": "importer",
    "exporters": "exporter",
    "services": "protocol",
    "commands": "command",
}
"""The groups of plugins, each with the noun for one of its objects. The entry-point group is named ``bidnerf.GROUP``."""

USUAL_BACKEND, USUAL_METHOD, USUAL_FEATURES, USUAL_POSER = "hashgrid", "auto", "sift", "colmap"
"""The backend, method, keypoint detector and poser that are used by default."""

TABLE = "*"
"""The name of an entry point whose object is a mapping from name to plugin. Listing the group imports the mapping."""

Defects: TypeAlias = Callable[[Any], Iterator[str]]
"""A function that yields the reasons why an object is not a valid plugin of its kind, the most informative one first."""

Plugin = TypeVar("Plugin")

registered: dict[tuple[str, str], Any] = {}
"""Objects passed to ``register``, by group and name."""


class PluginError(InputError):
    """Raised for a plugin that cannot be loaded or violates its contract; the message names the plugin and the cause."""


@dataclass(frozen=True)
class PluginInfo:
    """Information about a plugin, available without importing it (except for the summary of a bundled plugin)."""

    group: str
    name: str
    value: str  # "module:object", as declared; the object's type if it was registered in this process
    distribution: str
    version: str
    about: str = ""  # the distribution's own summary
    fault: str | None = None  # why it cannot be loaded, as far as the metadata shows

    @property
    def is_bundled(self) -> bool:
        return self.distribution == "bidnerf"

    @property
    def summary(self) -> str:
        """A one-line description: the plugin's own if it can be read, else its distribution's.

        The description of an installed function is the first line of its docstring, which is read without importing it. Other plugins
        are imported if they are bundled, but not if another distribution provides them.
        """
        if self.fault is None and self.version and (text := _function_doc(self.value)):
            return text.partition("\n")[0]
        if self.fault is None and (self.is_bundled or not self.version):
            with contextlib.suppress(PluginError):  # reported when the plugin is loaded for use
                plugin = load_plugin(self.group, self.name)
                text = getattr(plugin, "summary", None) or inspect.getdoc(plugin) or ""
                return str(text).strip().partition("\n")[0]
        return self.about

    @property
    def description(self) -> str:
        """The summary, with the distribution if it is not bidnerf's own, and the fault if there is one."""
        source = "" if self.is_bundled else f"[{self.distribution} {self.version}".strip() + "]"
        return " ".join(filter(None, (self.summary.replace("``", "'"), source, self.fault and f"fault: {self.fault}")))

    def __str__(self) -> str:
        origin = f"from {self.distribution} {self.version}" if self.version else "registered in this process"
        return f"{GROUPS[self.group]} '{self.name}' ({self.value}, {origin})"


def _function_doc(value: str) -> str:
    """Return the docstring of the function ``module:function`` without importing anything, or "" for any other object."""
    module, _, name = value.partition(":")
    path: Sequence[str] | None = None
    spec: ModuleSpec | None = None
    for package in itertools.accumulate(module.split("."), "{}.{}".format):
        spec = PathFinder.find_spec(package, path)
        if spec is None:
            return ""
        path = spec.submodule_search_locations
    assert spec is not None
    read: Any = getattr(spec.loader, "get_code", lambda _: None)
    for code in getattr(read(spec.name), "co_consts", ()):
        if isinstance(code, CodeType) and code.co_name == name and code.co_flags & inspect.CO_OPTIMIZED:
            return inspect.getdoc(FunctionType(code, {})) or ""
    return ""


def register(group: str, name: str, value: Any, replace: bool = False) -> None:
    """Make ``value`` available under ``name`` in this process, for scripts and notebooks; other processes do not see it.

    ``group``: one of ``GROUPS``, such as "methods". ``replace``: whether ``value`` may replace an existing plugin
    of that name (registered, installed or bundled). Raises ``InputError`` for an unknown group, an invalid name,
    and a name that is taken.
    """
    if not (isinstance(name, str) and re.fullmatch(r"[\w.-]+", name)):
        raise InputError(f"name is {name!r}", where="register", expected="letters, digits, '.', '-' and '_'")
    taken = [info for info in list_plugins(group) if info.name == name]
    if taken and not replace and registered.get((group, name)) is not value:
        raise InputError(
            f"the name is taken by {taken[0]}; choose another name, or pass replace=True to replace it",
            where="register",
        )
    registered[group, name] = value


def require_registered(names: Iterable[tuple[str, str]]) -> None:
    """Raise ``PluginError`` unless this process has registered the plugins that another process has registered.

    ``names`` are the group and name of each. An installed plugin of the same name does not count: the other process
    uses the one that it registered.
    """
    for group, name in names:
        if (group, name) not in registered:
            raise PluginError(
                f"{GROUPS[group]} {name!r} was registered in one process but is unknown in another that"
                " needs it; provide it through an entry point, register it where the main module is"
                " imported, or do everything in one process (workers=1)"
            )


def list_plugins(group: str) -> list[PluginInfo]:
    """Return all plugins of a group, sorted by name; nothing is imported except tables (see ``TABLE``).

    A name that two distributions declare is listed twice, with a fault: neither plugin can be loaded. Raises
    ``InputError`` for an unknown group.
    """
    if group not in GROUPS:
        raise unknown_name("group of plugins", group, GROUPS)
    own = [
        PluginInfo(of, name, type(value).__name__, "this process", "")
        for (of, name), value in list(registered.items())
        if of == group
    ]
    declared = [info for info in _declared(group) if (group, info.name) not in registered]
    return sorted([*own, *declared], key=lambda info: (info.name, info.distribution, info.value))


@functools.cache
def _declared(group: str) -> tuple[PluginInfo, ...]:
    """Return the entry points that installed distributions declare in a group.

    If several versions of a distribution are installed, the first on ``sys.path`` counts.
    """
    infos, points = list[PluginInfo](), list[tuple[EntryPoint, str, str, str]]()
    metadata = dict[Any, Any]()
    try:
        for p in entry_points(group=f"bidnerf.{group}"):
            if p.dist not in metadata:  # which is parsed at each access
                metadata[p.dist] = cast(Any, p.dist).metadata
            dist = metadata[p.dist]
            points.append((p, dist["Name"], dist["Version"], dist.get("Summary", "")))
    except Exception as error:
        raise PluginError(
            f"the metadata of an installed package cannot be read ({_describe(error)})",
            expected="a sound one; reinstall or remove it",
        ) from error
    for p, *source in points:
        try:
            names = p.load() if p.name == TABLE else [p.name]
        except Exception as error:
            raise PluginError(f"{p.value}: the table cannot be imported ({_describe(error)})") from error
        infos += [PluginInfo(group, name, p.value, *source) for name in names]
    found = []
    for info in infos:
        rivals = [x for x in infos if x.name == info.name and x is not info]
        claims = ", ".join(f"{x.distribution} {x.version} ({x.value})" for x in rivals)
        fault = f"the name is also claimed by {claims}; uninstall one of them" if rivals else None
        if not EntryPoint.pattern.match(info.value):
            fault = "expected a value of the form 'module:object'"
        found.append(replace(info, fault=fault))
    return tuple(found)


def load_plugin(group: str, name: str, defects: Defects | None = None, wanted_by: str = "") -> Any:
    """Import the plugin called ``name``, check it with ``defects`` if given, and return it.

    Raises ``PluginError``, which names the plugin and, if given, what needs it (``wanted_by``).
    """
    infos = {info.name: info for info in reversed(list_plugins(group))}
    if name not in infos:
        hint = spelling_hint(str(name).lower(), infos)
        why = f"no {GROUPS[group]} {name!r}{hint}; installed: {', '.join(sorted(infos)) or 'none'}"
        if not any(info.is_bundled for of in GROUPS for info in _declared(of)):
            why = f"no {GROUPS[group]} {name!r}: the metadata of bidnerf lists no plugins at all; reinstall bidnerf"
        raise PluginError(why, where=wanted_by)
    info = infos[name]
    where = f"{wanted_by}: {info}" if wanted_by else info
    if info.fault is not None:
        raise PluginError(info.fault, where=where)
    kind = f"{'an' if GROUPS[group][0] in 'aeiou' else 'a'} {GROUPS[group]}"
    doing = "cannot be imported"
    try:
        plugin = registered[group, name] if (group, name) in registered else EntryPoint(name, info.value, group).load()
        if isinstance(plugin, Mapping):
            plugin = plugin[name]
        doing = f"not {kind}"
        wrong = None if defects is None else next(defects(plugin), None)
    except KeyboardInterrupt:
        raise  # the user interrupted the import
    except (
        BaseException
    ) as error:  # a plugin may raise anything, even SystemExit, which must not end the caller's program
        raise PluginError(f"{doing}: {_describe(error)}", where=where) from error
    if wrong is not None:
        raise PluginError(f"not {kind}: {wrong}", where=where)
    return plugin


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


class Plugins(Mapping[str, Plugin], Generic[Plugin]):
    """Mapping from name to plugin for a group. Iteration only lists names; a plugin is imported and checked on look-up."""

    def __init__(self, group: str, defects: Defects, first: Sequence[str] = ()) -> None:
        """``first``: names to list first, in this order, before the other bundled plugins and then the rest."""
        self._group, self._defects, self._first = group, defects, first

    def load(self, name: str, wanted_by: str = "") -> Plugin:
        """Import the plugin called ``name``, check it, and return it, see ``load_plugin``."""
        return cast(Plugin, load_plugin(self._group, name, self._defects, wanted_by))

    def __iter__(self) -> Iterator[str]:
        ranks = {name: rank for rank, name in enumerate(self._first)}
        infos = list_plugins(self._group)
        infos.sort(key=lambda x: (ranks.get(x.name, len(ranks)), not x.is_bundled, x.name))
        return iter(dict.fromkeys(info.name for info in infos))

    def __len__(self) -> int:
        return sum(1 for _ in self)  # list() asks for the length

    def __contains__(self, name: object) -> bool:
        return any(info.name == name for info in list_plugins(self._group))

    def __getitem__(self, name: str) -> Plugin:
        if name not in self:
            raise KeyError(name)
        return self.load(name)


def interface_defects(plugin: Any, attributes: Sequence[str], methods: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield the reasons why an object does not implement an interface.

    ``attributes`` are names, and ``methods`` maps names to the names of parameters. Among the attributes,
    ``summary`` must be text, and ``config_type`` a frozen dataclass with defaults. A plain function counts as an
    object with the method ``__call__``.
    """
    missing = [name for name in (*attributes, *methods) if not hasattr(plugin, name)]
    if missing:
        who = f"class {plugin.__name__}" if isinstance(plugin, type) else type(plugin).__name__
        yield f"{who} has no {', '.join(missing)}"
        return
    if isinstance(plugin, type):
        yield f"it is the class {plugin.__name__} itself, expected an instance of it"
    if "summary" in attributes and not isinstance(plugin.summary, str):
        yield f"summary is {plugin.summary!r}, expected one line of text"
    if "config_type" in attributes:
        kind, nothing = plugin.config_type, dataclasses.MISSING
        is_dataclass = isinstance(kind, type) and dataclasses.is_dataclass(kind)
        fields = [f for f in dataclasses.fields(kind) if f.init] if is_dataclass else []
        if not is_dataclass or not kind.__dataclass_params__.frozen:
            yield f"config_type is {kind!r}, expected a frozen dataclass"
        if bare := [f.name for f in fields if f.default is f.default_factory is nothing]:
            yield f"config_type {kind.__name__} has no default for {', '.join(bare)}"
        typed = inspect.get_annotations(kind) if is_dataclass else vars(kind)
        for name, value in vars(kind).items():
            if name not in typed and not name.startswith("_") and isinstance(value, str | int | float | tuple):
                yield f"config_type {kind.__name__} has no type for {name}, expected '{name}: {type(value).__name__} = {value!r}'"
    for name, parameters in methods.items():
        method = plugin if name == "__call__" else getattr(plugin, name)
        try:
            inspect.signature(method).bind(*[None] * len(parameters))
        except TypeError:  # it does not take these parameters, or is not callable
            yield f"{'it' if name == '__call__' else name} does not take ({', '.join(parameters)})"
        except ValueError:  # compiled code may have no signature
            pass
