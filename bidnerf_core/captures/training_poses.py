"""The poses used for training: the given ones, or corrected ones where the photos contradict them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures.cameras import PoseRefinement
from bidnerf_core.captures.pose_refinement import adjusted_poses
from bidnerf_core.captures.survey import linked, relocated, suspects
from bidnerf_core.frames import View
from bidnerf_core.mapping import DEFAULT_LANDMARKS, LandmarkConfig, TrackedViews

INCONSISTENT = 0.25
"""Smallest deviation (pixels) added to the keypoints by errors of the given poses at which the poses are
refined. Poses from structure from motion or a renderer add less than a tenth.
"""


@dataclass(frozen=True, eq=False)
class TrainingPoses:
    """The poses to train with, and how far they are from the given ones."""

    tracked: TrackedViews  # with these poses
    pixels: Float[Tensor, "v"]  # median shift of the points in an image; 0 if its pose was kept
    replaced: list[int]  # images whose given pose was wrong, localized with the others' landmarks
    refined: bool  # whether all poses were refined
    consistency: PoseRefinement | None  # of the given poses; None if not known


def training_poses(
    tracked: TrackedViews,
    views: Sequence[View],
    least: float = INCONSISTENT,
    config: LandmarkConfig = DEFAULT_LANDMARKS,
) -> TrainingPoses:
    """Return the poses to train with, for ``views`` whose keypoints are ``tracked``.

    A photo whose given pose no group of photos supports is moved to where the landmarks of the others place
    it. All poses are refined if errors of the given ones add at least ``least`` pixels to the deviation of the
    keypoints; otherwise they are kept.
    """
    seen, _ = tracked.triangulated(config)
    elsewhere = relocated(tracked, views, suspects(seen, linked(seen)), config)
    wrong = {i: photo for i, photo in elsewhere.items() if photo.problem in ("badly posed", "turned")}
    if wrong:
        updates = torch.zeros(len(views), 6, dtype=torch.float64)
        for number, photo in wrong.items():
            updates[number] = photo.update
        tracked = tracked.at(tracked.T_world_camera.retract(updates)).matched_anew(config)
    fit = adjusted_poses(tracked, config, least)
    pixels, refined = torch.zeros(len(views), dtype=torch.float64), False
    if fit is not None and fit[2].inconsistency >= least:
        (tracked, pixels, _), refined = fit, True
    elif fit is not None and wrong:
        poses, better = tracked.T_world_camera, fit[0].T_world_camera
        for number in wrong:
            poses.rotation[number] = better.rotation[number]
            poses.translation[number] = better.translation[number]
        tracked = tracked.at(poses).matched_anew(config)
    for number, photo in wrong.items():
        pixels[number] = photo.pixels
    return TrainingPoses(tracked, pixels, list(wrong), refined, None if fit is None else fit[2])
