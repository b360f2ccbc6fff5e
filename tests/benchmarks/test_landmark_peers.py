"""The benchmark that compares ``auto`` with other methods: its solvers, its matching, and how it counts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from landmark_scene import PINHOLE, Points, looking_in, ring
from localizations import answer_row, assert_near

Script = Callable[[str], ModuleType]
LENS = Intrinsics(300.0, 300.0, 200.0, 150.0, 400, 300, (0.1, -0.05, 0.002, -0.001, 0.01))
BENT = Intrinsics(300.0, 300.0, 200.0, 150.0, 400, 300, (0.1, -0.05, 0.002, -0.001, 0.01, 0.02, 0.01, 0.005))


@pytest.fixture
def sift(script: Script) -> ModuleType:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    return script("sift")


class Seen:
    """A detector for images of ``Points``, with the interface of the benchmark's."""

    def __init__(self, points: Points) -> None:
        import pycolmap

        self.points, self.library = points, pycolmap

    def __call__(self, frame: Any) -> tuple[np.ndarray, np.ndarray]:
        found = self.points(frame.rgb)
        ones = torch.ones(len(found), 2)
        descriptors = torch.cat([found.descriptors, torch.zeros_like(found.descriptors)], dim=-1)
        return torch.cat([found.pixels, ones], dim=-1).numpy(), descriptors.numpy()


@pytest.mark.parametrize("camera", [PINHOLE, LENS, BENT], ids=["pinhole", "lens", "rational"])
@pytest.mark.parametrize("solver", ["colmap_pnp", "opencv_pnp"])
def test_solvers_find_a_pose_among_outliers(sift: ModuleType, solver: str, camera: Intrinsics) -> None:
    generator = np.random.default_rng(0)
    points, truth = Points(200).positions, looking_in(0.4)
    pixels = camera.project(truth.inverse().apply(points)).numpy()
    wrong = generator.random(200) < 0.3
    pixels[wrong] += generator.uniform(30, 200, (wrong.sum(), 2))
    found = getattr(sift, solver)(pixels, points.numpy(), camera, 0)
    assert_near(SE3.from_matrix(torch.tensor(found.T_world_camera)), truth, 1e-3, 0.02)
    assert abs(found.inliers - int((~wrong).sum())) <= 3


@pytest.mark.parametrize("solver", ["colmap_pnp", "opencv_pnp"])
def test_solvers_find_nothing_in_too_few_points(sift: ModuleType, solver: str) -> None:
    assert getattr(sift, solver)(np.zeros((2, 2)), np.zeros((2, 3)), PINHOLE, 0) is None


def test_triangulated_points_are_those_of_the_scene_and_locate_an_image(
    sift: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Points(300, noise=0.2)
    views = ring(scene, 8)
    monkeypatch.setattr(sift, "SiftDetector", lambda: Seen(scene))
    points = sift.sift_points(views, tmp_path)
    nearest = torch.cdist(torch.from_numpy(points.positions), scene.positions).min(1).values
    assert len(points) > 150
    assert float(nearest.median()) < 0.01
    assert len(points.first) == len(points)
    assert len(points.descriptors) >= 2 * len(points)

    query: View = scene.view(looking_in(0.25, 0.1), seed=99)
    pixels, shown = sift.SiftMatcher(points)(query.frame)
    found = sift.colmap_pnp(pixels, shown, PINHOLE, 0)
    assert_near(SE3.from_matrix(torch.tensor(found.T_world_camera)), query.T_ref_camera, 0.02, 0.5)
    assert found.inliers > 100

    monkeypatch.setattr(sift, "triangulate", None)  # a second call reads the cache
    again = sift.sift_points(views, tmp_path)
    assert np.array_equal(again.positions, points.positions)
    with pytest.raises(TypeError):
        sift.sift_points(views[:-1], tmp_path)


def test_answers_are_counted_alone_and_in_pairs(script: Script) -> None:
    counts = script("landmark_peers")
    ours = [answer_row(0.001), answer_row(0.03), answer_row(1.0), answer_row(0.001, accepted=False)]
    theirs = [
        answer_row(0.03, cpu_seconds=3),
        answer_row(None, accepted=False),
        answer_row(0.001, cpu_seconds=2),
        answer_row(9.0),
    ]
    found = counts.summary(ours)
    assert (found["5deg 0.05"]["successes"], found["1deg 0.02"]["successes"]) == (3, 2)
    assert (found["accepted"], found["silent"], found["right_but_rejected"]) == (3, 1, 1)
    paired = counts.against(ours, theirs)
    assert paired["5deg 0.05"] == {"both": 1, "only_auto": 2, "only_peer": 1, "neither": 0, "p": 1.0}
    assert paired["1deg 0.02"]["only_auto"] == 2
    assert paired["cpu_seconds_against_auto"] == 1.5
    assert (
        counts.summary([answer_row(None, None), answer_row(None, None), answer_row(0.1, None)])["median_translation"]
        is None
    )
    assert counts.summary([answer_row(0.1, None)])["silent"] is None
    assert "only auto, only this: 2, 1" in counts.line(counts.summary(theirs) | {"paired": paired})
