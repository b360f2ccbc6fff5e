"""``bidnerf poses``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import Flag, option, parse
from bidnerf_core.cli.output import print_json
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.io import to_plain
from bidnerf_core.structure import find_poses


def run(arguments: list[str]) -> None:
    parse("poses", poses, arguments)


def poses(
    photos: Annotated[
        Path, tyro.conf.Positional, option("PHOTOS", "folder of photos, or a video, without poses")
    ],
    out: Annotated[Path, option("DATASET", "folder for the dataset")],
    camera: Annotated[
        Path | None,
        option(
            "CAMERA.json",
            "file with the intrinsics of all photos, which are then kept fixed",
            "estimated, starting from EXIF",
        ),
    ] = None,
    overwrite: Annotated[Flag, option(None, "replace the poses in --out", "")] = False,
    json: Annotated[Flag, option(None, "print what was found as a JSON object", "")] = False,
) -> None:
    """Find the poses of photos by structure from motion, and write them as a dataset.

    The dataset refers to the photos in place; its poses.json lists those that were left out, and why. The
    unit of length is arbitrary. Ctrl-C stops, and the same command resumes. 'bidnerf train PHOTOS' performs
    this step first.
    """
    check_folder(out, (photos,))
    stopping = "stopping (Ctrl-C again: at once); what was found is kept"
    with stopped_by_ctrl_c(stopping) as cancel, Display() as progress:
        found = find_poses(photos, out, camera, overwrite, progress, cancel)
    if json:
        print_json(to_plain(found))
