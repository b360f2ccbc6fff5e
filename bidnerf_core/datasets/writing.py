"""Writing posed images as a folder with ``transforms_SPLIT.json``, which nerfstudio and instant-ngp read too."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bidnerf_core.camera import CentralLens, Intrinsics
from bidnerf_core.datasets.capture import SPLITS
from bidnerf_core.datasets.formats.transforms_json import METRES_PER_DEPTH_UNIT, SPLIT_FILES
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.io import png_bytes, write_file


def write_transforms(
    folder: str | Path, splits: Mapping[str, Sequence[View]], background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> None:
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
        frames = [_write_view(folder, split, view, background) for view in views]
        if not frames:  # readers reject a file without frames
            continue
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / SPLIT_FILES[split], json.dumps({"frames": frames}, indent=1, allow_nan=False).encode())


def _write_view(folder: Path, split: str, view: View, background: tuple[float, float, float]) -> dict[str, Any]:
    """Write the images of a frame and return the frame's entry."""
    frame = view.frame
    entry = frame_entry(f"images/{split}/{frame.name}.png", frame.name, frame.intrinsics, view.T_ref_camera)
    colours = frame.rgb.detach().cpu()
    if frame.alpha is not None:
        cover = frame.alpha.detach().cpu()[..., None]
        straight = (colours - (1 - cover) * colours.new_tensor(background)) / cover.clamp(min=1e-3)
        colours = torch.cat([straight, cover], dim=-1)  # RGBA that is not premultiplied
    _write(folder / entry["file_path"], (colours.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
    if frame.depth is not None:
        largest = 65534  # readers interpret the largest 16-bit number as "not measured"
        unit = max(METRES_PER_DEPTH_UNIT, float(frame.depth.max()) / largest)
        entry |= {"depth_file_path": f"depth/{split}/{frame.name}.png", "depth_unit_scale_factor": unit}
        steps = (frame.depth.double() / unit).round().clamp(0, largest)
        _write(folder / entry["depth_file_path"], steps.cpu().numpy().astype(np.uint16))
    return entry


def frame_entry(
    file_path: str, name: str, camera: Intrinsics | CentralLens, T_world_camera: SE3, time: float | None = None
) -> dict[str, Any]:
    """Return an entry of ``frames`` for a ``transforms.json``: an image, its camera, its pose and its time (seconds).

    Raises ``InputError`` for a lens that the format cannot describe.
    """
    lens, model = ["k1", "k2", "k3", "k4"], dict[str, str]()
    if isinstance(camera, CentralLens):
        values, model, camera = camera.coefficients, {"camera_model": camera.model}, camera.stored
    else:
        values, lens = camera.distortion, ["k1", "k2", "p1", "p2", "k3"]
    if len(values) > len(lens):
        raise InputError(
            f"the lens has {len(values)} coefficients",
            where=f"frame {name}",
            expected=f"at most {len(lens)}",
        )
    matrix = T_world_camera.to("cpu", torch.float64).matrix()
    return {
        "file_path": file_path,
        **model,
        # The y and z axes of the camera are reversed in OpenGL.
        "transform_matrix": (matrix * matrix.new_tensor([1.0, -1.0, -1.0, 1.0])).tolist(),
        **({} if time is None else {"time": time}),
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        **dict(zip(lens, values, strict=False)),
    }


def _write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(pixels))
