"""Depth images: planar z in metres, and 0 where nothing was measured."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.io import decode, read_array, to_numpy
from bidnerf_core.settings import FARTHEST

NOTHING = 1e10
"""Floating-point values from here on mean "not measured" in any unit, such as Blender's 1e10 and the largest float."""
MILLIMETRE = 0.001
"""One millimetre in metres, the usual step of integer depth images."""


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image, and counts of the values that stood for missing measurements."""

    metres: Float[Tensor, "h w"]  # planar z, 0 where nothing was measured
    unit: float  # metres per step
    replaced: dict[str, int]  # how often each kind of value that is not a depth occurred, except zeros

    @property
    def median(self) -> float | None:
        """The median of the measured distances (metres), or None if nothing was measured."""
        measured = self.metres[self.metres > 0]
        return float(measured.median()) if measured.numel() else None

    def notice(self, unit_assumed: bool) -> str | None:
        """Return one line on the assumed unit, missing depth and dropped values, or None if there is nothing to report."""
        parts = []
        if self.median is None:
            parts.append("the depth image holds no measurement, so only colour is used")
        elif unit_assumed:
            parts.append(
                f"depth_unit is not given, {self.unit:g} m per step is assumed: median depth {self.median:.4g} m"
            )
        return "; ".join([*parts, *filter(None, [self.dropped])]) or None

    @property
    def dropped(self) -> str | None:
        """A phrase that lists the dropped values, or None if there were none."""
        counts = ", ".join(f"{count} x {what}" for what, count in self.replaced.items())
        return f"treated as not measured: {counts}" if counts else None


def read_depth_image(path: Path, unit: float | None) -> DepthImage:
    """Read depth from a grey image (integers or floats), or from an array in a ``.npy`` file; see ``depth_image``.

    Raises ``InputError`` if the file holds neither.
    """
    raw = read_array(path, "a .npy file") if path.suffix.lower() == ".npy" else decode(path, 24)
    return depth_image(raw, unit, f"{path}: depth")


def depth_image(raw: np.ndarray | Tensor, unit: float | None, what: str) -> DepthImage:
    """Convert an array (h, w) or (h, w, 1) with ``unit`` metres per step; None means 0.001 for integers and 1 for floats.

    Values that no sensor measures become 0: NaN, infinite and negative values, the largest value of an
    integer type, 65535 and 65.535 in floating-point arrays, floats from 1e10 on, and depths above 1e9 m. The largest
    value of the image also becomes 0 if it is the sensor's limit: a round number of metres or a value with all bits set, in
    at least a twentieth of all pixels, and far more frequent than any other value. Raises ``InputError``, whose message
    begins with ``what``, for an array of another shape or type, and for a unit that is not positive.
    """
    values = to_numpy(raw)
    values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
    if values.ndim != 2 or not values.size or values.dtype.kind not in "uif":
        raise InputError(
            f"{what} is {'x'.join(map(str, values.shape))} of {values.dtype.name}",
            expected="one channel of integer or floating-point numbers",
        )
    if unit is None:
        unit = 1.0 if values.dtype.kind == "f" else MILLIMETRE
    given: Any = unit
    if not isinstance(given, Real) or not 0 < unit <= FARTHEST:
        raise InputError(f"depth_unit is {unit!r}", where=what, expected="a positive number of metres per step")
    metres = values.astype(np.float64) * unit
    absent = _absent(values, metres)
    unmeasured = np.logical_or.reduce([metres == 0, *absent.values()])
    limit = _at_limit(values, metres, unmeasured)
    absent |= limit
    unmeasured = np.logical_or.reduce([unmeasured, *limit.values()])
    counts = {name: int(mask.sum()) for name, mask in absent.items() if mask.any()}
    return DepthImage(torch.from_numpy(np.where(unmeasured, 0, metres).astype(np.float32)), float(unit), counts)


def likely_unit(estimate: float) -> float:
    """Return the unit (metres per step) behind an estimate, known to some percent: sensors count in round steps, such as 1 or 0.2 mm."""
    rounded = float(f"{estimate:.1g}")
    return rounded if abs(rounded / estimate - 1) < 0.05 else estimate


def _absent(values: np.ndarray, metres: np.ndarray) -> dict[str, np.ndarray]:
    """Return masks of the values that mean "not measured", by their names in messages; the masks are disjoint."""
    is_float, finite = values.dtype.kind == "f", np.isfinite(values)
    # written for "too far" or "nothing", in 16 bits as a rule
    largest = np.iinfo(np.uint16 if is_float else values.dtype).max
    absent = {"NaN": np.isnan(values), "infinite": np.isinf(values), "negative": finite & (values < 0)}
    absent |= {str(largest): values == largest}
    if is_float:
        clipped = largest * MILLIMETRE
        absent |= {
            f"{clipped:g}": np.abs(values - clipped) < 1e-5,
            f"{NOTHING:g} or more": finite & (values >= NOTHING),
        }
    return absent | {f"over {FARTHEST:g} m": ~np.logical_or.reduce(list(absent.values())) & (metres > FARTHEST)}


def _at_limit(values: np.ndarray, metres: np.ndarray, unmeasured: np.ndarray) -> dict[str, np.ndarray]:
    """Return the mask of the pixels at the sensor's limit, by its name in messages; empty if there are no such pixels."""
    measured = metres[~unmeasured]
    if not measured.size:
        return {}
    largest = float(measured.max())
    mask = ~unmeasured & (metres == largest)
    count = int(mask.sum())
    # A sensor's limit is round, as ranges in settings and data sheets are (a multiple of 0.5 m from 4 m on), or has all bits set.
    is_round = largest >= 4 and abs(largest - round(2 * largest) / 2) < 1e-6 * largest
    value = float(values[mask][0])
    fills_bits = values.dtype.kind != "f" and value in [2**bits - 1 for bits in range(11, 17)]
    if count < max(0.05 * values.size, 20) or not (is_round or fills_bits):
        return {}
    # A wall facing the camera has a single depth as well, but rarely a round one, and several flat surfaces give several values.
    _, others = np.unique(measured[measured < largest], return_counts=True)
    if not others.size or count < 4 * others.max():
        return {}
    return {f"{value:g} (the sensor's limit)": mask}


class DepthReader:
    """Reads the depth images of a recording, and warns once about each kind of value that means "not measured".

    ``documented`` lists the kinds that the recording's format defines, by their names in
    ``DepthImage.replaced``; they cause no warning.
    """

    def __init__(self, documented: Collection[str] = ()) -> None:
        self._mentioned = set(documented)

    def __call__(self, path: Path, unit: float) -> DepthImage:
        """Read an image as ``read_depth_image`` does. A kind of value not seen before causes an ``InputWarning``."""
        image = read_depth_image(path, unit)
        new = {name: count for name, count in image.replaced.items() if name not in self._mentioned}
        if new:
            self._mentioned |= new.keys()
            warnings.warn(
                f"{path}: depth: {replace(image, replaced=new).dropped}, here and in the images that follow",
                InputWarning,
                stacklevel=2,
            )
        return image
