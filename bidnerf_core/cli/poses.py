"""``bidnerf poses``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.options import Json
from bidnerf_core.cli.output import check_folder, print_json
from bidnerf_core.cli.parser import Flag, Option
from bidnerf_core.cli.progress import working


def run(
    photos: Annotated[Path, Option("PHOTOS", "folder of photos, or a video, without poses", positional=True)],
    out: Annotated[Path, Option("DATASET", "folder for the dataset")],
    camera: Annotated[
        Path | None,
        Option(
            "CAMERA.json",
            "file with the intrinsics of all photos, which are then kept fixed",
            "estimated, starting from EXIF",
        ),
    ] = None,
    overwrite: Annotated[Flag, Option(None, "replace the poses in --out")] = False,
    json: Json = False,
) -> None:
    """Find the poses of photos by structure from motion, and write them as a dataset.

    The dataset refers to the photos in place; its poses.json lists those that were left out, and why. The unit of length is
    arbitrary. Ctrl-C stops, and the same command resumes. 'bidnerf train PHOTOS' performs this step first.
    """
    from bidnerf_core.io import to_plain
    from bidnerf_core.structure import find_poses

    check_folder(out, (photos,))
    with working("stopping (Ctrl-C again: at once); what was found is kept"):
        found = find_poses(photos, out, camera, overwrite)
    if json:
        print_json(to_plain(found))
