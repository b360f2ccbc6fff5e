"""``bidnerf scale``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import MapFolder, require_one
from bidnerf_core.cli.output import say, show
from bidnerf_core.cli.parser import Option, parse
from bidnerf_core.errors import UsageError

if TYPE_CHECKING:
    from bidnerf_core.maps import Map


@dataclass(frozen=True)
class Scale:
    """Convert a map to metres: its field, bounds, surface, landmarks, capture record and anchor.

    Poses, covariances and errors are then in metres, and the depth of sensors fits. One of --distance, --poses and --factor
    gives the length of a unit.
    """

    map: MapFolder
    distance: Annotated[
        tuple[str, str, str] | None,
        Option(
            "A B METRES",
            "true distance between two places: camera names, NAME@U,V for what a camera shows at a pixel, or X,Y,Z",
        ),
    ] = None
    poses: Annotated[
        Path | None,
        Option(
            "JSON",
            "file with the true positions of three or more of the map's cameras in metres, in any world:"
            " {NAME: [x, y, z], ...}, or poses as localize --out POSES.json writes them",
        ),
    ] = None
    factor: Annotated[
        float | None, Option("F", "metres per unit of the map; 1 states that its unit is the metre")
    ] = None
    out: Annotated[Path | None, Option("MAP2", "leave the map unchanged and write a new one")] = None

    def __post_init__(self) -> None:
        given = {"--distance": self.distance, "--poses": self.poses, "--factor": self.factor}
        require_one(given, required=True)

    def run(self) -> None:
        from bidnerf_core.maps import load_info, load_map, map_folder

        if self.out is not None:
            check_folder(self.out, (self.map,))
        load_info(self.map)  # raises if there is no map
        place = self.out or self.map
        # Locked before it is read, so that nobody changes it meanwhile.
        with map_folder(place, overwrite=self.out is None):
            scene = load_map(self.map)
            factor = self._factor(scene)
            stored = scene.scaled(factor).stored_in(place)
        sides = " x ".join(f"{side:.3g}" for side in stored.bounds.size)
        show(
            f"{place}: all lengths multiplied by {factor:.6g}; the scene is now in metres, in a box of {sides}"
        )

    def _factor(self, scene: Map) -> float:
        from bidnerf_core.maps import factor_of_distance, factor_of_poses
        from bidnerf_core.results import read_positions

        if self.poses is not None:
            fit = factor_of_poses(scene, read_positions(self.poses))
            say(f"{self.poses}: {fit}")
            return fit.factor
        if self.distance is None:
            assert self.factor is not None
            return self.factor
        first, second, length = self.distance
        try:
            metres = float(length)
        except ValueError as error:
            raise UsageError(f"METRES is {length!r}", where="--distance", expected="a number") from error
        return factor_of_distance(scene, first, second, metres)


def run(arguments: list[str]) -> None:
    parse("scale", Scale, arguments).run()
