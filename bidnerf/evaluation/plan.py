"""Protocols, which choose frames, seeds and starts; the options shared by trials; trials, and plans of many trials."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import GetPydanticSchema
from pydantic_core import core_schema

from bidnerf.evaluation.faults import NO_FAULT, check_depth, expand_faults
from bidnerf.scenes import is_closed_form
from bidnerf_core.datasets import TEST_IMAGES, Capture, DatasetOptions
from bidnerf_core.errors import InputError, InputWarning, amount, unknown_name
from bidnerf_core.frames import INVERTED
from bidnerf_core.geometry import SE3, perturb, random_units
from bidnerf_core.io import parse_record
from bidnerf_core.localization import find_method, settings_of
from bidnerf_core.settings import LARGEST_SEED, Settings, WholeNumbers, to_flat

# Protocols.


def bid_start(T_true: SE3, size: float, seed: int, widest: float = math.pi / 4) -> SE3:
    """Return the start of BID-NeRF, ``T_true exp((e_t u1, e_r u2))`` with random unit vectors u1, u2 and e_t = ``size``.

    The paper does not state which e_r belongs to which e_t, only that errors stay below 45 degrees. Here e_r grows
    linearly from 0.2 rad at e_t = 0.5 to ``widest`` (rad) at e_t = 3.4, the ends of the range of e_t in the paper's
    tables. e_t is in units of a scene whose object fills a 2x2x2 cube, and in metres in rooms.
    """
    u1, u2 = random_units(2, torch.Generator().manual_seed(seed))
    e_r = max(0.0, 0.2 + (size - 0.5) / (3.4 - 0.5) * (widest - 0.2))
    return T_true.to(dtype=torch.float64).retract(torch.cat([size * u1, e_r * u2]))


def inerf_start(T_true: SE3, seed: int) -> SE3:
    """Return a start perturbed as in iNeRF (Yen-Chen et al. 2021, IV-A), by up to 40 degrees and 0.2 along each axis.

    The camera is rotated about a random axis through its own centre by an angle drawn uniformly from -40 to 40
    degrees; the offsets (in the unit of the poses) are uniform from -0.2 to 0.2.
    """
    generator = torch.Generator().manual_seed(seed)
    axis = random_units(1, generator)[0]
    chance = 2 * torch.rand(4, generator=generator, dtype=torch.float64) - 1
    turn = SE3.exp(torch.cat([torch.zeros_like(axis), math.radians(40) * chance[0] * axis])).rotation
    return T_true.to(dtype=torch.float64) @ SE3(turn, 0.2 * chance[1:])


Size = tuple[float, ...]
MOST_TRIALS = 100_000
"""The maximum number of trials per size, since all trials of a plan are in memory."""


def each_in_turn(frames: int, trials: int, seed: int, times: int = 1) -> list[tuple[int, int]]:
    """Return the frame index and seed of each trial; all seeds are distinct.

    Frames are taken cyclically in random order, each ``times`` times in a row.
    """
    order = torch.randperm(frames, generator=torch.Generator().manual_seed(seed)).tolist()
    return [(order[i // times % frames], seed + i) for i in range(trials)]


@dataclass(frozen=True)
class Protocol:
    """A way of choosing frames, seeds and starts.

    ``start`` takes the true pose, a size and the seed, and returns the start, or None for no start.
    """

    summary: str
    start: Callable[[SE3, Size, int], SE3 | None]
    sizes: tuple[Size, ...] = ((),)  # used by default
    units: tuple[str, ...] = ()  # units of the numbers in a size
    trials: int = 24  # per size, by default
    seed: int = 0
    cases: Callable[[int, int, int], list[tuple[int, int]]] = each_in_turn
    """Takes the numbers of frames and trials and the seed; returns the index of the frame and the seed of each trial of one
    size. A larger number of trials only appends cases."""

    def check_size(self, size: Size) -> None:
        """Raise ``InputError`` for a size with the wrong number of values, or with a value out of range."""
        most = [180.0 if unit == "DEGREES" else 1e6 for unit in self.units]
        if len(size) != len(self.units) or not all(0 <= x <= m for x, m in zip(size, most, strict=True)):
            limits = ":".join("0" for _ in most), ":".join(f"{largest:g}" for largest in most)
            raise InputError(
                f"size is {':'.join(f'{x:g}' for x in size) or 'missing'}",
                expected=f"{':'.join(self.units)} from {limits[0]} to {limits[1]}"
                if self.units
                else "no size with this protocol; bid, bid-hard and perturb have sizes",
            )


PROTOCOLS = {
    "bid": Protocol(
        "BID-NeRF: e_t in a random direction and a rotation from 0.2 rad (at 0.5) to pi/4 (at 3.4)",
        lambda T_true, size, seed: bid_start(T_true, size[0], seed),
        ((0.5,), (0.8,), (1.2,)),
        ("LENGTH",),
    ),
    "bid-hard": Protocol(
        "like bid, with rotations up to 1.4 rad",
        lambda T_true, size, seed: bid_start(T_true, size[0], seed, 1.4),
        ((0.5,), (0.8,), (1.2,)),
        ("LENGTH",),
    ),
    "inerf": Protocol(
        "iNeRF: up to 40 degrees about a random axis and up to 0.2 along each axis; five starts per frame",
        lambda T_true, size, seed: inerf_start(T_true, seed),
        trials=25,
        cases=partial(each_in_turn, times=5),  # starts for each frame
    ),
    "perturb": Protocol(
        "exactly the given errors, in random directions",
        lambda T_true, size, seed: perturb(T_true, size[0], size[1], seed),
        ((0.2, 10.0),),
        ("LENGTH", "DEGREES"),
    ),
    "none": Protocol(
        "no start at all; one trial per frame",
        lambda T_true, size, seed: None,
        cases=lambda frames, trials, seed: each_in_turn(frames, min(trials, frames), seed),
    ),
}
"""All protocols, by name."""


def find_protocol(name: str) -> Protocol:
    """Return a protocol by name. Raises ``InputError`` for an unknown name."""
    if name not in PROTOCOLS:
        raise unknown_name("protocol", name, PROTOCOLS)
    return PROTOCOLS[name]


# Trials.


StoredOptions = Annotated[
    DatasetOptions,
    # pydantic cannot resolve the annotations of ``DatasetOptions``, which names types that it does not import.
    GetPydanticSchema(
        lambda kind, handler: core_schema.no_info_plain_validator_function(
            lambda given: given if isinstance(given, DatasetOptions) else DatasetOptions(**given)
        )
    ),
]


@dataclass(frozen=True, kw_only=True)
class Setup:
    """The options shared by all trials of a plan."""

    protocol: str = "none"  # how starts are chosen
    method: str = "auto"
    config: str = "{}"  # JSON of the method's settings that differ from its defaults
    images: StoredOptions = TEST_IMAGES  # how the dataset is read; only names, paths and numbers, since trials are JSON
    device: str = "cpu"  # of a map that is read from a folder
    depth: bool = True  # whether the method receives the measured depth

    def __post_init__(self) -> None:
        images: dict[str, Any] = {
            name: str(value) if isinstance(value, Path) else value for name, value in vars(self.images).items()
        }
        object.__setattr__(self, "images", DatasetOptions(**images))
        files = {name: getattr(self, name, None) for name in ("map", "data")} | images  # ``Trial`` alone has a map
        for name, value in files.items():
            if not isinstance(value, str | float | int | None):
                raise InputError(
                    f"{name} is a {type(value).__name__}",
                    expected="text, a number or the path of a file, since trials are written as JSON",
                )
            if name != "split" and "\0" in str(value):
                raise InputError(f"{name} holds a NUL character", expected="the name of a file or folder")


USUAL_SETUP = Setup()


@dataclass(frozen=True)
class Trial(Setup):
    """Everything that the result of a trial depends on."""

    map: str  # folder, demo:NAME, or a name for a map in memory
    data: str
    frames: tuple[str, ...]  # views of a rig, or one image; the pose of the last one is to be found
    size: Size = ()  # how far the start is from the truth, in the protocol's units
    seed: int = 0  # of the start and of every random choice of the method
    fault: str = NO_FAULT  # faults of the images and their sizes, such as depth-scale:1.02+exposure:0.7

    @classmethod
    def __get_pydantic_core_schema__(cls, kind: Any, handler: Any) -> core_schema.CoreSchema:
        """Read a trial from an object of flat names, as ``to_flat`` writes it."""

        def nested(flat: Any) -> Any:
            if not isinstance(flat, dict):
                return flat
            options = vars(TEST_IMAGES)
            images = {name: flat.get(name, usual) for name, usual in options.items()}
            others = {name: value for name, value in flat.items() if name not in options}
            # JSON has lists where a trial has tuples.
            return {n: tuple(v) if isinstance(v, list) else v for n, v in others.items()} | {"images": images}

        return core_schema.no_info_before_validator_function(nested, handler(kind))

    @property
    def frame(self) -> str:
        """The name of the frame whose pose is to be found."""
        return self.frames[-1]

    @property
    def portable(self) -> Trial:
        """This trial with the names of files and folders instead of their paths, which differ between machines."""

        def last(value: Any) -> Any:
            is_path = isinstance(value, str) and not is_closed_form(value)
            return Path(os.path.realpath(value)).name if is_path else value

        options = {name: value if name == "split" else last(value) for name, value in vars(self.images).items()}
        return replace(self, map=last(self.map), data=last(self.data), images=replace(self.images, **options))


@dataclass(frozen=True, kw_only=True)
class Plan(Setup, Settings):
    """A set of trials. None selects the protocol's own sizes, number of trials and seed.

    Raises ``InputError`` for an unknown protocol, method or fault, and for settings and numbers that are invalid for any
    map and dataset.
    """

    sizes: Sequence[float | Sequence[float]] | None = None  # errors of the starts, in the protocol's units
    # settings of the method, a dictionary of those that differ from the defaults, or its JSON
    config: Any = "{}"
    trials: Annotated[int, WholeNumbers(1, MOST_TRIALS)] | None = (
        None  # of each size; without starts, one per frame at most
    )
    seed: Annotated[int, WholeNumbers(0, LARGEST_SEED)] | None = None
    frames: Sequence[str] | None = None  # use only these
    first: Annotated[int, WholeNumbers(1)] | None = None  # use only the first ones, in the order of the dataset
    faults: Sequence[str] = (NO_FAULT,)  # each is applied to the same frames from the same starts

    def __post_init__(self) -> None:
        Setup.__post_init__(self)
        Settings.__post_init__(self)
        config = self.config
        if not isinstance(config, str):
            settings = settings_of(self.method, dict(config)) if isinstance(config, Mapping) else config
            config = changed_settings(self.method, settings)
        parse_settings(self.method, config)
        object.__setattr__(self, "config", config)
        object.__setattr__(self, "faults", expand_faults(self.faults) or (NO_FAULT,))
        self.starts()  # checks the sizes
        if self.protocol == "none" and find_method(self.method).needs_start:
            others = " or ".join(name for name in PROTOCOLS if name != "none")
            raise InputError(
                f"method {self.method!r} needs a start, which `protocol` none does not give", expected=others
            )

    def starts(self) -> tuple[Size, ...]:
        """Return the sizes of the starts: those given, or the protocol's."""
        protocol = find_protocol(self.protocol)
        if self.sizes is None:
            return protocol.sizes
        try:
            rows = (size if isinstance(size, Sequence) else [size] for size in self.sizes)
            sizes = tuple(tuple(map(float, row)) for row in rows)
        except (TypeError, ValueError) as error:
            raise InputError(f"sizes is {self.sizes!r}", expected="a list of numbers or of lists of numbers") from error
        for size in sizes:
            protocol.check_size(size)
        return sizes


def changed_settings(method: str, settings: Any) -> str:
    """Return the JSON of the settings that differ from the method's defaults."""
    usual = to_flat(find_method(method).config_type())
    changed = {name: value for name, value in to_flat(settings).items() if value != usual[name]}
    return json.dumps(changed, sort_keys=True)


def parse_settings(method: str, config: str) -> Any:
    """Return the settings of ``method`` from the JSON of those that differ from its defaults."""
    return settings_of(method, dict(parse_record("config", config, f"an object of settings of {method}").values))


# Plans.


def list_trials(plan: Plan, map: str, data: str, dataset: Capture) -> list[Trial]:
    """Return the trials of a plan, in the order of the results.

    ``map`` and ``data`` are the names of the map and of ``dataset``. Frames that masks hide entirely are not tried, with
    an ``InputWarning``. Raises ``InputError`` for a plan that cannot be carried out.
    """
    split = plan.images.split
    protocol, names = find_protocol(plan.protocol), dataset.frame_names(split)
    check_depth(plan.faults, plan.depth)
    dataset.select(split, plan.frames)  # raises for an unknown name
    chosen = [name for name in names if plan.frames is None or name in plan.frames][: plan.first]
    hidden = [name for name in dataset.hidden_frames(split) if name in chosen]
    visible = [name for name in chosen if name not in hidden]
    if hidden:
        where, more = plan.images.masks or data, ", ..." if len(hidden) > 4 else ""
        listed = f"{', '.join(hidden[:4])}{more}"
        text = f"masks hide {amount(len(hidden), 'whole frame')} of {len(chosen)}, not tried: {listed}"
        if not visible:
            raise InputError(f"{text}; {INVERTED}", where=where)
        warnings.warn(f"{where}: {text}", InputWarning, stacklevel=2)
    if not visible:
        raise InputError("nothing to try:", expected="at least one frame")
    count = protocol.trials if plan.trials is None else plan.trials
    cases = protocol.cases(len(visible), count, protocol.seed if plan.seed is None else plan.seed)
    shared = {field.name: getattr(plan, field.name) for field in fields(Setup)}
    return [
        Trial(map, data, (visible[index],), size, seed, fault, **shared)
        for fault in plan.faults
        for size in plan.starts()
        for index, seed in cases
    ]
