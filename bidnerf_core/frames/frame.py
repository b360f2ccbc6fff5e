"""Images with their cameras, and posed images."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from bidnerf_core.camera import UPRIGHT, Camera, CameraSource, Intrinsics, Lens, Orientation, Raster
from bidnerf_core.depth import DepthCamera, depth_image
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.frames.colours import HELD, LAST, Colours, as_bytes
from bidnerf_core.frames.masks import HiddenColour, WhollyHidden, read_mask
from bidnerf_core.frames.photos import fit_depth, read_photo
from bidnerf_core.frames.resampling import Images
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Background, background_colour, over, pixel_array, reduced, resampled, split_alpha

SPARSE = 0.05
"""Fraction of pixels with depth below which depth counts as sparse: the pixels in between then remain unknown."""
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB or RGB-D image. Depth is planar z in metres, 0 where nothing was measured; NaN becomes 0."""

    name: str
    # rgb is in [0, 1], already composited over the background if there was an alpha channel; alpha is 1 where
    # the scene covers the pixel and 0 where the background shows. All are dense tensors of the camera's image
    # size with finite floats, which is checked here. Colours may be given as bytes (uint8): they are stored
    # as bytes and read as floats.
    rgb: Float[Tensor, "h w channels"]
    intrinsics: Intrinsics
    depth: Float[Tensor, "dh dw"] | None = None
    alpha: Float[Tensor, "ah aw"] | None = None
    camera_source: str | None = None
    """One line about the source of the intrinsics, for frames returned by ``open``."""

    focal_is_approximate: bool = False
    """Whether the focal length is only nominal, as in EXIF, and may be off by several percent."""

    has_colour: bool = True
    """Whether colours were recorded. If only depth was, as between the photos of a LiDAR scan, ``rgb`` is black."""

    hidden: Bool[Tensor, "hh hw"] | None = None
    """The pixels where the scene is hidden by something that is not part of the map.

    Masks are read into it (see ``masks``). Depth there counts as not measured. No rays are drawn there, no
    keypoints are detected, no points are tracked and no landmarks are expected; the thumbnails used to search
    by colour alone are filled in from the surrounding colours.
    """

    lens: Lens | None = None
    """The non-pinhole lens whose image was resampled to the frame's on reading, if there was one."""

    orientation: Orientation = UPRIGHT
    """How the image in its file was turned upright on reading."""

    def __post_init__(self) -> None:
        where, camera = f"frame {self.name}", self.intrinsics
        if not isinstance(camera, Intrinsics):
            raise InputError(f"intrinsics is a {type(camera).__name__}", where=where, expected="Intrinsics")
        _require_rays(where, camera)
        for what, image, channels in (
            ("rgb", self.held_rgb, 3),
            ("depth", self.depth, None),
            ("alpha", self.alpha, None),
            ("hidden", self.hidden, None),
        ):
            if image is not None or what == "rgb":
                _check_image(where, what, image, camera, channels)
        if self.depth is not None and not _is_finite(self.depth):
            object.__setattr__(self, "depth", self.depth.nan_to_num(0.0, 0.0, 0.0))
        if self.hidden is not None:
            self._hide(self.hidden)

    def _hide(self, hidden: Bool[Tensor, "h w"]) -> None:
        where, expected = f"frame {self.name}", "booleans that leave something visible"
        if hidden.dtype != torch.bool:
            raise InputError(f"hidden has dtype {hidden.dtype}", where=where, expected=expected)
        if bool(hidden.all()):
            raise WhollyHidden("hidden is all true", where=where, expected=expected)
        if self.depth is not None and bool((self.depth[hidden.to(self.depth.device)] != 0).any()):
            depth = torch.where(hidden.to(self.depth.device), 0, self.depth)
            object.__setattr__(self, "depth", depth)

    @staticmethod
    def open(
        path: str | Path,
        *,
        depth: str | Path | None = None,
        camera: Intrinsics | str | Path | None = None,
        focal: float | None = None,
        hfov: float | None = None,
        assumed: Sequence[Intrinsics] = (),
        depth_unit: float | None = None,
        background: Background = BLACK,
        largest: int | None = None,
        mask: str | Path | None = None,
        mask_hides: HiddenColour = "black",
    ) -> Frame:
        """Read a photo, turn it upright according to its EXIF orientation, and find its camera.

        The camera is given by at most one of ``camera`` (intrinsics, or a file, see
        ``bidnerf_core.camera.files``; photos from fisheye lenses are undistorted), ``focal`` (focal length in
        pixels of the image file) and ``hfov`` (horizontal field of view of the upright image, degrees).
        Otherwise it comes from the focal length in EXIF or, failing that, from the ``assumed`` cameras, for
        instance those of a map's landmarks (``map.landmarks.cameras``). A camera for another resolution is
        scaled, and one that describes the image as stored is turned with it. ``camera_source`` of the result
        states in one line where the camera comes from.

        ``depth`` is an image or a ``.npy`` file of planar z, in steps of ``depth_unit`` metres. Without a
        unit, 0.001 m is assumed for integers and 1 m for floats, with an ``InputWarning``, which also lists
        values that mean "nothing measured" (NaN, infinite, negative, 65535, 1e10 and the like); they become
        0. Depth at another resolution is resampled to the nearest measurement. ``background`` (rgb in [0, 1],
        "white" or "black") lies behind transparent pixels. If the longer side exceeds ``largest`` pixels, the
        image is downscaled to that size. ``mask`` is an image whose black pixels (white ones with
        ``mask_hides="white"``) are ignored: they become ``hidden``.

        Raises ``InputError`` if a file cannot be read or exceeds 100 megapixels, if the camera is unknown or
        given twice, and if camera or depth belong to an image of another aspect ratio.
        """
        given = CameraSource(camera, focal, hfov, tuple(assumed))
        return Frame.read(
            path, given, depth=depth, depth_unit=depth_unit, background=background, largest=largest,
            mask=mask, mask_hides=mask_hides,
        )  # fmt: skip

    @staticmethod
    def read(
        path: str | Path,
        camera: CameraSource,
        *,
        depth: str | Path | None = None,
        depth_unit: float | None = None,
        sensor: DepthCamera | None = None,
        background: Background = BLACK,
        largest: int | None = None,
        mask: str | Path | None = None,
        mask_hides: HiddenColour = "black",
    ) -> Frame:
        """Read a photo as ``open`` does; depth is registered to it from ``sensor``, if given."""
        path = Path(path)
        photo = read_photo(
            path,
            camera,
            depth=None if depth is None else Path(depth),
            depth_unit=depth_unit,
            sensor=sensor,
            background=background,
            largest=largest,
        )
        if photo.remark is not None:
            warnings.warn(f"{depth}: {photo.remark}", InputWarning, stacklevel=3)
        found, hidden = photo.camera, None
        if mask is not None:
            size = (found.camera.width, found.camera.height)
            hidden = read_mask(Path(mask), photo.raster, size, mask_hides)
        images = Images(photo.rgb, photo.depth, photo.alpha, hidden)
        return Frame.taken(
            path.stem,
            found.camera,
            images,
            camera_source=found.description,
            focal_is_approximate=found.approximate,
            orientation=photo.raster.orientation,
        )

    @staticmethod
    def taken(name: str, camera: Camera, images: Images, **about: Any) -> Frame:
        """Return the frame of upright images taken by ``camera``; those of a ``Lens`` are resampled to its
        pinhole camera.

        ``about`` holds further attributes of the frame, as for its constructor.
        """
        intrinsics = camera
        if isinstance(camera, Lens):
            intrinsics, images = camera.pinhole, images.as_pinhole(camera)
            about = {"camera_source": camera.sentence} | about | {"lens": camera}
        hidden = images.hidden if images.hidden is not None and bool(images.hidden.any()) else None
        return Frame(name, images.rgb, intrinsics, images.depth, images.alpha, hidden=hidden, **about)  # type: ignore[arg-type]

    def with_hidden(self, hidden: Bool[Tensor, "h w"] | None) -> Frame:
        """Return the frame with more pixels hidden; the frame itself if ``hidden`` is None or false
        everywhere.

        Raises ``WhollyHidden`` if nothing would be left.
        """
        if hidden is None or not bool(hidden.any()):
            return self
        return self.with_images(hidden=hidden if self.hidden is None else hidden | self.hidden)

    @staticmethod
    def from_numpy(
        rgb: np.ndarray | Tensor,
        camera: Intrinsics,
        *,
        depth: np.ndarray | Tensor | None = None,
        depth_unit: float | None = None,
        alpha: np.ndarray | Tensor | None = None,
        hidden: np.ndarray | Tensor | None = None,
        name: str = "image",
        background: Background = BLACK,
    ) -> Frame:
        """Build a frame from NumPy arrays or torch tensors.

        ``rgb`` is (h, w) or (h, w, 1 to 4): uint8 in [0, 255], uint16 in [0, 65535], or floats in [0, 1]; a
        second or fourth channel is alpha, which may be given as ``alpha`` (h, w) instead. Colours are
        straight (not premultiplied) and composited over ``background``. ``depth`` (planar z), ``depth_unit``
        and the scaling of ``camera`` are as in ``open``. ``hidden`` (h, w) holds booleans, true where a pixel
        is to be ignored.

        Raises ``InputError`` for other types and shapes, NaN, floats outside [0, 1], and if camera or depth
        belong to an image of another aspect ratio.
        """
        where = f"frame {name}"
        given: Any = camera
        if not isinstance(given, Intrinsics):
            found = type(given).__name__
            raise InputError(
                f"camera is a {found}",
                where=where,
                expected=(
                    "Intrinsics(fx=..., fy=..., cx=..., cy=..., width=..., height=...) or, from a matrix,"
                    " Intrinsics.from_opencv(K, distortion, (width, height))"
                ),
            )
        colour, cover = split_alpha(pixel_array(rgb, f"{where}: rgb"))
        if alpha is not None:
            if cover is not None:
                raise InputError(
                    "rgb has an alpha channel, and alpha is given;", where=where, expected="only one of them"
                )
            cover = _mask(alpha, (colour.shape[1], colour.shape[0]), where)
        raster = Raster(colour.shape[1], colour.shape[0])
        intrinsics = raster.upright(camera)
        if intrinsics is None:
            found, expected = f"{raster.width}x{raster.height}", f"{camera.width}x{camera.height}"
            raise InputError(
                f"rgb is {found}, but its camera expects {expected} or a size of the same aspect ratio",
                where=where,
            )
        metres = None
        if depth is not None:
            measured = depth_image(depth, depth_unit, f"{where}: depth")
            metres = fit_depth(measured, raster, raster.size, f"{where}: depth")
            if remark := measured.remark(depth_unit is None):
                warnings.warn(f"{where}: {remark}", InputWarning, stacklevel=2)
        laid = over(colour, cover, background_colour(background))
        unused = None if hidden is None else torch.as_tensor(hidden)
        if unused is not None and unused.dtype == torch.bool and not bool(unused.any()):
            unused = None
        return Frame(name, laid, intrinsics, metres, cover, hidden=unused)

    def to(self, device: torch.device | str) -> Frame:
        """Return the frame with its images on ``device``; the frame itself if they are already there."""
        others = (self.depth, self.alpha, self.hidden)
        depth, alpha, hidden = (None if image is None else image.to(device) for image in others)
        rgb = self.held_rgb.to(device)
        if all(a is b for a, b in zip((rgb, depth, alpha, hidden), (self.held_rgb, *others), strict=True)):
            return self
        return replace(self, rgb=rgb, depth=depth, alpha=alpha, hidden=hidden)

    @property
    def held_rgb(self) -> Shaped[Tensor, "h w channels"]:
        """The colours as stored: bytes from 0 to 255, or floats in [0, 1]."""
        held: Tensor = self.__dict__[HELD]
        return held

    def with_images(self, **images: Tensor | None) -> Frame:
        """Return the frame with other depth, alpha or hidden pixels; colours stored as bytes stay bytes."""
        return replace(self, rgb=self.held_rgb, **images)  # type: ignore[arg-type]

    def at_most(self, largest: int) -> Frame:
        """Return the frame downscaled to ``largest`` pixels along its longer side; the frame itself if it is
        not larger.

        Colours are averaged over areas and rounded to bytes. Depth is that of the nearest pixel, and a pixel
        is hidden if any pixel it covers is.
        """
        camera = self.intrinsics
        if max(camera.width, camera.height) <= largest:
            return self
        small = camera.at_most(largest)
        size = (small.width, small.height)
        rgb = reduced(self.held_rgb.cpu(), *size)
        depth = None if self.depth is None else resampled(self.depth.cpu(), *size)
        alpha = None if self.alpha is None else reduced(self.alpha.cpu().float(), *size)
        hidden = None if self.hidden is None else reduced(self.hidden.cpu().float(), *size) > 0
        return replace(
            self, rgb=rgb if rgb.dtype == torch.uint8 else as_bytes(rgb), intrinsics=small, depth=depth,
            alpha=alpha, hidden=hidden,
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copying: everything except the weak reference to the colours as floats."""
        return {name: value for name, value in self.__dict__.items() if name != LAST}

    @property
    def has_depth(self) -> bool:
        """Whether any depth was measured."""
        return self.depth is not None and bool((self.depth > 0).any())

    @property
    def has_dense_depth(self) -> bool:
        """Whether depth was measured at more than a few points."""
        return self.depth is not None and float((self.depth > 0).float().mean()) >= SPARSE


Frame.rgb = Colours()  # type: ignore[assignment]
"""Set after the class was created: in its body, it would be taken for a default value."""


def _check_image(where: str, what: str, image: object, camera: Intrinsics, channels: int | None) -> None:
    """Raise ``InputError`` unless the image is a tensor of the camera's size with finite floats (booleans if
    ``hidden``).
    """
    if not isinstance(image, Tensor):
        raise InputError(
            f"{what} is a {type(image).__name__}",
            where=where,
            expected="a tensor; Frame.from_numpy takes arrays",
        )
    found, size = tuple(image.shape), (camera.height, camera.width)
    if len(found) != (2 if channels is None else 3) or found[2:] != (() if channels is None else (channels,)):
        expected = "(height, width)" if channels is None else f"(height, width, {channels})"
        hint = "; Frame.from_numpy takes grey and RGBA" if what == "rgb" else ""
        raise InputError(f"{what} has shape {found}", where=where, expected=f"{expected}{hint}")
    if found[:2] != size:
        raise InputError(
            f"{what} is {found[1]}x{found[0]}, but its camera expects {size[1]}x{size[0]}", where=where
        )
    if image.layout != torch.strided or (image.is_meta and type(image) is Tensor):
        raise InputError(f"{what} is a sparse tensor or has no values", where=where, expected="a dense one")
    if what == "hidden" or (what == "rgb" and image.dtype == torch.uint8):
        return
    if not image.is_floating_point():
        scale = "bytes or floats in [0, 1]" if what == "rgb" else "floats"
        raise InputError(
            f"{what} has dtype {str(image.dtype).removeprefix('torch.')}", where=where, expected=scale
        )
    if image.requires_grad:
        raise InputError(
            f"{what} requires a gradient", where=where, expected="measured values; detach() them"
        )
    if what != "depth" and not _is_finite(image):
        raise InputError(
            f"{what} has values that are NaN or infinite", where=where, expected="finite numbers"
        )


def _is_finite(image: Tensor) -> bool:
    """Return whether all values are finite. On an accelerator this is skipped: waiting for it would delay each frame."""
    # The sum is cheaper than a mask, which is only computed if the sum is not finite.
    return image.device.type != "cpu" or math.isfinite(image.sum()) or bool(image.isfinite().all())


def _require_rays(where: str, camera: Intrinsics) -> None:
    if camera.distortion and not _has_rays(replace(camera, distortion=tuple(camera.distortion))):
        raise InputError(
            f"distortion is {camera.distortion}, which maps no ray to some of its pixels;",
            where=where,
            expected="coefficients of a real lens",
        )


@lru_cache(maxsize=64)
def _has_rays(camera: Intrinsics) -> bool:
    """Return whether the corners, the middles of the sides and the centre of the image have rays."""
    u, v = torch.linspace(0, camera.width, 3), torch.linspace(0, camera.height, 3)
    return bool(camera.unproject(torch.cartesian_prod(u.double(), v.double())).isfinite().all())


def _mask(alpha: np.ndarray | Tensor, size: tuple[int, int], where: str) -> Float[Tensor, "h w"]:
    values = pixel_array(alpha, f"{where}: alpha")
    if values.shape[2] != 1 or (values.shape[1], values.shape[0]) != size:
        found = "x".join(map(str, values.shape))
        raise InputError(
            f"alpha is {found}", where=where, expected=f"{size[1]}x{size[0]} as rgb (rows x columns)"
        )
    return values[..., 0]


@dataclass(frozen=True, eq=False)
class SeenLandmarks:
    """Landmarks visible in an image, and their distances from its camera."""

    pixels: Float[Tensor, "n 2"]  # column and row; the centre of the first pixel is (0.5, 0.5)
    distance: Float[Tensor, "n"]  # metres from the camera, not z
    deviation: Float[Tensor, "n"]  # metres: standard deviation of the distance


@dataclass(frozen=True, eq=False)
class View:
    """A frame and its camera's pose in some reference frame: the world, or the last camera of a rig."""

    frame: Frame
    T_ref_camera: SE3
    landmarks: SeenLandmarks | None = None  # those from which training takes distances
    motion: Float[Tensor, "6"] | None = None
    """Motion of the camera during readout, see ``rolling_shutter``; the pose is then that of the middle row."""

    def to(self, device: torch.device | str) -> View:
        """Return the view with its images and its pose on ``device``."""
        return replace(self, frame=self.frame.to(device), T_ref_camera=self.T_ref_camera.to(device))
