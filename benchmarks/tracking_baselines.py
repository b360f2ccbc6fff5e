"""Baselines of the tracker: a search in each frame, ICP from the last pose, odometry."""

from __future__ import annotations

from typing import Any

import torch

from bidnerf_core import SE3, Frame, Localizer, Outcome
from bidnerf_core.localization import Localization


class EachAnew:
    """Method ``auto`` on each frame, without information from earlier frames."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        return self._localizer(frame)


class GicpFromLast:
    """Generalised ICP (small_gicp) of measured points to the map's surface, from the last pose; it accepts all its poses."""

    def __init__(self, localizer: Localizer) -> None:
        import small_gicp

        assert localizer.map.surface is not None
        self._gicp, self._localizer, self._surface = small_gicp, localizer, localizer.map.surface
        self._voxel = 2 * self._surface.cell
        self._target, self._tree = small_gicp.preprocess_points(
            self._surface.surfels.positions.double().numpy(), self._voxel, num_threads=1
        )
        self._last: SE3 | None = None

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        if self._last is None or not frame.has_depth:
            found = self._localizer(frame)
            self._last = found.T_world_camera
            return found
        assert frame.depth is not None
        ray = frame.intrinsics.unproject(frame.intrinsics.pixel_centres(torch.float64))
        points = (ray * frame.depth.double()[..., None])[frame.depth > 0]
        source, _ = self._gicp.preprocess_points(points.numpy(), self._voxel, num_threads=1)
        done = self._gicp.align(
            self._target, source, self._tree, self._last.matrix().numpy(), registration_type="GICP",
            max_correspondence_distance=5 * self._voxel, num_threads=1,
        )  # fmt: skip
        self._last = SE3.from_matrix(torch.from_numpy(done.T_target_source).double())
        return Localization(
            self._last, Outcome.CONVERGED, "", 1, 0.0, float(done.error),
            "gicp", self._last[None], torch.zeros(1),
        )  # fmt: skip


class Open3dOdometry:
    """Open3D's frame-to-frame RGB-D odometry (Park et al. 2017), with ``auto`` initially, every 30 frames, and on failure."""

    EVERY = 30

    def __init__(self, localizer: Localizer) -> None:
        import open3d

        self._o3d, self._localizer = open3d, localizer
        self._last: tuple[Any, SE3] | None = None
        self._age = 0

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        image = self._image(frame)
        T = None if self._last is None or self._age >= self.EVERY else self._moved(frame, image, *self._last)
        if T is None:
            found = self._localizer(frame)
            self._age, self._last = 0, (image, found.T_world_camera) if found.converged else None
            return found
        self._age, self._last = self._age + 1, (image, T)
        return Localization(T, Outcome.CONVERGED, "", 1, 0.0, 0.0, "odometry", T[None], torch.zeros(1))

    def _moved(self, frame: Frame, image: Any, before: Any, T_world_before: SE3) -> SE3 | None:
        o3d, camera = self._o3d, frame.intrinsics
        pinhole = o3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5
        )
        done, T_before_now, _ = o3d.pipelines.odometry.compute_rgbd_odometry(
            image, before, pinhole, torch.eye(4, dtype=torch.float64).numpy(),
            o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
        )  # fmt: skip
        return T_world_before @ SE3.from_matrix(torch.tensor(T_before_now).double()) if done else None

    def _image(self, frame: Frame) -> Any:
        geometry, depth = self._o3d.geometry, frame.depth
        assert depth is not None
        rgb = (255 * frame.rgb).round().byte().contiguous().numpy()
        return geometry.RGBDImage.create_from_color_and_depth(
            geometry.Image(rgb), geometry.Image(depth.float().contiguous().numpy()), 1.0, 10.0
        )
