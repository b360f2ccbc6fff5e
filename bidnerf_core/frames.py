"""Images with their camera, and images with their place."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.se3 import SE3

SPARSE = 0.05
"""Share of an image's pixels under which measured depth is that of a few points: it tells of them, not of what is between."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB or RGB-D image. Depth is planar z in metres, 0 where nothing was measured."""

    name: str
    # rgb is in [0, 1], already over the background where there was an alpha channel; alpha is 1 where the scene covers
    # the pixel and 0 where the background shows. rgb has 3 channels, and all have the size of the camera's image, which is
    # checked here.
    rgb: Float[Tensor, "h w channels"]
    intrinsics: Intrinsics
    depth: Float[Tensor, "dh dw"] | None = None
    alpha: Float[Tensor, "ah aw"] | None = None

    def __post_init__(self) -> None:
        if self.rgb.ndim != 3 or self.rgb.shape[-1] != 3:
            raise InputError(
                f"frame {self.name}: rgb has shape {tuple(self.rgb.shape)}, expected (height, width, 3); put alpha"
                " apart and repeat grey three times"
            )
        expected = (self.intrinsics.height, self.intrinsics.width)
        for what, image in (("rgb", self.rgb), ("depth", self.depth), ("alpha", self.alpha)):
            if image is not None and tuple(image.shape[:2]) != expected:
                found = f"{image.shape[1]}x{image.shape[0]}"
                raise InputError(
                    f"frame {self.name}: {what} is {found}, its camera expects {expected[1]}x{expected[0]}"
                )

    @property
    def has_depth(self) -> bool:
        return self.depth is not None and bool((self.depth > 0).any())

    @property
    def has_dense_depth(self) -> bool:
        """Whether more than a few points were measured."""
        return self.depth is not None and float((self.depth > 0).float().mean()) >= SPARSE


@dataclass(frozen=True, eq=False)
class View:
    """A frame and where its camera is in some reference frame: the world, or the last camera of a rig."""

    frame: Frame
    T_ref_camera: SE3
