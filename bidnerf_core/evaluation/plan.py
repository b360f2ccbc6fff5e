"""What is tried: the options that trials share, a single trial, and a plan of many."""

from __future__ import annotations

import json
import logging
import os
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

from bidnerf_core.datasets import Capture, DatasetOptions, in_other_split
from bidnerf_core.errors import InputError, InputWarning, amount, refuse_text
from bidnerf_core.evaluation.arcs import arc
from bidnerf_core.evaluation.faults import NO_FAULT, check_depth, expand_faults
from bidnerf_core.evaluation.protocols import MOST_TRIALS, Size, find_protocol
from bidnerf_core.frames import INVERTED, HiddenColour, MaskFolder
from bidnerf_core.io import parse_record
from bidnerf_core.localization import find_method, settings_of
from bidnerf_core.maps import Map
from bidnerf_core.scenes import ClosedFormData, closed_form_data, is_closed_form
from bidnerf_core.settings import LARGEST_SEED, Range, Settings, WholeNumbers, to_flat

log = logging.getLogger("bidnerf")

FOLDERS = ("map", "data", "depth_points", "masks", "camera", "register_depth")
READING = ("split", "device", "masks", "mask_hides", "camera", "register_depth", "depth_unit")
"""The options that decide how a map and a dataset are read."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What all trials of a plan share. Raises ``InputError`` for anything that cannot be the name of a file or folder."""

    protocol: str = "none"  # how starts are chosen
    method: str = "auto"
    config: str = "{}"  # JSON of the method's settings that differ from its defaults
    split: str = "test"
    device: str = "cpu"  # of a map that is read from a folder
    depth: bool = True  # whether the method receives the measured depth
    depth_points: str | None = None  # folder of a COLMAP model whose points the method receives as depth rays
    masks: str | None = None  # folder of masks of the images, see ``MaskFolder``
    mask_hides: HiddenColour = "black"
    camera: str | None = None  # file or name of the camera of images whose format stores none
    register_depth: bool | str | None = None  # file of the depth sensor; False: depth is used as it is
    depth_unit: float | None = None  # metres per step of depth images

    def __post_init__(self) -> None:
        for name in FOLDERS:
            value = getattr(self, name, None)
            if "\0" in str(value):
                raise InputError(f"{name} holds a NUL character", expected="the name of a file or folder")
            if isinstance(value, Path):
                object.__setattr__(self, name, str(value))

    @property
    def reading(self) -> Setup:
        """The setup that reads the same map and data, with everything else at its default."""
        return Setup(**{name: getattr(self, name) for name in READING})

    def open(self, name: str, stored: Map | None = None) -> Capture:
        """Open the dataset in the folder ``name``, or of the closed-form scene of that name; ``stored`` gives the background colour."""
        if is_closed_form(name):
            return self.prepared(closed_form_data(name))
        options = DatasetOptions(
            self.camera, self.split, self.register_depth, self.depth_unit, self.masks, self.mask_hides,
            background=None if stored is None else stored.bounds.background,
        )  # fmt: skip
        return options.open(name)

    def prepared(self, dataset: Capture) -> Capture:
        """Return a dataset in memory with its masks. Raises ``InputError`` for options of files."""
        if not self.camera is self.register_depth is self.depth_unit is None:
            raise InputError(
                "has its own cameras and depth; leave out camera, register_depth and depth_unit",
                where=dataset.path,
            )
        return dataset if self.masks is None else dataset.masked(MaskFolder(self.masks, self.mask_hides))


@dataclass(frozen=True)
class Trial(Setup):
    """Everything that the result of a trial depends on."""

    map: str  # folder, demo:NAME, or a name for a map in memory
    data: str
    frames: tuple[str, ...]  # views of a rig, or one image; the pose of the last one is to be found
    size: Size = ()  # how far the start is from the truth, in the protocol's units
    seed: int = 0  # of the start and of every random choice of the method
    fault: str = NO_FAULT  # faults of the images and their sizes, such as depth-scale:1.02+exposure:0.7

    @property
    def frame(self) -> str:
        """The name of the frame whose pose is to be found."""
        return self.frames[-1]

    @property
    def portable(self) -> Trial:
        """This trial with the names of folders instead of their paths, which differ between machines."""
        names: dict[str, Any] = {}
        for field in FOLDERS:
            value = getattr(self, field)
            if isinstance(value, str) and not is_closed_form(value):
                length = 2 if field == "depth_points" else 1  # sparse/0
                names[field] = "/".join(Path(os.path.realpath(value)).parts[1:][-length:])
        return replace(self, **names)


@dataclass(frozen=True, kw_only=True)
class Plan(Setup, Settings):
    """A set of trials. None selects the protocol's own sizes, number of trials and seed.

    Raises ``InputError`` for an unknown protocol, method or fault, and for settings and numbers that are invalid for any
    map and dataset.
    """

    sizes: Sequence[float | Sequence[float]] | None = None  # errors of the starts, in the protocol's units
    # settings of the method, a dictionary of those that differ from the defaults, or its JSON
    config: Any = "{}"
    trials: Annotated[int, WholeNumbers(1, MOST_TRIALS)] | None = None  # of each size
    seed: Annotated[int, WholeNumbers(0, LARGEST_SEED)] | None = None
    frames: Sequence[str] | None = None  # use only these
    images: Annotated[int, WholeNumbers(1, 1000)] = 1  # length of the sequence that is localized jointly
    angle: Annotated[float, Range(0.01, 360.0)] = 15.0  # degrees between neighbours of a sequence
    faults: Sequence[str] = (NO_FAULT,)  # each is applied to the same frames from the same starts
    shard: int = 0  # the part to run, of ``shards``: every ``shards``-th trial
    shards: Annotated[int, WholeNumbers(1, MOST_TRIALS)] = 1

    def __post_init__(self) -> None:
        Setup.__post_init__(self)
        Settings.__post_init__(self)
        for name in ("faults", "frames", "sizes"):
            refuse_text(name, getattr(self, name))
        for name in ("trials", "seed", "images", "shard", "shards"):  # generators and ranges refuse 2.0
            if type(getattr(self, name)) not in (int, type(None)):
                raise InputError(f"{name} is {getattr(self, name)!r}", expected="a whole number")
        if not 0 <= self.shard < self.shards:
            raise InputError(f"shard is {self.shard}", expected=f"0 to {self.shards - 1}")
        twice = [name for name, count in Counter(self.frames or ()).items() if count > 1]
        if twice:
            raise InputError(f"frames names {twice[0]} more than once", expected="each once")
        given = (
            settings_of(self.method, dict(self.config)) if isinstance(self.config, Mapping) else self.config
        )
        text = given if isinstance(given, str) else changed_settings(self.method, given)
        parse_settings(self.method, text)
        object.__setattr__(self, "config", text)
        object.__setattr__(self, "faults", expand_faults(self.faults) or (NO_FAULT,))
        self.starts()  # checks the sizes

    def starts(self) -> tuple[Size, ...]:
        """Return the sizes of the starts: those given, or the protocol's."""
        protocol = find_protocol(self.protocol)
        if self.sizes is None:
            return protocol.sizes
        try:
            rows = (size if isinstance(size, Sequence) else [size] for size in self.sizes)
            sizes = tuple(tuple(map(float, row)) for row in rows)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"sizes is {self.sizes!r}", expected="a list of numbers or of lists of numbers"
            ) from error
        for size in sizes:
            protocol.check_size(size)
        return sizes


def planned(plan: Plan, map: str, data: str, dataset: Capture) -> list[Trial]:
    """Return all trials of a plan in the order of the results; ``map`` and ``data`` name the map and ``dataset``.

    Raises ``InputError`` for a plan that cannot be carried out.
    """
    protocol, names = find_protocol(plan.protocol), dataset.frame_names(plan.split)
    check_depth(plan.faults, plan.depth)
    rigs = _rigs(plan, dataset, names, data)
    if protocol.fixed and (plan.frames is not None or len(rigs) < len(names)):
        raise InputError(
            f"protocol {plan.protocol!r} defines its own frames", expected="one image and all frames"
        )
    count = protocol.trials if plan.trials is None else plan.trials
    cases = protocol.cases(len(rigs), count, protocol.seed if plan.seed is None else plan.seed)
    if plan.trials is not None and len(cases) < plan.trials:
        log.info(
            f"{amount(len(cases), 'trial')}, one per frame, instead of {plan.trials}: without a start,"
            " repeating a frame gives no new information"
        )
    shared = {field.name: getattr(plan, field.name) for field in fields(Setup)}
    every = [
        Trial(map, data, rigs[place], size, seed, fault, **shared)
        for fault in plan.faults
        for size in plan.starts()
        for place, seed in cases
    ]
    return every[plan.shard :: plan.shards]


def repeated_frames(trials: Sequence[Trial]) -> str | None:
    """Return a sentence about frames that are tried several times at each size, or None if there are none."""
    times = Counter((trial.fault, trial.size, trial.frames) for trial in trials)
    if not times or max(times.values()) == 1:
        return None
    frames = len({frames for _, _, frames in times})
    fewest, most = min(times.values()), max(times.values())
    often = f"{most}" if fewest == most else f"{fewest} to {most}"
    a_size = " of each size" if len({size for _, size, _ in times}) > 1 else ""
    distinct = f"{frames} distinct frame{'s' if frames > 1 else ''}"
    return f"{distinct} of split {trials[0].split!r}, each tried {often} times{a_size} with different seeds"


def changed_settings(method: str, settings: Any) -> str:
    """Return the JSON of the settings that differ from the method's defaults."""
    usual, given = to_flat(find_method(method).config_type()), to_flat(settings)
    return json.dumps({k: v for k, v in given.items() if v != usual[k]}, sort_keys=True)


def parse_settings(method: str, config: str) -> Any:
    """Return the settings of ``method`` from the JSON of those that differ from its defaults."""
    return settings_of(
        method, dict(parse_record("config", config, f"an object of settings of {method}").values)
    )


def listed(frames: Sequence[str]) -> str:
    """Return the first few names of frames, for a message."""
    return ", ".join(frames[:4]) + (", ..." if len(frames) > 4 else "")


def _rigs(plan: Plan, dataset: Capture, names: list[str], data: str) -> list[tuple[str, ...]]:
    """Return the names of the views for each frame that may be tried: those of which masks leave something visible."""
    for name in plan.frames or ():
        if name not in names:
            others = {split: dataset.frame_names(split) for split in dataset.splits}
            elsewhere = in_other_split(name, others) or f"no frame {name!r}"
            raise InputError(f"split {plan.split!r}: {elsewhere}", where=data)
    wanted = names if plan.frames is None else [name for name in names if name in plan.frames]
    every = set(dataset.wholly_hidden(plan.split))
    hidden = [name for name in wanted if name in every]
    if hidden:
        text = (
            f"masks hide {amount(len(hidden), 'whole frame')} of {len(wanted)}, not tried: {listed(hidden)}"
        )
        if len(hidden) == len(wanted):
            raise InputError(f"{text}; {INVERTED}", where=plan.masks or data)
        warnings.warn(f"{plan.masks or data}: {text}", InputWarning, stacklevel=3)
    visible = [name for name in wanted if name not in every]
    if plan.images == 1:
        return [(name,) for name in visible]
    if isinstance(dataset, ClosedFormData):
        return [dataset.sequence(name, plan.images, plan.angle) for name in visible]
    poses = {view.frame.name: view.T_ref_camera for view in dataset.views(plan.split)}
    seen = list(poses)  # without frames that masks hide altogether
    arcs = (arc(list(poses.values()), seen.index(n), plan.images, plan.angle) for n in visible if n in poses)
    rigs = [tuple(seen[place] for place in places) for places in arcs if places is not None]
    if not rigs:
        raise InputError(
            f"no frame of split {plan.split!r} ends a sequence of {plan.images} frames {plan.angle:g}"
            " degrees apart around what the cameras look at",
            where=data,
        )
    return rigs
