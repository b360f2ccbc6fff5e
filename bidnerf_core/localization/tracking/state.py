"""The state that a tracker keeps between frames, its file, and the tracker's answers."""

from __future__ import annotations

import json
import math
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import LARGEST_LENGTH
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.io import from_plain, parse_json, read_tensors_and_metadata, to_plain, write_file
from bidnerf_core.localization.landmarks.pose import CameraDoubt
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.tracking.flow import Grey
from bidnerf_core.localization.tracking.motion import Clock, Motion
from bidnerf_core.localization.tracking.points import FollowedPoints
from bidnerf_core.mapping import Calibration, Kinds, check_kinds, check_range


@dataclass(frozen=True)
class CorrectedCamera:
    """The stated intrinsics of a frame, and the better ones found for it."""

    given: Intrinsics
    found: Intrinsics
    # Whether the frame's focal length was approximate; frames of the other kind are from another source.
    approximate: bool

    def applies_to(self, frame: Frame) -> bool:
        """Return whether the intrinsics of a frame are from the same source."""
        return frame.focal_is_approximate == self.approximate

    def focal_factor(self, frame: Frame) -> float:
        """Return the ratio of a frame's corrected to its given focal length (geometric mean of both axes)."""
        if not self.applies_to(frame):
            return 1.0
        return math.sqrt(self.found.fx * self.found.fy / (self.given.fx * self.given.fy))

    def corrected(self, frame: Frame) -> Frame:
        """Return the frame with corrected intrinsics."""
        return frame.replace(intrinsics=self.changed(frame.intrinsics)) if self.applies_to(frame) else frame

    def stated_in(self, answer: Localization, frame: Frame) -> Localization:
        """Return the answer for a frame with the intrinsics that replace the frame's own, if any."""
        taken = self.corrected(frame).intrinsics
        corrected = None if taken == frame.intrinsics else taken
        return replace(answer, focal_factor=self.focal_factor(frame), intrinsics=corrected)

    def changed(self, camera: Intrinsics) -> Intrinsics:
        """Return corrected intrinsics; those with another focal length or size are changed in proportion."""
        given, found = self.given, self.found
        if camera == given:
            return found
        x, y = camera.width / given.width, camera.height / given.height
        return replace(
            camera, fx=camera.fx * found.fx / given.fx, fy=camera.fy * found.fy / given.fy,
            cx=camera.cx + x * (found.cx - given.cx), cy=camera.cy + y * (found.cy - given.cy),
            distortion=found.distortion if camera.distortion == given.distortion else camera.distortion,
        )  # fmt: skip

    def then(self, later: CorrectedCamera) -> CorrectedCamera:
        """Return this correction followed by the correction ``later``."""
        return replace(self, found=later.changed(self.found))


def after_search(
    frame: Frame, found: Intrinsics, before: CorrectedCamera | None
) -> tuple[Frame, CorrectedCamera]:
    """Return a frame with the intrinsics found for it by a search, and the correction for later frames.

    ``before`` is the correction that was already applied to the frame, if any.
    """
    later = CorrectedCamera(frame.intrinsics, found, frame.focal_is_approximate)
    if before is not None and before.applies_to(frame):
        return later.corrected(frame), before.then(later)
    return later.corrected(frame), later


R = TypeVar("R")

STATE_FORMAT, STATE_VERSION = "bidnerf tracker", 8
KINDS: Kinds = {
    "points.pixels": ((-1, 2), torch.float32), "points.positions": ((-1, 3), torch.float64),
    "points.deviations": ((-1, 2), torch.float64), "points.directions": ((-1, 3), torch.float64),
    "points.landmark": ((-1,), torch.int64), "doubt.covariance": ((6, 6), torch.float64),
    "doubt.other": ((5,), torch.float64), "doubt.numbers": ((3,), torch.float64),
}  # fmt: skip
MOTION_KINDS: Kinds = {
    "motion.rotation": ((3, 3), torch.float64), "motion.translation": ((3,), torch.float64),
    "motion.velocity": ((6,), torch.float64), "motion.noise": ((12, 12), torch.float64), "motion.bias": ((6, 6), torch.float64),
}  # fmt: skip
"""Shapes and dtypes of the tensors in a state's file, -1 for any length."""


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The complete state of a tracker between frames."""

    clock: Clock
    motion: Motion | None = None  # None before the first pose was found
    frames: int = 0  # number of frames so far
    lost: int = 0  # consecutive frames without an accepted pose, up to the last one
    searchable: int = 0  # of these, the searchable frames
    waited: float = 0.0  # seconds since the loss, or since the last search of an image
    points: FollowedPoints = field(default_factory=FollowedPoints.none)
    image: Grey | None = None  # the last one, in which the points were observed
    sought: int = 0  # number of points when they were last detected
    age: int = 0  # frames since then
    doubt: CameraDoubt = field(default_factory=CameraDoubt)  # about the intrinsics
    camera: CorrectedCamera | None = None  # found by searches; None while the given intrinsics are used
    noise: float = 1.0  # pixels: of the points in the last image
    moves: bool = False  # whether the camera moved during the readout of the last image

    @property
    def tracking(self) -> bool:
        """Whether the pose of the last frame was accepted."""
        return self.motion is not None and self.lost == 0


@dataclass(frozen=True)
class StoredNumbers:
    """The numbers of a state as stored in its file, with the names of ``TrackerState`` and ``Motion``."""

    clock: Clock
    camera: CorrectedCamera | None
    frames: int
    lost: int
    searchable: int
    waited: float
    sought: int
    age: int
    noise: float
    moves: bool
    reach: float | None  # None if there is no motion
    agility: float | None

    def __post_init__(self) -> None:
        for name in ("frames", "lost", "searchable", "waited", "sought", "age"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} is {getattr(self, name)}", expected="0 or more")
        if self.clock.interval <= 0 or self.noise <= 0:
            raise InputError("the interval or the noise is 0 or less", expected="positive numbers")
        if (self.reach is None) != (self.agility is None):
            raise InputError("only one of reach and agility is given", expected="both or neither")
        if self.reach is not None and not 0 < self.reach <= LARGEST_LENGTH:
            raise InputError(f"reach is {self.reach}", expected="a positive distance")

    @staticmethod
    def of(state: TrackerState) -> StoredNumbers:
        reach, agility = (None, None) if state.motion is None else (state.motion.reach, state.motion.agility)
        same = {f.name: getattr(state, f.name) for f in fields(StoredNumbers) if hasattr(state, f.name)}
        return StoredNumbers(**same, reach=reach, agility=agility)


def save_state(path: Path, state: TrackerState, key: str) -> None:
    """Write a state as safetensors, atomically; ``key`` identifies the map."""
    tensors = _tensors_of("points", state.points) | _doubt_tensors(state.doubt)
    if state.image is not None:
        tensors["image"] = torch.from_numpy(state.image)
    if state.motion is not None:
        tensors |= _tensors_of("motion", state.motion) | _tensors_of("motion", state.motion.T_world_camera)
    numbers = to_plain(StoredNumbers.of(state))
    content = {"format": STATE_FORMAT, "version": STATE_VERSION, "map": key, "state": numbers}
    metadata = {"bidnerf": json.dumps(content, allow_nan=False)}
    write_file(
        path,
        tensors_to_bytes({name: value.contiguous().clone() for name, value in tensors.items()}, metadata),
    )


def load_tracker_state(path: Path, key: str) -> TrackerState:
    """Read a state. Raises ``InputError`` for any other file, another version, or a map other than ``key``."""
    numbers, tensors = _read(path, key)
    try:
        return _state(numbers, tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"not a whole state of a tracker ({error}), save it anew", where=path) from error


def _read(path: Path, key: str) -> tuple[StoredNumbers, dict[str, Tensor]]:
    expected = "a file written by Tracker.save"
    tensors, metadata = read_tensors_and_metadata(path, expected)
    found = parse_json(metadata.get("bidnerf", "null"), str(path), expected)
    if not isinstance(found, dict) or found.get("format") != STATE_FORMAT:
        raise InputError("not the state of a tracker", where=path, expected=expected)
    if found.get("version") != STATE_VERSION:
        raise InputError(
            f"version {found.get('version')!r}",
            where=path,
            expected=f"{STATE_VERSION}; begin the sequence anew",
        )
    if found.get("map") != key:
        raise InputError(f"belongs to map {found.get('map')!r}, the tracker's is {key!r}", where=path)
    return from_plain(StoredNumbers, found.get("state"), str(path)), tensors


def _state(numbers: StoredNumbers, tensors: dict[str, Tensor]) -> TrackerState:
    _check_tensors(tensors, numbers.reach is not None)
    values = {f.name: getattr(numbers, f.name) for f in fields(numbers)}
    reach, agility = values.pop("reach"), values.pop("agility")
    if reach is not None:
        velocity, noise, bias = (tensors[f"motion.{name}"] for name in ("velocity", "noise", "bias"))
        T = _record(SE3, "motion", tensors)
        values["motion"] = Motion(T, velocity, noise, bias, reach, agility)
    return TrackerState(
        **values, points=_record(FollowedPoints, "points", tensors),
        doubt=_doubt(tensors),
        image=tensors["image"].numpy() if "image" in tensors else None,
    )  # fmt: skip


def _check_tensors(tensors: dict[str, Tensor], moving: bool) -> None:
    """Raise ``KeyError`` or ``ValueError`` for tensors of no valid state; ``moving`` is whether there is a motion."""
    check_kinds(tensors, KINDS | (MOTION_KINDS if moving else {}))
    if len({len(tensors[f"points.{f.name}"]) for f in fields(FollowedPoints)}) > 1:
        raise ValueError(
            "expected equal numbers of pixels, positions, deviations, directions and landmarks of points"
        )
    check_range(tensors, "points.positions", -LARGEST_LENGTH, LARGEST_LENGTH)
    check_range(tensors, "points.deviations", 0.0, LARGEST_LENGTH)
    if "image" in tensors and (tensors["image"].dim() != 2 or tensors["image"].dtype != torch.uint8):
        raise ValueError("image is not a grey image of 8 bits")
    if not moving:
        return
    check_range(tensors, "motion.velocity", -LARGEST_LENGTH, LARGEST_LENGTH)
    if not bool(_record(SE3, "motion", tensors).is_rigid()):
        raise ValueError("the pose of the motion is not rigid")
    if any(bool((tensors[f"motion.{name}"].diagonal() < 0).any()) for name in ("noise", "bias")):
        raise ValueError("a variance of the motion is negative")


def _doubt_tensors(doubt: CameraDoubt) -> dict[str, Tensor]:
    numbers = [doubt.wrong, doubt.expected_shift, float(doubt.other_is_known)]
    found = {"numbers": numbers, "other": astuple(doubt.other)}
    tensors = {f"doubt.{name}": torch.tensor(value, dtype=torch.float64) for name, value in found.items()}
    return tensors | {"doubt.covariance": doubt.covariance}


def _doubt(tensors: dict[str, Tensor]) -> CameraDoubt:
    wrong, shift, known = tensors["doubt.numbers"].tolist()
    other = Calibration(*tensors["doubt.other"].tolist())
    return CameraDoubt(wrong, shift, tensors["doubt.covariance"], other, bool(known))


def _tensors_of(name: str, record: Any) -> dict[str, Tensor]:
    """Return the tensors among a record's fields, under names prefixed with ``name``."""
    values = {f"{name}.{f.name}": getattr(record, f.name) for f in fields(record)}
    return {key: value for key, value in values.items() if isinstance(value, Tensor)}


def _record(kind: type[R], name: str, tensors: dict[str, Tensor]) -> R:
    """Return a record that consists of tensors, from those that ``_tensors_of`` returned."""
    return kind(**{f.name: tensors[f"{name}.{f.name}"] for f in fields(cast(Any, kind))})


METHOD = "track"
"""Method name of a tracker's poses."""


def tracked_localization(motion: Motion, verdict: Verdict, predicted: Motion, loss: float) -> Localization:
    """Convert the state of the motion to the answer for a frame; its path leads from the prediction to the pose."""
    T = motion.T_world_camera
    return Localization(
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=1,
        seconds=0.0,
        loss=loss,
        method=METHOD,
        poses=SE3.stack([predicted.T_world_camera, T]),
        losses=torch.tensor([loss], dtype=torch.float64),
        covariance=motion.covariance,
    )


def unknown(start: SE3 | None, extent: float) -> Localization:
    """Return the answer for a frame if neither its pose nor any earlier one is known.

    ``extent`` (metres) is the size of the scene, in which the camera may be anywhere.
    """
    T = SE3.identity() if start is None else start
    covariance = torch.diag(torch.tensor([extent] * 3 + [math.pi] * 3).double() ** 2)
    return Localization(
        T, Outcome.TOO_FEW_MATCHES, "the beginning of the sequence has not been recognised yet", 0, 0.0, 1.0,
        METHOD, T[None], torch.zeros(0, dtype=torch.float64), covariance,
    )  # fmt: skip
