"""Registration of depth to colour: the depth image as seen from the colour camera next to the depth camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics, Raster, read_camera
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, rigid_pose
from bidnerf_core.io import read_record, resample_nearest

EXTRINSICS = "T_colour_depth"
"""Key, in a depth sensor's file, of the 4x4 matrix T_colour_depth (metres, OpenCV axes) next to the intrinsics."""


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A depth camera mounted next to a colour camera; its depth is registered to the colour images."""

    camera: Intrinsics
    T_colour_depth: SE3  # metres, OpenCV axes

    @staticmethod
    def read(path: Path) -> DepthCamera:
        """Read a JSON file with intrinsics as in ``transforms.json``, including ``w`` and ``h``, and ``T_colour_depth`` (4x4).

        Raises ``InputError`` if one of them is missing or invalid.
        """
        record = read_record(path)
        if record.size("w") is None or record.size("h") is None:
            raise record.error("no w and h", expected="the size of the depth images")
        rows = record.matrix(EXTRINSICS, record.items(EXTRINSICS))
        camera = read_camera(path, (0, 0))
        if not isinstance(camera, Intrinsics):
            raise record.error(
                "describes a lens that is not perspective", expected="the intrinsics of the depth camera"
            )
        return DepthCamera(
            camera, rigid_pose(torch.tensor(rows, dtype=torch.float64), path, f"the rotation of {EXTRINSICS}")
        )

    def register(self, depth: Float[Tensor, "dh dw"], colour: Intrinsics, file: Path | str) -> Float[Tensor, "h w"]:
        """Register depth to the colour camera (planar z, metres); error messages begin with ``file``.

        Each measurement is transformed to the colour camera's frame and written to the pixel into which it
        projects. If several measurements fall into one pixel, the nearest is kept, which removes surfaces that
        are occluded from the colour camera. Pixels without a measurement are 0.

        Depth of a lower resolution than the colour image is registered at its own resolution and then
        resampled, since its points would otherwise be too far apart to occlude each other. Raises
        ``InputError`` for depth whose aspect ratio is not the sensor's, and if none of a thousand or more
        measurements falls into the colour image.
        """
        height, width = depth.shape
        camera = Raster(width, height).upright(self.camera)
        if camera is None:
            raise InputError(
                f"depth is {width}x{height}",
                where=file,
                expected=f"the aspect ratio of its camera, {self.camera.width}x{self.camera.height}",
            )
        coarse = colour.scaled(min(1.0, camera.fx / colour.fx, camera.fy / colour.fy))
        measured = depth > 0
        rays = camera.unproject(camera.pixel_centres(torch.float64)[measured])
        points = self.T_colour_depth.apply(rays * depth[measured].double()[:, None])
        # A polynomial lens model also maps some points outside of the image's frustum into the image.
        centres = coarse.pixel_centres(torch.float64)
        border = torch.cat([centres[[0, -1]].reshape(-1, 2), centres[:, [0, -1]].reshape(-1, 2)])
        edge, pixel = coarse.unproject(border)[:, :2], torch.tensor([1 / coarse.fx, 1 / coarse.fy], dtype=torch.float64)
        x = points[:, :2] / points[:, 2:].clamp(min=1e-9)
        nearest = nearest_depth(points[((x >= edge.amin(0) - pixel) & (x <= edge.amax(0) + pixel)).all(-1)], coarse)
        # A small number of measurements may all lie outside.
        if int(measured.sum()) >= 1000 and not bool((nearest > 0).any()):
            away = float(torch.linalg.vector_norm(self.T_colour_depth.translation))
            raise InputError(
                f"no measurement falls into the colour image; {EXTRINSICS} puts the depth camera {away:.3g}"
                " m from the colour camera",
                where=file,
                expected="metres and OpenCV axes",
            )
        return nearest if coarse == colour else resample_nearest(nearest, colour.width, colour.height)


def nearest_depth(points: Float[Tensor, "n 3"], camera: Intrinsics) -> Float[Tensor, "h w"]:
    """Return planar z (metres) of the nearest of the ``points`` (camera frame) in each pixel; 0 if there is none."""
    row, column, inside = camera.cells(points)
    empty = torch.full((camera.height * camera.width,), torch.inf)
    nearest = empty.scatter_reduce(0, (row * camera.width + column)[inside], points[inside, 2].float(), "amin")
    return torch.where(nearest.isfinite(), nearest, 0).reshape(camera.height, camera.width)
