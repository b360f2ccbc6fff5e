"""Options that several commands share, as annotations and as dataclasses, and their checks."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from bidnerf_core.cli.parser import FLAG, Option, Settings
from bidnerf_core.errors import InputError, UsageError

DEFAULT_BACKEND = "hashgrid"
USUAL_METHOD = "auto"

MapFolder: TypeAlias = Annotated[
    Path, Option("MAP", "folder of a map, as written by 'bidnerf train'", positional=True)
]
FeaturesName: TypeAlias = Annotated[
    str, Option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'")
]
Device: TypeAlias = Annotated[str, Option("NAME", "device on which the field computes: cpu, cuda ...")]
Json: TypeAlias = Annotated[bool, FLAG, Option(None, "print JSON: one value on a line")]
Names: TypeAlias = tuple[str, ...]


def _bake_settings(*_: Any) -> Any:
    from bidnerf_core.mapping import BakeConfig

    return BakeConfig()


def _point_choice(*_: Any) -> Any:
    from bidnerf_core.datasets import SparseChoice

    return SparseChoice()


BakeSettings: TypeAlias = Annotated[Any, Settings(_bake_settings)]
PointChoice: TypeAlias = Annotated[Any, Settings(_point_choice)]


def _method_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    from bidnerf_core.localization import find_method

    with wrong_usage():
        return find_method(values["method"]).settings(values["preset"])


@dataclass(frozen=True)
class MethodOptions:
    """How poses are found."""

    method: Annotated[str, Option("NAME", "how poses are found, one of 'bidnerf plugins methods'")] = (
        USUAL_METHOD
    )
    preset: Annotated[
        str | None,
        Option("NAME", "method settings to begin with, such as the paper's (default: the usual ones)"),
    ] = None
    config: Annotated[Any, Settings(_method_settings)] = None
    """settings of the method"""


@dataclass(frozen=True)
class StartOptions:
    """Where to start (default: no start; at most one of these)."""

    start: Annotated[
        Path | None,
        Option("POSE.json", "file with a 4x4 T_world_camera to start from, or with one per query by name"),
    ] = None
    perturb: Annotated[
        tuple[float, float] | None,
        Option("T R", "start from the dataset's pose moved by T metres and R degrees"),
    ] = None
    no_start: Annotated[bool, FLAG, Option(None, "no start is known")] = False

    def __post_init__(self) -> None:
        require_one({"--start": self.start, "--perturb": self.perturb, "--no-start": self.no_start or None})

    def check(self) -> None:
        """Raise ``UsageError`` for a perturbation out of range."""
        from bidnerf_core.evaluation import FARTHEST_START

        limits = (("T", "metres", FARTHEST_START), ("R", "degrees", 180.0))
        for (what, unit, most), value in zip(limits, self.perturb or (), strict=False):
            if not 0 <= value <= most:
                raise UsageError(
                    f"{what} is {value:g}", where="--perturb", expected=f"{unit} from 0 to {most:g}"
                )

    @property
    def given(self) -> bool:
        """Whether there is a start."""
        return self.start is not None or self.perturb is not None


def require_one(values: Mapping[str, object], required: bool = False) -> None:
    """Raise ``UsageError`` if several options have a value or, where one is required, none has."""
    given = [option for option, value in values.items() if value is not None]
    if len(given) > 1:
        raise UsageError(f"{given[0]} and {given[1]} exclude each other", expected="only one of them")
    if required and not given:
        raise UsageError(f"one of {', '.join(values)} is missing")


def require(what: str, value: float, least: float, most: float = math.inf) -> None:
    """Check a number from the command line. Raises ``UsageError`` if it is out of range."""
    if not least <= value <= most:
        expected = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise UsageError(f"{what} is {value}", expected=expected)


def require_different(what: str, names: Sequence[str]) -> None:
    """Check that no name is listed twice. Raises ``UsageError``."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(f"{what} names {twice[0]} more than once", expected="each once")


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """Convert an ``InputError`` to a ``UsageError`` if the arguments are wrong regardless of the files' contents."""
    try:
        yield
    except InputError as error:
        raise UsageError(error) from error
