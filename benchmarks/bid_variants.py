"""Variants of ``bid``, each tried on its own from the same starts, on the frames on which settings are tuned.

    python benchmarks/bid_variants.py DATA --map MAP --out FOLDER [--group schedule reach depth] [--variant NAME ...]
    python benchmarks/bid_variants.py SCENE [--group schedule reach depth] [--variant NAME ...]

- ``schedule``: what the paper leaves unspecified: learning rate, its decay, the frame of updates, the scale of the Huber loss;
- ``reach``: what may widen the basin of convergence from 0.9, 1.7 and 3.4 units;
- ``depth``: depth residuals in full detail, where a silhouette ray is off by the distance to what lies behind.

The frames are those whose index in the test split is 1 modulo 5; no result that is reported elsewhere uses them. Each group
has a file of results in FOLDER, which survives a kill at any moment: the same command resumes where it stopped.
``--stop-after`` ends the run after that many minutes; what is done by then is recorded.
"""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import _lab
from paper_tables import Settings, as_record, run_part, scene_of, test_frames, trials_of

from bidnerf.evaluation import Plan

WITHOUT_REACH: Settings = {"candidates": 1, "box_weight": 0.0}
"""The paper's objective alone; the defaults of ``bid`` add to it."""
PAPER = {
    "rays": 512,
    "max_steps": 1000,
    "learning_rate": 0.02,
    "decay": 0.8,
    "decay_steps": 100,
} | WITHOUT_REACH
"""The paper's steps with a quarter of its rays; the variants compared here add their own settings."""
QUICK = {
    "rays": 512,
    "max_steps": 300,
    "learning_rate": 0.04,
    "decay": 0.5,
    "decay_steps": 100,
} | WITHOUT_REACH
"""Settings with which poses can move as far in fewer steps, for variants that are compared only with each other."""

SCHEDULE: dict[str, Settings] = {
    "scene, 0.02": {},
    "camera, 0.02": {"pivot": "camera"},
    "camera, 0.01": {"pivot": "camera", "learning_rate": 0.01},
    "scene, 0.01": {"learning_rate": 0.01},
    "scene, 0.02, huber 1": {"depth_scale": 1.0, "colour_scale": 1.0},
    "camera, 0.02, huber 1": {"pivot": "camera", "depth_scale": 1.0, "colour_scale": 1.0},
}
REACH: dict[str, Settings] = {
    "as is": {},
    "pixels on matter": {"candidates": 3},
    "wide": {"wide": 2.0},
    "opacity": {"opacity_weight": 0.3},
    "free space": {"free_space_weight": 1.0},
    "points in the box": {"box_weight": 1.0},
    "points in the box, pixels on matter": {"box_weight": 1.0, "candidates": 3},
    "points in the box, weakly": {"box_weight": 0.2},
}
DEPTH: dict[str, Settings] = {
    "distance, fine": {"level": None},
    "distance, a tenth, fine": {"level": None, "depth_weight": 0.1},
    "truncated, fine": {"level": None, "depth_residual": "truncated"},
    "first surface, fine": {"level": None, "depth_residual": "first-surface"},
    "no depth, fine": {"level": None, "depth_weight": 0.0},
}
GROUPS: dict[str, tuple[Settings, dict[str, Settings], tuple[float, ...]]] = {
    "schedule": (PAPER, SCHEDULE, (0.5, 0.8, 1.2)),
    "reach": (QUICK, REACH, (0.9, 1.7)),
    "depth": (QUICK, DEPTH, (0.5, 1.2)),
}
"""The settings that all variants of a group share, the variants, and the sizes of the starts."""


def plans(group: str, base: Plan, given: Namespace, common: Settings) -> list[Plan]:
    """Return a plan for each variant of a group, or only for the named ones."""
    _, variants, usual = GROUPS[group]
    starts = tuple((size,) for size in given.size or usual)
    return [
        replace(base, sizes=starts, config=json.dumps(common | changed, sort_keys=True))
        for name, changed in variants.items()
        if given.variant is None or name in given.variant
    ]


def main() -> None:
    parser = _lab.parser(__doc__, named=False)
    parser.add_argument("data")
    parser.add_argument("--map", help="a folder (default: the map of SCENE, see answer_maps.py)")
    parser.add_argument("--out", type=Path, default=_lab.RESULTS)
    parser.add_argument("--group", nargs="+", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--variant", nargs="+", help="only these of the groups")
    parser.add_argument("--size", nargs="+", type=float, help="errors of the start; default: the group's")
    parser.add_argument("--rays", type=int, help="default: the group's, 512")
    parser.add_argument("--steps", type=int, help="default: the group's")
    parser.add_argument("--trials", type=int, default=8, help="of each variant and size")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--stop-after", type=float, help="minutes")
    given = parser.parse_args()
    scene = scene_of(given.data, given.map)
    frames = test_frames(*scene, tuning=True)
    base = Plan(protocol="bid", method="bid", trials=given.trials, seed=given.seed, frames=frames, device=given.device)
    own: Settings = {name: value for name, value in (("rays", given.rays), ("max_steps", given.steps)) if value}
    for group in given.group:
        common, variants = GROUPS[group][0] | own, GROUPS[group][1]
        chosen = plans(group, base, given, common)
        # One trial of every variant, then the next, so that the results at any moment compare all variants.
        rounds = zip(*(trials_of(plan, scene) for plan in chosen), strict=True)
        trials = [trial for same in rounds for trial in same]
        name = f"bid_{group}_{trials[0].portable.map.replace(':', '_') if given.map else given.data}"
        groups = run_part(trials, given.out / f"{name}.jsonl", given.workers, given.stop_after)
        results: dict[str, Any] = {"common_settings": common, "variants": variants, **as_record(groups)}
        _lab.record(name, results, given.seed, given.out)


if __name__ == "__main__":
    main()
