"""The cameras of a map's training images, as ``map.json`` stores them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import View


@dataclass(frozen=True)
class StoredCamera:
    """Camera and pose of a training image, from which the scene is known to be visible."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: tuple[tuple[float, float, float, float], ...]  # 4x4, rows


def stored_cameras(views: Sequence[View]) -> tuple[StoredCamera, ...]:
    """Return the cameras of training views in the form that ``map.json`` holds."""
    return tuple(
        StoredCamera(
            v.frame.name, v.frame.intrinsics, tuple(tuple(r) for r in v.T_ref_camera.matrix().tolist())
        )
        for v in views
    )
