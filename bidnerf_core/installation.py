"""The installation: the packages that bidnerf requires, those that its extras add, and which version wrote a file."""

from __future__ import annotations

import contextlib
import functools
import importlib
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Any, NamedTuple

from bidnerf_core.errors import InputError


class Requirement(NamedTuple):
    """A package that bidnerf needs."""

    name: str
    versions: str  # that serve, such as >=2.6
    installed: str | None  # the installed version, if any
    is_met: bool

    def __str__(self) -> str:
        return f"{self.name} {self.installed or 'is missing'}, expected {self.versions or 'any version'}"


@functools.cache
def requirements(extra: str = "") -> list[Requirement]:
    """Return the packages that bidnerf requires or, given the name of an extra, those that the extra adds."""
    # A sound installation without extras needs none of this, and the import takes longer than --help should.
    from packaging.requirements import Requirement as Declared

    found = []
    for line in requires("bidnerf") or ():
        declared = Declared(line)
        always, needed = (declared.marker is None or declared.marker.evaluate({"extra": name}) for name in ("", extra))
        if needed and (not extra or not always):
            try:
                installed = version(declared.name)
            except PackageNotFoundError:
                installed = None
            is_met = installed is not None and declared.specifier.contains(installed, prereleases=True)
            found.append(Requirement(declared.name, str(declared.specifier), installed, is_met))
    return found


def import_extra(module: str, extra: str, what: str, where: object = None, otherwise: str = "") -> Any:
    """Import a module that an extra of bidnerf installs.

    Raises ``InputError`` if it is missing, or if its version is not one that the extra allows. The message begins with ``where``, states
    that ``what`` needs the extra and how to install it, and ends with what to do ``otherwise``.
    """
    needs = f"{what} needs the extra {extra!r} (pip install 'bidnerf[{extra}]')"
    try:
        imported = importlib.import_module(module)
    except ImportError as error:
        raise InputError(needs + otherwise, where=where) from error
    for requirement in requirements(extra):
        if not requirement.is_met:
            raise InputError(f"{needs}: {requirement}", where=where)
    return imported


def with_writer(error: InputError, *writers: object) -> InputError:
    """Return an error about a file that also states which version of bidnerf wrote the file, if it is newer than this one.

    ``writers`` are the versions that are recorded with the file.
    """
    from packaging.version import InvalidVersion, Version

    newest = mine = version("bidnerf")
    for writer in writers:
        with contextlib.suppress(InvalidVersion):
            newest = max(newest, str(writer)[:40], key=Version)
    if newest == mine:
        return InputError(error)
    return InputError(
        error, expected=f"a file of bidnerf {mine} or earlier; bidnerf {newest} wrote it, so upgrade bidnerf"
    )
