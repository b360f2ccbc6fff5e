"""Maps exported for other software, imported again, and localized in beside the map that they come from.

    python benchmarks/round_trips.py MAP:DATA [MAP:DATA ...] --folder WORK [--ways map cloud splat ...]

The surface of each map is exported as a point cloud (``bidnerf export --to ply``), as a mesh (``--to mesh.glb``) and as Gaussians
(``--to splat.ply``, ``splat.spz``), and imported again (plugins ``bidnerf-scan``, ``bidnerf-gaussians``) with landmarks from the training photos (``--photos``), or with landmarks
from images that the imported field renders. Method ``auto`` localizes the test frames without a start in all of them in turn, from RGB and from
RGB-D. Answers are kept in a ``.rows.jsonl`` next to the record, and exports and maps in WORK, so that an interrupted run resumes
where it stopped.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _lab import (
    RESULTS,
    Row,
    RowStore,
    Scene,
    answer,
    cpu_seconds,
    in_turn,
    judgement,
    line,
    modes,
    one_thread,
    parser,
    rates,
    record,
)

from bidnerf import ImportOptions, Localizer, Map, export_map, import_map, load_map
from bidnerf.results import read_pose
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View

OWN = "map"
"""The map that the others come from."""


@dataclass(frozen=True)
class Way:
    """A way out of a map and into another one."""

    to: str  # format of the export
    file: str  # that is imported
    has_photos: bool = True  # whether its landmarks come from photos


WAYS = {
    "cloud": Way("ply", "surface.ply"),
    "mesh": Way("mesh.glb", "mesh.glb"),
    "splat": Way("splat.ply", "splat.ply"),
    "splat, compressed": Way("splat.spz", "splat.spz"),
    "cloud, no photos": Way("ply", "surface.ply", has_photos=False),
    "mesh, no photos": Way("mesh.glb", "mesh.glb", has_photos=False),
    "splat, no photos": Way("splat.ply", "splat.ply", has_photos=False),
}


def returned(scene: Scene, name: str, folder: Path) -> Map:
    """Return the map that came back, which is exported and imported unless it is there."""
    if name == OWN:
        return scene.map
    way, place = WAYS[name], folder / f"{scene.name}-{name.replace(', ', '-').replace(' ', '-')}"
    try:
        found = load_map(place)
        if found.surface is None or found.landmarks is None:
            raise InputError("not finished")
        return found
    except InputError:
        written = folder / f"{scene.name}-{way.to}"
        export_map(scene.map, written, way.to, overwrite=True)
        pose = written / "T_world_file.json"  # where the export was turned
        return import_map(
            written / way.file,
            place,
            config={"background": scene.map.bounds.background},
            photos=scene.data if way.has_photos else None,
            options=ImportOptions(T_world_file=read_pose(pose) if pose.exists() else None, overwrite=True),
        )


def once(make: Callable[[], Map]) -> Callable[[], Localizer]:
    """Return a function that makes the localizer when it is first called."""
    kept: list[Localizer] = []

    def get() -> Localizer:
        if not kept:
            kept.append(Localizer(make()))
        return kept[0]

    return get


def scene_rows(scene: Scene, given: argparse.Namespace, store: RowStore) -> dict[str, dict[str, list[Row]]]:
    """Return the answers by the kind of input and the way that their map took."""
    ways = [OWN, *(name for name in given.ways if name != OWN)]
    localizers = {name: once(lambda name=name: returned(scene, name, given.folder)) for name in ways}

    def found_in(name: str, view: View) -> Row:
        localizer = localizers[name]()  # made before the time is taken
        return answer(lambda: localizer(view.frame), view)

    found: dict[str, dict[str, list[Row]]] = {}
    for mode, views in modes(scene.views(given.tuning_frames, given.frames)).items():
        rows: dict[str, list[Row]] = {name: [] for name in ways}
        for place, view in enumerate(views):
            for name in in_turn(ways, place):
                key = [*scene.key, mode, name, view.frame.name]
                rows[name].append(store.get(key, lambda view=view, name=name: found_in(name, view)))
        for name in ways:
            print(line(f"{scene.name} {mode} {name}", rows[name]), flush=True)
        found[mode] = rows
    return found


def summary(rows: list[Row]) -> dict[str, Any]:
    return {"n": len(rows), **rates(rows), **judgement(rows), **cpu_seconds(rows)}


def main() -> None:
    arguments = parser(__doc__, "round_trips", scenes=True)
    arguments.add_argument("--folder", type=Path, required=True, help="for the exports and the maps")
    arguments.add_argument("--ways", nargs="+", choices=[OWN, *WAYS], default=list(WAYS), metavar="WAY")
    given = arguments.parse_args()
    one_thread()
    results = {}
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        for pair in given.scenes:
            scene = Scene.open(pair)
            found = scene_rows(scene, given, store)
            results[scene.name] = {
                mode: {name: summary(rows) for name, rows in ways.items()} for mode, ways in found.items()
            }
    record(given.name, {"scenes": results})


if __name__ == "__main__":
    main()
