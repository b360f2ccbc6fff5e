"""Options that several commands share, as annotations and as dataclasses, and their checks."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from bidnerf_core import datasets, mapping  # their parts are loaded when they are used
from bidnerf_core.cli.parser import FLAG, Option, Settings
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.settings import LARGEST_SEED, WholeNumbers

DEFAULT_BACKEND, USUAL_METHOD, USUAL_FEATURES = "hashgrid", "auto", "sift"
TEST_IMAGES = DatasetOptions(split="test")
"""The default options of images on which a map is tried."""

MapFolder: TypeAlias = Annotated[
    Path, Option("MAP", "folder of a map, as written by 'bidnerf train'", positional=True)
]
Method: TypeAlias = Annotated[str, Option("NAME", "how poses are found, one of 'bidnerf plugins methods'")]
Device: TypeAlias = Annotated[str, Option("NAME", "device on which the field computes: cpu, cuda ...")]
Host: TypeAlias = Annotated[
    str | None,
    Option("ADDRESS", "address to listen on, such as 0.0.0.0; others then need a token", "this machine only"),
]
Port: TypeAlias = Annotated[int, WholeNumbers(0, 65535), Option("N", "port to listen on; 0 picks a free one")]
Seed: TypeAlias = Annotated[int, WholeNumbers(0, LARGEST_SEED), Option("N", "seed of every random choice")]
Json: TypeAlias = Annotated[bool, FLAG, Option(None, "print JSON: one value on a line")]
Names: TypeAlias = tuple[str, ...]


BakeSettings: TypeAlias = Annotated[
    Any,
    Settings(lambda *_: mapping.BakeConfig(), "settings of the surface and the landmarks"),
]
PointChoice: TypeAlias = Annotated[
    Any,
    Settings(lambda *_: datasets.SparseChoice(), "which points of a COLMAP model are used"),
]


def _method_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    from bidnerf_core.localization import find_method

    with wrong_usage():
        return find_method(values["method"]).settings(values["preset"])


@dataclass(frozen=True)
class MethodOptions:
    """How poses are found."""

    method: Method = USUAL_METHOD
    preset: Annotated[
        str | None,
        Option("NAME", "method settings to begin with, such as the paper's (default: the usual ones)"),
    ] = None
    config: Annotated[Any, Settings(_method_settings, "settings of the method")] = None


@dataclass(frozen=True)
class MapOptions:
    """The map that is written, and its landmarks."""

    overwrite: Annotated[bool, FLAG, Option(None, "replace the map in --out")] = False
    no_bake: Annotated[bool, FLAG, Option(None, "leave the surface and landmarks to 'bidnerf bake'")] = False
    landmark_features: Annotated[
        str, Option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'")
    ] = USUAL_FEATURES
    device: Device = "cpu"


def require_one(values: Mapping[str, object], required: bool = False) -> None:
    """Raise ``UsageError`` if several options have a value or, where one is required, none has."""
    given = [option for option, value in values.items() if value is not None]
    if len(given) > 1:
        raise UsageError(f"{given[0]} and {given[1]} exclude each other", expected="only one of them")
    if required and not given:
        raise UsageError(f"one of {', '.join(values)} is missing")


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """Convert an ``InputError`` to a ``UsageError`` if the arguments are wrong regardless of the files' contents."""
    try:
        yield
    except InputError as error:
        raise UsageError(error) from error
