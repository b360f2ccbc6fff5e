"""Frames, which are images with their cameras, and views, which are frames with poses."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from bidnerf_core.camera import (
    UPRIGHT,
    Camera,
    CameraBatch,
    CameraSource,
    Intrinsics,
    Lens,
    Orientation,
    Raster,
    read_exif,
)
from bidnerf_core.depth import DepthCamera, depth_image, read_depth_image
from bidnerf_core.devices import move_to
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.frames.masks import MaskFile, WhollyHidden, read_mask
from bidnerf_core.frames.photos import fit_depth, pinhole_of
from bidnerf_core.geometry import SE3
from bidnerf_core.io import (
    Background,
    background_colour,
    composite,
    pixel_array,
    read_compact_image,
    read_header,
    read_image,
    reduce_image,
    resample_nearest,
    split_alpha,
)

SPARSE = 0.05
"""Fraction of pixels with depth below which depth counts as sparse: the pixels in between then remain unknown."""
BLACK = (0.0, 0.0, 0.0)
IMAGES = ("rgb", "depth", "alpha", "hidden")


def as_floats(colours: Shaped[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Convert bytes to floats in [0, 1]; floats are returned unchanged."""
    return colours.float().div_(255) if colours.dtype == torch.uint8 else colours


class _Colours:
    """Descriptor of a frame's ``rgb``, which is set as bytes or floats, stored as bytes and read as floats."""

    def __get__(self, frame: Frame | None, owner: type) -> Float[Tensor, "h w 3"]:
        if frame is None:
            raise AttributeError("rgb")  # tells dataclasses that the field has no default
        return as_floats(frame.rgb_bytes)

    def __set__(self, frame: Frame, colours: Shaped[Tensor, "h w channels"]) -> None:
        frame.__dict__["rgb"] = colours  # rounded once it is known to be an image


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB or RGB-D image. Depth is planar z in metres, 0 where nothing was measured; NaN becomes 0."""

    name: str
    # rgb is in [0, 1], already composited over the background if there was an alpha channel; alpha is 1 where
    # the scene covers the pixel and 0 where the background shows. All are dense tensors of the camera's image
    # size with finite floats, which is checked here. Colours are stored as bytes (uint8), to which floats are
    # rounded, and converted whenever they are read.
    rgb: Shaped[Tensor, "h w channels"] = _Colours()  # type: ignore[assignment]
    intrinsics: Intrinsics  # type: ignore[misc]
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

    awaits_background: bool = False
    """Whether ``rgb`` is black behind transparent pixels only until a map is known, whose background then lies there."""

    depth_unit: float | None = None
    """The length (metres) of a step of the file or array that the depth was read from, if known."""

    def __post_init__(self) -> None:
        where, camera = f"frame {self.name}", self.intrinsics
        _check_camera(where, camera)
        if camera.distortion and not _has_rays(replace(camera, distortion=tuple(camera.distortion))):
            raise InputError(
                f"distortion is {camera.distortion}, which maps no ray to some of its pixels;",
                where=where,
                expected="coefficients of a real lens",
            )
        for what in IMAGES:
            image = self.__dict__[what]
            if image is not None or what == "rgb":
                _check_image(where, what, image, camera)
        if self.rgb_bytes.dtype != torch.uint8:
            self.__dict__["rgb"] = (self.rgb_bytes * 255).round_().clamp_(0, 255).to(torch.uint8)
        if self.depth is not None and not _is_finite(self.depth):
            self.__dict__["depth"] = self.depth.nan_to_num(0.0, 0.0, 0.0)
        if self.hidden is not None and self.hidden.device.type == "cpu" and not bool(self.hidden.any()):
            self.__dict__["hidden"] = None
        if self.hidden is None:
            return
        if self.hidden.device.type == "cpu" and bool(self.hidden.all()):
            raise WhollyHidden("hidden is all true", where=where, expected="booleans that leave something visible")
        if self.depth is not None:
            hidden = self.hidden.to(self.depth.device)
            # A depth image that needs no change stays in its store; the host does not wait for an accelerator.
            if hidden.device.type != "cpu" or bool((self.depth[hidden] != 0).any()):
                self.__dict__["depth"] = torch.where(hidden, 0, self.depth)

    def __repr__(self) -> str:
        """A one-line description without images."""
        camera = self.intrinsics
        recorded = [name for name in ("depth", "alpha", "hidden") if self.__dict__[name] is not None]
        kinds = ", ".join(["colour"] * self.has_colour + recorded)
        return f"<Frame {self.name}: {camera.width}x{camera.height}, {kinds}, focal length {camera.fx:.4g} px>"

    @staticmethod
    def open(
        path: str | Path,
        *,
        depth: str | Path | None = None,
        camera: Intrinsics | str | Path | None = None,
        focal: float | None = None,
        hfov: float | None = None,
        depth_unit: float | None = None,
        largest: int | None = None,
        mask: str | Path | None = None,
    ) -> Frame:
        """Read a photo, turn it upright according to its EXIF orientation, and find its camera.

        The camera is given by at most one of ``camera`` (intrinsics, or a file, see
        ``bidnerf_core.camera.files``; photos from fisheye lenses are undistorted), ``focal`` (focal length in
        pixels of the image file) and ``hfov`` (horizontal field of view of the upright image, degrees).
        Otherwise it comes from the focal length in EXIF. A camera for another resolution is scaled, and a camera of the stored
        image is turned upright with the image. ``camera_source`` of the result states in one line where the camera comes from.

        ``depth`` is an image or a ``.npy`` file of planar z, in steps of ``depth_unit`` metres. Without a
        unit, 0.001 m is assumed for integers and 1 m for floats, with an ``InputWarning``, which also lists
        values that mean "nothing measured" (NaN, infinite, negative, 65535, 1e10 and the like); they become
        0. Depth at another resolution is resampled to the nearest measurement. Transparent pixels get the background of the map in
        which the frame is localized. If the longer side exceeds ``largest`` pixels, the image is downscaled to that size. ``mask``
        is an image whose black pixels are ignored: they become ``hidden``. ``read`` also accepts a background, masks of the other
        polarity, and cameras to assume.

        Raises ``InputError`` if a file cannot be read or is too large, if the camera is unknown or
        given twice, and if the camera or the depth has another aspect ratio than the image.
        """
        given, hides = CameraSource(camera, focal, hfov), None if mask is None else MaskFile(Path(mask))
        return Frame.read(path, given, depth=depth, depth_unit=depth_unit, largest=largest, mask=hides)

    @staticmethod
    def read(
        path: str | Path,
        camera: CameraSource,
        *,
        depth: str | Path | None = None,
        depth_unit: float | None = None,
        sensor: DepthCamera | None = None,
        background: Background | None = None,
        largest: int | None = None,
        mask: MaskFile | None = None,
    ) -> Frame:
        """Read a photo as ``open`` does, with any source of its camera.

        If ``sensor`` is given, its depth is registered to the photo. ``background`` (rgb in [0, 1], "white" or "black") lies behind
        transparent pixels, by default that of the map in which the frame is localized.
        """
        path, behind = Path(path), BLACK if background is None else background_colour(background)
        exif = read_exif(path)
        raster = Raster(*read_header(path).size, exif.orientation)
        resolved = camera.find(path, raster, exif).at_most(largest)
        measured = None if depth is None else read_depth_image(Path(depth), depth_unit)
        size = (resolved.camera.width, resolved.camera.height)
        rgb, alpha = (
            read_compact_image(path, behind)
            if size == raster.upright_size
            else read_image(path, behind, exif.orientation.upright_size(*size))
        )
        metres = None
        if measured is not None and depth is not None:
            if notice := measured.notice(depth_unit is None):
                warnings.warn(f"{depth}: {notice}", InputWarning, stacklevel=3)
            metres = (
                fit_depth(measured, raster, size, f"{depth}: depth")
                if sensor is None
                else sensor.register(measured.metres, pinhole_of(resolved.camera, Path(depth)), Path(depth))
            )
        return Frame.taken(
            path.stem,
            resolved.camera,
            exif.orientation.upright(rgb),
            metres,
            None if alpha is None else exif.orientation.upright(alpha),
            None if mask is None else read_mask(mask.path, raster, size, mask.hides),
            camera_source=resolved.description,
            focal_is_approximate=resolved.approximate,
            orientation=exif.orientation,
            awaits_background=background is None and alpha is not None,
            depth_unit=None if measured is None else measured.unit,
        )

    @staticmethod
    def taken(
        name: str,
        camera: Camera,
        rgb: Shaped[Tensor, "h w 3"],
        depth: Float[Tensor, "h w"] | None = None,
        alpha: Float[Tensor, "h w"] | None = None,
        hidden: Bool[Tensor, "h w"] | None = None,
        **about: Any,
    ) -> Frame:
        """Build a frame from upright images taken by ``camera``.

        Images of a ``Lens`` are resampled to its pinhole camera: colours are interpolated between pixels, depth
        is taken from the nearest pixel, and pixels that the lens did not see are hidden. ``about`` holds further
        attributes of the frame, as for its constructor.
        """
        if isinstance(camera, Lens):
            about = {"camera_source": camera.sentence} | about | {"lens": camera}
            unseen = torch.from_numpy(camera.unseen())
            if hidden is not None:
                unseen |= torch.from_numpy(camera.resample(hidden.byte().numpy(), nearest=True)) > 0
            rgb, hidden = torch.from_numpy(camera.resample(rgb.numpy())), unseen
            if depth is not None:
                depth = torch.from_numpy(camera.resample(depth.numpy(), nearest=True))
            if alpha is not None:
                alpha = torch.from_numpy(camera.resample(alpha.numpy()))
        return Frame(name, rgb, camera.pinhole, depth, alpha, hidden=hidden, **about)

    def over(self, background: tuple[float, float, float]) -> Frame:
        """Composite the frame over ``background`` (rgb in [0, 1]) if it awaits one; otherwise, return the frame itself."""
        if not self.awaits_background or self.alpha is None:
            return self
        uncovered = (1 - self.alpha)[..., None]
        rgb = self.rgb + uncovered * uncovered.new_tensor(background)
        return self.replace(rgb=rgb.clamp(0, 1), awaits_background=False)

    def with_hidden(self, hidden: Bool[Tensor, "h w"] | None) -> Frame:
        """Return the frame with more pixels hidden; the frame itself if ``hidden`` is None or false everywhere.

        Raises ``WhollyHidden`` if no pixel would remain visible.
        """
        if hidden is None or not bool(hidden.any()):
            return self
        return self.replace(hidden=hidden if self.hidden is None else hidden | self.hidden)

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
        background: Background | None = None,
    ) -> Frame:
        """Build a frame from NumPy arrays or torch tensors.

        ``rgb`` is (h, w) or (h, w, 1 to 4): uint8 in [0, 255], uint16 in [0, 65535], or floats in [0, 1]; a
        second or fourth channel is alpha, which may be given as ``alpha`` (h, w) instead. Colours are
        straight (not premultiplied) and composited over ``background``, by default that of the map in which the
        frame is localized. ``depth`` (planar z), ``depth_unit`` and the scaling of ``camera`` are as in
        ``open``. ``hidden`` (h, w) is true for the pixels to ignore.

        Raises ``InputError`` for other types and shapes, for NaN or floats outside [0, 1], and if the camera or
        the depth has another aspect ratio than the image.
        """
        where = f"frame {name}"
        _check_camera(where, camera)
        colour, cover = split_alpha(pixel_array(rgb, f"{where}: rgb"))
        if alpha is not None:
            if cover is not None:
                raise InputError(
                    "rgb has an alpha channel, and alpha is given;", where=where, expected="only one of them"
                )
            values = pixel_array(alpha, f"{where}: alpha")
            if values.shape != (*colour.shape[:2], 1):
                actual, size = ("x".join(map(str, shape)) for shape in (values.shape, colour.shape[:2]))
                raise InputError(f"alpha is {actual}", where=where, expected=f"{size} as rgb (rows x columns)")
            cover = values[..., 0]
        raster = Raster(colour.shape[1], colour.shape[0])
        intrinsics = raster.upright(camera)
        if intrinsics is None:
            raise InputError(
                f"rgb is {raster.width}x{raster.height}, but its camera expects {camera.width}x{camera.height} or a size"
                " of the same aspect ratio",
                where=where,
            )
        metres, step = None, None
        if depth is not None:
            measured = depth_image(depth, depth_unit, f"{where}: depth")
            metres, step = fit_depth(measured, raster, raster.size, f"{where}: depth"), measured.unit
            if notice := measured.notice(depth_unit is None):
                warnings.warn(f"{where}: {notice}", InputWarning, stacklevel=2)
        laid = composite(colour, cover, BLACK if background is None else background_colour(background))
        return Frame(
            name,
            laid,
            intrinsics,
            metres,
            cover,
            hidden=None if hidden is None else torch.as_tensor(hidden),
            awaits_background=background is None and cover is not None,
            depth_unit=step,
        )

    def replace(self, **changes: Any) -> Frame:
        """Return the frame with ``changes`` to its attributes, as ``dataclasses.replace`` does, without converting its colours."""
        return replace(self, **({"rgb": self.rgb_bytes} | changes))

    def to(self, device: torch.device | str) -> Frame:
        """Return the frame with its images on ``device``; the frame itself if they are already there."""
        return move_to(self, device)

    def at_most(self, largest: int) -> Frame:
        """Return the frame downscaled to ``largest`` pixels along its longer side; the frame itself if it is not larger.

        Colours are averaged over areas and rounded to bytes. Depth is taken from the nearest pixel, and a
        pixel is hidden if any of the pixels it covers is hidden.
        """
        camera = self.intrinsics
        if max(camera.width, camera.height) <= largest:
            return self
        small = camera.at_most(largest)
        size = (small.width, small.height)
        depth = None if self.depth is None else resample_nearest(self.depth.cpu(), *size)
        alpha = None if self.alpha is None else reduce_image(self.alpha.cpu().float(), *size)
        hidden = None if self.hidden is None else reduce_image(self.hidden.cpu().float(), *size) > 0
        rgb = reduce_image(self.rgb_bytes.cpu(), *size)
        return self.replace(rgb=rgb, intrinsics=small, depth=depth, alpha=alpha, hidden=hidden)

    @property
    def rgb_bytes(self) -> Shaped[Tensor, "h w 3"]:
        """The colours as they are stored, from 0 to 255."""
        return cast(Tensor, self.__dict__["rgb"])

    def colours_at(self, rows: Int[Tensor, "*p"], columns: Int[Tensor, "*p"]) -> Float[Tensor, "*p 3"]:
        """Return the colours in [0, 1] of the pixels at ``rows`` and ``columns``."""
        there = self.rgb_bytes.device
        return as_floats(self.rgb_bytes[rows.to(there), columns.to(there)])

    @cached_property
    def measured_share(self) -> float:
        """Fraction of the pixels at which depth was measured."""
        return 0.0 if self.depth is None else float((self.depth > 0).float().mean())

    @property
    def has_depth(self) -> bool:
        """Whether any depth was measured."""
        return self.measured_share > 0

    @property
    def has_dense_depth(self) -> bool:
        """Whether depth was measured at more than a few points."""
        return self.measured_share >= SPARSE


def _check_camera(where: str, camera: object) -> None:
    if not isinstance(camera, Intrinsics):
        raise InputError(
            f"camera is a {type(camera).__name__}",
            where=where,
            expected="Intrinsics(fx=..., fy=..., cx=..., cy=..., width=..., height=...) or, from a matrix,"
            " Intrinsics.from_opencv(K, distortion, (width, height))",
        )


def _check_image(where: str, what: str, image: object, camera: Intrinsics) -> None:
    """Raise ``InputError`` unless the image is a dense tensor of the camera's size that holds finite floats without gradients
    (``rgb`` may hold bytes, ``depth`` NaN; ``hidden`` holds booleans).
    """
    if not isinstance(image, Tensor):
        raise InputError(
            f"{what} is a {type(image).__name__}",
            where=where,
            expected="a tensor; Frame.from_numpy takes arrays",
        )
    shape, wanted = tuple(image.shape), (camera.height, camera.width, *((3,) if what == "rgb" else ()))
    if len(shape) != len(wanted) or shape[2:] != wanted[2:]:
        raise InputError(
            f"{what} has shape {shape}",
            where=where,
            expected="(height, width, 3); Frame.from_numpy takes grey and RGBA" if what == "rgb" else "(height, width)",
        )
    if shape != wanted:
        raise InputError(
            f"{what} is {shape[1]}x{shape[0]}, but its camera expects {camera.width}x{camera.height}", where=where
        )
    if image.layout != torch.strided or (image.is_meta and type(image) is Tensor):
        raise InputError(f"{what} is a sparse tensor or has no values", where=where, expected="a dense one")
    if image.dtype == {"rgb": torch.uint8, "hidden": torch.bool}.get(what):
        return
    if what == "hidden" or not image.is_floating_point():
        kinds = {"rgb": "bytes or floats in [0, 1]", "hidden": "booleans that leave something visible"}
        dtype = str(image.dtype).removeprefix("torch.")
        raise InputError(f"{what} has dtype {dtype}", where=where, expected=kinds.get(what, "floats"))
    if image.requires_grad:
        raise InputError(f"{what} requires a gradient", where=where, expected="measured values; detach() them")
    if what != "depth" and not _is_finite(image):
        raise InputError(f"{what} has values that are NaN or infinite", where=where, expected="finite numbers")


def _is_finite(image: Tensor) -> bool:
    """Return whether all values are finite; always True on an accelerator, since waiting for it would delay each frame."""
    # The sum is cheaper than a mask, which is only computed if the sum is not finite.
    return image.device.type != "cpu" or math.isfinite(image.sum()) or bool(image.isfinite().all())


@lru_cache(maxsize=64)
def _has_rays(camera: Intrinsics) -> bool:
    """Return whether the corners, the middles of the sides and the centre of the image have rays."""
    u, v = torch.linspace(0, camera.width, 3), torch.linspace(0, camera.height, 3)
    pixels = torch.cartesian_prod(u.double(), v.double())
    # Unlike ``Intrinsics.unproject``, a batch does not replace the rays of a lens that has none.
    return bool(CameraBatch.of([camera]).unproject(pixels, torch.zeros(9, dtype=torch.long)).isfinite().all())


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
    landmarks: SeenLandmarks | None = None  # landmarks from which training takes distances
    motion: Float[Tensor, "6"] | None = None
    """Motion of the camera during readout, see ``rolling_shutter``; the pose is then that of the middle row."""

    def to(self, device: torch.device | str) -> View:
        """Return the view with its images and its pose on ``device``."""
        return move_to(self, device)

    def over(self, background: tuple[float, float, float]) -> View:
        """Return the view with ``background`` behind the frame, see ``Frame.over``."""
        frame = self.frame.over(background)
        return self if frame is self.frame else replace(self, frame=frame)
