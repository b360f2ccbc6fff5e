"""The options that select a method's settings, on which the parser of the other settings depends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeAlias

from bidnerf_core.cli.options import option, value_of, wrong_usage
from bidnerf_core.localization import find_method

Preset: TypeAlias = Annotated[
    str | None,
    option("NAME", "method settings to begin with, such as the paper's", "the defaults"),
]


def chosen_settings(arguments: Sequence[str], usual: str) -> Any:
    """Return the settings of the method given by ``--method``: its defaults, or those of ``--preset``."""
    with wrong_usage():
        method = find_method(value_of("--method", arguments) or usual)
        return method.settings(value_of("--preset", arguments))
