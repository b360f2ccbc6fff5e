"""The state that a tracker keeps between frames, and its file."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import LARGEST_LENGTH
from bidnerf_core.frames import Frame
from bidnerf_core.io import (
    from_plain,
    packed,
    parse_json,
    read_tensors_and_metadata,
    to_plain,
    with_tensors,
    write_file,
)
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.tracking.keyframes import Points
from bidnerf_core.localization.tracking.motion import Clock, Motion

STATE_FORMAT, STATE_VERSION = "bidnerf tracker", 9


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


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The complete state of a tracker between frames."""

    clock: Clock
    motion: Motion | None = None  # None before the first pose was found
    frames: int = 0  # number of frames so far
    lost: int = 0  # consecutive frames without an accepted pose, up to the last one
    searchable: int = 0  # of these, the searchable frames
    waited: float = 0.0  # seconds since the loss, or since the last search of an image
    points: Points = field(default_factory=Points.none)
    image: UInt8[Tensor, "h w"] | None = None  # the last one, grey, in which the points were observed
    sought: int = 0  # number of points when they were last detected
    age: int = 0  # frames since then
    camera: CorrectedCamera | None = None  # found by searches; None while the given intrinsics are used
    noise: float = 1.0  # pixels: of the points in the last image
    moves: bool = False  # whether the camera moved during the readout of the last image
    # Covariance of the pose due to errors of the intrinsics.
    doubt: Float[Tensor, "6 6"] = field(default_factory=lambda: torch.zeros((6, 6), dtype=torch.float64))

    def __post_init__(self) -> None:
        for name in ("frames", "lost", "searchable", "waited", "sought", "age"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} is {getattr(self, name)}", expected="0 or more")
        if self.clock.interval <= 0 or self.noise <= 0:
            raise InputError("the interval or the noise is 0 or less", expected="positive numbers")

    @property
    def tracking(self) -> bool:
        """Whether the pose of the last frame was accepted."""
        return self.motion is not None and self.lost == 0


def save_state(path: Path, state: TrackerState, key: str) -> None:
    """Write a state as safetensors, atomically; ``key`` identifies the map."""
    tensors: dict[str, Tensor] = {}
    numbers = to_plain(state, tensors=tensors)
    content = {"format": STATE_FORMAT, "version": STATE_VERSION, "map": key, "state": numbers}
    write_file(path, tensors_to_bytes(packed(tensors), {"bidnerf": json.dumps(content, allow_nan=False)}))


def load_tracker_state(path: Path, key: str) -> TrackerState:
    """Read a state. Raises ``InputError`` for any other file, another version, or a map other than ``key``."""
    expected = "a file written by Tracker.save"
    tensors, metadata = read_tensors_and_metadata(path, expected)
    found = parse_json(metadata.get("bidnerf", "null"), str(path), expected)
    if not isinstance(found, dict) or found.get("format") != STATE_FORMAT:
        raise InputError("not the state of a tracker", where=path, expected=expected)
    if found.get("version") != STATE_VERSION:
        hint = f"{STATE_VERSION}; begin the sequence anew"
        raise InputError(f"version {found.get('version')!r}", where=path, expected=hint)
    if found.get("map") != key:
        raise InputError(f"belongs to map {found.get('map')!r}, the tracker's is {key!r}", where=path)
    plain = with_tensors(found.get("state"), tensors, str(path))
    state = from_plain(TrackerState, plain, str(path))
    for name, value in tensors.items():
        kind = torch.float32 if name == "points.pixels" else torch.float64
        if value.is_floating_point() and (value.dtype != kind or not bool(value.isfinite().all())):
            raise InputError(f"{name} is not finite, or {value.dtype}", where=path, expected=str(kind))
        if value.is_floating_point() and value.numel() and float(value.abs().max()) > LARGEST_LENGTH:
            raise InputError(
                f"{name} is {float(value.abs().max()):g}", where=path, expected=f"at most {LARGEST_LENGTH:g}"
            )
    points, motion = state.points, state.motion
    if len({len(getattr(points, part.name)) for part in fields(points)}) > 1:
        raise InputError("the points have different numbers of pixels, positions or landmarks", where=path)
    if bool((points.deviations < 0).any()):
        raise InputError("a deviation of the points is negative", where=path)
    if motion is None:
        return state
    T = motion.T_world_camera
    if T.rotation.dim() + T.translation.dim() != 3 or not bool(T.is_rigid().all()):
        raise InputError("the pose of the motion is not rigid", where=path)
    if any(bool((part.diagonal() < 0).any()) for part in (motion.noise, motion.bias)):
        raise InputError("a variance of the motion is negative", where=path)
    if not 0 < motion.reach <= LARGEST_LENGTH:
        raise InputError(f"reach is {motion.reach}", where=path, expected="a positive distance")
    return state
