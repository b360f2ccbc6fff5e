"""The tables of BID-NeRF (Csehi and Jozsa 2023) and the starts of other papers, on given maps, with the paper's settings.

    python benchmarks/paper_tables.py DATA --map MAP [--map MAP ...] --out FOLDER [--part table1 ...]
    python benchmarks/paper_tables.py SCENE [--part table1 ...]

SCENE is a name as ``answer_maps.py`` takes it, for the map that it has trained.

- ``table1``: fine or coarse x RGB or RGB-D, one image, e_t 0.5, 0.8 and 1.2 together;
- ``depth_weight``: the cells of ``table1`` that have depth, with a tenth of its weight;
- ``table2``: 1 image, 8 images 15 degrees apart, 8 and wide sampling, at e_t 0.9, 1.7 and 3.4;
- ``inerf``: ``bid`` and ``inerf`` from iNeRF's starts;
- ``parallel``: ``bid`` and ``inerf`` from the 25 starts of Parallel Inversion.

All cells of a part share the frames, the starts, the numbers of rays and steps, and all settings but those compared. The
settings are those of ``--preset``: ``paper``, with updates in the camera's frame as in the paper's Alg. 1, or ``paper-scene``,
with ours. In ``table1``, the frames of cells without depth have none, so that nothing can use it: ``bid`` then turns about the
middle of the map instead of the middle of the measured points. Frames whose index in the test split is 1 modulo 5 are left
out, since settings were tuned on them, except in ``parallel``, which draws its frames from the whole split.

Each part and map has a file of results in FOLDER, which survives a kill at any moment: the same command resumes where it
stopped. When a part is complete, its record is written next to it; ``bidnerf report FOLDER/table1_*.jsonl`` draws it.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import _lab
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import fisher_exact, mannwhitneyu

from bidnerf.cli import display_progress
from bidnerf.evaluation import (
    NEVER,
    PROTOCOLS,
    Plan,
    Protocol,
    ResultGroup,
    ResultsFile,
    Size,
    Trial,
    changed_settings,
    group_results,
    list_trials,
    median,
    open_scene,
    run_trials,
    steps_of,
)
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.geometry import SE3
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


# The starts of other papers.

PARALLEL_SEED, PARALLEL_TRIALS = 1234, 25


def draw_starts(frames: int) -> tuple[Int[np.ndarray, "5"], Float[np.ndarray, "5 5 3"], Float[np.ndarray, "5 5 3"]]:
    """Return the frame indices, angles (degrees) and translations of Parallel Inversion, bit for bit.

    The 25 starts are those of Lin et al. 2023, "Parallel Inversion of Neural Radiance Fields for Robust Pose Estimation",
    from the description of its published bulk experiment. The program seeds NumPy's legacy generator once and draws 5 frames
    of the test file *with* replacement, 5x5x3 Euler angles uniform in +-15 degrees, and 5x5x3 translations uniform in +-0.25.
    The numbers depend on the number of frames in the split, since the choice of frames consumes random numbers. Ranges and
    seed are options of the program that its repository sets for each experiment; 1234, 15 and 0.25 are assumed here. The
    published scenes may be scaled; here lengths are those of the data.
    """
    generator = np.random.RandomState(PARALLEL_SEED)
    chosen, shape = generator.choice(frames, 5), (5, 5, 3)
    angles = generator.uniform(-15.0, 15.0, size=shape)
    return chosen, angles, generator.uniform(-0.25, 0.25, size=shape)


def parallel_cases(frames: int, trials: int, seed: int) -> list[tuple[int, int]]:
    """Return the frame index and seed of the first ``trials`` of the 25 trials, whose seeds are 1234 to 1258."""
    if seed != PARALLEL_SEED or trials > PARALLEL_TRIALS:
        expected = f"at most {PARALLEL_TRIALS} from seed {PARALLEL_SEED}, since the list is fixed"
        raise InputError(f"{trials} trials from seed {seed}", where="parallel", expected=expected)
    chosen = draw_starts(frames)[0]
    return [(int(chosen[i // 5]), PARALLEL_SEED + i) for i in range(trials)]


def parallel_start(T_true: SE3, size: Size, seed: int) -> SE3:
    """Return the start of the trial with ``seed`` (1234 to 1258); ``size`` holds the number of frames in the split.

    The angles (phi, theta, psi) turn the camera about its own centre and the *world's* axes, R' = Rz(phi) Ry(-theta) Rx(psi) R,
    and the centre moves along the world's axes.
    """
    _, angles, moves = draw_starts(int(size[0]))
    start = divmod(seed - PARALLEL_SEED, 5)
    phi, theta, psi = angles[start]
    turn = torch.from_numpy(Rotation.from_euler("xyz", (psi, -theta, phi), degrees=True).as_matrix())
    true = T_true.to(dtype=torch.float64)
    return SE3(turn @ true.rotation, true.translation + torch.from_numpy(moves[start]))


# Processes that run trials import this file, too.
PROTOCOLS["parallel"] = Protocol(
    "Parallel Inversion: its 25 starts, up to 15 degrees and 0.25 along each axis",
    parallel_start,
    ((200.0,),),
    ("frames in the split",),
    PARALLEL_TRIALS,
    PARALLEL_SEED,
    parallel_cases,
)


def rotate_about(
    T_world_camera: SE3, middle: Float[torch.Tensor, "3"], up: Float[torch.Tensor, "3"], angle_deg: float
) -> SE3:
    """Return the camera's pose after a rotation by ``angle_deg`` about the axis ``up`` through ``middle`` (metres, world)."""
    phi = math.radians(angle_deg) * torch.nn.functional.normalize(up, dim=0)
    turn = SE3.exp(torch.cat([torch.zeros_like(phi), phi]))
    moved = T_world_camera.translation - middle
    return SE3(turn.rotation @ T_world_camera.rotation, turn.rotate(moved) + middle)


def arc(poses: Sequence[SE3], last: int, count: int, angle_deg: float) -> tuple[int, ...] | None:
    """Return the indices of ``count`` frames ending with ``last``, ``angle_deg`` apart about a common centre (BID-NeRF, Table 2).

    The centre is the point at which the cameras look: the least-squares intersection of their optical axes. At each step
    about the vertical axis, the frame nearest in direction from the centre is chosen. Both senses of rotation are tried,
    and the better fit is returned; None if at some step no unused frame lies within half a step.
    """
    rotations, positions = torch.stack([T.rotation for T in poses]), torch.stack([T.translation for T in poses])
    eye, axes = torch.eye(3, dtype=torch.float64), rotations[:, :, 2]
    across = eye - axes[:, :, None] * axes[:, None]
    normal = across.sum(0) + 1e-9 * eye  # for parallel axes, any point will do
    middle = torch.linalg.solve(normal, (across @ positions[..., None]).sum(0)[:, 0])
    mean = -rotations[:, :, 1].mean(0)
    up = torch.nn.functional.normalize(mean if mean.norm() > 1e-3 else -rotations[0, :, 1], dim=0)
    directions = torch.nn.functional.normalize(positions - middle, dim=-1)
    fitting = []
    for step in (angle_deg, -angle_deg):
        turns = [rotate_about(poses[last], middle, up, number * step) for number in range(count)]
        ideal = torch.nn.functional.normalize(torch.stack([T.translation for T in turns]) - middle, dim=-1)
        cosines = directions @ ideal.mT  # (frames, steps)
        taken, missed = [last], [0.0]
        for number in range(1, count):
            cosines[taken, number] = -1
            taken.append(int(cosines[:, number].argmax()))
            missed.append(math.acos(min(1.0, float(cosines[taken[-1], number]))))
        if max(missed) <= math.radians(abs(angle_deg)) / 2:
            fitting.append((sum(missed), tuple(reversed(taken))))
    return min(fitting)[1] if fitting else None


def rigs_on_arcs(plan: Plan, scene: Scene, count: int, angle_deg: float) -> dict[str, tuple[str, ...]]:
    """Return ``count`` frames on an arc that end with each frame of the plan with which such an arc can end."""
    dataset = open_scene(*scene, plan)[1]
    poses = {view.frame.name: view.T_ref_camera for view in dataset.views(plan.images.split)}
    ending, names = plan.frames or tuple(poses), list(poses)
    arcs = {name: arc([*poses.values()], names.index(name), count, angle_deg) for name in ending}
    if not any(arcs.values()):
        raise InputError(f"no frame ends {count} frames {angle_deg:g} degrees apart about a centre", where=scene[1])
    return {name: tuple(names[index] for index in indices) for name, indices in arcs.items() if indices is not None}


# The parts. Each returns the trials of its cells.


def table1(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[list[Trial]]:
    """Return the cells of table 1; ``trials`` is the number over all three sizes."""
    each = -(-(trials or 24) // 3)
    plan = replace(base, protocol="bid", sizes=(0.5, 0.8, 1.2), trials=each)
    return [
        trials_of(replace(plan, depth=depth, config=_json(common("bid") | {"level": level})), scene)
        for level in (0, None)
        for depth in (True, False)
    ]


def depth_weight(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[list[Trial]]:
    """Return the cells of ``table1`` that have depth, from the same starts, with a tenth of its weight."""
    return [
        [replace(trial, config=_json(json.loads(trial.config) | {"depth_weight": 0.1})) for trial in cell]
        for cell in table1(base, common, trials, scene)
        if cell[0].depth
    ]


def table2(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[list[Trial]]:
    """Return the cells of table 2."""
    rigs = rigs_on_arcs(base, scene, 8, 15.0)
    # One image is the last of the eight: the same frames for all.
    plan = replace(base, protocol="bid", sizes=(0.9, 1.7, 3.4), trials=trials or 16, frames=tuple(rigs))
    single, wide = (
        trials_of(replace(plan, config=_json(common("bid") | settings)), scene) for settings in ({}, {"wide": 2.0})
    )
    return [single, *([replace(trial, frames=rigs[trial.frame]) for trial in cell] for cell in (single, wide))]


def inerf(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[list[Trial]]:
    """Return ``bid`` and ``inerf`` from the starts of iNeRF, both with its learning rate, as in the paper."""
    plan = replace(base, protocol="inerf", trials=trials or 25)
    return [
        trials_of(replace(plan, method=method, config=_json(common(method) | {"learning_rate": 0.01})), scene)
        for method in ("bid", "inerf")
    ]


def parallel(base: Plan, common: Common, trials: int | None, scene: Scene) -> list[list[Trial]]:
    """Return ``bid`` and ``inerf`` from the starts of Parallel Inversion."""
    frames = len(open_scene(*scene, base)[1].frame_names(base.images.split))
    plan = replace(base, protocol="parallel", sizes=[frames], trials=trials, seed=None, frames=None)
    return [trials_of(replace(plan, method=method, config=_json(common(method))), scene) for method in ("bid", "inerf")]


PARTS: dict[str, Callable[[Plan, Common, int | None, Scene], list[list[Trial]]]] = {
    "table1": table1,
    "depth_weight": depth_weight,
    "table2": table2,
    "inerf": inerf,
    "parallel": parallel,
}
"""Functions of a plan, the shared settings, the number of trials of a cell and the scene; each returns the trials of its cells."""


def preset_settings(preset: str, others: Settings, method: str) -> Settings:
    """Return the settings of a preset that differ from the method's defaults, and ``others``; iNeRF has one preset only."""
    offered = METHODS[method]
    chosen = offered.settings(preset if preset in offered.presets else "paper")
    return json.loads(changed_settings(method, chosen)) | others


def scene_of(data: str, folder: str | None) -> Scene:
    """Return a map and its dataset; without ``folder``, those of a scene that ``answer_maps.py`` has trained."""
    return (folder, data) if folder else (str(_lab.require_map(data)), str(_lab.data_folder(data)))


def test_frames(map_folder: str, data: str, tuning: bool) -> tuple[str, ...]:
    """Return the test frames on which settings are tuned, or all others."""
    _, dataset = open_scene(map_folder, data)
    return tuple(_lab.held_out(dataset.frame_names("test"), tuning))


def trials_of(plan: Plan, scene: Scene) -> list[Trial]:
    """Return the trials of a plan."""
    return list_trials(plan, *scene, open_scene(*scene, plan)[1])


def run_part(trials: Sequence[Trial], path: Path, workers: int, minutes: float | None = None) -> list[ResultGroup]:
    """Run the missing trials and return the groups of all results; after ``minutes``, of those available by then.

    Raises ``SystemExit`` if it is stopped, or if nothing was done in time.
    """
    began = time.monotonic()

    def late() -> bool:
        return minutes is not None and time.monotonic() - began > 60 * minutes

    with ResultsFile(path) as file:
        with display_progress(), suppress(Cancelled, KeyboardInterrupt), job_context(cancel=late):
            run_trials(trials, file, workers=workers)
        done = [trial for trial in trials if trial in file]
        if not done or (len(done) < len(trials) and minutes is None):
            raise SystemExit(f"stopped; {path} is kept, the same command goes on")
        file.put_in_order(trials)
        return group_results([file[trial] for trial in done])


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


def pairwise_tests(groups: Sequence[ResultGroup], criterion: str) -> list[PairTest]:
    """Return the tests of every pair of groups that share a situation and to which the criterion applies."""
    fitting = [group for group in groups if group.summary.success[criterion] is not None]
    pairs = itertools.combinations(fitting, 2)
    return [compare_pair(a, b, criterion) for a, b in pairs if a.situation == b.situation]


def compare_pair(first: ResultGroup, second: ResultGroup, criterion: str) -> PairTest:
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


def as_record(groups: Sequence[ResultGroup]) -> dict[str, Any]:
    """Return rates by each criterion, costs, and p values of each pair, for each size and over all sizes."""
    cells = [
        {
            "map": group.situation.map,
            "start": group.situation.start,
            "condition": group.label,
            **asdict(group.summary),
        }
        for group in groups
    ]
    pairs = [asdict(pair) | {"criterion": c} for c in ("10%", "5deg 0.05") for pair in pairwise_tests(groups, c)]
    return {"cells": cells, "settings": [g.results[0].settings for g in groups], "pairs": pairs}


def main() -> None:
    parser = _lab.parser(__doc__, named=False)
    parser.add_argument("data")
    parser.add_argument("--map", action="append", help="a folder; may be given again (default: the map of SCENE)")
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
        for folder in given.map or [None]:
            scene = scene_of(given.data, folder)
            frames = test_frames(*scene, tuning=False)
            base = Plan(protocol="bid", method="bid", seed=given.seed, device=given.device, frames=frames)
            trials = [trial for cell in PARTS[part](base, common, given.trials, scene) for trial in cell]
            name = f"{part}_{trials[0].portable.map.replace(':', '_') if folder else given.data}"
            groups = run_part(trials, given.out / f"{name}.jsonl", given.workers, given.stop_after)
            results = {"paper_percent": PAPER.get(part), "preset": given.preset, **as_record(groups)}
            _lab.record(name, results, given.seed, given.out)


def _json(settings: Settings) -> str:
    return json.dumps(settings, sort_keys=True)


if __name__ == "__main__":
    main()
