"""Photos without poses as the images of a map: their poses are found first, in a folder next to the map."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections.abc import Iterator
from pathlib import Path

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import HOLD_OUT_EVERY
from bidnerf_core.errors import amount
from bidnerf_core.maps.views import Images
from bidnerf_core.progress import Cancel, ProgressCallback
from bidnerf_core.structure import lacks_poses

log = logging.getLogger("bidnerf")


def poses_folder(out: Path) -> Path:
    """Return the folder next to a map that holds the poses of its photos: MAP-poses."""
    place = out if out.name else out.absolute()  # "." has no name
    return place.with_name(f"{place.name}-poses")


@contextlib.contextmanager
def posed_images(
    data: Images, split: str, out: Path | None, camera: Intrinsics | str | Path | None = None, overwrite: bool = False,
    progress: ProgressCallback | None = None, cancel: Cancel | None = None,
) -> Iterator[tuple[Images, Intrinsics | str | Path | None]]:  # fmt: skip
    """Yield images with poses, and the camera with which to open a dataset of them.

    For a folder of photos without poses, or a video, this is the dataset of poses found by structure from
    motion, next to the map ``out``, or in a temporary folder for a map in memory; existing poses are reused.
    Anything else is yielded unchanged.
    """
    if not isinstance(data, str | Path) or not lacks_poses(data):
        yield data, camera
        return
    from bidnerf_core.structure import find_poses

    with (
        tempfile.TemporaryDirectory()
        if out is None
        else contextlib.nullcontext(str(poses_folder(out))) as folder
    ):
        found = find_poses(data, folder, camera, overwrite, progress, cancel, reuse=True)
        if split == "train":
            held = len(range(0, found.placed, HOLD_OUT_EVERY))
            log.info(
                f"{folder}: {amount(held, 'photo')} of {found.placed} are held out to test the map; split 'all' trains on all"
            )
        yield folder, None
