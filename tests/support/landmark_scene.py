"""A scene of points with descriptors and exact geometry, seen without rendering anything."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from bidnerf import SE3, Frame, Intrinsics, View
from bidnerf_core.camera import exposure_times, poses_of_rows
from bidnerf_core.geometry import look_at
from bidnerf_core.mapping import Keypoints, quantize

PINHOLE = Intrinsics(300.0, 300.0, 200.0, 150.0, 400, 300)
SIZE = 0.04  # metres: of what a keypoint describes


@dataclass
class Points:
    """Points in a box about the origin; as ``Features``, it sees them in views that ``view`` made."""

    count: int = 300
    noise: float = 0.0  # pixels
    outliers: float = 0.0  # share of the keypoints with the descriptor of some other point
    positions: Tensor = field(init=False)
    descriptors: Tensor = field(init=False)

    def __post_init__(self) -> None:
        generator = torch.Generator().manual_seed(1)
        self.positions = 2 * torch.rand(self.count, 3, dtype=torch.float64, generator=generator) - 1
        random = torch.rand(self.count, 64, generator=generator) ** 4
        self.descriptors = quantize(random / random.norm(dim=-1, keepdim=True))
        self.seen: list[Keypoints] = []

    def view(
        self,
        T_world_camera: SE3,
        intrinsics: Intrinsics = PINHOLE,
        depth: float | None = None,
        T_ref_camera: SE3 | None = None,
        seed: int = 0,
        motion: Tensor | None = None,
    ) -> View:
        """An image whose first pixel names the keypoints in it; with depth at them, times ``depth``.

        The rows of a camera with a ``motion`` are exposed one after another. The view does not tell.
        The right half is blue, which is what the first pixel is in a mirror.
        """
        generator = torch.Generator().manual_seed(seed)
        local = T_world_camera.inverse().apply(self.positions)
        pixels = intrinsics.project(local)
        for _ in range(0 if motion is None else 6):  # a point's row depends on when it was exposed
            T = poses_of_rows(exposure_times(pixels, intrinsics), motion)
            pixels = intrinsics.project(T.inverse().apply(local))
        size = torch.tensor([intrinsics.width, intrinsics.height])
        inside = ((pixels > 3) & (pixels < size - 3)).all(-1)
        pixels = pixels[inside] + self.noise * torch.randn(
            int(inside.sum()), 2, dtype=torch.float64, generator=generator
        )
        number = inside.nonzero()[:, 0]
        wrong = torch.rand(len(number), generator=generator) < self.outliers
        shown = torch.where(wrong, torch.randint(self.count, number.shape, generator=generator), number)
        focal = (intrinsics.fx * intrinsics.fy) ** 0.5
        sizes = SIZE * focal / local[inside, 2]
        self.seen.append(Keypoints(pixels.float(), sizes.float(), self.descriptors[shown]))
        image = torch.zeros((intrinsics.height, intrinsics.width, 3), dtype=torch.uint8)
        image[..., 1], image[..., 0] = divmod(len(self.seen) - 1, 256)
        image[:, intrinsics.width // 2 :, 2] = 255
        measured = None if depth is None else self._depth(intrinsics, pixels, local[inside, 2] * depth)
        return View(Frame("f", image, intrinsics, measured), T_ref_camera or T_world_camera)

    def __call__(self, rgb: Tensor) -> Keypoints:
        low, high, blue = (255 * rgb[0, 0]).round().long().tolist()
        keypoints = self.seen[256 * high + low]
        if not blue:
            return keypoints
        across, down = keypoints.pixels.unbind(-1)
        return replace(keypoints, pixels=torch.stack([rgb.shape[1] - across, down], dim=-1))

    def _depth(self, intrinsics: Intrinsics, pixels: Tensor, z: Tensor) -> Tensor:
        image = torch.zeros(intrinsics.height, intrinsics.width)
        for (u, v), value in zip(pixels.long().tolist(), z.tolist(), strict=True):
            image[v - 1 : v + 2, u - 1 : u + 2] = value
        return image


def looking_in(angle: float, height: float = 0.3, distance: float = 4.0) -> SE3:
    """Return the pose of a camera on a ring about the origin (radians) that looks at it."""
    eye = (distance * math.sin(angle), -height, -distance * math.cos(angle))
    return look_at(eye, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0))


def ring(points: Points, count: int = 10, **options: object) -> list[View]:
    """Views from places six degrees apart, up and down in turn."""
    return [
        points.view(looking_in(0.105 * i, 0.3 * (i % 3)), seed=i, **options)  # type: ignore[arg-type]
        for i in range(count)
    ]
