"""Matches of keypoints with landmarks: by descriptors, by projection, in a mirror, and how many agree by chance."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf import SE3, Frame, Intrinsics, View
from bidnerf.testing import unseen
from bidnerf_core.devices import move_to
from bidnerf_core.localization import LandmarkMatcher

# Inside: the matches, of which answers show only the number
from bidnerf_core.localization.matching import (
    STRONGEST,
    Matches,
    Nearest,
    Projected,
    QueryKeypoints,
    log10_nfa,
)
from bidnerf_core.mapping import LandmarkMap, Sift, States, Tracks, build_landmarks, squared_distances
from conditions import COPY, PINHOLE, point_landmarks, point_view, points, twice
from landmark_scene import Points, looking_in, ring
from refusals import refused
from simulated_device import DEVICE, Elsewhere

TRUE = looking_in(0.43, 0.45, 3.6)
NO_CORRECTION = torch.zeros(6, dtype=torch.float64)


def query(*views: View, seen: Points) -> QueryKeypoints:
    last = views[-1].T_ref_camera.inverse()
    return QueryKeypoints.of([replace(view, T_ref_camera=last @ view.T_ref_camera) for view in views], seen)


def pairs(found: Matches) -> set[tuple[int, int]]:
    return set(zip(found.keypoint.tolist(), found.landmark.tolist(), strict=True))


def errors(query: QueryKeypoints, landmarks: LandmarkMap, found: Matches, T: SE3) -> torch.Tensor:
    """Return the distances (pixels) of keypoints from their landmarks' projections in the only image."""
    seen = PINHOLE.project(T.inverse().apply(landmarks.positions[found.landmark].double()))
    return (seen - query.keypoints.pixels[found.keypoint]).norm(dim=-1)


# By descriptors: an exhaustive search, or an inverted file


def many(count: int) -> LandmarkMap:
    generator = torch.Generator().manual_seed(3)
    middles = torch.randint(20, 200, (count // 20, 128), generator=generator)
    spread = torch.randint(-20, 21, (count, 128), generator=generator)
    descriptors = (middles.repeat_interleave(20, 0) + spread).clamp(0, 255).byte()
    ones = torch.ones(count)
    return LandmarkMap(
        torch.rand(count, 3, generator=generator),
        torch.ones(count, 2),
        descriptors,
        torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1),
        ones,
        ones,
        ones.int(),
        0.5,
        torch.zeros((6, 6), dtype=torch.float64),
    )


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
    distances, index = LandmarkMatcher(landmarks).nearest(queries, 2)
    assert float((index[:, 0] == torch.arange(0, 40_000, 50)).float().mean()) > 0.99
    exact = squared_distances(queries, landmarks.descriptors)
    assert torch.equal(exact.gather(1, index), distances)
    assert float((exact.topk(2, largest=False).values == distances).float().mean()) > 0.9


def test_queries_of_a_large_map_meet_the_landmarks_of_similar_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two look-alike places are both searched, an unknown one among all landmarks."""
    monkeypatch.setattr("bidnerf_core.localization.matching.MANY_LANDMARKS", 5000)
    generator = torch.Generator().manual_seed(0)

    def noisy(descriptors: torch.Tensor) -> torch.Tensor:
        return (descriptors + torch.randint(-9, 10, descriptors.shape, generator=generator)).clamp(0, 255).byte()

    drawn = torch.randint(0, 256, (8000, 128), generator=generator)
    seen = drawn[1000:1100].clone()
    drawn[1000:1100], drawn[7000:7100] = noisy(seen), noisy(seen)  # by images 10 and 70
    image = torch.arange(8000) // 100
    order = torch.randperm(8000, generator=generator)  # of an extended map, whose tracks are not in the order of images
    landmarks = replace(
        many(8000),
        descriptors=drawn.byte(),
        tracks=Tracks(order.int(), image[order].int(), torch.zeros(8000, 2)),
    )
    matcher = LandmarkMatcher(landmarks)
    query = noisy(seen)
    distance, index = matcher.nearest(query, 4)
    assert set(image[index].flatten().tolist()) == {10, 70}
    alike = torch.cat([torch.arange(1000, 1100), torch.arange(7000, 7100)])
    expected = squared_distances(query, landmarks.descriptors[alike]).topk(4, largest=False)
    assert torch.equal(distance, expected.values)
    assert torch.equal(index, alike[expected.indices])
    unknown = torch.randint(0, 256, (100, 128), generator=generator).byte()
    monkeypatch.setattr("bidnerf_core.localization.matching.VOTERS", 20)  # chance votes stay below the least
    everywhere = matcher.nearest(unknown, 4)
    assert len(image[everywhere[1]].unique()) > 40


def test_products_in_half_precision_find_the_nearest_but_for_near_ties() -> None:
    """The host waits once, and distances are exact."""
    landmarks = many(600)
    queries = (landmarks.descriptors[::2].int() + 3).clamp(max=255).byte()
    expected = LandmarkMatcher(landmarks).nearest(queries, 3)
    with Elsewhere() as mode:
        matcher = LandmarkMatcher(move_to(landmarks, DEVICE))
        mode.waits.clear()
        distances, index = matcher.nearest(queries, 3)
        assert mode.waits == {"_to_copy": 2}
    exact = squared_distances(queries, landmarks.descriptors)
    assert torch.equal(exact.gather(1, index), distances)
    assert float((distances == expected[0]).float().mean()) > 0.99
    assert torch.equal(index[:, 0], expected[1][:, 0])


def test_fewer_landmarks_than_wanted_are_filled_up_with_infinity() -> None:
    distances, index = LandmarkMatcher(many(20)[torch.arange(2)]).nearest(many(20).descriptors[:3], 4)
    assert bool(distances[:, 2:].isinf().all())
    assert bool((index < 2).all())


def test_descriptors_of_another_detector_are_refused() -> None:
    with refused(found="the map's descriptors have 128 channels, those of the image 64"):
        LandmarkMatcher(many(20)).nearest(many(20).descriptors[:, :64], 2)


def test_the_strongest_keypoints_of_each_view_are_looked_up() -> None:
    seen, landmarks = points(), point_landmarks()
    both = query(point_view(seen, looking_in(0.2)), point_view(seen, TRUE, seed=1), seen=seen)
    found = Nearest.of(both, LandmarkMatcher(landmarks), 50)
    assert [int((both.view[found.keypoint] == v).sum()) for v in (0, 1)] == [50, 50]
    second = int((both.view == 0).sum())
    assert found.keypoint.tolist() == [*range(50), *range(second, second + 50)]


def test_unambiguous_matches_come_first_and_are_filled_up_if_they_are_few() -> None:
    seen, landmarks = points(), point_landmarks()
    image = query(point_view(seen, TRUE, wrong=0.3), seen=seen)
    found = Nearest.of(image, LandmarkMatcher(landmarks), STRONGEST)
    order = found.ambiguity.argsort(stable=True)
    assert torch.equal(found.best.keypoint, found.keypoint[order[: len(found.best)]])
    assert float((errors(image, landmarks, found.best, TRUE) < 5).double().mean()) > 0.6
    both = landmarks[torch.arange(len(landmarks)).repeat(2)]
    both.positions[len(landmarks) :] += 30
    both.descriptors.bitwise_xor_(1)  # neither is exactly that of the keypoint
    unsure = Nearest.of(image, LandmarkMatcher(both), STRONGEST)
    assert bool((unsure.ambiguity == 1).all())
    assert len(unsure.best) == 60


def test_landmarks_of_another_place_that_look_the_same_are_the_other_matches() -> None:
    seen, landmarks = points(), twice(point_landmarks())
    image = query(point_view(seen, TRUE), seen=seen)
    found = Nearest.of(image, LandmarkMatcher(landmarks), STRONGEST)
    here = found.landmark < len(landmarks) // 2
    others = found.others(near=here)
    assert len(others) > 100
    assert bool((others.landmark >= len(landmarks) // 2).all())
    right = errors(image, landmarks, others, COPY @ TRUE) < 5
    assert float(right.double().mean()) > 0.8


# By projection


def projected(image: QueryKeypoints, landmarks: LandmarkMap, T: SE3 = TRUE, margin: float = 10.0) -> Projected:
    return Projected(image, landmarks, States.known(T, NO_CORRECTION), margin)


def test_projection_finds_the_landmarks_of_most_keypoints_and_few_by_chance() -> None:
    seen, landmarks = points(), point_landmarks()
    image = query(point_view(seen, TRUE), seen=seen)
    there = projected(image, landmarks)
    found = there.matches(5.0)
    assert len(found) > 0.9 * min(len(image.view), there.visible)
    assert bool((errors(image, landmarks, found, TRUE) <= 5).all())
    assert len(there.matches(5.0, shift=40.0)) < 0.1 * len(found)
    assert pairs(there.matches(1.0)) <= pairs(found)


def test_each_view_matches_a_landmark_once_and_a_rig_as_its_images_do() -> None:
    seen, landmarks = points(), point_landmarks()
    views = [point_view(seen, T, seed=i) for i, T in enumerate((looking_in(0.2, 0.6, 4.0), TRUE))]
    rig = query(*views, seen=seen)
    found = projected(rig, landmarks).matches(5.0)
    for number in (0, 1):
        own = found[rig.view[found.keypoint] == number]
        assert len(own.landmark.unique()) == len(own)
        alone = projected(query(views[number], seen=seen), landmarks, views[number].T_ref_camera).matches(5.0)
        first = int((rig.view < number).sum())
        assert {(k - first, i) for k, i in pairs(own)} == pairs(alone)


def test_a_landmark_that_two_keypoints_claim_goes_to_the_more_similar_one() -> None:
    seen, landmarks = points(), point_landmarks()
    view = point_view(seen, TRUE)
    before = projected(query(view, seen=seen), landmarks).matches(5.0)
    own = seen.seen[-1]
    nearby = replace(own[slice(0, 20)], pixels=own.pixels[:20] + 1)
    worse = (nearby.descriptors.int() + 6 * torch.randint(-1, 2, nearby.descriptors.shape)).clamp(0, 255).byte()
    parts = [
        torch.cat([getattr(own, n), value])
        for n, value in (("pixels", nearby.pixels), ("sizes", nearby.sizes), ("descriptors", worse))
    ]
    seen.seen[-1] = type(own)(*parts)
    assert pairs(projected(query(view, seen=seen), landmarks).matches(5.0)) <= pairs(before)


def test_hidden_pixels_show_no_landmark() -> None:
    seen, landmarks = points(), point_landmarks()
    view = point_view(seen, TRUE)
    hidden = torch.zeros((PINHOLE.height, PINHOLE.width), dtype=torch.bool)
    hidden[:, : PINHOLE.width // 2] = True
    covered = replace(view, frame=replace(view.frame, hidden=hidden))
    whole, half = (projected(query(v, seen=seen), landmarks) for v in (view, covered))
    assert 0.2 * whole.visible < half.visible < 0.8 * whole.visible


def test_a_later_round_looks_among_the_landmarks_of_the_first() -> None:
    seen, landmarks = points(), point_landmarks()
    image = query(point_view(seen, TRUE), seen=seen)
    first, state = projected(image, landmarks), States.known(TRUE, NO_CORRECTION)
    again = Projected(image, landmarks, state, 10.0, first)
    assert pairs(again.matches(5.0)) == pairs(first.matches(5.0))
    assert again.visible == first.visible


def test_a_larger_map_whose_landmarks_are_in_cells_gives_the_same_matches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = Points(count=600, noise=0.3)
    landmarks = build_landmarks(ring(seen), seen)
    image = query(seen.view(TRUE), seen=seen)
    assert landmarks.cells is None
    plain = projected(image, landmarks).matches(5.0)
    assert len(plain) > 50
    monkeypatch.setattr("bidnerf_core.mapping.landmarks.landmark_map.FEW", 10)
    assert replace(landmarks).cells is not None
    assert pairs(projected(image, replace(landmarks)).matches(5.0)) == pairs(plain)


# In a mirror


def test_descriptors_of_a_mirrored_image_are_permuted_ones() -> None:
    frame = unseen().frame
    height, width, _ = frame.rgb.shape
    camera = Intrinsics(120.0, 118.0, 60.0, 50.0, width, height)
    image = QueryKeypoints.of([View(replace(frame, intrinsics=camera), SE3.identity())], Sift())
    flipped = Frame("flipped", frame.rgb.flip(1), replace(camera, cx=camera.width - camera.cx))
    expected = QueryKeypoints.of([View(flipped, SE3.identity())], Sift())
    found = image.mirrored
    assert found.camera == expected.camera
    distance = torch.cdist(found.keypoints.pixels, expected.keypoints.pixels)
    sizes = (found.keypoints.sizes[:, None] / expected.keypoints.sizes).log().abs()
    nearest, other = torch.where(sizes < 0.1, distance, torch.inf).min(1)
    same = nearest < 0.7
    assert float(same.double().mean()) > 0.7
    difference = (found.keypoints.descriptors[same].float() - expected.keypoints.descriptors[other[same]].float()).norm(
        dim=-1
    )
    unrelated = (found.keypoints.descriptors.float() - expected.keypoints.descriptors.float().mean(0)).norm(dim=-1)
    assert float((difference < 0.5 * unrelated.median()).double().mean()) > 0.7
    torch.testing.assert_close(found.sights.image[same], expected.sights.image[other[same]], rtol=0, atol=0.01)


# By chance


def test_fewer_agreements_among_more_matches_are_likelier_by_chance() -> None:
    assert log10_nfa(500, 5, 1e-3) > 0
    assert log10_nfa(500, 50, 1e-3) < -40
    by_count = [log10_nfa(500, count, 1e-3) for count in range(10, 501, 10)]
    assert by_count == sorted(by_count, reverse=True)
    by_matches = [log10_nfa(count, 50, 1e-3) for count in range(50, 501, 50)]
    assert by_matches == sorted(by_matches)
    by_probability = [log10_nfa(500, 50, p) for p in (1e-4, 1e-3, 1e-2, 0.1)]
    assert by_probability == sorted(by_probability)
    assert log10_nfa(500, 3, 1e-3) == 0
