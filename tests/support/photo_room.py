"""Photos of a room with patterned walls and exact poses, rendered in milliseconds, for structure from motion."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from bidnerf import SE3, Intrinsics
from bidnerf_core.geometry import look_at

CAMERA = Intrinsics(230.0, 230.0, 128.0, 96.0, 256, 192)
HALF = 2.0  # metres: from the middle of the room to each wall
PIXELS = 500  # of a wall's pattern


def walk(count: int) -> list[SE3]:
    """Poses along a curve, all looking into one corner."""
    steps = np.linspace(0, 1, count)
    eyes = [(-1.2 + 1.6 * s, 0.9 - 1.9 * s, -0.4 + 0.5 * np.sin(5 * s)) for s in steps]
    return [look_at(eye, (1.7, 1.3 + 0.2 * s, 0.2)) for eye, s in zip(eyes, steps, strict=True)]


@lru_cache(maxsize=64)
def _pattern(wall: int, seed: int) -> np.ndarray:
    generator = np.random.default_rng(100 * seed + wall)
    total = np.zeros((PIXELS, PIXELS, 3))
    for sigma in (2.0, 4.0, 10.0, 30.0):
        layer = cv2.GaussianBlur(generator.standard_normal((PIXELS, PIXELS, 3)), (0, 0), sigma)
        total += layer / layer.std()
    return np.clip(128 + 28 * total, 0, 255).astype(np.float32)


def photograph(T_world_camera: SE3, seed: int = 0, walls: int = 6, camera: Intrinsics = CAMERA) -> np.ndarray:
    """Return the photo (h, w, 3) of the room ``seed``; only the first ``walls`` have a pattern, the others are grey."""
    rays = T_world_camera.rotate(camera.unproject(camera.pixel_centres(torch.float64))).numpy()
    origin = T_world_camera.translation.numpy()
    with np.errstate(divide="ignore"):
        ahead = (np.sign(rays) * HALF - origin) / rays
    axis = ahead.argmin(-1)
    places = origin + rays * ahead.min(-1, keepdims=True)
    image = np.full((*axis.shape, 3), 128.0, np.float32)
    for wall in range(walls):
        of, sign = divmod(wall, 2)
        here = (axis == of) & ((np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0) == (sign == 0))
        if here.any():
            u, v = ((places[..., i] / HALF + 1) / 2 * (PIXELS - 1) for i in range(3) if i != of)
            seen = cv2.remap(_pattern(wall, seed), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
            image[here] = seen[here]
    return image.round().astype(np.uint8)


def room_depth(T_world_camera: SE3, camera: Intrinsics = CAMERA) -> torch.Tensor:
    """Return the planar depth (h, w) of the walls in metres."""
    rays = camera.unproject(camera.pixel_centres(torch.float64))
    turned, origin = T_world_camera.rotate(rays), T_world_camera.translation
    ahead = ((turned.sign() * HALF - origin) / turned).amin(-1)
    return (ahead * rays[..., 2]).float()


def write_photos(folder: Path, poses: Sequence[SE3], seed: int = 0, walls: int = 6, first: int = 0) -> list[Path]:
    """Write photos NUMBER.png of the room from each pose, numbered from ``first`` on."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{first + number:03d}.png" for number in range(len(poses))]
    for file, pose in zip(files, poses, strict=True):
        Image.fromarray(photograph(pose, seed, walls)).save(file)
    return files
