"""The pinhole views into which panoramas are cut."""

from __future__ import annotations

import torch

from bidnerf_core.camera.lenses import PanoramaFace
from bidnerf_core.geometry.se3 import SE3


def panorama_pose(face: str) -> SE3:
    """Return T_panorama_face: the pose of a view in the camera of its panorama (OpenCV axes, float64)."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(PanoramaFace(face, 2, 1).rotation)
    return SE3.from_matrix(T)
