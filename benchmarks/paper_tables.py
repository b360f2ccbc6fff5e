"""The tables of BID-NeRF (Csehi and Jozsa 2023) and the protocol of iNeRF, on given maps, with the paper's settings.

    python benchmarks/paper_tables.py DATA --map MAP [--map MAP ...] --out FOLDER [--part table1 depth_weight table2 inerf]

- ``table1``: fine or coarse x RGB or RGB-D, one image, e_t 0.5, 0.8 and 1.2 together;
- ``depth_weight``: the cells of ``table1`` that have depth, with a tenth of its weight;
- ``table2``: 1 image, 8 images 15 degrees apart, 8 and wide sampling, at e_t 0.9, 1.7 and 3.4;
- ``inerf``: ``bid`` and ``inerf`` from iNeRF's starts.

All cells of a part share the frames, the starts, the numbers of rays and steps, and all settings but those compared. The
settings are those of ``--preset``: ``paper``, with updates in the camera's frame as in the paper's Alg. 1, or ``paper-scene``,
with ours. In ``table1``, the frames of cells without depth have none, so that nothing can use it: ``bid`` then turns about the
middle of the map instead of the middle of the measured points. Frames whose index in the test split is 1 modulo 5 are left
out, since settings were tuned on them.

Each part and map has a file of results in FOLDER, which survives a kill at any moment: the same command resumes where it
stopped. When a part is complete, its record is written next to it; ``bidnerf report FOLDER/table1_*.jsonl`` draws it.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import _lab
from scipy.stats import fisher_exact, mannwhitneyu

from bidnerf.cli import displayed
from bidnerf.evaluation import (
    NEVER,
    Group,
    Plan,
    ResultsFile,
    Trial,
    changed_settings,
    grouped,
    median,
    opened,
    planned,
    run_trials,
    steps_of,
    summarize,
)
from bidnerf_core.errors import Cancelled
from bidnerf_core.localization import METHODS
from bidnerf_core.progress import job_context

Settings = dict[str, Any]
Common = Callable[[str], Settings]
"""A function from a method's name to the settings that all cells share."""
Scene = tuple[str, str]
"""The folder of a map, and that of its dataset."""

PAPER = {
    "table1": {"RGB-D fine": 87.5, "RGB-D coarse": 95.83, "RGB fine": 25.0, "RGB coarse": 75.0},
    "table2": {
        "1 image": {"0.9": 87.5, "1.7": 50.0, "3.4": 0.0},
        "8 images": {"0.9": 87.5, "1.7": 87.5, "3.4": 25.0},
        "8 images, wide": {"0.9": 87.5, "1.7": 75.0, "3.4": 25.0},
    },
    "inerf": {"bid": 95.0, "inerf, translation": 38.0, "inerf, rotation": 42.0},
}
"""Percentages as printed in the paper."""


def table1(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[Plan]:
    """Return the cells of table 1; ``trials`` is the number over all three sizes."""
    each = -(-(trials or 24) // 3)
    plan = replace(base, protocol="bid", sizes=(0.5, 0.8, 1.2), trials=each)
    return [
        replace(plan, depth=depth, config=_json(common("bid") | {"level": level}))
        for level in (0, None)
        for depth in (True, False)
    ]


def depth_weight(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[Plan]:
    """Return the cells of ``table1`` that have depth, from the same starts, with a tenth of its weight."""
    return [
        replace(plan, config=_json(json.loads(plan.config) | {"depth_weight": 0.1}))
        for plan in table1(base, common, trials, scene)
        if plan.depth
    ]


def table2(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[Plan]:
    """Return the cells of table 2."""
    plan = replace(base, protocol="bid", sizes=(0.9, 1.7, 3.4), trials=trials or 16)
    ending = sequence_ends(plan, scene)  # one image is the last of the eight: the same frames for all
    return [
        replace(plan, config=_json(common("bid")), frames=ending),
        replace(plan, config=_json(common("bid")), images=8),
        replace(plan, config=_json(common("bid") | {"wide": 2.0}), images=8),
    ]


def inerf(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[Plan]:
    """Return ``bid`` and ``inerf`` from the starts of iNeRF, both with its learning rate, as in the paper."""
    plan = replace(base, protocol="inerf", trials=trials or 25)
    return [
        replace(plan, method=method, config=_json(common(method) | {"learning_rate": 0.01}))
        for method in ("bid", "inerf")
    ]


PARTS: dict[str, Callable[[Plan, Common, int | None, Scene], list[Plan]]] = {
    "table1": table1,
    "depth_weight": depth_weight,
    "table2": table2,
    "inerf": inerf,
}


def preset_settings(preset: str, others: Settings, method: str) -> Settings:
    """Return the settings of a preset that differ from the method's defaults, and ``others``; iNeRF has one preset only."""
    offered = METHODS[method]
    chosen = offered.settings(preset if preset in offered.presets else "paper")
    return json.loads(changed_settings(method, chosen)) | others


def test_frames(map_folder: str, data: str, tuning: bool) -> tuple[str, ...]:
    """Return the test frames on which settings are tuned, or all others."""
    _, dataset = opened(map_folder, data)
    return tuple(_lab.held_out(dataset.frame_names("test"), tuning))


def trials_of(plan: Plan, scene: Scene) -> list[Trial]:
    """Return the trials of a plan."""
    return planned(plan, *scene, opened(*scene, plan)[1])


def sequence_ends(plan: Plan, scene: Scene) -> tuple[str, ...]:
    """Return the frames with which a sequence of eight can end."""
    every = trials_of(replace(plan, images=8, trials=10_000, sizes=(0.9,)), scene)
    return tuple(dict.fromkeys(trial.frame for trial in every))


def run_part(trials: Sequence[Trial], path: Path, workers: int, minutes: float | None = None) -> list[Group]:
    """Run the missing trials and return the groups of all results; after ``minutes``, of those available by then.

    Raises ``SystemExit`` if it is stopped, or if nothing was done in time.
    """
    began = time.monotonic()

    def late() -> bool:
        return minutes is not None and time.monotonic() - began > 60 * minutes

    with ResultsFile(path) as file:
        with displayed(), suppress(Cancelled, KeyboardInterrupt), job_context(cancel=late):
            run_trials(trials, file, workers=workers)
        done = [trial for trial in trials if trial in file]
        if not done or (len(done) < len(trials) and minutes is None):
            raise SystemExit(f"stopped; {path} is kept, the same command goes on")
        file.put_in_order(trials)
        return grouped([file[trial] for trial in done])


@dataclass(frozen=True)
class PairTest:
    """Tests of whether two groups of trials in the same situation differ, by one criterion. All p values are two-sided."""

    first: str
    second: str
    trials: tuple[int, int]
    successes: tuple[int, int]
    rates_p: float  # of equal success rates, Fisher's exact test
    median_steps: tuple[float | None, float | None]
    steps_u: float | None  # Mann-Whitney U of the first group, over the trials that succeeded
    steps_p: float | None  # of equal steps to success
    all_p: float  # of equal speed over all trials, where a failure is slower than any success


def pairwise_tests(groups: Sequence[Group], criterion: str) -> list[PairTest]:
    """Return the tests of every pair of groups that share a situation and to which the criterion applies."""
    fitting = [group for group in groups if summarize(group.results).success[criterion] is not None]
    pairs = itertools.combinations(fitting, 2)
    return [compare_pair(a, b, criterion) for a, b in pairs if a.situation == b.situation]


def compare_pair(first: Group, second: Group, criterion: str) -> PairTest:
    """Test whether two groups differ in success rate or in steps to success, by one criterion."""
    a, b = (steps_of(group.results, criterion) for group in (first, second))
    good_a, good_b = ([s for s in row if s < NEVER] for row in (a, b))
    test = mannwhitneyu(good_a, good_b, alternative="two-sided") if good_a and good_b else None
    # Over all trials, failures tie, behind every success; if all trials tie, nothing differs.
    last = 1 + max(good_a + good_b, default=0)
    ranks = [[min(s, last) for s in row] for row in (a, b)]
    all_p = 1.0
    if len({*ranks[0], *ranks[1]}) > 1:
        all_p = float(mannwhitneyu(*ranks, alternative="two-sided", method="asymptotic").pvalue)
    return PairTest(
        first=first.label,
        second=second.label,
        trials=(len(a), len(b)),
        successes=(len(good_a), len(good_b)),
        rates_p=float(fisher_exact([[len(good_a), len(a) - len(good_a)], [len(good_b), len(b) - len(good_b)]]).pvalue),
        median_steps=(median(good_a), median(good_b)),
        steps_u=None if test is None else float(test.statistic),
        steps_p=None if test is None else float(test.pvalue),
        all_p=all_p,
    )


def as_record(groups: Sequence[Group]) -> dict[str, Any]:
    """Return rates by each criterion, costs, and p values of each pair, for each size and over all sizes."""
    cells = [
        {
            "map": group.situation.map,
            "start": group.situation.start,
            "condition": group.label,
            **asdict(summarize(group.results)),
        }
        for group in groups
    ]
    pairs = [asdict(pair) | {"criterion": c} for c in ("10%", "5deg 0.05") for pair in pairwise_tests(groups, c)]
    return {"cells": cells, "settings": [g.results[0].settings for g in groups], "pairs": pairs}


def main() -> None:
    parser = _lab.parser(__doc__, named=False)
    parser.add_argument("data")
    parser.add_argument("--map", action="append", required=True, help="a folder; may be given again")
    parser.add_argument("--out", type=Path, default=_lab.RESULTS)
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--preset", choices=list(METHODS["bid"].presets), default="paper")
    parser.add_argument("--rays", type=int, default=2048)
    parser.add_argument("--steps", type=int, help="default: the preset's, 1000")
    parser.add_argument("--config", default="{}", help="JSON of other settings, for all cells")
    parser.add_argument("--trials", type=int, help="a cell; default 24, 16 of each size, 25")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--stop-after", type=float, help="minutes a part; what is done then is recorded")
    given = parser.parse_args()
    own: Settings = {"rays": given.rays} | ({} if given.steps is None else {"max_steps": given.steps})
    common = partial(preset_settings, given.preset, own | json.loads(given.config))
    for part in given.part:
        for folder in given.map:
            scene = folder, given.data
            base = Plan(method="bid", seed=given.seed, device=given.device, frames=test_frames(*scene, tuning=False))
            plans = PARTS[part](base, common, given.trials, scene)
            trials = [trial for plan in plans for trial in trials_of(plan, scene)]
            name = f"{part}_{trials[0].portable.map.replace(':', '_')}"
            groups = run_part(trials, given.out / f"{name}.jsonl", given.workers, given.stop_after)
            results = {"paper_percent": PAPER.get(part), "preset": given.preset, **as_record(groups)}
            _lab.record(name, results, given.seed, given.out)


def _json(settings: Settings) -> str:
    return json.dumps(settings, sort_keys=True)


if __name__ == "__main__":
    main()
