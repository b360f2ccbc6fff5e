"""Photos of a capture with suspicious poses, localized with the landmarks of the other photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from bidnerf_core.captures.links import LEAST_GROUP, groups
from bidnerf_core.captures.pose_conventions import matched_pair
from bidnerf_core.captures.report import PhotoProblem, PhotoRecord
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import MIRROR, Answer, LandmarkMatcher, Loop, Outcome
from bidnerf_core.mapping import ImageKeypoints, LandmarkConfig, TrackedKeypoints, TrackedViews

TELLING = (Outcome.CONVERGED, Outcome.AMBIGUOUS, Outcome.MIRRORED)
"""Outcomes of a localization that determine the pose, or which poses look the same."""
SUSPECT = 0.5
"""A photo is suspect if the fraction of its keypoints that are landmarks is below this multiple of the median
of its group."""
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


def suspects(seen: TrackedKeypoints, links: csr_array) -> list[int]:
    """Return the photos whose given poses the others do not support; ``links`` are those of ``linked``.

    A photo is suspect if it belongs to no group, or shows far fewer landmarks than is usual in its group,
    unless enough photos agree with its pose. Photos that agree among themselves are not suspect even if they
    are linked to none of the others: a place that looks like another is more likely than the same error in
    all of them.
    """
    group = groups(links)
    if not bool((group >= 0).any()):
        return []
    keypoints = torch.tensor([len(image.keypoints) for image in seen.images])
    share = torch.bincount(seen.image, minlength=len(group)) / keypoints.clamp(min=1)
    doubtful = group < 0
    for number in range(int(group.max()) + 1):
        own = group == number
        doubtful |= own & (share < SUSPECT * share[own].median())
    found = [i for i in doubtful.nonzero()[:, 0].tolist() if not _has_support(seen.images, links, i)]
    step = max(1.0, len(found) / MOST_SUSPECTS)
    return [found[int(i * step)] for i in range(min(len(found), MOST_SUSPECTS))]


def _has_support(images: Sequence[ImageKeypoints], links: csr_array, number: int) -> bool:
    """Return whether a photo's given pose agrees with as many linked photos as make a group with it.

    Their matches are found without the poses, so that wrong ones agree with none of them.
    """
    poses, needed = SE3.stack([image.T_ref_camera for image in images]), LEAST_GROUP - 1
    for other in links.indices[links.indptr[number] : links.indptr[number + 1]].tolist():
        pair = matched_pair(images, number, other)
        needed -= pair is not None and bool(pair.agreeing(poses[None])[0])
        if not needed:
            return True
    return False


def relocated(
    tracked: TrackedViews,
    views: Sequence[View],
    numbers: Sequence[int],
    config: LandmarkConfig,
) -> dict[int, Relocation]:
    """Localize the suspects with landmarks built without them.

    Of several poses that explain a photo, as in a building with identical rooms, the one nearest to the given
    pose is taken.
    """
    if not numbers:
        return {}
    try:
        matcher = LandmarkMatcher(tracked.without(numbers).landmarks(config))
    except InputError:  # the rest has no overlap
        return {}
    answers: dict[int, Relocation] = {}
    for number in numbers:
        features = tracked.detector_of(views[number], number)
        found = Loop([View(views[number].frame, SE3.identity())], matcher, features=features)()
        if found is not None and found.verdict.outcome in TELLING:
            answers[number] = _compared(found, views[number])
    return answers


def _compared(found: Answer, view: View) -> Relocation:
    T, mirrored = view.T_ref_camera.to("cpu", torch.float64), found.verdict.outcome is Outcome.MIRRORED
    places = [found.posterior.place(g) for g, mode in enumerate(found.modes) if mode.name != MIRROR]
    poses = [found.T_world_rig] if mirrored else [found.T_world_rig, *places]
    update = min(((T.inverse() @ pose).log() for pose in poses), key=lambda each: float(each[:3].norm()))
    deviations = float((update @ torch.linalg.solve(found.covariance, update)).clamp(min=0).sqrt())
    return Relocation(update, deviations, image_motion(update, view, found.distance), mirrored)


def image_motion(update: Float[Tensor, "6"], view: View, distance: float) -> float:
    """Return how far (pixels, at most) an update of the pose moves the image of a point at ``distance``
    (metres).
    """
    translation, rotation = (float(torch.linalg.vector_norm(part)) for part in update.split(3))
    return view.frame.intrinsics.fx * (rotation + translation / max(distance, 1e-9))
