"""Reading of photos and their metadata from uploads, and error messages that clients may see."""

from __future__ import annotations

import math
import os
from pathlib import Path

from bidnerf.results import read_pose
from bidnerf.service.models import Upload
from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import DatasetOptions, Photos
from bidnerf_core.errors import InputError, spelled
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_heif, read_header
from bidnerf_core.settings import WIDEST_HFOV


def read_upload(upload: Upload, usual: CameraSource, folder: Path, max_pixels: float) -> tuple[Photos, SE3 | None]:
    """Write the files of a request to ``folder``, check the image sizes in their headers, and return the photo and the start pose.

    ``usual`` is the camera source for photos sent without a camera. Raises ``InputError``; pass it to
    ``public_message`` before showing it to clients.
    """
    images, widths = dict[str, Path](), dict[str, int]()
    for name, content in upload.files.items():
        ending = ".npy" if content.startswith(b"\x93NUMPY") else ".heic" if is_heif(content[:12]) else ""
        images[name] = file = folder / f"{name}{ending}"
        file.write_bytes(content)
        if ending == ".npy":  # an array is as large as its file, which reading it checks
            continue
        try:
            header = read_header(file)
        except InputError as error:  # perhaps the name of a file instead of its content
            expected = f"an image file, as 'curl -F {name}=@FILE' sends it" if content.isascii() else None
            raise InputError(error, expected=expected) from error
        widths[name] = header.width
        if header.width * header.height > max_pixels:
            raise InputError(
                f"image is {header.width}x{header.height}",
                where=file,
                expected=f"at most {max_pixels / 1e6:g} megapixels",
            )
    texts = dict[str, Path]()
    for name in ("camera", "start"):
        if name in upload.parameters:
            texts[name] = folder / name
            texts[name].write_text(upload.parameters[name], encoding="utf-8")
    focal, hfov = upload.parameters.get("focal"), upload.parameters.get("hfov")
    least = widths.get("photo", 0) / 2 / math.tan(math.radians(WIDEST_HFOV / 2))
    if focal is not None and focal < least:
        raise InputError(
            f"focal is {focal:g} for {widths['photo']} columns",
            expected=f"at least {least:.3g}, which is a field of view of {WIDEST_HFOV:g} degrees",
        )
    own = CameraSource(texts.get("camera"), focal, hfov, usual.assumed)
    photo, depth = images["photo"], images.get("depth")
    photos = Photos(
        [photo],
        DatasetOptions(own if own.is_given else usual, depth_unit=upload.parameters.get("depth_unit")),
        {} if depth is None else {photo: depth},
    )
    return photos, read_pose(texts["start"]) if "start" in texts else None


def public_message(error: InputError, folder: Path) -> str:
    """Return the message of an error for clients: without the folder of the request, and with the names of the request's parameters."""
    return spelled(str(error).replace(f"{folder}{os.sep}", ""))
