r"""Quick maps: how long ``train --quick`` takes, and what its maps answer, beside the maps of ``answers``.

    BIDNERF_DATA=FOLDER python benchmarks/quick_maps.py SCENE [SCENE ...] --out DIR [--name quick_maps]

SCENE is the name of a dataset in the folder ``BIDNERF_DATA``. Each map is trained with the default backend's quick settings on
one thread, into a folder of DIR, and then localizes, without a start, the images of the record ``answers`` under the condition
"as it is", with depth and without. The answers of the record are those of the map with 1500 steps of the default settings.
Times are CPU times, which other work on the machine hardly changes: a machine with two cores takes little more than half of
them. A map that is already in DIR is used as it is, with the times stored beside it.
"""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import _lab
from _lab import RESULTS, Row
from answer_maps import folder_of
from answers import answers_of, read_rows, summary

import bidnerf as bn
from bidnerf_core.progress import Progress

CONDITION = "as it is"
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


def train_quick(data: Path, folder: Path) -> Row:
    """Train a quick map, unless it is there, and return its times."""
    stored = folder.with_name(f"{folder.name}.json")
    if not stored.exists():
        stages = StageTimes()
        scene = bn.train(data, out=folder, config="quick", options=bn.TrainOptions(overwrite=True), progress=stages)
        stages.end()
        times = {"cpu_minutes": sum(stages.seconds.values()) / 60, "photos": len(scene.info.cameras)}
        stored.write_text(json.dumps(times | {"steps": scene.info.step, "cpu_seconds_of_stages": stages.seconds}))
    found: Row = json.loads(stored.read_text())
    return found


def main() -> None:
    parser = _lab.parser(__doc__, "quick_maps")
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the maps")
    given = parser.parse_args()
    _lab.one_thread()
    known = answers_of(read_rows(RESULTS / "answers.rows.jsonl.xz"))
    result: dict[str, Any] = {}
    for name in given.scenes:
        data = folder_of("BIDNERF_DATA") / name
        about = train_quick(data, given.out / name)
        localizer, dataset = bn.Localizer(given.out / name), bn.open_dataset(data)
        result[name] = about | {"answers": {}}
        for mode in ("RGB", "RGB-D"):
            default = {key[3]: row for key, row in known.items() if key[:3] == (name, mode, CONDITION)}
            rows = []
            for view in dataset.views("test", list(default)) if default else []:
                view = view if mode == "RGB-D" else _lab.without_depth(view)
                rows.append(_lab.answer(partial(localizer, view.frame), view))
            if rows:
                both = {"quick": summary(rows), "default": summary(list(default.values()))}
                result[name]["answers"][mode] = {
                    which: {part: counts[part] for part in SHOWN} for which, counts in both.items()
                }
        print(name, json.dumps(result[name]), flush=True)
    _lab.record(given.name, result)


if __name__ == "__main__":
    main()
