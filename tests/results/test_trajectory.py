"""Errors of trajectories, compared with evo where it is installed, and by their laws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bidnerf import SE3
from bidnerf.results import TrajectoryErrors, spans

# Inside: errors after each alignment, compared with evo's, and the paths that are drawn
from bidnerf.results.errors import ErrorSummary, alignment_errors, relative_errors
from bidnerf.results.plots import draw_path
from optional import require
from refusals import refused


def walk(count: int = 40, seed: int = 0, noise: float = 0.0) -> SE3:
    """Return a smooth random path, with independent errors of each pose."""
    generator = torch.Generator().manual_seed(seed)
    steps = 0.1 * torch.randn((count, 6), generator=generator, dtype=torch.float64)
    poses = [SE3.identity()]
    for step in steps[1:]:
        poses.append(poses[-1].retract(step))
    errors = noise * torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return SE3.stack(poses).retract(errors)


def evo_path(path: SE3) -> Any:
    trajectory = pytest.importorskip("evo.core.trajectory")
    return trajectory.PosePath3D(poses_se3=list(path.matrix().numpy()))


def test_ate_is_evos() -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    found, true = walk(noise=0.02), walk()
    reference, estimate = evo_path(true), evo_path(found)
    estimate.align(reference, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    ours = require(alignment_errors(found, true))
    assert np.allclose(ours.numpy(), ape.error, atol=1e-9)
    ate = TrajectoryErrors.of(found, true).ate
    assert ate == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def test_rpe_is_evos() -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    found, true = walk(noise=0.02), walk()
    ours = relative_errors(found, true)
    for relation, values in (
        (metrics.PoseRelation.translation_part, ours.translation),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        rpe = metrics.RPE(relation, 1, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((evo_path(true), evo_path(found)))
        assert np.allclose(values.numpy(), rpe.error, atol=1e-7)


def test_the_raw_error_sees_an_offset_that_alignment_removes() -> None:
    true = walk()
    T = SE3.exp(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.3, 0.0], dtype=torch.float64))
    moved = SE3(T.rotation @ true.rotation, T.apply(true.translation))
    errors = TrajectoryErrors.of(moved, true)
    assert errors.raw.translation_median > 0.1
    assert errors.ate == pytest.approx(0.0, abs=1e-9)
    assert require(errors.rpe).translation_rmse == pytest.approx(0.0, abs=1e-9)


def test_scale_is_not_aligned() -> None:
    true = walk()
    errors = require(alignment_errors(SE3(true.rotation, 1.1 * true.translation), true))
    assert float(errors.max()) > 0.01


def test_a_camera_at_rest_has_no_alignment() -> None:
    still = SE3.stack([SE3.identity()] * 5)
    errors = TrajectoryErrors.of(still, still)
    assert errors.ate is None
    assert errors.raw.translation_p95 == 0


def test_short_trajectories() -> None:
    one = walk(1)
    assert TrajectoryErrors.of(one, one).rpe is None
    with refused(found="no errors", expected="at least one pose"):
        TrajectoryErrors.of(one[:0], one[:0])


def test_summaries_are_numpys() -> None:
    errors = relative_errors(walk(noise=0.05), walk())
    found = ErrorSummary.of(errors)
    values = errors.translation.numpy()
    assert found.translation_median == pytest.approx(np.median(values))
    assert found.translation_p95 == pytest.approx(np.quantile(values, 0.95))
    assert found.translation_rmse == pytest.approx(np.sqrt((values**2).mean()))


@pytest.mark.parametrize(
    ("flags", "expected"),
    [([], []), ([0, 0], []), ([1], [(0, 0)]), ([1, 1, 0, 1], [(0, 1), (3, 3)]), ([0, 1, 1], [(1, 2)])],
)
def test_spans(flags: list[int], expected: list[tuple[int, int]]) -> None:
    assert spans([bool(flag) for flag in flags]) == expected


def test_a_path_is_drawn_with_lost_frames_and_truth(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    poses = walk(12)
    accepted = torch.arange(12) % 5 != 0
    truth = [None, *[poses[i] for i in range(11)]]
    draw_path(poses, accepted, torch.full((12,), 0.01), truth, tmp_path / "path.png")
    assert (tmp_path / "path.png").read_bytes().startswith(b"\x89PNG")
