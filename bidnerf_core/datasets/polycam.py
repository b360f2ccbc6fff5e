"""Raw data exported by the iOS app Polycam (https://github.com/PolyCam/polyform): folders with ``keyframes``.

``keyframes/cameras/TIME.json`` has ``fx fy cx cy width height`` and ``t_00`` to ``t_23``, the rows of ARKit's
camera-to-world matrix (OpenGL axes, +y up); TIME is in microseconds. ``keyframes/corrected_cameras`` and
``corrected_images`` have the poses after global optimization and undistorted photos; they are used if they
exist, else ``cameras`` and ``images``. Newer exports store no size, so the photo's size is used.
``keyframes/depth/TIME.png`` is planar z in millimetres at a lower resolution, with
``keyframes/confidence/TIME.png`` (0 low, 127 medium, 255 high). See ``phone_scans`` for how both are read.

Undistorted photos have a black border, which must not be learned: 15 pixels of it are hidden, the width that
other software crops. Every eighth photo (the first, the ninth ...) is held out as "test" and the others are
"train".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.incomplete import present, remark
from bidnerf_core.datasets.phone_scans import CENTRE_OF_PIXEL, Measured, SureDepth, scan_frame
from bidnerf_core.datasets.phone_scans import HIGH_CONFIDENCE as ARKIT_CONFIDENCE
from bidnerf_core.datasets.pose_rows import pose_of_rows
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits, hold_out
from bidnerf_core.depth import MILLIMETRE, read_depth_image
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, natural_order
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import Background, Record, decode, is_file, read_compact_image, read_record

BORDER = 15
"""Width in pixels of the hidden border of an undistorted photo."""
HIGH_CONFIDENCE = 255
MICROSECONDS = 1_000_000
SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, eq=False)
class PolycamFrame:
    """A photo with its camera."""

    image: Path
    record: Record
    T_world_camera: SE3
    corrected: bool
    depth: Path | None
    confidence: Path | None

    @property
    def stem(self) -> str:
        return self.image.stem

    @property
    def parts(self) -> tuple[str, ...]:
        return (self.stem,)

    @property
    def time(self) -> float | None:
        return int(self.stem) / MICROSECONDS if self.stem.isdecimal() else None


class PolycamReader(Reader):
    """Reader for Polycam's raw data."""

    expected = "keyframes/images and keyframes/cameras, or the corrected ones (Polycam, raw data)"

    def recognises(self, path: Path) -> bool:
        return any(_folders(path, corrected) is not None for corrected in (True, False))

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the cameras. Raises ``InputError`` if one is invalid, and if no photo has one."""
        return self._open(path, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        return self._open(path, options).sequence()

    def _open(self, path: Path, options: ReadOptions) -> PolycamDataset:
        return PolycamDataset(Splits(path, hold_out(_frames(path))), options.background)


class PolycamDataset(SplitDataset[PolycamFrame]):
    """Views of Polycam's raw data; see ``Dataset``."""

    unit: LengthUnit | None = "metres"
    up: tuple[float, float, float] | None = (0.0, 1.0, 0.0)  # ARKit aligns its world with gravity

    def __init__(self, frames: Splits[PolycamFrame], background: Background | None) -> None:
        super().__init__(frames, background)
        self._sure = SureDepth()

    def _pose(self, frame: PolycamFrame) -> SE3:
        return frame.T_world_camera

    def _frame(self, frame: PolycamFrame, name: str) -> Frame:
        rgb, _ = read_compact_image(frame.image, self._background)
        camera = _camera(frame.record, rgb.shape[1], rgb.shape[0])
        found = scan_frame(name, rgb, camera, _depth(frame, self._sure), frame.image)
        if not frame.corrected:
            return found
        border = max(1, round(BORDER * found.intrinsics.width / rgb.shape[1]))
        hidden = torch.ones(found.rgb.shape[:2], dtype=torch.bool)
        hidden[border:-border, border:-border] = False
        return found if bool(hidden.all()) else replace(found, hidden=hidden)


def _folders(path: Path, corrected: bool) -> tuple[Path, Path] | None:
    """Return the folders of photos and cameras, or None if one of them is missing or empty."""
    prefix = "corrected_" if corrected else ""
    for base in (path / "keyframes", path):
        images, cameras = base / f"{prefix}images", base / f"{prefix}cameras"
        if images.is_dir() and cameras.is_dir() and any(cameras.glob("*.json")):
            return images, cameras
    return None


def _frames(path: Path) -> list[PolycamFrame]:
    corrected, found = True, _folders(path, True)
    if found is None:
        corrected, found = False, _folders(path, False)
        remark(
            path,
            "has no corrected_cameras, so the poses are ARKit's, which drift; Polycam can correct them on"
            " export",
        )
    assert found is not None  # ensured by recognises
    images, cameras = found
    descriptions = sorted(cameras.glob("*.json"), key=lambda file: natural_order(file.name))
    photos = {file.stem: file for file in images.iterdir() if file.suffix.lower() in SUFFIXES}
    kept = present(
        descriptions,
        lambda file: file.stem in photos,
        images,
        lambda file: f"{file.stem}.jpg",
        lambda file: InputError(f"no such file, although {file} exists", where=f"{images / file.stem}.jpg"),
        noun="photo",
    )
    if alone := len(photos) - len(kept):
        remark(
            images,
            f"{alone} of {amount(len(photos), 'photo')} have no camera in {cameras.name} and are left out",
        )
    frames = [_frame(file, photos[file.stem], cameras.parent, corrected) for file in kept]
    measured = [frame for frame in frames if frame.depth is not None]
    if measured and len(measured) < len(frames):
        remark(path, f"{len(frames) - len(measured)} of {amount(len(frames), 'photo')} have no depth")
    return frames


def _frame(description: Path, photo: Path, base: Path, corrected: bool) -> PolycamFrame:
    record = read_record(description)
    rows = [[record.number(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    missing = [f"t_{row}{column}" for row in range(3) for column in range(4) if rows[row][column] is None]
    if missing:
        raise record.error(f"no {missing[0]}", expected="t_00 to t_23, the rows of the camera's pose")
    files = [base / kind / f"{description.stem}.png" for kind in ("depth", "confidence")]
    depth, confidence = (file if is_file(file) else None for file in files)
    pose = pose_of_rows(record, "t_00 to t_23", rows)
    return PolycamFrame(photo, record, pose, corrected, depth, confidence if depth is not None else None)


def _camera(record: Record, width: int, height: int) -> Intrinsics:
    """Return the camera of a photo of this size, which newer exports do not state."""
    numbers = [record.number(key) for key in ("fx", "fy", "cx", "cy")]
    missing = [key for key, number in zip(("fx", "fy", "cx", "cy"), numbers, strict=True) if number is None]
    if missing:
        raise record.error(f"no {missing[0]}", expected="fx, fy, cx and cy")
    fx, fy, cx, cy = (number or 0.0 for number in numbers)
    size = record.size("width") or width, record.size("height") or height
    try:
        return Intrinsics(fx, fy, cx + CENTRE_OF_PIXEL, cy + CENTRE_OF_PIXEL, *size)
    except InputError as error:
        raise record.error(error) from error


def _depth(frame: PolycamFrame, filtered: SureDepth) -> Measured | None:
    if frame.depth is None:
        return None
    measured = read_depth_image(frame.depth, MILLIMETRE)
    confidence = None if frame.confidence is None else decode(frame.confidence)
    if confidence is not None and confidence.ndim != 2:
        raise InputError(f"has {confidence.shape[-1]} channels", where=frame.confidence, expected="one")
    is_arkit = confidence is not None and 0 < confidence.max() <= ARKIT_CONFIDENCE
    high = ARKIT_CONFIDENCE if is_arkit else HIGH_CONFIDENCE
    sure = None if confidence is None else confidence.astype(np.int64)
    return Measured(filtered(measured, sure, str(frame.confidence), high), str(frame.depth))


reader = PolycamReader()
