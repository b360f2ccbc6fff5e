"""Search by landmarks: poses, their covariance, rigs, unknown focal lengths, and what leads to no answer.

Points are seen without an image, so that ``propose`` is called with their detector; matching is compared with an exhaustive one.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core import SE3, Intrinsics
from bidnerf_core.localization import LandmarkMatcher, LandmarkPose, landmark_verdict, propose

# Inside: the number of false alarms, the matches around a known pose, and one verdict
from bidnerf_core.localization.landmarks.chance import log10_nfa
from bidnerf_core.localization.landmarks.correspondences import query_images
from bidnerf_core.localization.landmarks.guided import guided_matches
from bidnerf_core.mapping import LandmarkMap, build_landmarks, squared_distances
from landmark_scene import PINHOLE, Points, looking_in, ring
from refusals import refused

TRUE = looking_in(0.43, 0.45, 3.6)


@pytest.fixture(scope="module")
def exact() -> LandmarkMap:
    points = Points()
    return build_landmarks(ring(points), points)


def error(found: LandmarkPose | None, T: SE3 = TRUE) -> float:
    assert found is not None
    return float((found.T_world_camera.inverse() @ T).log().norm())


def test_an_exact_view_is_found_exactly(exact: LandmarkMap) -> None:
    points = Points()
    found = propose(LandmarkMatcher(exact), [points.view(TRUE)], points)
    assert error(found) < 1e-4
    assert found is not None
    assert found.log10_nfa < -100
    assert found.agreeing > 200
    assert found.chance < 5


def test_inliers_allow_for_the_uncertainty_of_landmarks(exact: LandmarkMap) -> None:
    """Where landmarks are less certain than keypoints, these seem free of noise; agreement must not shrink with that."""
    points = Points(noise=0.5)
    uncertain = replace(exact, deviations=torch.full_like(exact.deviations, 0.06))
    found = propose(LandmarkMatcher(uncertain), [points.view(TRUE)], points)
    assert found is not None
    assert found.noise < 0.2  # pixels, of 0.5
    assert found.inliers > 0.9 * len(found.correspondences)
    assert landmark_verdict(found).accepted


def test_a_lens_with_distortion_is_no_harder(exact: LandmarkMap) -> None:
    points = Points()
    bent = replace(PINHOLE, distortion=(0.1, -0.05, 0.001, 0.002))
    assert error(propose(LandmarkMatcher(exact), [points.view(TRUE, bent)], points)) < 1e-3


def test_a_camera_with_uneven_focal_lengths(exact: LandmarkMap) -> None:
    points = Points()
    uneven = Intrinsics(310.0, 250.0, 180.0, 160.0, 400, 300)
    assert error(propose(LandmarkMatcher(exact), [points.view(TRUE, uneven)], points)) < 1e-3


def test_in_a_moved_world_the_answer_moves(exact: LandmarkMap) -> None:
    points = Points(noise=0.3)
    view = points.view(TRUE)
    T = SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.3], dtype=torch.float64))
    moved = replace(
        exact,
        positions=T.apply(exact.positions.double()).float(),
        directions=T.rotate(exact.directions.double()).float(),
    )
    here, there = (propose(LandmarkMatcher(m), [view], points) for m in (exact, moved))
    assert here is not None
    assert error(there, T @ here.T_world_camera) < 1e-4


def test_covariance_is_that_of_many_trials(exact: LandmarkMap) -> None:
    points = Points(noise=0.5)
    matcher = LandmarkMatcher(replace(exact, correlation=1.0))  # as the noise drawn here is independent
    found = [propose(matcher, [points.view(TRUE, seed=i)], points) for i in range(40)]
    assert all(pose is not None for pose in found)
    squared = torch.tensor(
        [
            float(xi @ torch.linalg.solve(p.covariance, xi))
            for p in found
            if p is not None and (xi := (p.T_world_camera.inverse() @ TRUE).log()) is not None
        ]
    )
    assert 4.5 < float(squared.mean()) < 8.0  # of six degrees of freedom: 6
    assert float((squared < 12.59).float().mean()) > 0.87


def test_another_seed_gives_the_same_answer(exact: LandmarkMap) -> None:
    points = Points(noise=0.5, outliers=0.5)
    view, matcher = points.view(TRUE), LandmarkMatcher(exact)
    found = [propose(matcher, [view], points, seed=seed) for seed in range(5)]
    assert found[0] is not None
    for other in found[1:]:
        assert error(other, found[0].T_world_camera) < error(found[0]) / 3
    again = propose(matcher, [view], points, seed=0)
    assert error(again, found[0].T_world_camera) == 0


def test_a_rig_is_found_where_its_last_camera_is(exact: LandmarkMap) -> None:
    points = Points(noise=0.5)
    others = [looking_in(0.2), looking_in(0.7, 0.0)]
    T_ref_world = SE3.exp(torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, 0.3], dtype=torch.float64))
    views = [points.view(T, T_ref_camera=T_ref_world @ T, seed=i) for i, T in enumerate([*others, TRUE])]
    matcher = LandmarkMatcher(exact)
    together, alone = propose(matcher, views, points), propose(matcher, views[-1:], points)
    assert together is not None
    assert alone is not None
    assert error(together) < 0.005
    assert sorted(together.correspondences.view.unique().tolist()) == [0, 1, 2]
    assert float(torch.linalg.det(together.covariance)) < float(torch.linalg.det(alone.covariance))


def test_a_rig_whose_cameras_are_in_one_place_is_found_too(exact: LandmarkMap) -> None:
    points = Points(noise=0.3)
    turned = TRUE @ SE3.exp(torch.tensor([0, 0, 0, 0.0, 0.2, 0.0], dtype=torch.float64))
    views = [points.view(turned), points.view(TRUE, seed=1)]
    assert error(propose(LandmarkMatcher(exact), views, points)) < 0.01


def test_measured_depth_removes_what_it_contradicts_and_tells_its_scale(exact: LandmarkMap) -> None:
    points = Points(noise=0.2)
    view = points.view(TRUE, depth=1.03)
    assert view.frame.depth is not None
    view.frame.depth[:, :100] *= 1.5
    found = propose(LandmarkMatcher(exact), [view], points)
    assert error(found) < 0.01
    assert found is not None
    assert found.depth_scale == pytest.approx(1 / 1.03, rel=0.005)
    assert not bool((found.pixels[:, 0] < 98).any())


def test_a_blank_image_has_no_pose(exact: LandmarkMap) -> None:
    points = Points(count=1)
    points.descriptors = Points().descriptors[:1]
    far = looking_in(0.0, distance=4.0) @ SE3.exp(torch.tensor([0, 0, -1.0, 3.1, 0, 0], dtype=torch.float64))
    assert propose(LandmarkMatcher(exact), [points.view(far)], points) is None


def test_an_empty_map_has_no_pose(exact: LandmarkMap) -> None:
    points = Points()
    matcher = LandmarkMatcher(exact[torch.tensor([], dtype=torch.long)])
    assert propose(matcher, [points.view(TRUE)], points) is None


def test_what_cannot_be_asked_is_refused(exact: LandmarkMap) -> None:
    points = Points()
    matcher = LandmarkMatcher(exact)
    with refused(expected="at least one view"):
        propose(matcher, [], points)


def test_few_agreements_among_many_matches_are_chance() -> None:
    assert log10_nfa(500, 5, 1e-3) > 0
    assert log10_nfa(500, 50, 1e-3) < -40
    assert log10_nfa(500, 51, 1e-3) < log10_nfa(500, 50, 1e-3)


def many(count: int) -> LandmarkMap:
    generator = torch.Generator().manual_seed(3)
    middles = torch.randint(20, 200, (count // 20, 128), generator=generator)
    spread = torch.randint(-20, 21, (count, 128), generator=generator)
    descriptors = (middles.repeat_interleave(20, 0) + spread).clamp(0, 255).byte()
    ones = torch.ones(count)
    return LandmarkMap(
        torch.rand(count, 3, generator=generator), torch.ones(count, 2), descriptors,
        torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1), ones, ones, ones.int(), 0.5,
        torch.zeros((6, 6), dtype=torch.float64),
    )  # fmt: skip


def test_few_landmarks_are_compared_exactly() -> None:
    landmarks = many(600)
    queries = landmarks.descriptors[::7]
    distances, index = LandmarkMatcher(landmarks).nearest(queries, 3)
    expected = squared_distances(queries, landmarks.descriptors).topk(3, largest=False)
    assert torch.equal(distances, expected.values)
    assert torch.equal(index[:, 0], torch.arange(0, 600, 7))
    assert torch.equal(squared_distances(queries, landmarks.descriptors).gather(1, index), distances)


def test_many_landmarks_are_found_by_their_cells() -> None:
    landmarks = many(40_000)
    queries = landmarks.descriptors[::50]
    distances, index = LandmarkMatcher(landmarks, seed=1).nearest(queries, 2)
    assert float((index[:, 0] == torch.arange(0, 40_000, 50)).float().mean()) > 0.99
    exact = squared_distances(queries, landmarks.descriptors)
    assert torch.equal(exact.gather(1, index), distances)
    assert float((exact.topk(2, largest=False).values == distances).float().mean()) > 0.9


def test_fewer_landmarks_than_asked_for_are_filled_up_with_infinity() -> None:
    distances, index = LandmarkMatcher(many(20)[torch.arange(2)]).nearest(many(20).descriptors[:3], 4)
    assert bool(distances[:, 2:].isinf().all())
    assert bool((index < 2).all())


def test_guided_matching_finds_the_same_with_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    points, truth = Points(count=600, noise=0.3), looking_in(0.43)
    landmarks, image = build_landmarks(ring(points), points), query_images([points.view(truth)], points)

    def matches(known: LandmarkMap) -> list[list[int]]:
        found = guided_matches(image, known, truth, radius=5.0, most_distance=200.0**2)
        return sorted(torch.stack([found.keypoint, found.landmark], dim=-1).tolist())

    assert landmarks.cells is None
    plain = matches(landmarks)
    assert len(plain) > 50
    monkeypatch.setattr("bidnerf_core.mapping.landmarks.landmark_map.FEW", 10)
    assert replace(landmarks).cells is not None
    assert matches(replace(landmarks)) == plain
