"""A trial and its result as plain data: the inputs with their digests, and one line of a results file."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.frames import HiddenColour, View
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.io import to_plain
from bidnerf_core.results import PoseError
from bidnerf_core.scenes import is_closed_form

Rows: TypeAlias = tuple[tuple[float, ...], ...]
DIGEST_BYTES = 16  # enough that no two inputs coincide by chance
LARGEST_COUNT = 2**63 - 1
"""The largest count. JSON can hold integers that no tensor or float can."""


@dataclass(frozen=True)
class Trial:
    """Everything that the result of a trial depends on. Raises ``InputError`` for anything that cannot be a
    folder name.
    """

    map: str  # folder, or demo:NAME
    data: str  # folder, or demo:NAME
    frames: tuple[str, ...]  # views of a rig, or one image; the pose of the last one is to be found
    protocol: str = "bid"  # how the start is chosen
    size: tuple[float, ...] = ()  # how far the start is from the truth, in the protocol's units
    method: str = "auto"
    config: str = "{}"  # JSON of the method's settings that differ from its defaults
    seed: int = 0  # of the start and of every random choice of the method
    split: str = "test"
    device: str = "cpu"  # the map's device
    depth: bool = True  # whether the method receives the measured depth
    depth_points: str | None = None  # folder of a COLMAP model whose points the method receives as depth rays
    masks: str | None = None  # folder of masks of the images, see ``MaskFolder``
    mask_hides: HiddenColour = "black"
    fault: str = "none"  # faults of the images and their sizes, such as depth-scale:1.02+exposure:0.7
    camera: str | None = None  # file or name of the camera of images whose format stores none
    register_depth: bool | str | None = None  # file of the depth sensor; False: depth is used as it is
    depth_unit: float | None = None  # metres per step of depth images

    def __post_init__(self) -> None:
        for name in ("map", "data", "depth_points", "masks", "camera", "register_depth"):
            if "\0" in str(getattr(self, name)):
                raise InputError(f"{name} holds a NUL character", expected="the name of a file or folder")

    @property
    def frame(self) -> str:
        """The name of the frame whose pose is to be found."""
        return self.frames[-1]

    @property
    def portable(self) -> Trial:
        """This trial with the names of folders instead of their paths, which differ between machines."""
        points = None if self.depth_points is None else "/".join(_parts(self.depth_points)[-2:])  # sparse/0
        masks, camera = (None if each is None else _name(each) for each in (self.masks, self.camera))
        sensor = _name(self.register_depth) if isinstance(self.register_depth, str) else self.register_depth
        return replace(
            self, map=_name(self.map), data=_name(self.data), depth_points=points, masks=masks, camera=camera,
            register_depth=sensor,
        )  # fmt: skip


@dataclass(frozen=True)
class ScalarPoseError:
    """The distance and the angle between a pose and the true one, as plain numbers."""

    translation: float  # metres
    rotation_deg: float


@dataclass(frozen=True)
class Trace:
    """Errors at the start and after each step; without a start, entry 0 is the method's first pose.

    Raises ``ValueError`` if the two sequences differ in length or are empty.
    """

    translation: tuple[float | None, ...]  # metres; None if a pose was not finite
    rotation_deg: tuple[float | None, ...]

    def __post_init__(self) -> None:
        lengths = len(self.translation), len(self.rotation_deg)
        if lengths[0] != lengths[1] or lengths[0] == 0:
            raise ValueError(
                f"{lengths[0]} translation and {lengths[1]} rotation errors, expected as many of each"
            )

    def as_error(self) -> PoseError:
        """Return the errors as tensors (n), NaN where a pose was not finite."""
        rows = ([math.nan if x is None else x for x in row] for row in (self.translation, self.rotation_deg))
        translation, rotation_deg = (torch.tensor(row, dtype=torch.float64) for row in rows)
        return PoseError(translation, rotation_deg)


@dataclass(frozen=True)
class InputDigests:
    """Digests of the content of a trial's input: folders may move and machines may differ, but the content must not."""

    views: str  # images, depth, intrinsics and true poses of the frames, in hexadecimal
    points: str | None = None  # files of the COLMAP model that depth points were taken from
    surface: str | None = None  # file name of the map's baked surface, which changes with every baking


@dataclass(frozen=True)
class TrialResult:
    """One line of results: the output of ``bidnerf localize --json``, and everything that a report needs.

    Raises ``ValueError`` for a count that does not fit into 64 bits.
    """

    T_world_camera: Rows | None  # 4x4; None if it was not finite
    converged: bool  # according to the method itself
    steps: int
    seconds: float
    covariance: Rows | None
    loss: float | None
    backend: str
    method: str
    error: ScalarPoseError | None  # None if the pose was not finite
    frame: str
    seed: int
    start_error: ScalarPoseError | None  # None if no start was given
    errors: Trace
    reason: str  # why the method stopped
    peak_memory_bytes: int  # of the process during the trial: resident memory, or memory of the GPU
    settings: dict[str, Any]  # all settings of the method
    weights: str  # identifies the map's training run, see ``Map.training``
    trial: Trial  # with folders' names instead of paths
    outcome: str = ""  # the method's outcome; empty in results of earlier versions
    focal_factor: float = 1.0  # ratio of the true to the given focal length, if it was estimated as well
    intrinsics: Intrinsics | None = None  # those used for the pose, if they differ from the given ones
    confidence: float | None = None  # probability that the pose is right; None if unknown
    unit: LengthUnit = "units"  # of all lengths: that of the map
    inputs: InputDigests | None = None  # None in results of earlier versions

    def __post_init__(self) -> None:
        for name in ("steps", "seed", "peak_memory_bytes"):
            if abs(getattr(self, name)) > LARGEST_COUNT:
                raise ValueError(f"{name} is larger than any measurement")


def _name(folder: str) -> str:
    return folder if is_closed_form(folder) else Path(os.path.realpath(folder)).name


def _parts(folder: str) -> tuple[str, ...]:
    return Path(os.path.realpath(folder)).parts[1:]


def views_digest(views: Sequence[View]) -> str:
    """Return the digest of the images, depth, alpha, hidden pixels, intrinsics and poses of ``views``; it depends on their order."""
    hashed = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for view in views:
        frame = view.frame
        camera = json.dumps(to_plain(frame.intrinsics), sort_keys=True)
        hashed.update(f"{frame.name}\n{camera}\n".encode(errors="surrogatepass"))
        for image in (frame.rgb, frame.depth, frame.alpha, view.T_ref_camera.matrix()):
            _add_tensor(hashed, image)
        if frame.hidden is not None:
            _add_tensor(hashed, frame.hidden)
    return hashed.hexdigest()


@lru_cache(maxsize=4)
def folder_digest(folder: str) -> str:
    """Return the digest of the names and contents of the files directly in ``folder``.

    Raises ``InputError`` if one of them cannot be read.
    """
    hashed = hashlib.blake2b(digest_size=DIGEST_BYTES)
    try:
        for path in sorted(path for path in Path(folder).iterdir() if path.is_file()):
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "blake2b").digest()
            hashed.update(path.name.encode(errors="surrogateescape") + b"\n" + content)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=error.filename or folder) from error
    return hashed.hexdigest()


def _add_tensor(hashed: hashlib.blake2b, tensor: Tensor | None) -> None:
    if tensor is None:
        hashed.update(b"none\n")
        return
    array = tensor.detach().cpu().contiguous().numpy()
    hashed.update(f"{array.dtype} {array.shape}\n".encode())
    hashed.update(array.tobytes())
