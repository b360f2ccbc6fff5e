r"""Quick maps: how long ``train --quick`` takes, and what its maps answer, beside maps of more steps.

    BIDNERF_DATA=FOLDER BIDNERF_MAPS=FOLDER python benchmarks/quick_maps.py SCENE [SCENE ...] [--default SCENE ...]

SCENE is the name of a dataset in the folder ``BIDNERF_DATA``. Each map is trained with the default backend's quick settings on
one thread. It and the map that ``answer_maps.py`` has trained with 1500 steps of the default settings then localize, without a start,
the images of the test split, with depth and without. The scenes of ``--default`` are also trained with all default settings, for the
time alone. Times are CPU times, which other work on the machine hardly changes: a machine with two cores takes little more than half of
them. Maps go into folders of ``--out``; one that is there is used as it is, with the times stored beside it.
"""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import _lab
from _lab import RESULTS, Row, Scene
from answers import summary

import bidnerf as bn
from bidnerf_core.progress import Progress

SHOWN = ("n", "right", "strict", "accepted", "silent")


class StageTimes:
    """The CPU time of each stage of a job: from its first report to that of the next."""

    def __init__(self) -> None:
        self.seconds, self._stage, self._began = dict[str, float](), "reading", time.process_time()

    def __call__(self, now: Progress) -> None:
        if now.stage != self._stage:
            self.end(now.stage)

    def end(self, following: str = "") -> None:
        now = time.process_time()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._began
        self._stage, self._began = following, now


def train_timed(data: Path, folder: Path, config: str | None) -> Row:
    """Train a map, unless it is there, and return its times."""
    stored = folder.with_name(f"{folder.name}.json")
    if not stored.exists():
        stages = StageTimes()
        scene = bn.train(data, out=folder, config=config, options=bn.TrainOptions(overwrite=True), progress=stages)
        stages.end()
        times = {"cpu_minutes": sum(stages.seconds.values()) / 60, "photos": len(scene.info.cameras)}
        stored.write_text(json.dumps(times | {"steps": scene.info.step, "cpu_seconds_of_stages": stages.seconds}))
    found: Row = json.loads(stored.read_text())
    return found


def main() -> None:
    parser = _lab.parser(__doc__, "quick_maps")
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--default", nargs="+", default=(), metavar="SCENE", help="trained with default settings, too")
    parser.add_argument("--out", type=Path, default=RESULTS.parent / "cache" / "quick_maps", metavar="DIR")
    given = parser.parse_args()
    _lab.one_thread()
    quick: dict[str, Any] = {}
    for name in given.scenes:
        scene, about = Scene.open(name), train_timed(_lab.data_folder(name), given.out / name, "quick")
        localizers = {"quick": bn.Localizer(given.out / name), "default": bn.Localizer(scene.map)}
        quick[name] = about | {"answers": {}}
        for mode, views in _lab.modes(scene.dataset.views("test")).items():
            rows = {
                which: summary([_lab.answer(partial(localizer, view.frame), view) for view in views])
                for which, localizer in localizers.items()
            }
            quick[name]["answers"][mode] = {which: {part: r[part] for part in SHOWN} for which, r in rows.items()}
        print(name, json.dumps(quick[name]), flush=True)
    default = {name: train_timed(_lab.data_folder(name), given.out / f"{name}-default", None) for name in given.default}
    _lab.record(given.name, {"quick": quick, "default": default})


if __name__ == "__main__":
    main()
