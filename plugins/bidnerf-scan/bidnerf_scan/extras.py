"""Packages that only some formats need, which are extras of the distribution."""

from __future__ import annotations

import importlib
from typing import Any

from bidnerf_core.errors import InputError


def library(name: str, what: str, extra: str) -> Any:
    """Import a package of an extra. Raises ``InputError``, which names ``what`` needs it, if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.split(".")[0].replace("skimage", "scikit-image")
        raise InputError(
            f"{what} needs {package}, which is not installed (pip install 'bidnerf-scan[{extra}]')"
        ) from error
