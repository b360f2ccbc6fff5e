"""Digests of a trial's input, so that results from other images or another surface are not mistaken for its own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames.frame import View
from bidnerf_core.io.serialization import to_plain

DIGEST_BYTES = 16  # enough that no two inputs share one by chance


@dataclass(frozen=True)
class InputDigests:
    """Digests of the content of a trial's input. Folders may move, and machines may differ; content may not."""

    views: str  # images, depth, intrinsics and true poses of the frames, in hexadecimal
    points: str | None = None  # files of the COLMAP model that depth points were taken from
    surface: str | None = None  # file name of the map's baked surface, which is new with every baking


def views_digest(views: Sequence[View]) -> str:
    """Return the digest of the images, depth, alpha, intrinsics and poses of ``views``; it depends on their order."""
    hashed = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for view in views:
        frame = view.frame
        camera = json.dumps(to_plain(frame.intrinsics), sort_keys=True)
        hashed.update(f"{frame.name}\n{camera}\n".encode(errors="surrogatepass"))
        for image in (frame.rgb, frame.depth, frame.alpha, view.T_ref_camera.matrix()):
            _add_tensor(hashed, image)
    return hashed.hexdigest()


@lru_cache(maxsize=4)
def folder_digest(folder: str) -> str:
    """Return the digest of the names and contents of the files that lie directly in ``folder``.

    Raises ``InputError`` where one of them cannot be read.
    """
    hashed = hashlib.blake2b(digest_size=DIGEST_BYTES)
    try:
        for path in sorted(path for path in Path(folder).iterdir() if path.is_file()):
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "blake2b").digest()
            hashed.update(path.name.encode(errors="surrogateescape") + b"\n" + content)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: cannot be read ({error.strerror})") from error
    return hashed.hexdigest()


def _add_tensor(hashed: hashlib.blake2b, tensor: Tensor | None) -> None:
    if tensor is None:
        hashed.update(b"none\n")
        return
    array = tensor.detach().cpu().contiguous().numpy()
    hashed.update(f"{array.dtype} {array.shape}\n".encode())
    hashed.update(array.tobytes())
