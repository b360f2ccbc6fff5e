"""Packages that only some formats need, which are extras of the distribution."""

from __future__ import annotations

import importlib
from typing import Any

from bidnerf_core.errors import InputError


def library(name: str, what: str, package: str) -> Any:
    """Import a module. Raises ``InputError``, which names ``what`` needs it and what pip installs, if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"{what} needs a missing package: pip install '{package}'") from error
