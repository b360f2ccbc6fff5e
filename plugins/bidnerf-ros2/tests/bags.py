"""Bags for tests, and ``tum_fr1_xyz`` as a bag: python bags.py DATA BAG."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
Moment = tuple[float, np.ndarray, np.ndarray | None]
"""Time (seconds), colour (uint8), depth (uint16, millimetres)."""


def header(store: Any, time: float) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](int(time), round((time - int(time)) * 1e9))
    parts = {"stamp": stamp, "frame_id": "camera_optical"}
    kind = store.types["std_msgs/msg/Header"]
    return kind(**({"seq": 0} if "seq" in kind.__dataclass_fields__ else {}), **parts)


def image(store: Any, time: float, pixels: np.ndarray, encoding: str, padding: int = 0) -> Any:
    """Return an image message whose rows end with some unused bytes."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    kind = store.types["sensor_msgs/msg/Image"]
    return kind(header(store, time), height, width, encoding, 0, rows.shape[1], rows.reshape(-1))


def compressed(store: Any, time: float, pixels: np.ndarray) -> Any:
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "PNG")
    data = np.frombuffer(content.getvalue(), np.uint8)
    return store.types["sensor_msgs/msg/CompressedImage"](header(store, time), "rgb8; png compressed rgb8", data)


def camera_info(store: Any, time: float, fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Any:
    """Return a camera info; the principal point is that of ROS, from the centre of the first pixel."""
    k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], float)
    p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], float)
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    values = (height, width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, roi)
    return store.types["sensor_msgs/msg/CameraInfo"](header(store, time), *values)


def write(
    path: Path,
    moments: Iterable[Moment],
    camera: tuple[float, float, float, float],
    kind: str = "mcap",
    late: float = 0.01,
) -> Path:
    """Write a bag: "mcap" or "sqlite" of ROS 2, or "ros1"; depth is taken ``late`` seconds after the colour image."""
    store = ROS1 if kind == "ros1" else ROS2
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
    with Writer1(path) if kind == "ros1" else Writer2(path, version=9, storage_plugin=plugin) as bag:
        names = {
            "/camera/image_raw": "Image",
            "/camera/camera_info": "CameraInfo",
            "/camera/depth/image_raw": "Image",
        }
        topics = {n: bag.add_connection(n, f"sensor_msgs/msg/{t}", typestore=store) for n, t in names.items()}
        for time, colour, depth in moments:
            height, width = colour.shape[:2]
            parts = [("/camera/camera_info", camera_info(store, time, *camera, width, height), time)]
            parts.append(("/camera/image_raw", image(store, time, colour[..., ::-1], "bgr8", padding=2), time))
            if depth is not None:
                parts.append(("/camera/depth/image_raw", image(store, time + late, depth, "16UC1"), time + late))
            for topic, message, at in parts:
                bag.write(topics[topic], round(at * 1e9), serialize(message, message.__msgtype__))
    return path


def moments_of(folder: Path) -> tuple[list[Moment], tuple[float, float, float, float]]:
    """Return the images of a dataset with ``transforms_*.json`` whose frames name the time of their sources."""
    files = [json.loads((folder / f"transforms_{split}.json").read_text()) for split in ("train", "test")]
    frames = sorted((f for file in files for f in file["frames"]), key=lambda frame: frame["source"])

    def read(frame: Any) -> Moment:
        colour, depth = (np.asarray(Image.open(folder / frame[k])) for k in ("file_path", "depth_file_path"))
        return float(Path(frame["source"]).stem), colour[..., :3], depth.astype(np.uint16)

    camera = files[0]
    numbers = (camera["fl_x"], camera["fl_y"], camera["cx"] - 0.5, camera["cy"] - 0.5)
    return [read(frame) for frame in frames], numbers


if __name__ == "__main__":
    given, numbers = moments_of(Path(sys.argv[1]))
    write(Path(sys.argv[2]), given, numbers)
