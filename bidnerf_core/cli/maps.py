"""``bidnerf info``, ``export`` and ``scale``: what is done with a map alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.options import Json, MapFolder, require_one
from bidnerf_core.cli.output import check_folder, check_output, print_json, say, show
from bidnerf_core.cli.parser import Flag, Option
from bidnerf_core.errors import InputError, UsageError


def info(
    map: MapFolder,
    json: Json = False,
    draw: Annotated[
        Path | None, Option("PNG", "file for a picture of the capture from above", "no picture")
    ] = None,
) -> None:
    """Describe a map and the photos it was built from. The whole map is loaded, so that damage is detected."""
    from bidnerf_core.maps import load_map
    from bidnerf_core.results import draw_capture

    if draw is not None:
        if draw.suffix.lower() != ".png":
            raise InputError(where=draw, expected="the name of a PNG file")
        check_output(draw, ())
    scene = load_map(map)
    summary = scene.describe()
    if draw is not None:
        if scene.capture is None:
            raise InputError(
                "has no record of its photos to draw; 'bidnerf bake MAP --data DATA' creates one", where=map
            )
        seen_by = None if scene.landmarks is None else scene.landmarks.views
        points = None if scene.landmarks is None else scene.landmarks.positions
        draw_capture(scene.capture, points, seen_by, draw, scene.unit)
        say(f"{draw}: written")
    if json:
        print_json(summary.plain())
        return
    for line in str(summary).splitlines():
        show(line)


def export(
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


def scale(
    map: MapFolder,
    distance: Annotated[
        tuple[str, str, str] | None,
        Option(
            "A B METRES",
            "true distance between two places: camera names, NAME@U,V for what a camera shows at a pixel, or X,Y,Z",
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        Option(
            "JSON",
            "file with the true positions of three or more of the map's cameras in metres, in any world:"
            " {NAME: [x, y, z], ...}, or poses as localize --out POSES.json writes them",
        ),
    ] = None,
    factor: Annotated[
        float | None, Option("F", "metres per unit of the map; 1 states that its unit is the metre")
    ] = None,
    out: Annotated[Path | None, Option("MAP2", "leave the map unchanged and write a new one")] = None,
) -> None:
    """Convert a map to metres: its field, bounds, surface, landmarks, capture record and anchor.

    Poses, covariances and errors are then in metres, and the depth of sensors fits. One of --distance, --poses and --factor
    gives the length of a unit.
    """
    from bidnerf_core.maps import factor_of_distance, factor_of_poses, load_info, load_map, map_folder
    from bidnerf_core.results import read_positions

    require_one({"--distance": distance, "--poses": poses, "--factor": factor}, required=True)
    first, second, length = distance or ("", "", "1")
    try:
        metres = float(length)
    except ValueError as error:
        raise UsageError(f"METRES is {length!r}", where="--distance", expected="a number") from error
    if out is not None:
        check_folder(out, (map,))
    load_info(map)  # raises if there is no map
    # The map is locked before it is read, so that nobody changes it meanwhile.
    with map_folder(out or map, overwrite=out is None):
        scene = load_map(map)
        if poses is not None:
            fit = factor_of_poses(scene, read_positions(poses))
            say(f"{poses}: {fit}")
            factor = fit.factor
        elif distance is not None:
            factor = factor_of_distance(scene, first, second, metres)
        assert factor is not None
        stored = scene.scaled(factor).stored_in(out or map)
    sides = " x ".join(f"{side:.3g}" for side in stored.bounds.size)
    show(
        f"{out or map}: all lengths multiplied by {factor:.6g}; the scene is now in metres, in a box of {sides}"
    )
