"""The poses used for training: the given ones, or corrected ones where the photos contradict them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures.cameras import PoseConsistency
from bidnerf_core.captures.links import linked
from bidnerf_core.captures.pose_refinement import AdjustedPoses, adjusted_poses
from bidnerf_core.captures.relocated_photos import Relocation, relocated, suspects
from bidnerf_core.frames import View
from bidnerf_core.mapping import LandmarkConfig, TrackedViews

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
    consistency: PoseConsistency | None  # of the given poses; None if not known


def training_poses(
    tracked: TrackedViews,
    views: Sequence[View],
    least: float = INCONSISTENT,
    config: LandmarkConfig | None = None,
) -> TrainingPoses:
    """Return the poses to train with, for ``views`` whose keypoints are ``tracked``.

    A photo whose given pose no group of photos supports is moved to where the landmarks of the others place
    it. All poses are refined if errors of the given ones add at least ``least`` pixels to the deviation of the
    keypoints; otherwise they are kept.
    """
    config = LandmarkConfig() if config is None else config
    given = tracked.T_world_camera
    wrong = _wrongly_posed(tracked, views, config)
    if wrong:
        updates = torch.zeros(len(views), 6, dtype=torch.float64)
        for number, found in wrong.items():
            updates[number] = found.update
        tracked = tracked.at(given.retract(updates)).matched_anew(config)
    fit = adjusted_poses(tracked, config, least)
    answer = _chosen(tracked, fit, list(wrong), least)
    if wrong and fit is not None and not answer.refined:
        answer = replace(answer, tracked=answer.tracked.matched_anew(config))
    for number, found in wrong.items():
        answer.pixels[number] = found.pixels
    return answer


def _chosen(
    tracked: TrackedViews, fit: AdjustedPoses | None, wrong: list[int], least: float
) -> TrainingPoses:
    """Return the refined poses if needed, else the present ones, in which only wrong poses are replaced."""
    still = torch.zeros(len(tracked.observations.images), dtype=torch.float64)
    if fit is None:
        return TrainingPoses(tracked, still, wrong, False, None)
    if fit.consistency.inconsistency >= least:
        return TrainingPoses(fit.tracked, fit.pixels, wrong, True, fit.consistency)
    poses, better = tracked.T_world_camera, fit.tracked.T_world_camera
    for number in wrong:
        poses.rotation[number], poses.translation[number] = (
            better.rotation[number],
            better.translation[number],
        )
    return TrainingPoses(tracked.at(poses) if wrong else tracked, still, wrong, False, fit.consistency)


def _wrongly_posed(
    tracked: TrackedViews, views: Sequence[View], config: LandmarkConfig
) -> dict[int, Relocation]:
    """Return the photos, by index, that the landmarks of the others place elsewhere."""
    seen, _ = tracked.triangulated(config)
    found = relocated(tracked, views, suspects(seen, linked(seen)), config)
    return {number: photo for number, photo in found.items() if photo.problem in ("badly posed", "turned")}
