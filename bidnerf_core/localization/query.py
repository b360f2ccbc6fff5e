"""The images of a query: their keypoints as observations of one rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import Features, ImageKeypoints, Keypoints, Sights, image_keypoints

THRESHOLD = 0.005
"""Largest reprojection error of an inlier as a fraction of the image's diagonal; at least two pixels."""


@dataclass(frozen=True, eq=False)
class Query:
    """The keypoints of all images, view by view, the strongest of each view first."""

    images: tuple[ImageKeypoints, ...]
    keypoints: Keypoints  # (q)
    view: Int[Tensor, "q"]
    sights: Sights  # (q)
    focal: Float[Tensor, "q"]  # pixels
    approximate: bool  # whether the focal length was only assumed or read from EXIF

    @staticmethod
    def of(views: Sequence[View], features: Features) -> Query:
        """Detect the keypoints of ``views``, whose ``T_ref_camera`` are relative to the last view."""
        images = tuple(image_keypoints(view, features) for view in views)  # host
        return Query.seen(images, any(view.frame.focal_is_approximate for view in views))

    @staticmethod
    def seen(images: tuple[ImageKeypoints, ...], approximate: bool) -> Query:
        counts = [len(image.keypoints) for image in images]
        view = torch.arange(len(images)).repeat_interleave(torch.tensor(counts))
        T = SE3.stack([image.T_ref_camera.inverse() for image in images])[view]
        names = ("pixels", "sizes", "descriptors")
        joined = (torch.cat([getattr(image.keypoints, name) for image in images]) for name in names)
        times = images[0].exposure_times if len(images) == 1 else torch.zeros(len(view)).double()
        rays = torch.cat([image.rays for image in images])[:, :2]
        focal = torch.tensor([image.focal for image in images], dtype=torch.float64)[view]
        last = images[-1].T_ref_camera.matrix()
        single = len(images) == 1 and torch.allclose(last, torch.eye(4, dtype=last.dtype), rtol=0, atol=1e-9)
        sights = Sights(rays, times, T.rotation, T.translation, single)
        return Query(images, Keypoints(*joined), view, sights, focal, approximate)

    @cached_property
    def mirrored(self) -> Query:
        """The keypoints of the mirror image (left and right swapped): SIFT's descriptors are permuted, not computed anew."""
        image = self.images[-1]
        k, c = image.keypoints, image.intrinsics
        pixels = torch.stack([c.width - k.pixels[:, 0], k.pixels[:, 1]], -1)
        there = Keypoints(pixels, k.sizes, k.descriptors[:, mirrored_sift()])
        rays = image.rays * image.rays.new_tensor([-1.0, 1.0, 1.0])
        swapped = replace(
            image,
            keypoints=there,
            rays=rays,
            intrinsics=replace(c, cx=c.width - c.cx),
            hidden=None if image.hidden is None else image.hidden.flip(1),
            T_ref_camera=SE3.identity(),
        )
        return Query.seen((swapped,), self.approximate)

    @property
    def camera(self) -> Intrinsics:
        """The stated camera of the last image."""
        return self.images[-1].intrinsics

    @property
    def has_one_camera(self) -> bool:
        return len({image.intrinsics for image in self.images}) == 1

    @property
    def threshold(self) -> float:
        """The largest reprojection error of an inlier, pixels."""
        return max(2.0, THRESHOLD * math.hypot(self.camera.width, self.camera.height))

    @property
    def area(self) -> float:
        """The area of an image, in square pixels."""
        return float(self.camera.width * self.camera.height)

    @property
    def by_chance(self) -> float:
        """The probability that a wrong match, uniform in the image, is an inlier of a given pose."""
        return min(0.5, math.pi * self.threshold**2 / self.area)


@lru_cache(maxsize=1)
def mirrored_sift() -> Int[Tensor, "128"]:
    """Return the channels of the SIFT descriptor of a mirrored patch: the rows (across the orientation) and the angles are reversed."""
    row, column, angle = torch.meshgrid(torch.arange(4), torch.arange(4), torch.arange(8), indexing="ij")
    return (((3 - row) * 4 + column) * 8 + (-angle) % 8).flatten()
