"""Photos of a capture with suspicious poses, localized with the landmarks of the other photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.captures.report import PhotoProblem, PhotoRecord
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import LandmarkMatcher, LandmarkPose, landmark_verdict, mirror_image, propose
from bidnerf_core.mapping import LandmarkConfig, TrackedKeypoints, TrackedViews

SUSPECT = 0.5
"""A photo is suspect if the fraction of its keypoints that are landmarks is below this multiple of the
capture's median."""
MOST_SUSPECTS = 32
"""Largest number of photos that are relocalized."""
POSE_DEVIATIONS, POSE_PIXELS = 6.0, 4.0
"""Standard deviations, and pixels of image motion, by which a bad pose differs at least from the pose given
by landmarks.

The latter is twice as far as a match may lie from its epipolar line.
"""
TURNED_ANGLE = 60.0
"""Smallest rotation about the optical axis, in degrees, at which a photo counts as rotated rather than badly
posed."""
ALONG_AXIS = 0.9
"""Smallest cosine between that rotation's axis and the optical axis."""


@dataclass(frozen=True, eq=False)
class Relocation:
    """A photo's pose from other photos' landmarks, compared with the given one."""

    update: Float[Tensor, "6"]  # right update from the given pose, translation (metres) first
    deviations: float  # length of the update, in standard deviations
    pixels: float  # how far the image moves with the update
    mirrored: bool = False

    @property
    def problem(self) -> PhotoProblem | None:
        angle = float(torch.linalg.vector_norm(self.update[3:]))
        if self.mirrored:
            return "mirrored"
        if self.deviations < POSE_DEVIATIONS or self.pixels < POSE_PIXELS:
            return None
        about_axis = abs(float(self.update[5])) >= ALONG_AXIS * angle
        return "turned" if about_axis and math.degrees(angle) >= TURNED_ANGLE else "badly posed"

    def onto(self, record: PhotoRecord) -> PhotoRecord:
        """Return the record with the error of its given pose filled in; a mirrored photo's pose cannot be
        compared.
        """
        if self.mirrored:
            return record
        translation, rotation = (float(torch.linalg.vector_norm(part)) for part in self.update.split(3))
        return replace(
            record, pose_translation=translation, pose_rotation_deg=math.degrees(rotation),
            pose_deviations=self.deviations,
        )  # fmt: skip


def suspects(seen: TrackedKeypoints, count: Int[Tensor, "v"], group: Int[Tensor, "v"]) -> list[int]:
    """Return the photos outside the largest group, and those with unusually few keypoints among the
    landmarks.
    """
    keypoints = torch.tensor([len(image.keypoints) for image in seen.images])
    share = count / keypoints.clamp(min=1)
    main = group == 0
    if not bool(main.any()):
        return []
    found = (~main | (share < SUSPECT * share[main].median())).nonzero()[:, 0].tolist()
    step = max(1.0, len(found) / MOST_SUSPECTS)
    return [found[int(i * step)] for i in range(min(len(found), MOST_SUSPECTS))]


def relocated(
    tracked: TrackedViews,
    views: Sequence[View],
    numbers: Sequence[int],
    config: LandmarkConfig,
) -> dict[int, Relocation]:
    """Localize the suspects with landmarks built without them, as they are and then mirrored."""
    if not numbers:
        return {}
    try:
        matcher = LandmarkMatcher(tracked.without(numbers).landmarks(config))
    except InputError:  # the rest has no overlap
        return {}
    answers: dict[int, Relocation] = {}
    for number in numbers:
        features = tracked.detector_of(views[number], number)
        for mirrored in (False, True):
            view = views[number]
            if mirrored:
                view = replace(view, frame=mirror_image(view.frame))
            found = propose(matcher, [View(view.frame, SE3.identity())], features)
            if found is not None and landmark_verdict(found).accepted:
                answers[number] = _compared(found, views[number], mirrored)
                break
    return answers


def _compared(found: LandmarkPose, view: View, mirrored: bool) -> Relocation:
    T = view.T_ref_camera.to("cpu", torch.float64)
    update = (T.inverse() @ found.T_world_camera).log()
    deviations = float((update @ torch.linalg.solve(found.full_covariance, update)).clamp(min=0).sqrt())
    return Relocation(update, deviations, image_motion(update, view, found.distance), mirrored)


def image_motion(update: Float[Tensor, "6"], view: View, distance: float) -> float:
    """Return how far (pixels, at most) an update of the pose moves the image of a point at ``distance``
    (metres).
    """
    translation, rotation = (float(torch.linalg.vector_norm(part)) for part in update.split(3))
    return view.frame.intrinsics.fx * (rotation + translation / max(distance, 1e-9))
