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

import numpy as np
import torch
from jaxtyping import Float, Int

from bidnerf.evaluation.faults import NO_FAULT, check_depth, expand_faults
from bidnerf.scenes import ClosedFormData, is_closed_form
from bidnerf_core.datasets import Capture, DatasetOptions, in_other_split
from bidnerf_core.errors import InputError, InputWarning, amount, refuse_text, unknown_name
from bidnerf_core.frames import INVERTED, HiddenColour
from bidnerf_core.geometry import SE3, perturb, random_units, rotate_about
from bidnerf_core.io import parse_record
from bidnerf_core.localization import find_method, settings_of
from bidnerf_core.settings import LARGEST_SEED, Range, Settings, WholeNumbers, to_flat

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


# The 25 starts of Lin et al. 2023, "Parallel Inversion of Neural Radiance Fields for Robust Pose Estimation", from the
# description of its published bulk experiment. The program seeds NumPy's legacy generator once and draws 5 frames of the test
# file *with* replacement, 5x5x3 Euler angles uniform in +-15 degrees, and 5x5x3 translations uniform in +-0.25. The angles
# (phi, theta, psi) turn the camera about its own centre and the *world's* axes, R' = Rz(phi) Ry(-theta) Rx(psi) R, and the
# centre moves along the world's axes. The numbers depend on the number of frames in the split, since the choice of frames
# consumes random numbers. Ranges and seed are options of the program that its repository sets for each experiment; 1234, 15
# and 0.25 are assumed here. The published scenes may be scaled; here lengths are those of the data.

PARALLEL_SEED, PARALLEL_TRIALS = 1234, 25


def draw_starts(
    frames: int,
) -> tuple[Int[np.ndarray, "5"], Float[np.ndarray, "5 5 3"], Float[np.ndarray, "5 5 3"]]:
    """Return the published frame indices, angles (degrees) and translations (units of the data), bit for bit."""
    generator = np.random.RandomState(PARALLEL_SEED)
    chosen, shape = generator.choice(frames, 5), (5, 5, 3)
    angles = generator.uniform(-15.0, 15.0, size=shape)
    return chosen, angles, generator.uniform(-0.25, 0.25, size=shape)


def parallel_cases(frames: int, trials: int, seed: int) -> list[tuple[int, int]]:
    """Return the frame index and seed of the first ``trials`` of the 25 published trials, whose seeds are 1234 to 1258.

    Raises ``InputError`` for more trials, or if ``seed`` is not 1234, since the list is fixed.
    """
    if seed != PARALLEL_SEED or trials > PARALLEL_TRIALS:
        raise InputError(
            f"{trials} trials from seed {seed}",
            where="parallel",
            expected=f"at most {PARALLEL_TRIALS} from seed {PARALLEL_SEED}, since the list is fixed",
        )
    chosen = draw_starts(frames)[0]
    return [(int(chosen[i // 5]), PARALLEL_SEED + i) for i in range(trials)]


def parallel_start(T_true: SE3, seed: int, frames: int) -> SE3:
    """Return the start (T_world_camera) of the trial with ``seed`` (1234 to 1258) in a split of ``frames`` frames."""
    from scipy.spatial.transform import Rotation  # imported here: other protocols do without

    if not PARALLEL_SEED <= seed < PARALLEL_SEED + PARALLEL_TRIALS:
        last = PARALLEL_SEED + PARALLEL_TRIALS - 1
        raise InputError(f"seed is {seed}", where="parallel", expected=f"{PARALLEL_SEED} to {last}")
    _, angles, moves = draw_starts(frames)
    place = divmod(seed - PARALLEL_SEED, 5)
    phi, theta, psi = angles[place]
    turn = torch.from_numpy(Rotation.from_euler("xyz", (psi, -theta, phi), degrees=True).as_matrix())
    true = T_true.to(dtype=torch.float64)
    return SE3(turn @ true.rotation, true.translation + torch.from_numpy(moves[place]))


Size = tuple[float, ...]
MOST_TRIALS = 100_000
"""The maximum number of trials per size, since all trials of a plan are in memory."""


def each_in_turn(frames: int, trials: int, seed: int, times: int = 1) -> list[tuple[int, int]]:
    """Return the frame index and seed of each trial; all seeds are distinct.

    Frames are taken cyclically in random order, each ``times`` times in a row.
    """
    order = torch.randperm(frames, generator=torch.Generator().manual_seed(seed)).tolist()
    return [(order[i // times % frames], seed + i) for i in range(trials)]


def once_each(frames: int, trials: int, seed: int) -> list[tuple[int, int]]:
    """Return the frame index and seed of each trial: at most ``trials`` distinct frames, in random order; seeds are distinct."""
    return each_in_turn(frames, min(trials, frames), seed)


@dataclass(frozen=True)
class Protocol:
    """A way of choosing frames, seeds and starts.

    ``start`` takes the true pose, a size, the seed and the number of frames, and returns the start, or None
    for no start.
    """

    summary: str
    start: Callable[[SE3, Size, int, int], SE3 | None]
    sizes: tuple[Size, ...] = ((),)  # used by default
    units: tuple[str, ...] = ()  # units of the numbers in a size
    trials: int = 24  # per size, by default
    seed: int = 0
    cases_of: Callable[[int, int, int], list[tuple[int, int]]] = each_in_turn
    """Takes the numbers of frames and trials and the seed; returns the index of the frame and the seed of each trial."""
    fixed: bool = False  # whether it always chooses from all frames of a split

    def cases(self, frames: int, trials: int, seed: int) -> list[tuple[int, int]]:
        """Return the frame index and seed of each trial of one size; a larger number of trials only appends cases."""
        if frames < 1:
            raise InputError("nothing to try:", expected="at least one frame")
        return self.cases_of(frames, trials, seed)

    def check_size(self, size: Size) -> None:
        """Raise ``InputError`` for a size with the wrong number of values, or with a value out of range."""
        most = [180.0 if "deg" in unit else 1e6 for unit in self.units]  # degrees, metres
        if len(size) != len(self.units) or not all(0 <= x <= m for x, m in zip(size, most, strict=True)):
            expected = " : ".join(self.units) or "none, since this protocol has no sizes, as bid and others have"
            limits = f", 0 to {' : '.join(f'{m:g}' for m in most)}" if most else ""
            raise InputError(f"size is {':'.join(f'{x:g}' for x in size) or 'missing'}", expected=f"{expected}{limits}")


PROTOCOLS = {
    "bid": Protocol(
        "BID-NeRF: e_t in a random direction and a rotation from 0.2 rad (at 0.5) to pi/4 (at 3.4)",
        lambda T_true, size, seed, frames: bid_start(T_true, size[0], seed),
        ((0.5,), (0.8,), (1.2,)),
        ("e_t (m)",),
    ),
    "bid-hard": Protocol(
        "like bid, with rotations up to 1.4 rad",
        lambda T_true, size, seed, frames: bid_start(T_true, size[0], seed, 1.4),
        ((0.5,), (0.8,), (1.2,)),
        ("e_t (m)",),
    ),
    "inerf": Protocol(
        "iNeRF: up to 40 degrees about a random axis and up to 0.2 along each axis; five starts per frame",
        lambda T_true, size, seed, frames: inerf_start(T_true, seed),
        trials=25,
        cases_of=partial(each_in_turn, times=5),  # starts for each frame
    ),
    "parallel": Protocol(
        "Parallel Inversion: its 25 starts, up to 15 degrees and 0.25 along each axis",
        lambda T_true, size, seed, frames: parallel_start(T_true, seed, frames),
        trials=PARALLEL_TRIALS,
        seed=PARALLEL_SEED,
        cases_of=parallel_cases,
        fixed=True,
    ),
    "perturb": Protocol(
        "exactly the given errors, in random directions",
        lambda T_true, size, seed, frames: perturb(T_true, size[0], size[1], seed),
        ((0.2, 10.0),),
        ("metres", "degrees"),
    ),
    "none": Protocol(
        "no start at all; one trial per frame",
        lambda T_true, size, seed, frames: None,
        cases_of=once_each,
    ),
}
"""All protocols, by name."""


def find_protocol(name: str) -> Protocol:
    """Return a protocol by name. Raises ``InputError`` for an unknown name."""
    if name not in PROTOCOLS:
        raise unknown_name("protocol", name, PROTOCOLS)
    return PROTOCOLS[name]


# Trials.

FOLDERS = ("map", "data", "depth_points", "masks", "camera", "register_depth")
"""The fields that may name a file or folder."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """The options shared by all trials of a plan."""

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
            value = getattr(self, name, None)  # some of these are fields of ``Trial`` alone
            if "\0" in str(value):
                raise InputError(f"{name} holds a NUL character", expected="the name of a file or folder")
            if isinstance(value, Path):  # stored as text, since trials are written as JSON
                object.__setattr__(self, name, str(value))

    @property
    def reading(self) -> DatasetOptions:
        """The options with which the dataset is read."""
        return DatasetOptions(
            self.camera, self.split, self.register_depth, self.depth_unit, self.masks, self.mask_hides
        )


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
    trials: Annotated[int, WholeNumbers(1, MOST_TRIALS)] | None = (
        None  # of each size; without a start, at most one per frame
    )
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
        given = self.config
        if isinstance(given, Mapping):
            given = settings_of(self.method, dict(given))
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
            raise InputError(f"sizes is {self.sizes!r}", expected="a list of numbers or of lists of numbers") from error
        for size in sizes:
            protocol.check_size(size)
        return sizes


def changed_settings(method: str, settings: Any) -> str:
    """Return the JSON of the settings that differ from the method's defaults."""
    usual, given = to_flat(find_method(method).config_type()), to_flat(settings)
    return json.dumps({k: v for k, v in given.items() if v != usual[k]}, sort_keys=True)


def parse_settings(method: str, config: str) -> Any:
    """Return the settings of ``method`` from the JSON of those that differ from its defaults."""
    given = parse_record("config", config, f"an object of settings of {method}").values
    return settings_of(method, dict(given))


# Plans.


def planned(plan: Plan, map: str, data: str, dataset: Capture) -> list[Trial]:
    """Return the trials of a plan, or of its shard, in the order of the results; ``map`` and ``data`` name the map and ``dataset``.

    Raises ``InputError`` for a plan that cannot be carried out.
    """
    protocol, names = find_protocol(plan.protocol), dataset.frame_names(plan.split)
    check_depth(plan.faults, plan.depth)
    rigs = _rigs(plan, dataset, names, data)
    if protocol.fixed and (plan.frames is not None or len(rigs) < len(names)):
        raise InputError(f"protocol {plan.protocol!r} defines its own frames", expected="one image and all frames")
    count = protocol.trials if plan.trials is None else plan.trials
    cases = protocol.cases(len(rigs), count, protocol.seed if plan.seed is None else plan.seed)
    shared = {field.name: getattr(plan, field.name) for field in fields(Setup)}
    every = [
        Trial(map, data, rigs[place], size, seed, fault, **shared)
        for fault in plan.faults
        for size in plan.starts()
        for place, seed in cases
    ]
    return every[plan.shard :: plan.shards]


def listed(frames: Sequence[str]) -> str:
    """Return the first few of these frame names as text for a message."""
    return ", ".join(frames[:4]) + (", ..." if len(frames) > 4 else "")


def _rigs(plan: Plan, dataset: Capture, names: list[str], data: str) -> list[tuple[str, ...]]:
    """Return the view names (a rig) for each frame to try, without frames that masks hide entirely."""
    for name in plan.frames or ():
        if name not in names:
            others = {split: dataset.frame_names(split) for split in dataset.splits}
            elsewhere = in_other_split(name, others) or f"no frame {name!r}"
            raise InputError(f"split {plan.split!r}: {elsewhere}", where=data)
    wanted = names if plan.frames is None else [name for name in names if name in plan.frames]
    every = set(dataset.wholly_hidden(plan.split))
    hidden = [name for name in wanted if name in every]
    if hidden:
        count = amount(len(hidden), "whole frame")
        text = f"masks hide {count} of {len(wanted)}, not tried: {listed(hidden)}"
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


def arc(poses: Sequence[SE3], last: int, count: int, angle_deg: float) -> tuple[int, ...] | None:
    """Return the indices of ``count`` frames ending with ``last``, ``angle_deg`` apart about a common centre (BID-NeRF, Table 2).

    The centre is the point at which the cameras look: the least-squares intersection of their optical axes. At each step
    about the vertical axis, the frame nearest in direction from the centre is chosen. Both senses of rotation are tried,
    and the better fit is returned; None if at some step no unused frame lies within half a step.
    """
    rotations, positions = (
        torch.stack([T.rotation for T in poses]),
        torch.stack([T.translation for T in poses]),
    )
    eye, axes = torch.eye(3, dtype=torch.float64), rotations[:, :, 2]
    across = eye - axes[:, :, None] * axes[:, None]
    normal = across.sum(0) + 1e-9 * eye  # for parallel axes, any point will do
    middle = torch.linalg.solve(normal, (across @ positions[..., None]).sum(0)[:, 0])
    mean = -rotations[:, :, 1].mean(0)
    up = torch.nn.functional.normalize(mean if mean.norm() > 1e-3 else -rotations[0, :, 1], dim=0)
    directions = torch.nn.functional.normalize(positions - middle, dim=-1)
    fitting = []
    for step in (angle_deg, -angle_deg):
        turns = [rotate_about(poses[last], middle, up, number * step) for number in range(count)]
        ideal = torch.nn.functional.normalize(torch.stack([T.translation for T in turns]) - middle, dim=-1)
        cosines = directions @ ideal.mT  # (frames, steps)
        taken, missed = [last], [0.0]
        for number in range(1, count):
            cosines[taken, number] = -1
            taken.append(int(cosines[:, number].argmax()))
            missed.append(math.acos(min(1.0, float(cosines[taken[-1], number]))))
        if max(missed) <= math.radians(abs(angle_deg)) / 2:
            fitting.append((sum(missed), tuple(reversed(taken))))
    return min(fitting)[1] if fitting else None
