"""Discovery of backends by entry-point name.

A distribution offers a backend through an entry point of the group ``bidnerf.backends``. Listing reads only metadata and
source text, so that a broken backend cannot break the list: its fault surfaces when that backend is loaded, in an error
that names the entry point, its value, its distribution and the cause.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import inspect
from collections.abc import Iterator
from dataclasses import dataclass, replace
from email import message_from_string
from functools import reduce
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, distributions
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from bidnerf_core.errors import InputError, spelling_hint

if TYPE_CHECKING:
    from bidnerf_core.backend import Backend
else:
    Backend = Any  # its module imports torch, which takes seconds and is not needed to list backends

GROUP = "bidnerf.backends"

AnyDistribution: TypeAlias = Any
AnyEntryPoint: TypeAlias = Any
"""Types of ``importlib.metadata``, left open: once anything imports the backport ``importlib_metadata``, look-ups return
its own classes, which are not subclasses of the standard library's."""

UNREADABLE = "?"
"""Stands for the name of entry points that cannot be read."""

REQUIRED_METHODS = {"build": ("config", "bounds"), "train": ("field", "views", "config", "report")}


class BackendError(InputError):
    """A backend cannot be loaded; the message names it, its distribution and the cause."""


@dataclass(frozen=True)
class BackendInfo:
    """What is known about a backend without importing it."""

    name: str
    value: str  # "module:object", as declared
    distribution: str
    version: str
    summary: str = ""
    fault: str | None = None  # why it cannot be loaded, as far as the metadata shows
    hidden: tuple[str, ...] = ()  # other versions of the same distribution, later on sys.path

    def __str__(self) -> str:
        return f"backend '{self.name}' ({self.value}, from {self.distribution} {self.version})"


def list_backends() -> list[BackendInfo]:
    """Return all declared backends, sorted by name, without importing any. A name that is declared twice is listed twice."""
    infos = [info for dist, hidden in _installed() for info in _declared(dist, hidden)]
    return sorted(_with_rivals(infos), key=lambda info: (info.name, info.distribution, info.value))


def load_backend(name: str, wanted_by: str = "") -> Backend:
    """Return the backend of that name, imported and checked.

    Raises ``BackendError``, which names the entry point and, where it is given, the map that needs it (``wanted_by``).
    """
    try:
        return _loaded(name)
    except BackendError as error:
        raise BackendError(f"{wanted_by}: {error}" if wanted_by else str(error)) from error.__cause__


def _loaded(name: str) -> Backend:
    infos = list_backends()
    found = [info for info in infos if info.name == name and name != UNREADABLE]
    if not found:
        raise BackendError(_unknown(name, infos))
    info = found[0]
    if info.fault is not None:
        raise BackendError(f"{info}: {info.fault}")
    return _checked(info, _imported(info))


# Reading metadata. Any metadata file of any distribution may be malformed.


def _installed() -> Iterator[tuple[AnyDistribution, tuple[str, ...]]]:
    """Yield the distributions that ``import`` would use, the first on sys.path, each with the versions that it hides."""
    copies: dict[str, list[AnyDistribution]] = {}
    for dist in distributions():
        copies.setdefault(_normalized(_label(dist)), []).append(dist)
    for first, *others in copies.values():
        shown = _version(first)
        yield first, tuple(dict.fromkeys(v for v in map(_version, others) if v != shown))


def _declared(dist: AnyDistribution, hidden: tuple[str, ...]) -> Iterator[BackendInfo]:
    about = BackendInfo(UNREADABLE, UNREADABLE, _label(dist), _version(dist), hidden=hidden)
    try:
        points = tuple(dist.entry_points.select(group=GROUP))
    except Exception as error:
        if _mentions_group(dist):
            yield replace(about, fault=f"entry_points.txt cannot be read ({_described(error)})")
        return
    for point in points:
        yield _read(replace(about, name=point.name, value=point.value), point, dist)


def _read(info: BackendInfo, point: AnyEntryPoint, dist: AnyDistribution) -> BackendInfo:
    fallback = _metadata(dist, "Summary") or ""
    try:
        module = point.module  # fails where the value is not of the form module:object
    except Exception:
        return replace(info, summary=fallback, fault="expected a value of the form 'module:object'")
    try:
        spec = _spec(module)
    except Exception as error:
        return replace(
            info, summary=fallback, fault=f"module '{module}' cannot be found ({_described(error)})"
        )
    if spec is None:
        return replace(info, summary=fallback, fault=f"module '{module}' is not installed")
    return replace(info, summary=_first_line(spec) or fallback)


def _with_rivals(infos: list[BackendInfo]) -> Iterator[BackendInfo]:
    """Yield the backends, with a fault for each name that is declared more than once, and is therefore ambiguous."""
    for info in infos:
        rivals = [x for x in infos if x.name == info.name and x is not info]
        if rivals and info.name != UNREADABLE:
            also = ", ".join(f"{x.distribution} {x.version} ({x.value})" for x in rivals)
            yield replace(info, fault=f"the name is also claimed by {also}; uninstall one of them")
        else:
            yield info


def _metadata(dist: AnyDistribution, key: str) -> str | None:
    try:
        head, _, readme = (dist.read_text("METADATA") or "").partition("\n\n")
        # The README after the headers would take nearly all of the parsing time.
        values = (message_from_string(head) if readme else dist.metadata).get_all(key)
    except Exception:
        return None
    return str(values[0]) if values else None


def _label(dist: AnyDistribution) -> str:
    return _metadata(dist, "Name") or f"unnamed distribution {getattr(dist, '_path', id(dist))}"


def _version(dist: AnyDistribution) -> str:
    return _metadata(dist, "Version") or "of unknown version"


def _normalized(name: str) -> str:
    return name.lower().replace("-", "_").replace(".", "_")


def _mentions_group(dist: AnyDistribution) -> bool:
    try:
        return GROUP in (dist.read_text("entry_points.txt") or "")
    except Exception:
        return False


# Summaries: the first line of the docstring, from the source as text.


def _spec(module: str) -> ModuleSpec | None:
    """Return the spec of a module. ``find_spec`` alone would import the parents of a dotted name."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top)
    for part in rest:
        if spec is None or spec.submodule_search_locations is None:
            return None
        spec = PathFinder.find_spec(f"{spec.name}.{part}", spec.submodule_search_locations)
    return spec


def _first_line(spec: ModuleSpec) -> str:
    read = getattr(spec.loader, "get_source", None)
    try:
        source = read(spec.name) if read else None
        text = ast.get_docstring(ast.parse(source)) if source else None
    except Exception:  # the source is not valid Python, which loading the backend will report
        return ""
    return text.strip().splitlines()[0] if text and text.strip() else ""


# Loading.


def _imported(info: BackendInfo) -> Any:
    point = EntryPoint(info.name, info.value, GROUP)
    try:
        module = importlib.import_module(point.module)
    except (Exception, SystemExit) as error:
        raise BackendError(f"{info}: cannot be imported: {_described(error)}") from error
    try:
        return reduce(getattr, filter(None, (point.attr or "").split(".")), module)
    except Exception as error:
        raise BackendError(f"{info}: there is no such object: {_described(error)}") from error


def _checked(info: BackendInfo, backend: Any) -> Backend:
    try:
        wrong = next(_defects(backend), None)
    except Exception as error:  # a property may do anything
        raise BackendError(f"{info}: not a backend: {_described(error)}") from error
    if wrong is not None:
        raise BackendError(f"{info}: not a backend: {wrong}")
    return cast(Backend, backend)


def _defects(backend: Any) -> Iterator[str]:
    """Yield the reasons why an object is not a ``Backend``, the most informative one first."""
    missing = [name for name in ("summary", "config_type", *REQUIRED_METHODS) if not hasattr(backend, name)]
    if missing:
        who = f"class {backend.__name__}" if isinstance(backend, type) else type(backend).__name__
        yield f"{who} has no {', '.join(missing)}"
        return
    if isinstance(backend, type):
        yield f"it is the class {backend.__name__} itself, expected an object of it"
    if not isinstance(backend.summary, str):
        yield f"summary is {backend.summary!r}, expected text"
    yield from _config_defects(backend.config_type)
    for name, parameters in REQUIRED_METHODS.items():
        if not _accepts(getattr(backend, name), len(parameters)):
            yield f"{name} does not take ({', '.join(parameters)})"


def _config_defects(config_type: Any) -> Iterator[str]:
    if not (isinstance(config_type, type) and dataclasses.is_dataclass(config_type)):
        yield f"config_type is {config_type!r}, expected a frozen dataclass"
        return
    if not config_type.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        yield f"config_type {config_type.__name__} is a dataclass that is not frozen"
    bare = [field.name for field in dataclasses.fields(config_type) if field.init and not _defaulted(field)]
    if bare:
        yield f"config_type {config_type.__name__} has no default for {', '.join(bare)}"


def _defaulted(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


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


def _described(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _unknown(name: str, infos: list[BackendInfo]) -> str:
    names = sorted({info.name for info in infos} - {UNREADABLE})
    message = (
        f"no backend {name!r}{spelling_hint(name.lower(), names)}; installed: {', '.join(names) or 'none'}"
    )
    unread = [f"{x.distribution} {x.version}: {x.fault}" for x in infos if x.name == UNREADABLE]
    return "; ".join([message, *unread])
