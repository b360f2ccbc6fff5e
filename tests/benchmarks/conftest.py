"""The modules of the benchmarks, which are scripts beside the package."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from unittest import mock

import pytest

from bidnerf.evaluation import PROTOCOLS

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def script() -> Iterator[Callable[[str], ModuleType]]:
    """Imports a module of the benchmarks, which is forgotten afterwards, with the protocols that it adds."""
    known = set(sys.modules)
    with pytest.MonkeyPatch.context() as patch, mock.patch.dict(PROTOCOLS):
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module
    for name in set(sys.modules) - known:
        if Path(getattr(sys.modules[name], "__file__", None) or "").parent == BENCHMARKS:
            del sys.modules[name]
