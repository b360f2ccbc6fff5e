"""Landmarks from posed views: where they are, how surely, and what makes none; their cells leave out what an image does not show."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from bidnerf import SE3, Cancelled, Frame, InputError, Intrinsics, View
from bidnerf_core.geometry import look_at
from bidnerf_core.mapping import (
    LandmarkConfig,
    LandmarkMap,
    Sift,
    Sightings,
    build_landmarks,
    image_keypoints,
    likely_pairs,
    robust_covariance,
    track_views,
    update_scatter,
)

# Inside: triangulation, tracks and cells, each against an exhaustive computation
from bidnerf_core.mapping.geometry.triangulation import parallax, refine_points, triangulate
from bidnerf_core.mapping.landmarks.landmark_map import MOST_IN_CELL, LandmarkCells
from bidnerf_core.mapping.landmarks.tracks import (
    EPIPOLAR_BAND,
    PairMatches,
    _mean_descriptors,
    epipolar_matches,
    link_tracks,
)
from bidnerf_core.progress import Progress, job_context
from landmark_scene import PINHOLE, Points, looking_in, ring
from optional import require


def truth(points: Points, landmarks: LandmarkMap) -> torch.Tensor:
    """The true position of each landmark, told by its descriptor."""
    off = (landmarks.descriptors[:, None].float() - points.descriptors.float()).square().sum(-1)
    return points.positions[off.argmin(1)]


@pytest.mark.parametrize(("lens", "most"), [((), 1e-4), ((0.1, -0.05, 0.001, 0.002), 1e-3)], ids=["ideal", "distorted"])
def test_exact_views_give_exact_landmarks(lens: tuple[float, ...], most: float) -> None:
    points = Points()
    found = build_landmarks(ring(points, intrinsics=replace(PINHOLE, distortion=lens)), points)
    assert len(found) > 0.9 * points.count
    assert float((found.positions - truth(points, found)).norm(dim=-1).max()) < most
    assert int(found.views.max()) > 5


def test_errors_are_as_large_as_the_deviations_say() -> None:
    points = Points(noise=0.4)
    found = build_landmarks(ring(points), points)
    off = (found.positions - truth(points, found)).double()
    along = (off * found.directions).sum(-1) / found.deviations[:, 1]
    assert 0.7 < float(along.abs().median()) / 0.6745 < 1.4
    assert found.noise == pytest.approx(0.4, rel=0.25)


def test_each_image_sees_landmarks_as_far_away_as_they_are() -> None:
    points = Points(noise=0.4)
    views = ring(points)
    seen, off = track_views(views, points).landmarks_by_image(LandmarkConfig()), []
    assert len(seen) == len(views)
    for view, part in zip(views, seen, strict=True):
        local = view.T_ref_camera.inverse().apply(points.positions)
        nearest = (PINHOLE.project(local) - part.pixels.double()[:, None]).norm(dim=-1).min(dim=1)
        assert float(nearest.values.max()) < 4
        off.append((part.distance - local[nearest.indices].norm(dim=-1)) / part.deviation)
    assert len(torch.cat(off)) > 0.9 * sum(len(found.pixels) for found in points.seen)
    assert 0.7 < float(torch.cat(off).abs().median()) / 0.6745 < 1.4


def test_a_moved_world_has_moved_landmarks() -> None:
    points = Points(noise=0.3)
    views = ring(points)
    T = SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.3], dtype=torch.float64))
    here = build_landmarks(views, points)
    there = build_landmarks([View(v.frame, T @ v.T_ref_camera) for v in views], points)
    torch.testing.assert_close(there.positions.double(), T.apply(here.positions.double()), atol=1e-4, rtol=0)
    torch.testing.assert_close(there.deviations, here.deviations, atol=1e-5, rtol=1e-3)


def test_the_order_of_the_views_does_not_matter() -> None:
    points = Points(noise=0.3)
    views = ring(points)
    a, b = build_landmarks(views, points), build_landmarks(views[::-1], points)
    off = torch.cdist(a.positions.double(), b.positions.double()).amin(1)
    assert len(a) == len(b)
    assert float(off.max()) < 1e-3


def test_without_parallax_measured_depth_places_the_points() -> None:
    points = Points()
    turned = [looking_in(0.0) @ SE3.exp(torch.tensor([0, 0, 0, 0, 0.05 * i, 0], dtype=torch.float64)) for i in range(4)]
    with pytest.raises(InputError, match="no landmark"):
        build_landmarks([points.view(T) for T in turned], points)
    found = build_landmarks([points.view(T, depth=1.0) for T in turned], points)
    assert len(found) > 100
    assert int(found.views.max()) == 4
    assert float((found.positions - truth(points, found)).norm(dim=-1).median()) < 1e-3


def test_keypoints_of_one_image_become_landmarks_only_by_request() -> None:
    points = Points()
    view = points.view(looking_in(0.0), depth=1.0)
    assert len(build_landmarks([view], points)) > 100
    with pytest.raises(InputError, match="no landmark"):
        build_landmarks([view], points, LandmarkConfig(singles=False))


def test_the_best_seen_are_kept_and_the_rest_is_reported() -> None:
    points = Points()
    said: list[str] = []
    views = ring(points)
    everything = build_landmarks(views, points)
    found = build_landmarks(views, points, LandmarkConfig(most=50), report=said.append)
    assert len(found) == 50
    assert f"{len(everything)} landmarks found, 50 kept" in said[0]
    assert int(found.views.min()) >= int(everything.views.sort(descending=True).values[49])
    # Of more than a thousand images, as many more are kept.
    tracked = track_views(views, points)
    first = tracked.observations.images[0]
    empty = replace(first, keypoints=first.keypoints[torch.arange(0)], rays=first.rays[:0], depth=first.depth[:0])
    images = [*tracked.observations.images, *[empty] * (2000 - len(views))]
    many = replace(tracked, observations=replace(tracked.observations, images=images))
    assert len(many.landmarks(LandmarkConfig(most=50))) == 100


def test_progress_ends_at_its_total() -> None:
    points, reports = Points(count=50), list[Progress]()
    with job_context(reports.append):
        build_landmarks(ring(points, 4), points)
    assert [report.done for report in reports] == list(range(reports[-1].total + 1))


class LastOfAll(Executor):
    """Runs the tasks only when it is closed, but for the first, unless they were cancelled by then."""

    def __init__(self) -> None:
        self.waiting = list[tuple[Future[object], Callable[[], object]]]()
        self.run = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future = Future[Any]()
        self.waiting.append((future, lambda: fn(*args, **kwargs)))
        if len(self.waiting) == 1:
            self.finish()
        return future

    def finish(self) -> None:
        for future, work in self.waiting:
            if not future.done() and future.set_running_or_notify_cancel():
                self.run += 1
                future.set_result(work())


def test_tasks_that_wait_are_not_done_after_the_job_is_cancelled() -> None:
    points, executor = Points(count=50), LastOfAll()
    with pytest.raises(Cancelled) as caught, job_context(cancel=lambda: executor.run > 0, executor=executor):
        build_landmarks(ring(points, 9), points)
    executor.finish()
    assert caught.value  # whose traceback keeps the generator alive
    assert len(executor.waiting) == 9
    assert executor.run == 1


@pytest.mark.parametrize("count", [0, 1, 3])
def test_blank_images_are_refused(count: int) -> None:
    blank = Frame("b", torch.full((40, 60, 3), 0.5), Intrinsics(50, 50, 30, 20, 60, 40))
    with pytest.raises(InputError, match="landmark"):
        build_landmarks([View(blank, looking_in(0.1 * i)) for i in range(count)], Sift())


def sightings(point: torch.Tensor, cameras: list[SE3], noise: float, trials: int, seed: int = 0) -> Sightings:
    """One point, seen ``trials`` times by all cameras; noise in pixels at a focal length of 300."""
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.stack([T.rotation.mT for T in cameras]).repeat(trials, 1, 1)
    centre = torch.stack([T.translation for T in cameras]).repeat(trials, 1)
    local = (rotation @ (point - centre)[..., None])[..., 0]
    image = local[:, :2] / local[:, 2:]
    image = image + noise / 300 * torch.randn(image.shape, dtype=torch.float64, generator=generator)
    index = torch.arange(trials).repeat_interleave(len(cameras))
    view = torch.arange(len(index))
    focal = torch.full((len(index),), 300.0, dtype=torch.float64)
    return Sightings(index, view, rotation, centre, image, focal, torch.zeros_like(focal))


def test_covariance_of_a_triangulated_point_is_that_of_many_trials() -> None:
    point, cameras = (
        torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64),
        [looking_in(0.15 * i) for i in range(4)],
    )
    seen = sightings(point, cameras, 0.5, 3000)
    found, unit = refine_points(seen, triangulate(seen, 3000), 50.0)
    sampled = (found - point).mT @ (found - point) / len(found)
    expected = 0.25 * unit.mean(0)
    whitened = torch.linalg.solve(torch.linalg.cholesky(expected), sampled)
    whitened = torch.linalg.solve(torch.linalg.cholesky(expected), whitened.mT)
    torch.testing.assert_close(whitened, torch.eye(3, dtype=torch.float64), atol=0.15, rtol=0)


def test_one_wrong_observation_of_six_does_not_pull_a_point_away() -> None:
    point, cameras = (
        torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64),
        [looking_in(0.15 * i) for i in range(6)],
    )
    seen = sightings(point, cameras, 0.0, 1)
    seen.image[2] += 0.1  # 30 pixels
    found = triangulate(seen, 1)
    for scale in (5.0, 1.0, 0.2):
        found, _ = refine_points(seen, found, scale)
    assert float((found[0] - point).norm()) < 1e-3


def test_parallax_is_the_angle_between_two_rays() -> None:
    cameras = [looking_in(0.0, 0.0), looking_in(0.2, 0.0)]
    seen = sightings(torch.zeros(3, dtype=torch.float64), cameras, 0.0, 1)
    assert float(parallax(seen, torch.zeros(1, 3, dtype=torch.float64))) == pytest.approx(0.2)


@pytest.mark.parametrize(
    "motion",
    [
        pytest.param([0.4, 0.1, 0.2, -0.1, 0.3, 0.05], id="around"),
        pytest.param([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], id="forward"),  # the epipole is in the middle of the image
        pytest.param([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], id="sideways"),  # and here at infinity
        pytest.param([0.0, 0.0, 0.0, 0.02, 0.05, 0.1], id="turning"),  # there is none
    ],
)
def test_matches_near_epipolar_lines_are_those_of_an_exhaustive_search(
    monkeypatch: pytest.MonkeyPatch, motion: list[float]
) -> None:
    points = Points(count=150, noise=1.0)
    generator = torch.Generator().manual_seed(0)

    def noisy(descriptors: Tensor, size: int) -> Tensor:
        return (
            (descriptors + torch.randint(-size, size + 1, descriptors.shape, generator=generator)).clamp(0, 255).byte()
        )

    # Of points that look alike the lines decide, and the ratio test refuses some.
    points.descriptors = noisy(points.descriptors[torch.arange(150) % 40], 40)
    first = looking_in(0.0, 0.0)
    second = first.retract(torch.tensor(motion, dtype=torch.float64))
    a, b = (image_keypoints(points.view(T, seed=seed), points) for seed, T in enumerate((first, second)))
    b.keypoints.descriptors[:] = noisy(b.keypoints.descriptors, 25)
    # Of keypoints with equal descriptors near the line, the first is the nearest.
    a.keypoints.descriptors[5] = a.keypoints.descriptors[4]
    a.rays[5] = a.rays[4]
    T = b.T_ref_camera.inverse() @ a.T_ref_camera
    near = torch.zeros(len(a.keypoints), len(b.keypoints), dtype=torch.bool)
    for i, ray in enumerate(a.rays):
        depths = torch.logspace(-3, 5, 20_000, dtype=torch.float64)
        line = T.apply(ray * depths[:, None])
        pixels = (line[:, :2] / line[:, 2:])[line[:, 2] > 0]
        near[i] = torch.cdist(b.rays[:, :2], pixels).amin(1) < EPIPOLAR_BAND / b.focal
    distance = (a.keypoints.descriptors[:, None].float() - b.keypoints.descriptors.float()).square().sum(-1)
    banded = torch.where(near, distance, torch.inf)
    expected = set()
    for i, row in enumerate(banded):
        j = int(row.argmin())
        others = (b.keypoints.pixels - b.keypoints.pixels[j]).norm(dim=-1) >= max(4.0, float(b.keypoints.sizes[j]) / 2)
        passes = row[j] < 0.85**2 * row[others].min() and row[j] < 0.95**2 * distance[i, others].min()
        if bool(row[j].isfinite() and banded[:, j].argmin() == i and passes):
            expected.add((i, j))
    whole = epipolar_matches(a, b)
    assert {(i, j) for i, j in whole.pairs.tolist()} == expected
    assert 10 < len(expected) < len(a.keypoints)
    monkeypatch.setattr("bidnerf_core.mapping.landmarks.tracks.CACHED", 500)  # blocks of a few rows
    monkeypatch.setattr("bidnerf_core.mapping.landmarks.tracks.ROWS", 7)
    parts = epipolar_matches(a, b)
    assert torch.equal(parts.pairs, whole.pairs)
    assert torch.equal(parts.ambiguity, whole.ambiguity)


def test_a_match_that_would_join_two_keypoints_of_an_image_is_left_out() -> None:
    def match(a: int, b: int, ambiguity: float) -> PairMatches:
        return PairMatches(torch.tensor([[a, b]]), torch.tensor([ambiguity]))

    track = link_tracks([(0, 1, match(0, 0, 0.1)), (1, 2, match(0, 0, 0.2)), (0, 2, match(1, 0, 0.5))], [2, 1, 1])
    assert track[0] == track[2] == track[3]
    assert track[1] != track[0]


def test_likely_pairs_are_neighbours_on_the_ring() -> None:
    points = Points(count=10)
    views = [points.view(looking_in(2 * math.pi * i / 24)) for i in range(24)]
    poses = [view.T_ref_camera for view in views]
    pairs = likely_pairs(poses, 4)
    apart = (pairs[:, 1] - pairs[:, 0]).minimum(24 - pairs[:, 1] + pairs[:, 0])
    assert int(apart.max()) <= 5
    assert int((apart == 1).sum()) == 24
    assert likely_pairs(poses[:2], 8).tolist() == [[0, 1]]


@pytest.mark.parametrize("rooms", [1, 8, 200])
def test_pairs_show_the_same_walls_in_a_building_as_in_a_room(rooms: int) -> None:
    """Photos are taken all over rooms of 4 x 3 m, 20 in each, in all directions."""
    generator = torch.Generator().manual_seed(0)
    room = torch.arange(rooms).repeat_interleave(20)
    corner = torch.stack([room % 10 * 4.3, room // 10 % 10 * 3.3, room // 100 * 3.0], dim=-1)
    centre = corner + torch.rand(len(room), 3, generator=generator) * torch.tensor([3.0, 2.0, 0.6])
    angle = 2 * math.pi * torch.rand(len(room), generator=generator)
    ahead = centre + torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    poses = [look_at(tuple(eye), tuple(target)) for eye, target in zip(centre.tolist(), ahead.tolist(), strict=True)]
    first, second = likely_pairs(poses, 8).unbind(-1)
    alike = (room[first] == room[second]) & ((angle[first] - angle[second]).cos() > 0.5)
    assert 0.4 < float(alike.double().mean()) < 0.6
    # Of some places, many photos may be taken from one point.
    assert len(likely_pairs(poses[:1] * 300, 8)) > 300


def test_robust_covariance_is_right_for_normal_values_and_holds_with_outliers(
    generator: torch.Generator,
) -> None:
    shape = torch.randn(6, 6, dtype=torch.float64, generator=generator)
    values = torch.randn(4000, 6, dtype=torch.float64, generator=generator) @ shape.mT
    whitening = torch.linalg.inv(shape)
    values[:200] *= 30
    found = whitening @ robust_covariance(values) @ whitening.mT
    assert float(torch.linalg.eigvalsh(found)[0]) > 0.85
    assert float(torch.linalg.eigvalsh(found)[-1]) < 1.4


def test_scatter_of_updates_is_that_of_the_images_that_moved_if_most_did() -> None:
    deviations = torch.tensor([3, 2, 1, 0.3, 0.2, 0.1], dtype=torch.float64)
    noise = torch.randn((400, 6), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    updates = list(noise * deviations)
    found = require(update_scatter(updates))
    torch.testing.assert_close(found.diagonal().sqrt(), deviations, rtol=0.15, atol=0)
    half = require(update_scatter([*updates, *[None] * 400]))
    assert torch.equal(half, found)
    for few in ([*updates, *[None] * 401], updates[:7], []):
        assert update_scatter(few) is None


def test_few_images_do_not_make_their_poses_exact() -> None:
    points = Points(noise=0.4)
    few, many = (build_landmarks(ring(points, count), points).pose_covariance.diagonal().sqrt() for count in (6, 12))
    assert bool((few > 0).all())
    assert 0.1 < float((few / many).min()) <= float((few / many).max()) < 10


@pytest.mark.parametrize("zero", [0, 128])
def test_descriptors_of_one_point_are_averaged_to_their_usual_length(zero: int, generator: torch.Generator) -> None:
    true = normalize(
        torch.randn(300, 64, generator=generator).abs() if not zero else torch.randn(300, 64, generator=generator)
    )
    point = torch.arange(300).repeat(8)
    seen = normalize(true[point] + 0.05 * torch.rand(2400, 64, generator=generator))
    length = 512 if not zero else 256
    descriptors = (zero + length * seen).round().clamp(0, 255).byte()
    found = _mean_descriptors(lambda: iter(descriptors.split(7)), point, 300).float() - zero
    torch.testing.assert_close(found.norm(dim=-1), torch.full((300,), float(length)), rtol=0.01, atol=0)


OBLIQUE, SIZE = 0.7, 0.01


def some(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return positions in a long house, directions in which they were seen, cones about these, and sizes."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(count, 3, generator=generator) * torch.tensor([40.0, 10.0, 3.0])
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    directions[: count // 2] = torch.tensor([0.0, 0.0, 1.0])
    cones, sizes = torch.rand(2, count, generator=generator)
    return positions, directions, cones, 0.2 * sizes


def poses(count: int) -> SE3:
    generator = torch.Generator().manual_seed(1)
    turn = 2 * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    place = torch.rand(count, 3, dtype=torch.float64, generator=generator) * torch.tensor([50.0, 15.0, 5.0])
    return SE3(SE3.exp(torch.cat([torch.zeros_like(turn), turn], dim=-1)).rotation, place)


@pytest.mark.parametrize("count", [1, MOST_IN_CELL + 1, 20_000])
def test_no_landmark_in_the_image_is_left_out(count: int) -> None:
    positions, directions, cones, sizes = landmarks = some(count)
    cells, slopes, looked_at = LandmarkCells.of(*landmarks), torch.tensor([0.7, 0.5]), 0
    for number in range(40):
        T = poses(40)[number]
        found = cells.seen_from(T, slopes, OBLIQUE, SIZE)
        assert len(found.unique()) == len(found)
        # From the definition of which landmarks an image shows.
        local = T.inverse().to(torch.float32).apply(positions)
        angle = (normalize(T.translation.float() - positions, dim=-1) * directions).sum(-1).clamp(-1, 1).acos()
        ahead = (local[:, :2].abs() <= slopes * local[:, 2:]).all(-1) & (local[:, 2] > 0)
        shown = ahead & (sizes >= SIZE * local[:, 2]) & (angle <= cones + OBLIQUE)
        assert not torch.isin(shown.nonzero()[:, 0], found, invert=True).any()
        looked_at += len(found)
    assert looked_at < 0.25 * 40 * count or count < 20_000  # a few cells are hardly smaller than the scene


def test_each_landmark_is_in_one_cell_which_holds_it() -> None:
    positions, *others = some(5000)
    cells = LandmarkCells.of(positions, *others)
    assert torch.equal(cells.order.sort().values, torch.arange(5000))
    assert int(cells.counts.max()) <= MOST_IN_CELL
    cell = torch.arange(len(cells.counts)).repeat_interleave(cells.counts)
    apart = (positions[cells.order] - cells.centres[cell]).norm(dim=-1)
    assert bool((apart <= cells.radii[cell] + 1e-4).all())


def test_only_pairs_whose_relative_pose_has_changed_are_matched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    points, config = Points(noise=0.4), LandmarkConfig()
    tracked = track_views(ring(points), points)
    seen, positions = tracked.triangulate(config)
    matched = list[tuple[float, ...]]()

    def match(a: ImageKeypoints, b: ImageKeypoints) -> PairMatches:
        matched.append((float(a.T_ref_camera.translation[0]), float(b.T_ref_camera.translation[0])))
        return epipolar_matches(a, b)

    monkeypatch.setattr("bidnerf_core.mapping.landmarks.building.epipolar_matches", match)
    # The world moves as a whole: no pair changes.
    T = SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.3], dtype=torch.float64))
    moved = tracked.at(T @ tracked.T_world_camera)
    again = moved.rematch(config, *moved.triangulate(config))
    assert not matched
    assert torch.equal(again.observations.point, tracked.observations.point)
    # One image turns by a pixel: its pairs are matched again, and give the tracks of a matching from scratch.
    turn = torch.zeros(len(tracked.T_world_camera.translation), 6, dtype=torch.float64)
    turn[7, 4] = 1 / 300
    moved = tracked.at(tracked.T_world_camera.retract(turn))
    own = float(moved.T_world_camera.translation[7, 0])
    again = moved.rematch(config, seen, positions)
    assert len(matched) > 3
    assert all(own in pair for pair in matched)
    scratch = replace(moved, matches={}).rematch(config, seen, positions)
    assert torch.equal(again.observations.point, scratch.observations.point)
