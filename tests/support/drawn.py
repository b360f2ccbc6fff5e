"""What hypothesis draws for round trips through files: poses, cameras, and records of plain data by their annotations."""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Callable
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import torch
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from bidnerf.evaluation import Trace
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3
from bidnerf_core.settings import Above, Range

numbers = st.floats(-1e6, 1e6)
shares = st.floats(0, 1)
words = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=8)
json_values = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | numbers | words


def poses(most: float = 10.0) -> SearchStrategy[SE3]:
    """Poses of any rotation, a half turn among them, whose positions have coordinates up to ``most``."""
    axis = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 1e-3)
    angle = st.sampled_from([0.0, 1e-9, math.pi / 2, math.pi]) | st.floats(0, math.pi)
    place = st.tuples(*[st.floats(-most, most)] * 3)

    def pose(axis: tuple[float, ...], angle: float, place: tuple[float, ...]) -> SE3:
        turn = torch.tensor(axis, dtype=torch.float64)
        tangent = torch.cat([torch.zeros(3, dtype=torch.float64), angle * turn / turn.norm()])
        return SE3(SE3.exp(tangent).rotation, torch.tensor(place, dtype=torch.float64))

    return st.builds(pose, axis, angle, place)


def cameras(coefficients: tuple[int, ...] = (0, 4, 5, 8)) -> SearchStrategy[Intrinsics]:
    """Cameras with any of these numbers of distortion coefficients."""
    lens = st.sampled_from(coefficients).flatmap(lambda n: st.tuples(*[st.floats(-0.1, 0.1)] * n))
    size, focal, middle = st.integers(1, 5000), st.floats(1, 1e4), st.floats(0, 5000)
    return st.builds(Intrinsics, focal, focal, middle, middle, size, size, lens)


def bounds() -> SearchStrategy[SceneBounds]:
    corner, size = st.floats(-100, 100), st.floats(1e-3, 100)

    def made(
        lower: tuple[float, ...], sizes: tuple[float, ...], near: float, more: float, **others: Any
    ) -> SceneBounds:
        upper = tuple(a + b for a, b in zip(lower, sizes, strict=True))
        return SceneBounds(lower, upper, near, near + more, **others)  # type: ignore[arg-type]

    return st.builds(
        made,
        st.tuples(*[corner] * 3),
        st.tuples(*[size] * 3),
        shares,
        size,
        background=st.tuples(*[shares] * 3),
        contracted=st.booleans(),
        footprint=shares,
    )


def dataset_options() -> SearchStrategy[DatasetOptions]:
    """Options of which JSON can hold every value."""
    text = st.none() | words
    units = st.none() | st.floats(1e-6, 1e-2)
    shared = {"camera": text, "images": text, "split": words, "depth_unit": units}
    masked = st.builds(
        DatasetOptions, **shared, register_depth=text, masks=words, mask_hides=st.sampled_from(["black", "white"])
    )
    return masked | st.builds(
        DatasetOptions, **shared, register_depth=text | st.booleans(), largest=st.none() | st.integers(1, 9)
    )


SPECIAL: dict[type, Callable[[], SearchStrategy[Any]]] = {
    DatasetOptions: dataset_options,
    Intrinsics: cameras,
    SceneBounds: bounds,
    Trace: lambda: st.lists(st.tuples(*[st.none() | numbers] * 2), min_size=1, max_size=3).map(
        lambda pairs: Trace(*zip(*pairs, strict=True))
    ),
    bool: st.booleans,
    float: lambda: numbers,
    str: lambda: words,
    int: lambda: st.integers(0, 2**40),
}


def record(kind: Any, **given: SearchStrategy[Any]) -> SearchStrategy[Any]:
    """Any value of an annotated type, such as a dataclass of plain data; ``given`` draws some fields of this one."""
    if kind in SPECIAL:
        return SPECIAL[kind]()
    if get_origin(kind) is Annotated:
        kind, *notes = get_args(kind)
        limits = next((note for note in notes if isinstance(note, Range)), None)
        if limits is None or isinstance(limits, Above):
            return record(kind).filter(lambda value: limits is None or value in limits)
        least, most = max(limits.least, -1e6), min(limits.most, 1e6)
        return st.floats(least, most) if kind is float else st.integers(int(least), int(most))
    if dataclasses.is_dataclass(kind):
        hints, names = get_type_hints(kind, include_extras=True), [f.name for f in dataclasses.fields(kind)]
        fields = {name: record(hints[name]) for name in names if name not in given}
        return st.builds(kind, **(fields | given))
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return st.sampled_from(parts)
    if origin in (Union, types.UnionType):
        return st.one_of([st.none() if part is type(None) else record(part) for part in parts])
    if origin is tuple:
        many = parts[-1] is Ellipsis
        return st.lists(record(parts[0]), max_size=2).map(tuple) if many else st.tuples(*map(record, parts))
    assert origin is dict, kind
    return st.dictionaries(words, json_values if parts[1] is Any else record(parts[1]), max_size=3)
