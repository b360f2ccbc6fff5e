"""Seeded poses of every method, to detect whether a change of the code changes an answer.

    python tests/localization/pinned_poses.py record before.json [--map MAP DATA]...
    (change the code)
    python tests/localization/pinned_poses.py record after.json [--map MAP DATA]...
    python tests/localization/pinned_poses.py compare before.json after.json

A closed-form scene is always recorded; each ``--map`` adds a stored map with a dataset of the same scene. The settings are for
short runs. Answers repeat to the last digit on one machine with one thread; other processors round differently.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from bidnerf_core import SE3, Localization, Localizer, View, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation import perturb
from bidnerf_core.localization import SceneMap, settings_of
from bidnerf_core.mapping import BakeConfig, bake
from bidnerf_core.scenes import closed_form_data, closed_form_map

SETTINGS: dict[str, dict[str, Any]] = {
    "auto": {},
    "bid": {"rays": 256, "max_steps": 40, "candidates": 1, "box_weight": 0.0},  # the paper's objective
    "inerf": {"rays": 256, "max_steps": 40},
    "bid-lm": {"poses": 8, "fine_rays": 256},
    "inerf-lm": {"poses": 16, "search_poses": 6, "middle_poses": 3, "fine_rays": 256, "width": 8},
}
SEED = 3
TOLERANCE = 1e-5
"""Largest difference of pose matrices and of losses that counts as equal."""


@dataclass(frozen=True, eq=False)
class PinnedMap:
    """A map and the images that are localized in it."""

    name: str
    map: SceneMap
    one: Sequence[View]
    rig: Sequence[View]


@dataclass(frozen=True, eq=False)
class Case:
    """One localization."""

    name: str  # map/views/channels/method/start
    map: SceneMap
    views: Sequence[View]
    method: str
    start: SE3 | None

    def run(self) -> Localization:
        config = settings_of(self.method, SETTINGS[self.method])
        localizer = Localizer(self.map, self.method, config, warm_up=False)
        return localizer(self.views, start=self.start, seed=SEED)


def blobs() -> PinnedMap:
    """Return the closed-form scene of coloured clouds, baked from its own images with depth."""
    stored, data = closed_form_map("demo:blobs"), closed_form_data("demo:blobs")
    names = data.frame_names("test")
    surface = bake(stored.field, stored.bounds, [], data.views("test", names[8:]), BakeConfig(cells=100_000))
    one, rig = data.views("test", [names[3]]), data.views("test", names[5:8])
    return PinnedMap("blobs", replace(stored, surface=surface), one, rig)


def stored_map(path: Path, data: Path, split: str = "test") -> PinnedMap:
    dataset = open_dataset(str(data))
    names = dataset.frame_names(split)
    one, rig = dataset.views(split, [names[3]]), dataset.views(split, names[5:8])
    return PinnedMap(path.name, load_map(path), one, rig)


def cases(pinned: PinnedMap) -> Iterator[Case]:
    """Yield every method on one view and on a rig, with depth and without, from a start and, where possible, from none."""
    for which, views in (("one", pinned.one), ("rig", pinned.rig)):
        bare = [replace(view, frame=replace(view.frame, depth=None)) for view in views]
        start = perturb(views[-1].T_ref_camera, 0.1, 5.0, 1)
        for channels, seen in (("rgbd", views), ("rgb", bare)):
            for method in SETTINGS:
                if method == "inerf" and which == "rig":
                    continue  # the method takes only one image
                name = f"{pinned.name}/{which}/{channels}/{method}"
                yield Case(f"{name}/start", pinned.map, seen, method, start)
                if method == "auto":
                    yield Case(f"{name}/none", pinned.map, seen, method, None)


def row(found: Localization) -> dict[str, Any]:
    """Return the values to compare."""
    return {
        "T": found.T_world_camera.matrix().tolist(),
        "loss": found.loss,
        "converged": found.converged,
        "steps": found.steps,
    }


def differences(expected: dict[str, Any], found: dict[str, Any], tolerance: float = TOLERANCE) -> list[str]:
    """Return the differences between two rows in words."""
    apart = (torch.tensor(expected["T"]) - torch.tensor(found["T"])).abs().max().item()
    loss = abs(expected["loss"] - found["loss"])
    words = [
        f"{what} off by {by:.1e}" for what, by in (("pose", apart), ("loss", loss)) if not by <= tolerance
    ]
    names = ("converged", "steps")
    return words + [f"{n} {expected[n]} -> {found[n]}" for n in names if expected[n] != found[n]]


def record(out: Path, maps: list[list[Path]]) -> None:
    rows = {}
    for pinned in (blobs(), *(stored_map(*pair) for pair in maps)):
        for case in cases(pinned):
            began = time.perf_counter()
            rows[case.name] = row(case.run())
            print(f"{case.name}: {time.perf_counter() - began:.1f} s", flush=True)
    out.write_text(json.dumps(rows, indent=1) + "\n")


def compare(one: Path, other: Path) -> int:
    """Print the differences, and return the number of cases that differ."""
    expected, found = (json.loads(path.read_text()) for path in (one, other))
    off = {name: differences(expected[name], found[name]) for name in expected if name in found}
    for name, words in off.items():
        print(f"{name}: {', '.join(words) or 'the same'}")
    print(f"{len(off)} compared, {sum(map(bool, off.values()))} differ")
    return sum(map(bool, off.values()))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record")
    recording.add_argument("out", type=Path)
    recording.add_argument("--map", type=Path, nargs=2, action="append", default=[], metavar=("MAP", "DATA"))
    comparing = commands.add_parser("compare")
    comparing.add_argument("one", type=Path)
    comparing.add_argument("other", type=Path)
    given = parser.parse_args()
    if given.command == "compare":
        return int(compare(given.one, given.other) > 0)
    torch.set_num_threads(1)
    record(given.out, given.map)
    return 0


if __name__ == "__main__":
    sys.exit(main())
