"""``bidnerf export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import MapFolder
from bidnerf_core.cli.output import show
from bidnerf_core.cli.parser import Flag, Option


def run(
    map: MapFolder,
    to: Annotated[
        str,
        Option(
            "FORMAT",
            "ply: surface, landmarks and cameras as point clouds and meshes; colmap: a text model of cameras and landmarks;"
            " transforms.json: cameras in nerfstudio's format, with landmarks as sparse points; or another one of"
            " 'bidnerf plugins exporters'",
        ),
    ],
    out: Annotated[Path, Option("DIR", "folder for the files")],
    overwrite: Annotated[Flag, Option(None, "write into a non-empty folder")] = False,
) -> None:
    """Export the surface, landmarks and cameras of a map for other software, in the map's frame and unit."""
    from bidnerf_core.results import export_map

    check_folder(out, (map,))
    for file in export_map(map, out, to, overwrite):
        show(f"{file}: {file.stat().st_size / 1e6:.2f} MB")
