"""Landmarks as named tensors: there and back, and what is not a map is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.localization import LandmarkMatcher
from bidnerf_core.mapping import LandmarkMap, build_landmarks, landmark_tensors, landmarks_from_tensors
from landmark_scene import Points, ring


@pytest.fixture(scope="module")
def landmarks() -> LandmarkMap:
    points = Points(count=60, noise=0.2)
    return build_landmarks(ring(points), points)


def test_there_and_back(landmarks: LandmarkMap) -> None:
    tensors = landmark_tensors(landmarks)
    again = landmark_tensors(landmarks_from_tensors(tensors))
    assert tensors.keys() == again.keys()
    assert all(torch.equal(tensors[name], again[name]) for name in tensors)
    assert landmarks_from_tensors(tensors).noise == landmarks.noise


def test_no_landmarks_at_all_are_a_map(landmarks: LandmarkMap) -> None:
    assert len(landmarks_from_tensors(landmark_tensors(landmarks[torch.tensor([], dtype=torch.long)]))) == 0


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("positions", lambda v: torch.full_like(v, torch.nan), "positions holds NaN"),
        ("positions", lambda v: v[:, :2], "positions is"),
        ("positions", lambda v: v.double(), "float64"),
        ("deviations", lambda v: v[1:], "deviations has"),
        ("deviations", lambda v: -v, "deviations is"),
        ("descriptors", lambda v: v[:, :0], "no channels"),
        ("descriptors", lambda v: v.float(), "descriptors is torch.float32"),
        ("directions", lambda v: 2 * v, "unit length"),
        ("cones", lambda v: v + 4, "cones is"),
        ("positions", lambda v: torch.full_like(v, 3e38), "positions is 3e\\+38"),
        ("deviations", lambda v: torch.full_like(v, 3e38), "deviations is 3e\\+38"),
        ("sizes", lambda v: -1 - v, "sizes is"),
        ("views", lambda v: v - v, "views is"),
        ("noise", torch.zeros_like, "noise is 0"),
        ("usual_matches", lambda v: v - 1, "usual_matches is -1"),
        ("pose_covariance", lambda v: v - torch.eye(6), "positive semidefinite"),
        ("pose_covariance", lambda v: v + torch.arange(6.0), "symmetric"),
    ],
)
def test_what_is_no_map_is_refused(landmarks: LandmarkMap, name: str, change, said: str) -> None:
    tensors = landmark_tensors(landmarks)
    with pytest.raises(ValueError, match=said):
        landmarks_from_tensors(tensors | {name: change(tensors[name])})


@pytest.mark.parametrize("name", ["positions", "noise", "views"])
def test_a_missing_tensor_is_named(landmarks: LandmarkMap, name: str) -> None:
    tensors: dict[str, Tensor] = landmark_tensors(landmarks)
    del tensors[name]
    with pytest.raises(KeyError, match=name):
        landmarks_from_tensors(tensors)


def test_correlation_grows_with_the_square_root_of_the_matches_where_the_usual_number_is_known(
    landmarks: LandmarkMap,
) -> None:
    unknown = replace(landmarks, correlation=17.0)
    assert unknown.correlation_of(25) == unknown.correlation_of(400) == 17
    known = replace(unknown, usual_matches=400.0)
    assert [known.correlation_of(n) for n in (0, 25, 100, 400, 1600)] == [1, 5, 9, 17, 33]
    assert replace(known, correlation=1.0).correlation_of(25) == 1


@pytest.mark.parametrize("channels", [1, 7, 129, 4096])
def test_descriptors_of_another_detector_are_named_when_they_meet(
    landmarks: LandmarkMap, channels: int
) -> None:
    other = replace(landmarks, descriptors=torch.zeros((len(landmarks), channels), dtype=torch.uint8))
    with pytest.raises(InputError, match=f"descriptors have {channels} channels, those of the image"):
        LandmarkMatcher(other).nearest(landmarks.descriptors, 2)
