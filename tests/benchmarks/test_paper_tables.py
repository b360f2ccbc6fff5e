"""The script behind the paper's tables, on a closed-form scene with few rays."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf.evaluation import PROTOCOLS, Plan, ResultGroup, Trial, group_results
from bidnerf.scenes import demo_object, orbit, views
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import write_transforms
from bidnerf_core.geometry import SE3, look_at
from optional import require
from refusals import refused
from trial_results import trial_result

Script = Callable[[str], ModuleType]
BLOBS = "demo:blobs"
CIRCLE = [look_at((4 * math.cos(a), 4 * math.sin(a), 2.0), (0.0, 0.0, 0.0)) for a in np.arange(24) * (math.pi / 12)]
CELLS = {
    "table1": (4, 3, 8, {"bid"}),  # conditions, sizes, trials of each, methods
    "depth_weight": (2, 3, 8, {"bid"}),
    "table2": (3, 3, 16, {"bid"}),
    "inerf": (2, 1, 25, {"bid", "inerf"}),
    "parallel": (2, 1, 25, {"bid", "inerf"}),
}


@pytest.mark.parametrize("part", CELLS)
def test_the_cells_of_a_part_are_tried_from_the_same_starts(part: str, script: Script, tmp_path: Path) -> None:
    base, settings, data = Plan(protocol="bid", method="bid", seed=0), {"rays": 8, "max_steps": 2}, BLOBS
    if part == "table2":
        around = views(demo_object(), Intrinsics(8.0, 8.0, 4.0, 4.0, 8, 8), CIRCLE)
        write_transforms(tmp_path, {"test": around})
        data = str(tmp_path)
    cells = script("paper_tables").PARTS[part](base, lambda method: settings, None, (BLOBS, data))
    conditions, sizes, each, methods = CELLS[part]
    assert (
        len({(trial.method, trial.config, trial.depth, len(trial.frames)) for cell in cells for trial in cell})
        == conditions
    )
    assert {trial.method for cell in cells for trial in cell} == methods
    assert [len(cell) for cell in cells] == [sizes * each] * conditions
    for same in zip(*cells, strict=True):
        assert len({(trial.frame, trial.size, trial.seed) for trial in same}) == 1
    if part == "table2":
        assert [len(cell[0].frames) for cell in cells] == [1, 8, 8]


def test_an_arc_goes_round_the_object_in_equal_steps(script: Script) -> None:
    arc, poses = script("paper_tables").arc, CIRCLE
    assert arc(poses, 5, 4, 15.0) in ((2, 3, 4, 5), (8, 7, 6, 5))
    assert arc(poses, 5, 3, 30.0) in ((1, 3, 5), (9, 7, 5))
    assert arc(poses, 5, 4, 7.0) is None
    assert arc(poses, 5, 24, 15.0) is not None
    assert arc(poses, 5, 25, 15.0) is None


def test_an_arc_follows_a_moved_and_turned_world(script: Script) -> None:
    arc, poses = script("paper_tables").arc, orbit(3.0, 60, elevation=(10, 40), seed=2)
    move = look_at((1.0, -2.0, 0.5), (3.0, 1.0, 4.0))
    arcs = [arc(poses, last, 4, 15.0) for last in range(60)]
    assert any(arcs)
    assert arcs == [arc([move @ T for T in poses], last, 4, 15.0) for last in range(60)]


def test_parallel_starts_are_the_published_draws(script: Script) -> None:
    """The rotation is scipy's: extrinsic x, then y the other way round, then z, about the camera's own centre."""
    parts, T_true = script("paper_tables"), SE3.exp(torch.tensor([0.3, 1.0, -2.0, 0.5, -0.2, 0.9], dtype=torch.float64))
    protocol = PROTOCOLS["parallel"]
    for frames in (25, 200):
        np.random.seed(1234)
        chosen = np.random.choice(frames, 5)
        angles, moves = np.random.uniform(-15, 15, (5, 5, 3)), np.random.uniform(-0.25, 0.25, (5, 5, 3))
        for ours, theirs in zip(parts.draw_starts(frames), (chosen, angles, moves), strict=True):
            assert np.array_equal(ours, theirs)
        assert protocol.cases(frames, 25, 1234) == [(chosen[i // 5], 1234 + i) for i in range(25)]
        for i in range(25):
            start = require(protocol.start(T_true, (float(frames),), 1234 + i))
            phi, theta, psi = angles[i // 5, i % 5]
            turn = Rotation.from_euler("xyz", [psi, -theta, phi], degrees=True).as_matrix()
            np.testing.assert_allclose(start.rotation, turn @ T_true.rotation.numpy(), atol=1e-12)
            np.testing.assert_allclose(start.translation, T_true.translation.numpy() + moves[i // 5, i % 5])
    assert chosen.tolist() == [47, 38, 53, 116, 152]  # of the 200 frames of a NeRF-Synthetic test split
    assert angles[0, 0] == pytest.approx([8.140797565872, 10.820093141331, -10.480891031817], abs=1e-11)
    for trials, seed in ((26, 1234), (5, 0)):
        with refused(where="parallel", found=f"{trials} trials from seed {seed}", expected="25 from seed 1234"):
            protocol.cases(50, trials, seed)


@pytest.mark.usefixtures("small_images")
def test_a_part_is_recorded(tmp_path: Path, script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    few = ["--trials", "1", "--rays", "8", "--steps", "1", "--workers", "1", "--part", "inerf"]
    monkeypatch.setattr("sys.argv", ["paper_tables.py", BLOBS, "--map", BLOBS, "--out", str(tmp_path), *few])
    script("paper_tables").main()
    found = json.loads((tmp_path / "inerf_demo_blobs.json").read_text())["results"]
    assert [cell["condition"] for cell in found["cells"]] == ["bid", "inerf"]
    assert [pair["first"] for pair in found["pairs"]] == ["bid", "bid"]  # by each criterion
    assert len((tmp_path / "inerf_demo_blobs.jsonl").read_text().splitlines()) == 2


def test_failures_are_slower_than_any_success_and_equal_among_themselves(script: Script) -> None:
    def group(label: str, *distances: float) -> ResultGroup:
        trials = (Trial("m", "d", ("r",), (1.0,), seed) for seed in range(len(distances)))
        found = [trial_result(trial, [1.0, x, x]) for trial, x in zip(trials, distances, strict=True)]
        return replace(group_results(found)[0], label=label)

    test = script("paper_tables").compare_pair
    good, bad, mixed = group("good", *[0.01] * 6), group("bad", *[0.9] * 6), group("mixed", 0.01, 0.9)
    assert test(good, bad, "10%").rates_p == pytest.approx(2 / 924)  # 2 of choose(12, 6)
    assert (test(good, bad, "10%").steps_p, test(bad, bad, "10%").all_p) == (None, 1)
    assert test(good, bad, "10%").all_p == test(bad, good, "10%").all_p < 0.05
    assert test(mixed, mixed, "10%").all_p == pytest.approx(1)


def test_presets_become_settings_of_each_method(script: Script) -> None:
    settings_of_preset = script("paper_tables").preset_settings
    bid = settings_of_preset("paper", {"rays": 7}, "bid")
    assert bid == {
        "rays": 7,
        "pivot": "camera",
        "max_steps": 1000,
        "learning_rate": 0.02,
        "decay": 0.8,
        "decay_steps": 100,
        "depth_scale": 0.1,
        "candidates": 1,
        "box_weight": 0.0,
    }
    assert settings_of_preset("paper-scene", {}, "inerf") == {"max_steps": 1000}
