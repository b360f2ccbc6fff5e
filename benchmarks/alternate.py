r"""Compare this code with another checkout: two processes answer the same questions in turn, each on one thread.

    BIDNERF_DATA=FOLDER BIDNERF_MAPS=FOLDER python benchmarks/alternate.py CHECKOUT track [SCENE ...] --name alternate_tracking
    BIDNERF_DATA=FOLDER BIDNERF_MAPS=FOLDER python benchmarks/alternate.py CHECKOUT localize [SCENE ...] --name alternate_queries

The maps are those that ``answer_maps.py`` has trained. ``track`` shows each frame of a sequence to a tracker of either code, with
depth and without. ``localize`` asks for test frames of each scene, with depth and without, and for frames of the scenes after
it in the list, which should be refused. Who answers first changes with each question, so that a machine whose speed varies favours neither.
Times are CPU times. The record has, of the old and the new code, times, errors and verdicts, and the ratios of the times.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from _lab import (
    RIGHT,
    STRICT,
    Row,
    folder_of,
    held_out,
    in_turn,
    judgement,
    map_folder,
    parser,
    record,
    times_slower,
    within,
)
from tracking import SEQUENCES

from bidnerf_core.datasets import open_dataset

HERE = Path(__file__).resolve().parents[1]
SCENES = ("phone_doll", "tum_fr1_xyz", "room_living", "blender_lego", "iphone_corridor", "blender_mic")
FOREIGN = 2
"""Number of other scenes whose frames are shown."""
Pair = dict[str, Row]
"""The answers of both codes to one question."""


class Respondents:
    """The processes of both codes."""

    def __init__(self, checkouts: dict[str, Path]) -> None:
        self._turn, self._metadata = 0, TemporaryDirectory()
        self._processes = {name: _start(folder, Path(self._metadata.name, name)) for name, folder in checkouts.items()}

    def __enter__(self) -> Respondents:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()
        self._metadata.cleanup()

    def __call__(self, question: str, **arguments: Any) -> Pair:
        """Return the answers to one question by the name of the code."""
        found: Pair = {}
        for name in in_turn(list(self._processes), self._turn):
            process = self._processes[name]
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps({"question": question} | arguments) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
            if not line:
                raise SystemExit(f"the process of the {name} code ended at {question} {arguments}")
            found[name] = json.loads(line)
        self._turn += 1
        return found


def _start(checkout: Path, metadata: Path) -> subprocess.Popen[str]:
    """Start the process of a checkout, whose entry points are read from its pyproject.toml, since another one may be installed."""
    project = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]
    folder = metadata / f"{project['name']}-0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 0\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {target}" for name, target in points.items())]
    (folder / "entry_points.txt").write_text("\n".join(lines) + "\n")
    plugins = sorted((checkout / "plugins").glob("*/"))
    parts = [metadata, checkout, checkout / "backends", checkout / "benchmarks", *plugins]
    path = os.pathsep.join(map(str, parts))
    # Without -P, the folder of this script, with the modules of the new code, would come first.
    command = [sys.executable, "-P", str(HERE / "benchmarks" / "_questions.py")]
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def track(ask: Respondents, scene: str, first: int | None) -> Iterator[tuple[str, list[Pair]]]:
    """Yield the answers to the frames of a sequence in order of time."""
    data = str(folder_of("BIDNERF_DATA") / scene)
    for mode, depth in (("RGB-D", True), ("RGB", False)):
        begun = ask("begin", data=data, first=first)["new"]
        shown = [n for n, colour in enumerate(begun["with colour"]) if depth or colour]
        yield mode, [ask("track", number=number, depth=depth) for number in shown]


def localize(ask: Respondents, scene: str, count: int | None) -> Iterator[tuple[str, list[Pair]]]:
    """Yield the answers to test frames of a scene and of others."""
    place, data = SCENES.index(scene), folder_of("BIDNERF_DATA")
    others = [SCENES[(place + step) % len(SCENES)] for step in range(1, FOREIGN + 1)]
    names = {name: held_out(open_dataset(data / name).frame_names("test"), count=count) for name in (scene, *others)}
    ask("localize", data=str(data / scene), name=names[scene][0], depth=True)  # the first one starts lazily
    for mode, depth in (("RGB", False), ("RGB-D", True)):
        for kind, shown in (("", [scene]), (", other scenes", others)):
            pairs = [
                ask("localize", data=str(data / name), name=frame, depth=depth)
                for name in shown
                for frame in names[name][: count if name == scene else -(-(count or 8) // FOREIGN)]
            ]
            pairs = [pair for pair in pairs if "converged" in pair["new"]]
            if not pairs:
                break  # the scene was recorded without depth
            yield mode + kind, pairs


def summary(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return times, errors and verdicts of both codes, and the ratios of the times: that of the sums and the median one."""
    rows = {name: [pair[name] for pair in pairs] for name in ("old", "new")}
    ratio = sum(r["cpu_seconds"] for r in rows["new"]) / sum(r["cpu_seconds"] for r in rows["old"])
    found: dict[str, Any] = {
        "n": len(pairs),
        "cpu_ratio": ratio,
        "median_cpu_ratio": times_slower(rows["new"], rows["old"]),
    }
    for name, answers in rows.items():
        times = [row["cpu_seconds"] for row in answers]
        found[name] = {
            "accepted": sum(row["converged"] for row in answers),
            "mean_cpu_seconds": statistics.mean(times),
            "slowest_cpu_seconds": max(times),
        }
        known = [row for row in answers if row["translation"] is not None]
        if known:
            accepted = [row for row in known if row["converged"]]
            found[name] |= judgement(known) | {
                "right": sum(within(row, RIGHT) for row in known),
                "strict": sum(within(row, STRICT) for row in known),
                "median_translation": statistics.median(row["translation"] for row in accepted or known),
                "median_rotation_deg": statistics.median(row["rotation_deg"] for row in accepted or known),
            }
    return found


def overall(cells: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the mean ratio of all cells, the largest, how a refusal compares with an accepted answer, and the slowest answer."""
    own = {name: cell for name, cell in cells.items() if not name.endswith("other scenes")}
    ratios = {name: cell["cpu_ratio"] for name, cell in own.items()}
    found: dict[str, Any] = {
        "mean_cpu_ratio": statistics.mean(ratios.values()),
        "largest_cpu_ratio": max(ratios.values()),
        "slowest_cpu_seconds": max(cell["new"]["slowest_cpu_seconds"] for cell in cells.values()),
    }
    refusals = [
        cell["new"]["mean_cpu_seconds"] / cells[name.removesuffix(", other scenes")]["new"]["mean_cpu_seconds"]
        for name, cell in cells.items()
        if name not in own
    ]
    return found | ({"refusal_to_answer": statistics.mean(refusals)} if refusals else {})


TASKS: dict[str, tuple[Sequence[str], Callable[[Respondents, str, int | None], Iterator[tuple[str, list[Pair]]]]]] = {
    "track": (SEQUENCES, track),
    "localize": (SCENES, localize),
}


def main() -> None:
    arguments = parser(__doc__, "alternate")
    arguments.add_argument("checkout", type=Path, help="folder with the other code")
    arguments.add_argument("task", choices=list(TASKS))
    arguments.add_argument("scenes", nargs="*", metavar="SCENE", help="default: all")
    arguments.add_argument(
        "--count", type=int, help="frames of each scene: the first of a sequence, or evenly spaced ones"
    )
    given = arguments.parse_args()
    scenes, pairs_of = TASKS[given.task]
    cells: dict[str, dict[str, Any]] = {}
    commit = subprocess.run(
        ["git", "-C", str(given.checkout), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    for scene in given.scenes or scenes:
        with Respondents({"old": given.checkout.resolve(), "new": HERE}) as ask:
            ask("open", map=str(map_folder(scene)), data=str(folder_of("BIDNERF_DATA") / scene))
            for kind, pairs in pairs_of(ask, scene, given.count):
                cells[f"{scene}, {kind}"] = cell = summary(pairs)
                print(_line(f"{scene}, {kind}", cell), flush=True)
        # What is done is on record if a later scene is interrupted.
        record(given.name, {"old_commit": commit.stdout.strip(), "overall": overall(cells), "cells": cells})
    print(json.dumps(overall(cells)))


def _line(name: str, cell: dict[str, Any]) -> str:
    parts = [f"{name}: n {cell['n']}, CPU time {cell['cpu_ratio']:.2f} of the old"]
    for code in ("old", "new"):
        c = cell[code]
        known = (
            ""
            if "right" not in c
            else (
                f", right {c['right']}, strict {c['strict']}, wrong {c['silent']}, median {c['median_translation']:.4f} m"
                f" {c['median_rotation_deg']:.2f} deg, inside {c['inside_95_of_converged']}"
            )
        )
        parts.append(
            f"{code}: accepted {c['accepted']}{known}, mean {1000 * c['mean_cpu_seconds']:.0f} ms,"
            f" slowest {1000 * c['slowest_cpu_seconds']:.0f} ms"
        )
    return "\n  ".join(parts)


if __name__ == "__main__":
    main()
