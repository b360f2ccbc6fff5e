"""The pinhole views into which panoramas are divided."""

from __future__ import annotations

import torch

from bidnerf_core.camera import PANORAMA_FACES, PanoramaFace
from bidnerf_core.geometry import SE3


def faces_of(T_world_panorama: SE3) -> list[tuple[str, SE3]]:
    """Return the name and the pose T_world_face of each pinhole view of a panorama."""
    return [(face, T_world_panorama @ panorama_pose(face)) for face in PANORAMA_FACES]


def panorama_pose(face: str) -> SE3:
    """Return T_panorama_face: the pose of a view in the camera of its panorama (OpenCV axes, float64)."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(PanoramaFace(face, (2, 1)).rotation)
    return SE3.from_matrix(T)
