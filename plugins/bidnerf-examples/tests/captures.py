"""A capture in the format of the example's reader, of the textured ground on which contracts try methods."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from bidnerf.testing import GROUND_CAMERA, training_views


def write_capture(folder: Path) -> Path:
    c = GROUND_CAMERA
    camera = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
    (folder / "camera.json").write_text(json.dumps(camera))
    with (folder / "poses.csv").open("w", newline="") as opened:
        table = csv.writer(opened)
        for number, view in enumerate(training_views()):
            pose, name, depth = view.T_ref_camera, f"image{number:02d}", view.frame.depth
            table.writerow([name, 0.1 * number, *pose.matrix()[:3].flatten().tolist()])
            iio.imwrite(folder / f"{name}.png", (255 * view.frame.rgb).round().byte().numpy())
            millimetres = (1000 * depth).round().numpy().astype(np.uint16)
            iio.imwrite(folder / f"{name}.depth.png", millimetres)
    return folder
