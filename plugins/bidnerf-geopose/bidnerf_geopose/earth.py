"""Poses of cameras on the earth, related to those in a map by its anchor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.maps import Anchor
from bidnerf_geopose.wgs84 import Geodetic, geodetic


@dataclass(frozen=True)
class GeographicPose:
    """A camera on the earth: its place, and its rotation in the east-north-up frame at that place."""

    place: Geodetic
    rotation: Float[Tensor, "3 3"]  # R_enu_camera, OpenCV camera axes

    @staticmethod
    def of(T_world_camera: SE3, anchor: Anchor) -> GeographicPose:
        """Return the place of a camera in a map, and its rotation relative to east, north and up there, not at the anchor."""
        pose = T_world_camera.to("cpu", torch.float64)
        T_ecef_camera = _T_ecef_world(anchor) @ SE3(pose.rotation, pose.translation * anchor.metres_per_unit)
        place = geodetic(T_ecef_camera.translation)
        return GeographicPose(place, place.T_ecef_enu.rotation.mT @ T_ecef_camera.rotation)

    def in_map(self, anchor: Anchor) -> SE3:
        """Return T_world_camera in the map of an anchor; the inverse of ``of``."""
        local = self.place.T_ecef_enu
        T_ecef_camera = SE3(local.rotation @ self.rotation.double(), local.translation)
        T_world_camera = _T_ecef_world(anchor).inverse() @ T_ecef_camera
        return SE3(T_world_camera.rotation, T_world_camera.translation / anchor.metres_per_unit)


def _T_ecef_world(anchor: Anchor) -> SE3:
    """Return the map's frame, in metres, in the earth-centred frame."""
    return Geodetic(anchor.latitude, anchor.longitude, anchor.height).T_ecef_enu @ anchor.pose
