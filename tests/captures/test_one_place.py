"""Photos from one place: they are recognised, their map tells directions, and nothing in it claims a position."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

import tiny
from bidnerf import SE3, Localizer, Outcome, Tracker, View, load_map, train
from bidnerf.evaluation import faulty
from bidnerf.testing import MapWithLandmarks, textured_map, unseen

# Inside: whether photos show distances, before a map of them is trained
from bidnerf_core.captures.coverage import shows_distances
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.mapping import LandmarkConfig, track_views
from bidnerf_core.maps import TrainOptions, load_info
from landmark_scene import Points, looking_in, ring
from refusals import refused

CENTRE = looking_in(0.0)


def turned(points: Points, moved: float = 0.0, depth: float | None = None) -> list[View]:
    """Views that turn about one place; ``moved`` is a random motion beside it, metres."""
    generator, views = torch.Generator().manual_seed(0), []
    for i in range(10):
        aside = moved * torch.randn(3, dtype=torch.float64, generator=generator)
        turn = torch.tensor([0, 0.03 * (i % 5 - 2), 0.02 * (i % 3)], dtype=torch.float64)
        views.append(points.view(CENTRE.retract(torch.cat([aside, turn])), seed=i, depth=depth))
    return views


@pytest.mark.parametrize(("moved", "noise"), [(0.0, 0.0), (0.0, 0.4), (1e-3, 0.4)])
def test_turning_about_one_place_shows_no_distances(moved: float, noise: float) -> None:
    points = Points(noise=noise)
    views = turned(points, moved)
    assert not shows_distances(views, track_views(views, points))


def test_depth_and_several_places_show_distances() -> None:
    points = Points(noise=0.4)
    around, near = ring(points), turned(points, depth=1.0)
    assert shows_distances(around, track_views(around, points))
    assert shows_distances(near, track_views(near, points))
    assert shows_distances(around, None)
    assert not shows_distances(turned(points), None)


def test_landmarks_of_one_place_have_the_right_directions() -> None:
    points = Points()
    views = turned(points)
    tracked = track_views(views, points)
    with refused(found=f"no landmarks found in {len(views)} images", expected="different places"):
        tracked.landmarks(LandmarkConfig())
    found = tracked.at_distance(5.0).landmarks(LandmarkConfig())
    off = (found.descriptors[:, None].float() - points.descriptors.float()).square().sum(-1)
    true = points.positions[off.argmin(1)] - CENTRE.translation
    seen = found.positions.double() - CENTRE.translation
    torch.testing.assert_close(seen.norm(dim=-1), torch.full((len(seen),), 5.0).double(), rtol=1e-4, atol=0)
    assert float(torch.linalg.cross(true, seen).norm(dim=-1).div(true.norm(dim=-1) * 5).max()) < 1e-4


@dataclass(frozen=True, eq=False)
class WithoutDistances(MapWithLandmarks):
    has_distances: bool = False


@pytest.mark.slow
def test_an_accepted_pose_is_imprecise_and_a_rejected_one_stays_rejected() -> None:
    scene = textured_map()
    flat = WithoutDistances(scene.field, scene.bounds, scene.landmarks)
    assert scene.has_distances
    frame = unseen().frame
    usual, cautious = Localizer(scene)(frame), Localizer(flat)(frame)
    assert usual.converged
    assert cautious.outcome is Outcome.IMPRECISE
    assert not cautious.converged
    assert (cautious.covariance, cautious.confidence) == (None, None)
    assert "one place" in cautious.reason
    assert torch.equal(cautious.T_world_camera.matrix(), usual.T_world_camera.matrix())
    mirrored = Localizer(flat)(replace(faulty(unseen(), "mirror", 0).frame, depth=None))
    assert mirrored.outcome is Outcome.MIRRORED
    assert mirrored.covariance is None


def test_there_is_no_tracking_without_distances() -> None:
    scene = textured_map()
    with refused(found="tracking needs positions", expected="a map of photos from several places"):
        Tracker(Localizer(WithoutDistances(scene.field, scene.bounds, scene.landmarks)))


def test_training_goes_on_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "bidnerf")
    pose = tiny.views(1)[0].T_ref_camera
    photos = [
        View(
            replace(v.frame, depth=None, alpha=None),
            pose.retract(torch.tensor([0, 0, 0, 0, 0.1 * i, 0]).double()),
        )
        for i, v in enumerate(tiny.views(3))
    ]
    train(
        photos,
        out=tmp_path / "still",
        config=tiny.config(2),
        bake=False,
        options=TrainOptions(images=DatasetOptions(background=tiny.BACKGROUND)),
    )
    assert caplog.text.count("from one place and do not determine distances") == 1
    assert not load_info(tmp_path / "still").distances
    assert not load_map(tmp_path / "still").has_distances
    assert "distances:   unknown, since" in str(load_map(tmp_path / "still").describe())
    moved = [
        replace(v, T_ref_camera=SE3(v.T_ref_camera.rotation, v.T_ref_camera.translation + i))
        for i, v in enumerate(photos)
    ]
    assert train(
        moved,
        config=tiny.config(2),
        bake=False,
        options=TrainOptions(images=DatasetOptions(background=tiny.BACKGROUND)),
    ).has_distances
