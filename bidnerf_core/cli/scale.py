"""``bidnerf scale``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import MapFolder, option, parse
from bidnerf_core.cli.output import say, show
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.maps.anchor import load_anchor, save_anchor, scaled_anchor
from bidnerf_core.maps.map import load_map
from bidnerf_core.maps.scaling import factor_of_distance, factor_of_poses
from bidnerf_core.results.pose_files import read_poses

one_way = tyro.conf.create_mutex_group(required=True, title="how long a unit is (one of them)")


def run(arguments: list[str]) -> None:
    parse("scale", scale, arguments)


def scale(
    map: MapFolder,
    distance: Annotated[
        tuple[str, str, str] | None,
        one_way,
        option(
            "A B METRES",
            "the true distance of two places: names of cameras, NAME@U,V for what a camera shows at a pixel, or X,Y,Z",
            "",
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        one_way,
        option(
            "JSON", "true positions of cameras of the map in metres, as --out POSES.json writes poses", ""
        ),
    ] = None,
    factor: Annotated[
        float | None,
        one_way,
        option("F", "metres in a unit of the map; 1 says that its unit is the metre", ""),
    ] = None,
    out: Annotated[Path | None, option("MAP2", "leave the map as it is and write another one", "")] = None,
) -> None:
    """Change the unit of a map to metres: of its field, bounds, surface, landmarks, record and anchor.

    Poses, covariances and errors are in metres from then on, and depth of sensors fits.
    """
    if out is not None:
        check_folder(out, (map,))
    scene = load_map(map)
    if factor is not None:
        found = factor
    elif poses is not None:
        fit = factor_of_poses(scene, read_poses(poses))
        say(f"{poses}: {fit}")
        found = fit.factor
    elif distance is not None:
        first, second, length = distance
        found = factor_of_distance(scene, first, second, _metres(length))
    else:
        raise UsageError("expected one of --distance, --poses and --factor")
    if not found > 0:
        raise InputError(f"the factor is {found:g}, expected a positive number")
    anchor = load_anchor(map)
    stored = scene.scaled(found).save(out or map, overwrite=out is None)
    if anchor is not None:
        save_anchor(out or map, scaled_anchor(anchor, found))
    sides = " x ".join(f"{side:.3g}" for side in stored.bounds.size)
    show(
        f"{stored.folder}: all lengths multiplied by {found:.6g}; in metres now, the scene is a box of {sides}"
    )


def _metres(word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise UsageError(f"--distance: METRES is {word!r}, expected a number") from error
