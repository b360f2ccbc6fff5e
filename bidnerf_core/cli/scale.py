"""``bidnerf scale``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import MapFolder, option, parse
from bidnerf_core.cli.output import say, show
from bidnerf_core.errors import UsageError
from bidnerf_core.maps import Map, factor_of_distance, factor_of_poses, load_info, load_map, map_folder
from bidnerf_core.results import read_positions

one_way = tyro.conf.create_mutex_group(required=True, title="length of a unit (one of them)")


def run(arguments: list[str]) -> None:
    parse("scale", scale, arguments)


def scale(
    map: MapFolder,
    distance: Annotated[
        tuple[str, str, str] | None,
        one_way,
        option(
            "A B METRES",
            "true distance between two places: camera names, NAME@U,V for what a camera shows at a pixel,"
            " or X,Y,Z",
            "",
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        one_way,
        option(
            "JSON",
            "file with the true positions of three or more of the map's cameras in metres, in any world:"
            " {NAME: [x, y, z], ...}, or poses as localize --out POSES.json writes them",
            "",
        ),
    ] = None,
    factor: Annotated[
        float | None,
        one_way,
        option("F", "metres per unit of the map; 1 states that its unit is the metre", ""),
    ] = None,
    out: Annotated[Path | None, option("MAP2", "leave the map unchanged and write a new one", "")] = None,
) -> None:
    """Convert a map to metres: its field, bounds, surface, landmarks, capture record and anchor.

    Poses, covariances and errors are then in metres, and the depth of sensors fits.
    """
    if out is not None:
        check_folder(out, (map,))
    load_info(map)  # raises if there is no map
    place = out or map
    with map_folder(
        place, overwrite=out is None
    ):  # locked before it is read, so that nobody changes it meanwhile
        scene = load_map(map)
        found = _factor(scene, distance, poses, factor)
        stored = scene.scaled(found).stored_in(place)
    sides = " x ".join(f"{side:.3g}" for side in stored.bounds.size)
    show(f"{place}: all lengths multiplied by {found:.6g}; the scene is now in metres, in a box of {sides}")


def _factor(
    scene: Map, distance: tuple[str, str, str] | None, poses: Path | None, factor: float | None
) -> float:
    if poses is not None:
        fit = factor_of_poses(scene, read_positions(poses))
        say(f"{poses}: {fit}")
        return fit.factor
    if distance is not None:
        first, second, length = distance
        return factor_of_distance(scene, first, second, _metres(length))
    if factor is None:
        raise UsageError(expected="one of --distance, --poses and --factor")
    return factor


def _metres(word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise UsageError(f"METRES is {word!r}", where="--distance", expected="a number") from error
