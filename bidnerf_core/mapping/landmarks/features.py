"""Keypoints of an image and their descriptors, by which they are matched across images.

Any detector that turns an image into ``Keypoints``, a learned one included, can serve as ``Features``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import Annotated, ClassVar, Protocol, cast, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from bidnerf_core.camera import AT_REST, Intrinsics, exposure_times, reduced_size
from bidnerf_core.devices import TensorRows
from bidnerf_core.errors import enumeration
from bidnerf_core.frames import Frame, View, as_floats
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.landmarks.descriptors import quantize
from bidnerf_core.registry import USUAL_FEATURES as USUAL_FEATURES
from bidnerf_core.registry import PluginError, Plugins, interface_defects
from bidnerf_core.settings import Range, Settings

FIRST_CENTRE = 0.5
"""Offset from OpenCV's pixel coordinates to ours: the centre of the first pixel is (0, 0) there, (0.5, 0.5) here."""


@dataclass(frozen=True, eq=False)
class Keypoints(TensorRows):
    """Keypoints of one image, the strongest first. Descriptors are compared by Euclidean distance."""

    pixels: Float[Tensor, "n 2"]  # (u, v), the centre of the first pixel at (0.5, 0.5)
    sizes: Float[Tensor, "n"]  # pixels: diameter of the keypoint's neighbourhood, as OpenCV defines it
    descriptors: UInt8[Tensor, "n d"]


@runtime_checkable
class Features(Protocol):
    """A detector that finds and describes keypoints, always with the same number of descriptor channels.

    It must be safe to call from several threads at once. ``quantize`` turns float descriptors into bytes. A detector that is
    faster when fewer keypoints are wanted may have a method ``at_most(count)``, which returns such a detector. One that also takes
    bytes, which spares large photos a conversion to floats, has the attribute ``takes_bytes``.
    """

    def __call__(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints: ...


@dataclass(frozen=True)
class Sift(Settings):
    """OpenCV's SIFT (Lowe 2004), with the root normalisation of Arandjelovic and Zisserman 2012."""

    # maximum number of keypoints: those with the highest contrast are kept
    count: Annotated[int, Range(1, 10**6)] = 2000
    # minimum contrast of a keypoint; OpenCV's default of 0.04 leaves few indoors
    contrast: Annotated[float, Range(0.0, 0.999)] = 0.01
    # maximum pixels along the longer side; larger images are downscaled first: a phone's twelve megapixels contain no more
    # keypoints of the sizes that maps use, and take half a minute
    largest: Annotated[int, Range(16, 10**5)] = 800
    takes_bytes: ClassVar[bool] = True

    def at_most(self, count: int) -> Sift:
        return replace(self, count=count)

    def __call__(self, rgb: Shaped[Tensor, "h w 3"]) -> Keypoints:
        # Precise upscaling maps index x to 2 x; without it, all keypoints of the first octave are a quarter of a pixel
        # off. A detector object is not thread-safe, and is cheap to create.
        sift = cv2.SIFT.create(nfeatures=self.count, contrastThreshold=self.contrast, enable_precise_upscale=True)
        grey = grey_image(rgb)
        height, width = grey.shape
        size, scale = reduced_size(width, height, self.largest), np.ones(2, dtype=np.float32)
        if size != (width, height):
            scale = np.array([size[0] / width, size[1] / height], dtype=np.float32)
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        detections, descriptors = sift.detectAndCompute(grey, None)
        if descriptors is None or not len(detections):
            return Keypoints(torch.zeros(0, 2), torch.zeros(0), torch.zeros((0, 128), dtype=torch.uint8))
        order = np.argsort([-keypoint.response for keypoint in detections], kind="stable")
        pixels = (np.asarray(cv2.KeyPoint.convert(detections), dtype=np.float32) + FIRST_CENTRE)[order] / scale
        sizes = np.array([detections[i].size for i in order], dtype=np.float32) / scale.mean()
        raw = torch.from_numpy(np.asarray(descriptors, dtype=np.float32)[order])
        total = raw.sum(-1, keepdim=True).clamp(min=torch.finfo(raw.dtype).tiny)
        # Euclidean distances of the roots are Hellinger distances.
        return Keypoints(torch.from_numpy(pixels), torch.from_numpy(sizes), quantize((raw / total).sqrt()))


SIFT = Sift()
"""OpenCV's SIFT (Lowe 2004), with root normalisation."""


FEATURES: Plugins[Features] = Plugins(
    "features",
    lambda features: interface_defects(features, (), {"__call__": ("rgb",)}),
    first=(USUAL_FEATURES,),
)
"""The detectors by name."""


def find_features(name: str, wanted_by: str = "") -> Features:
    """Return a detector by name. Raises ``PluginError`` (an ``InputError``) for an unknown name or a broken plugin."""
    return FEATURES.load(name, wanted_by)


def detect(features: Features, rgb: Shaped[Tensor, "h w 3"]) -> Keypoints:
    """Run the detector on an image (bytes, or floats in [0, 1]).

    Raises ``PluginError`` unless the detector returns ``Keypoints`` that lie inside the image.
    """
    keypoints = features(rgb if hasattr(features, "takes_bytes") else as_floats(rgb))
    who = f"detector {getattr(features, '__name__', type(features).__name__)}"
    if not isinstance(keypoints, Keypoints):
        raise PluginError(
            f"returned a {type(keypoints).__name__}", where=who, expected="Keypoints(pixels, sizes, descriptors)"
        )
    parts = (keypoints.pixels, keypoints.sizes, keypoints.descriptors)
    kinds = [f"{p.dtype} {list(p.shape)}" if isinstance(p, Tensor) else type(p).__name__ for p in parts]
    fits = all(isinstance(part, Tensor) for part in parts) and keypoints.descriptors.dtype == torch.uint8
    if not fits or [list(p.shape) for p in parts] != [[n := len(parts[2]), 2], [n], [n, parts[2].shape[-1]]]:
        raise PluginError(
            f"pixels, sizes and descriptors are {enumeration(kinds)}",
            where=who,
            expected="tensors (n, 2), (n) and (n, d), the last in torch.uint8; quantize converts floats",
        )
    size = torch.tensor([rgb.shape[1], rgb.shape[0]])
    if not bool(((keypoints.pixels >= 0) & (keypoints.pixels <= size)).all()):
        raise PluginError(
            f"keypoints lie outside the image of {size[0]}x{size[1]} pixels", where=who, expected="all inside"
        )
    return keypoints


@dataclass(frozen=True)
class _Strongest:
    features: Features
    count: int
    takes_bytes: ClassVar[bool] = True

    def __call__(self, rgb: Shaped[Tensor, "h w 3"]) -> Keypoints:
        detections = detect(self.features, rgb)
        return detections[torch.arange(min(self.count, len(detections)))]


def limit_features(features: Features, count: int) -> Features:
    """Return a detector that returns at most the ``count`` strongest keypoints."""
    return cast(Features, getattr(features, "at_most", partial(_Strongest, features))(count))


class CachedFeatures:
    """A detector that caches the keypoints of each image during one query.

    ``features`` is called with images as they are given, in bytes or floats, and ``known`` holds images with keypoints that are
    already known. Threads may share the detector.
    """

    takes_bytes = True

    def __init__(self, features: Callable[[Tensor], Keypoints], known: Iterable[tuple[Tensor, Keypoints]] = ()) -> None:
        self._features, self._cache, self._lock = features, list(known), Lock()

    def __call__(self, rgb: Shaped[Tensor, "h w 3"]) -> Keypoints:
        with self._lock:
            for image, keypoints in self._cache:
                if image is rgb or (image.shape == rgb.shape and torch.equal(image.to(rgb), rgb)):
                    return keypoints
            self._cache.append((rgb, self._features(rgb)))
            return self._cache[-1][1]


def grey_image(rgb: Shaped[Tensor, "h w 3"]) -> np.ndarray:
    """Return the brightness of an image (bytes, or floats in [0, 1]) as bytes (h, w)."""
    rgb = rgb.detach().cpu()
    if rgb.dtype != torch.uint8:
        # Strips of the image are converted one by one, since converting a whole phone photo at once takes a gigabyte.
        strips = rgb.split(max(1, 2**22 // rgb.shape[1]))
        rgb = torch.cat([x.float().nan_to_num(0.0).clamp_(0, 1).mul_(255).round_().to(torch.uint8) for x in strips])
    return cv2.cvtColor(rgb.contiguous().numpy(), cv2.COLOR_RGB2GRAY)


@dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """The keypoints of a view, as undistorted rays, and the pose of its camera: in the world, or in the frame of a rig."""

    keypoints: Keypoints
    rays: Float[Tensor, "n 3"]  # on the plane z = 1 of the camera, float64
    depth: Float[Tensor, "n"]  # metres, 0 where none was measured
    intrinsics: Intrinsics
    T_ref_camera: SE3  # float64; of the middle row
    motion: Float[Tensor, "6"] = AT_REST  # during the readout: metres, then radians; epipolar lines ignore it
    hidden: Bool[Tensor, "h w"] | None = None  # pixels of objects that are not in the map, see ``Frame``

    @property
    def focal(self) -> float:
        """The geometric mean of the two focal lengths, pixels."""
        return (self.intrinsics.fx * self.intrinsics.fy) ** 0.5

    @property
    def exposure_times(self) -> Float[Tensor, "n"]:
        """The exposure times of the keypoints, as fractions of the readout (-0.5 to 0.5), float64; see the function ``exposure_times``."""
        return exposure_times(self.keypoints.pixels, self.intrinsics)


def image_keypoints(view: View, features: Features) -> ImageKeypoints:
    """Detect the keypoints of ``view`` whose neighbourhoods contain no hidden pixel."""
    frame = view.frame
    hidden = None if frame.hidden is None else frame.hidden.cpu()
    keypoints = detect(features, frame.rgb_bytes)
    if hidden is not None and len(keypoints):
        # Keypoints stay if their neighbourhoods contain no hidden pixel.
        visible = np.ascontiguousarray((~hidden.numpy()).astype(np.uint8))
        away = torch.from_numpy(cv2.distanceTransform(visible, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
        columns, rows = keypoints.pixels.long().unbind(-1)
        reached = away[rows.clamp(0, hidden.shape[0] - 1), columns.clamp(0, hidden.shape[1] - 1)]
        keypoints = keypoints[reached > keypoints.sizes.to(reached) / 2]
    return ImageKeypoints(
        keypoints,
        frame.intrinsics.unproject(keypoints.pixels.double()),
        measured_depth(frame, keypoints.pixels),
        frame.intrinsics,
        view.T_ref_camera.to("cpu", torch.float64),
        AT_REST if view.motion is None else view.motion,
        hidden,
    )


def measured_depth(frame: Frame, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Return the median depth (metres) of the 3x3 pixels around each of ``pixels`` (u, v).

    The result is 0 at depth edges, where depth changes by over 5 %, and where fewer than six of the nine pixels have
    measured depth.
    """
    if frame.depth is None or not len(pixels):
        return torch.zeros(len(pixels), dtype=torch.float64)
    depth = frame.depth.detach().cpu().double()
    height, width = depth.shape
    u, v = pixels.floor().long().unbind(-1)
    step = torch.tensor([-1, 0, 1])
    rows = (v[:, None, None] + step[:, None]).clamp(0, height - 1)
    columns = (u[:, None, None] + step).clamp(0, width - 1)
    around = depth[rows, columns].flatten(1)
    around = torch.where(around.isfinite() & (around > 0), around, torch.nan)
    median = around.nanmedian(dim=1).values
    known = around.isfinite()
    low = torch.where(known, around, torch.inf).amin(1)
    high = torch.where(known, around, 0).amax(1)
    smooth = (known.sum(1) >= 6) & (high - low <= 0.05 * median)
    return torch.where(smooth, median, 0)
