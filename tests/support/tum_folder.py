"""Folders in the layout of the TUM RGB-D benchmark, written from frames whose poses are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from scipy.spatial.transform import Rotation

from bidnerf_core.frames import View

HEAD = "# {}\n# file: 'rgbd_dataset.bag'\n# timestamp {}\n"


@dataclass(frozen=True)
class Recorded:
    """A frame of the recording: times in seconds, pixels of 8 and 16 bits as they are stored."""

    time: float
    view: View  # whose pose is the truth at ``time``


def write_recording(folder: Path, frames: Sequence[Recorded]) -> Path:
    """Write images, lists, and a ground truth that passes through the poses of the frames at constant velocities.

    Depth is 4 ms later than colour. No sample of the ground truth is at the time of an image: each frame has one 3 ms before
    and one 6 ms after.
    """
    generator = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    rows: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for frame in frames:
        rgb = (frame.view.frame.rgb.numpy() * 255).round().astype(np.uint8)
        rows["rgb"].append(_write(folder, "rgb", frame.time, rgb))
        if frame.view.frame.depth is not None:
            steps = (frame.view.frame.depth.double().numpy() * 5000).round().astype(np.uint16)
            rows["depth"].append(_write(folder, "depth", frame.time + 0.004, steps))
        T, (turn, shift) = frame.view.T_ref_camera, generator.normal(size=(2, 3))
        for after in (-0.003, 0.006):
            rotation = Rotation.from_matrix(T.rotation.numpy()) * Rotation.from_rotvec(turn * after)
            numbers = [*(T.translation.numpy() + shift * after), *rotation.as_quat()]
            row = " ".join([f"{frame.time + after:.6f}", *(f"{number:.12f}" for number in numbers)])
            rows["groundtruth"].append(f"{row}\n")
    for name, columns in {
        "rgb": "filename",
        "depth": "filename",
        "groundtruth": "tx ty tz qx qy qz qw",
    }.items():
        (folder / f"{name}.txt").write_text(HEAD.format(name, columns) + "".join(rows[name]))
    return folder


def _write(folder: Path, kind: str, time: float, pixels: np.ndarray) -> str:
    name = f"{kind}/{time:.6f}.png"
    iio.imwrite(folder / name, pixels)
    return f"{time:.6f} {name}\n"


def edit_rows(file: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the rows of a list; comments before them stay."""
    lines = file.read_text().splitlines()
    head = [line for line in lines if line.startswith("#")]
    file.write_text("\n".join([*head, *change([line for line in lines if not line.startswith("#")])]) + "\n")
