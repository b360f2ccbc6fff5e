"""Which keypoints of an image agree with which landmarks of the map, from the record of a localization."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.localization import LandmarkAnswer, Localization, SearchRecord, same_pose


def landmark_matches(answer: LandmarkAnswer) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"], Bool[Tensor, "m"], int]:
    """Return the last image's keypoints and their landmarks at a pose, and whether each lies within three standard deviations.

    Matches by projection come first; those that were found by descriptors alone, whose number is returned too, do not agree.
    """
    mode, best = answer.mode, answer.posterior.best
    query, matches = mode.query, mode.matches
    agree = answer.landmarks.residuals(answer.posterior.states[best : best + 1])[0][0, : len(matches)] <= 9
    refused = mode.by_descriptors[~torch.isin(mode.by_descriptors.keypoint, matches.keypoint)]
    keypoint = torch.cat([matches.keypoint, refused.keypoint])
    landmark = torch.cat([matches.landmark, refused.landmark])
    agree = torch.cat([agree, torch.zeros(len(refused), dtype=torch.bool)])
    is_last = query.view[keypoint] == len(query.images) - 1
    return keypoint[is_last], landmark[is_last], agree[is_last], int(is_last[len(matches) :].sum())


def is_pose_of(localization: Localization, answer: LandmarkAnswer) -> bool:
    """Return whether the pose from landmarks is the pose found."""
    T, other = localization.T_world_camera.to("cpu", torch.float64), answer.T_world_rig.to("cpu", torch.float64)
    return bool(same_pose(T, other[None], torch.tensor([0.0, 0.0, answer.distance], dtype=torch.float64)))


def agreeing_matches(
    localization: Localization, record: SearchRecord, camera: Intrinsics
) -> tuple[Float[Tensor, "m 2"], Int[Tensor, "m"]] | None:
    """Return the pixels (of ``camera``, the last image's) that agree with landmarks, and their indices; None if no landmark gave the pose."""
    if not record.answers or not is_pose_of(localization, record.answers[-1]):
        return None
    answer = record.answers[-1]
    keypoint, landmark, agree, _ = landmark_matches(answer)
    query = answer.mode.query
    scale = torch.tensor([camera.width / query.camera.width, camera.height / query.camera.height])
    return query.keypoints.pixels[keypoint[agree]] * scale, landmark[agree].int()
