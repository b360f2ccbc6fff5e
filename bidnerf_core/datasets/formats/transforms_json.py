"""Reading frames and splits from ``transforms*.json`` (without images) and writing them (with images)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import numpy as np
import torch

from bidnerf_core.camera import CameraRecord, Intrinsics, camera_record
from bidnerf_core.datasets.capture import SPLITS, remark
from bidnerf_core.datasets.file_names import posix_name
from bidnerf_core.datasets.formats.photos import timestamp
from bidnerf_core.datasets.pose_rows import pose_and_scale
from bidnerf_core.datasets.trajectories import LEAST_NANOSECONDS, NANOSECONDS
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import IMAGE_SUFFIXES, Record, png_bytes, read_record, write_file

METRES_PER_DEPTH_UNIT = 0.001
UNIT_KEYS = {"depth_file_path": "depth_unit_scale_factor", "depth_path": "integer_depth_scale"}
"""The keys of a depth image, nerfstudio's and that of instant-ngp and NeRFCapture, with those of the metres per step of its
values."""
LARGEST_DEPTH = 65534  # readers interpret the largest 16-bit number as "not measured"


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """An entry of ``frames`` with the file-level defaults applied."""

    record: Record
    file_path: PurePosixPath  # as in the file, without a leading "./"
    camera: CameraRecord
    T_world_camera: SE3
    scale: float  # removed from its matrix; 1 if that was rigid
    depth_path: PurePosixPath | None
    depth_unit: float  # metres
    time: float | None  # seconds
    mask_path: PurePosixPath | None  # black is hidden

    @property
    def unit(self) -> LengthUnit | None:
        """The unit of the camera position, if the file states it (``"unit": "metres"`` or ``"units"``), as bidnerf's files do."""
        stated = self.record.value("unit")
        return stated if stated in get_args(LengthUnit) else None

    @property
    def stem(self) -> str:
        known = self.file_path.suffix.lower() in IMAGE_SUFFIXES
        return self.file_path.stem if known else self.file_path.name  # "r_0.5" may have no extension

    @property
    def parts(self) -> tuple[str, ...]:
        """The folders of the image path, followed by its stem."""
        return (*self.file_path.parts[:-1], self.stem)


def read_splits(path: Path) -> list[tuple[FrameRecord, tuple[str, ...]]]:
    """Read the frames in the folder ``path`` with their splits; frames have no split if a single file lists none.

    Raises ``InputError`` for an invalid ``transforms*.json``.
    """
    files = {split: path / file_of(split) for split in SPLITS if (path / file_of(split)).is_file()}
    if files:
        return [
            (frame, (split,)) for split, file in files.items() for frame in read_frames(read_record(file))
        ]
    record = read_record(path / "transforms.json")
    frames, lists = read_frames(record), {split: record.items(f"{split}_filenames") for split in SPLITS}
    if not any(lists.values()):
        return [(frame, ()) for frame in frames]
    by_path = {frame.file_path: frame for frame in frames}
    splits, unknown = (
        dict[FrameRecord, tuple[str, ...]](),
        list[tuple[str, str]](),
    )  # in the order of the lists
    for split, name in [(split, str(name)) for split, listed in lists.items() for name in listed or []]:
        if (frame := by_path.get(posix_name(name))) is not None:
            splits[frame] = *splits.get(frame, ()), split
        else:
            unknown.append((split, name))
    if unknown:
        (split, first), count = unknown[0], len(unknown)
        found = f"{split}_filenames and the other lists have {count} that no frame has, the first of them {first!r}"
        if not splits:
            raise record.error(found, expected=f"the file_path of one of its {len(by_path)} frames")
        remark(record.where, found)
    return list(splits.items())


def read_frames(file: Record) -> list[FrameRecord]:
    """Read every entry of ``frames`` that has a pose; a remark counts the others.

    Raises ``InputError`` if two frames have the same image, and if no frame has a pose.
    """
    entries = file.items("frames")
    if not entries:
        found = "no frames" if entries is None else "frames is empty"
        raise file.error(found, expected="a list of objects with file_path and transform_matrix")
    posed = [(number, entry) for number, entry in enumerate(entries) if not _lacks_pose(entry)]
    if 0 < len(posed) < len(entries):
        first = next(entry.get("file_path") for entry in entries if _lacks_pose(entry))
        remark(
            file.where,
            f"{len(entries) - len(posed)} of {amount(len(entries), 'frame')} have no pose (transform_matrix"
            f" is missing, zero or not finite) and are left out, first: {first}",
        )
    frames = [_frame(file, number, entry) for number, entry in posed or enumerate(entries)]
    seen: dict[tuple[str, ...], int] = {}
    for number, frame in enumerate(frames):
        first = seen.setdefault(frame.parts, number)
        if first != number:
            raise frame.record.error(f"has the same image as frame {first}", expected="each image once")
    if scaled := [frame for frame in frames if frame.scale != 1.0]:
        whose = "all" if len(scaled) == len(frames) else f"{len(scaled)} of"
        remark(
            file.where,
            f"{whose} {len(frames)} matrices have a scale (frame {scaled[0].file_path}: {scaled[0].scale:.6g}), which is"
            " removed; the positions of the cameras are those of the matrices",
        )
    return frames


def _lacks_pose(entry: Any) -> bool:
    """Return whether a frame's matrix is missing, zero, or has non-finite entries."""
    if not isinstance(entry, dict):
        return False
    try:
        matrix = np.array(entry.get("transform_matrix"), dtype=np.float64)  # None becomes NaN
    except (TypeError, ValueError, OverflowError):  # an error when the frame is read
        return False
    return not np.isfinite(matrix).all() or (matrix.ndim == 2 and not matrix[:3, :3].any())


def _frame(file: Record, number: int, entry: object) -> FrameRecord:
    where = f"{file.where}: frame {number}"
    if not isinstance(entry, dict):
        raise InputError("is not an object", where=where, expected="one with file_path and transform_matrix")
    own = Record(where, entry)
    path = own.text("file_path")
    if not path:
        raise own.error("no file_path", expected="the name of its image")
    record = Record(f"{where} ({path})", entry, file)
    T_world_camera, scale = pose_and_scale(Record(record.where, entry))
    depth, unit = _depth(record, own)
    return FrameRecord(
        record,
        posix_name(path),
        camera_record(record),
        T_world_camera,
        scale,
        depth,
        unit,
        _time(own),
        posix_name(mask) if (mask := own.text("mask_path")) else None,
    )


def _depth(record: Record, own: Record) -> tuple[PurePosixPath | None, float]:
    """Return the depth image of a frame, or None, and its depth unit (metres per step).

    nerfstudio and instant-ngp use different keys for both; ``enable_depth_loading`` disables instant-ngp's.
    """
    for key, unit_key in UNIT_KEYS.items():
        path, keys = (
            own.text(key),
            (unit_key, *UNIT_KEYS.values()),
        )  # the other program's if its own is missing
        units = [(name, unit) for name in keys if (unit := record.number(name)) is not None]
        name, unit = units[0] if units else (unit_key, METRES_PER_DEPTH_UNIT)
        if unit <= 0:
            raise record.error(f"{name} is {unit:g}", expected="a positive number of metres")
        if path and (key == "depth_file_path" or record.value("enable_depth_loading") is not False):
            return posix_name(path), unit
    return None, METRES_PER_DEPTH_UNIT


def _time(own: Record) -> float | None:
    """Return ``time`` or ``timestamp`` (seconds), or the number in the name of the ``source`` file."""
    for key in ("time", "timestamp"):
        if (found := own.number(key)) is not None:
            return found / NANOSECONDS if found >= LEAST_NANOSECONDS else found
    source = own.value("source")
    return timestamp(PurePosixPath(source).stem) if isinstance(source, str) else None


def file_of(split: str) -> str:
    """Return the name of the file that describes a split."""
    return f"transforms_{split}.json"


def write_transforms(
    folder: str | Path, splits: Mapping[str, Sequence[View]], background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> None:  # fmt: skip
    """Write ``transforms_SPLIT.json``, ``images/SPLIT/NAME.png`` (8 bits) and ``depth/SPLIT/NAME.png`` (16 bits).

    ``background`` is the colour over which frames with an alpha channel were composited; it is removed from their colours.
    Depth is stored in millimetres, or in larger steps if 16 bits would not suffice. A split without views is
    left out. Raises ``InputError`` for an unknown split, a duplicate name, and a lens with more than five
    distortion coefficients.
    """
    folder = Path(folder)
    for split, views in splits.items():
        if split not in SPLITS:
            raise InputError(f"split {split!r} cannot be written", where=folder, expected=", ".join(SPLITS))
        names = [view.frame.name for view in views]
        if len(set(names)) != len(names):
            raise InputError(
                f"two frames of split {split!r} have the same name", where=folder, expected="different ones"
            )
        frames = [_written(folder, split, view, background) for view in views]
        if not frames:  # readers reject a file without any
            continue
        folder.mkdir(parents=True, exist_ok=True)
        write_file(
            folder / file_of(split), json.dumps({"frames": frames}, indent=1, allow_nan=False).encode()
        )


def _written(folder: Path, split: str, view: View, background: tuple[float, float, float]) -> dict[str, Any]:
    """Write the images of a frame and return the frame's entry."""
    frame = view.frame
    file = f"images/{split}/{frame.name}.png"
    entry = frame_entry(file, frame.name, frame.intrinsics, view.T_ref_camera)
    _write(folder / entry["file_path"], _colours(frame, background))
    if frame.depth is not None:
        unit = max(METRES_PER_DEPTH_UNIT, float(frame.depth.max()) / LARGEST_DEPTH)
        entry |= {"depth_file_path": f"depth/{split}/{frame.name}.png", "depth_unit_scale_factor": unit}
        steps = (frame.depth.double() / unit).round().clamp(0, LARGEST_DEPTH)
        _write(folder / entry["depth_file_path"], steps.cpu().numpy().astype(np.uint16))
    return entry


def frame_entry(
    file_path: str, name: str, camera: Intrinsics, T_world_camera: SE3, time: float | None = None
) -> dict[str, Any]:
    """Return an entry of ``frames`` for a ``transforms.json``: an image, its camera, its pose and its time (seconds).

    Raises ``InputError`` for a lens that the format cannot describe.
    """
    lens = ("k1", "k2", "p1", "p2", "k3")
    if len(camera.distortion) > len(lens):
        found = f"the lens has {len(camera.distortion)} coefficients"
        raise InputError(found, where=f"frame {name}", expected=f"at most {len(lens)}")
    matrix = T_world_camera.to("cpu", torch.float64).matrix()
    return {
        "file_path": file_path,
        # The y and z axes of the camera are reversed in OpenGL.
        "transform_matrix": (matrix * matrix.new_tensor([1.0, -1.0, -1.0, 1.0])).tolist(),
        **({} if time is None else {"time": time}),
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
        **dict(zip(lens, camera.distortion, strict=False)),
    }  # fmt: skip


def _colours(frame: Frame, background: tuple[float, float, float]) -> np.ndarray:
    """Return RGB, or straight (not premultiplied) RGBA if the frame has alpha."""
    colours = frame.rgb.detach().cpu()
    if frame.alpha is not None:
        cover = frame.alpha.detach().cpu()[..., None]
        straight = (colours - (1 - cover) * colours.new_tensor(background)) / cover.clamp(min=1e-3)
        colours = torch.cat([straight, cover], dim=-1)
    return (colours.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(pixels))
