"""Masks: images that mark which pixels of a photo to ignore, such as people who walk through the scene.

A mask is read into the boolean image ``Frame.hidden``. By the convention of nerfstudio and COLMAP, black is
ignored and everything brighter is used; segmentation masks often mark the region to ignore in white instead.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from bidnerf_core.camera import Raster
from bidnerf_core.errors import InputError, amount
from bidnerf_core.io import IMAGE_SUFFIXES, decode, resample_nearest

HiddenColour = Literal["black", "white"]
"""The mask colour that marks pixels to ignore."""
INVERTED = "if it marks what should be used, the masks are inverted (`mask_hides`)"


@dataclass(frozen=True)
class MaskFile:
    """A mask of an image, and the mask colour that marks pixels to ignore."""

    path: Path
    hides: HiddenColour = "black"


class WhollyHidden(InputError):
    """Raised if a mask hides its entire image, which leaves nothing to use."""


def read_mask(path: Path, raster: Raster, size: tuple[int, int], hides: HiddenColour = "black") -> Bool[Tensor, "h w"]:
    """Return which pixels of an image of ``size`` (width, height) the mask in file ``path`` hides.

    ``raster`` is the raster of the image file; a mask that fits the stored image is turned upright with it. A mask of another
    resolution is resampled by nearest neighbour. Values in the upper half of the range count as white, others as black;
    if all values are in the lower half, such as 0 and 1, every value above 0 is white. If the colours are uniform, the alpha
    channel is the mask. Raises ``InputError`` if the file is not an image or has another aspect ratio, and
    ``WhollyHidden`` if it hides everything.
    """
    white = raster.turn(torch.from_numpy(_white(decode(path))), "mask", path)
    if tuple(white.shape) != size[::-1]:
        white = resample_nearest(white, *size)
    hidden = white if hides == "white" else ~white
    if bool(hidden.all()):
        raise WhollyHidden(f"mask is all {hides}, which hides the whole image; {INVERTED}", where=path)
    return hidden


def hides_everything(path: Path, hides: HiddenColour = "black") -> bool:
    """Return whether a mask hides every pixel. Raises ``InputError`` if the file is not an image."""
    return bool((_white(decode(path)) == (hides == "white")).all())


def _white(raw: np.ndarray) -> Bool[np.ndarray, "h w"]:
    values = raw if raw.ndim == 3 else raw[..., None]
    colours, alpha = (values[..., :-1], values[..., -1:]) if values.shape[-1] in (2, 4) else (values, None)
    if alpha is not None and bool((colours == colours[:1, :1]).all()):
        colours = alpha
    brightness: np.ndarray = colours.max(-1)
    full = float(np.iinfo(brightness.dtype).max) if brightness.dtype.kind in "ui" else 1.0
    is_dark = float(brightness.max(initial=0)) < full / 2
    white: np.ndarray = brightness > 0 if is_dark else brightness >= full / 2
    return white


class MaskFolder:
    """A folder of masks that belong to photos by name.

    The mask of ``NAME.jpg`` is ``NAME.png``, ``NAME.jpg.png`` (COLMAP's convention), or has ``mask`` before
    or after the name (``dynamic_mask_NAME.png``, ``NAME_mask.png``). If photos are in subfolders, their masks
    may be too. Any image format is accepted. ``hides`` is the colour of the pixels to ignore. Raises ``InputError``
    if there is no such folder, or no image in it.
    """

    def __init__(self, path: str | Path, hides: HiddenColour = "black") -> None:
        self.path, self.hides = Path(path), hides
        if hides not in get_args(HiddenColour):
            raise InputError(f"mask_hides is {hides!r}", expected=f"one of {', '.join(get_args(HiddenColour))}")
        if not self.path.is_dir():
            raise InputError(
                "is a file" if self.path.exists() else "no such folder", where=self.path, expected="a folder of masks"
            )
        files = sorted(
            f
            for f in self.path.rglob("*")
            if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file() and not f.name.startswith(".")
        )
        if not files:
            raise InputError("contains no images", where=self.path, expected="masks")
        self._by_name = defaultdict[str, list[Path]](list)
        for file in files:
            photo = PurePath(re.sub("^(dynamic_)?mask_|[_.-]mask$", "", file.stem))
            stem = photo.stem if photo.suffix.lower() in IMAGE_SUFFIXES else photo.name
            parts = (*file.relative_to(self.path).parts[:-1], stem)
            for depth in range(1, len(parts) + 1):
                self._by_name["_".join(parts[-depth:])].append(file)

    def file_of(self, name: str) -> Path | None:
        """Return the mask of the frame named ``name``; None if there is none. Raises ``InputError`` if there are several."""
        files = self._by_name.get(name, [])
        if len(files) > 1:
            raise InputError(f"{files[0]} and {files[1]} both match {name} by name", expected="one mask")
        return files[0] if files else None

    def require_any(self, names: Sequence[str]) -> None:
        """Raise ``InputError`` if none of the frames ``names`` has a mask."""
        if names and all(self.file_of(name) is None for name in names):
            raise InputError(
                "no mask in it matches an image by name;",
                where=self.path,
                expected=f"{names[0]}.png or the like, found {next(iter(self._by_name))}",
            )


def masks_sentence(hidden: Sequence[Bool[Tensor, "h w"] | None]) -> str | None:
    """Return one sentence on how much of some images is hidden; None if nothing is.

    If most images are mostly hidden, the sentence adds that the masks may be inverted.
    """
    shares = [float(pixels.float().mean()) for pixels in hidden if pixels is not None]
    if not shares:
        return None
    mean, without = 100 * sum(shares) / len(shares), len(hidden) - len(shares)
    clauses = (
        f"masks hide {mean:.3g} % of the pixels of {amount(len(shares), 'image')}",
        f"{amount(without, 'image')} without hidden pixels" if without else None,
        INVERTED if float(np.median(shares)) > 0.5 else None,
    )
    return "; ".join(filter(None, clauses))
