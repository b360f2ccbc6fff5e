"""Survey of a capture: measure its photos, find those with problems, and localize the suspects among them.

Photos are linked if they share landmarks. Photos whose poses are not supported by any group of linked photos are
localized with the landmarks of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from bidnerf_core.captures.coverage import UpDirection, coverage
from bidnerf_core.captures.pose_conventions import match_pair
from bidnerf_core.captures.report import CaptureReport, PhotoProblem, PhotoRecord
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import LandmarkMatcher, Loop, Outcome
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    ENOUGH_IMAGES,
    HeldOutTrial,
    ImageKeypoints,
    TrackedKeypoints,
    TrackedViews,
    pose_updates,
    robust_covariance,
)
from bidnerf_core.training import BLURRED, are_outliers, excess, exposures, nearby_photos, photo_measures

LEAST_GROUP = 3
"""Smallest number of linked photos that form a group."""


def survey_capture(
    tracked: TrackedViews,
    views: Sequence[View],
    trial: HeldOutTrial | None = None,
    up: UpDirection | None = None,
) -> CaptureReport:
    """Return a report on the photos ``views``, whose keypoints are matched in ``tracked`` in the same order.

    If the other photos do not support the pose of a photo, their landmarks are used to localize it, both as it is
    and mirrored; this distinguishes a wrong pose from a photo of something else. ``trial`` holds the errors of
    held-out photos, and ``up`` is the upward direction of the scene, if known.
    """
    seen, positions = tracked.triangulate(DEFAULT_LANDMARKS)
    links = link_photos(seen)
    sharp, overexposed, underexposed = photo_measures(views)
    group = groups(links)
    near = nearby_photos(views, group)
    count = torch.bincount(seen.image, minlength=len(views))
    doubtful = suspects(seen, links)
    posed: dict[int, Relocation | None] = dict(_by_own_landmarks(seen, positions, views))
    posed |= dict.fromkeys(doubtful) | relocate_photos(tracked, views, doubtful)
    exposure, sharpness = exposures(views, seen), excess(sharp, near)
    compared = exposure.isfinite()
    is_badly_exposed = torch.maximum(excess(overexposed, near), excess(underexposed, near)) > 0.25
    # Training corrects differences of less than a stop.
    if bool(compared.any()):
        is_badly_exposed[compared] |= are_outliers(exposure[compared].abs(), 1.0)
    defects: dict[PhotoProblem, Tensor] = {
        "blurred": are_outliers(-sharpness, BLURRED),
        "badly exposed": is_badly_exposed,
    }
    grouped = bool((group >= 0).any())  # if no photos are linked at all, no photo is reported as unlinked
    photos = []
    for i, (view, image) in enumerate(zip(views, seen.images, strict=True)):
        relocation, pose = posed.get(i), view.T_ref_camera.to("cpu", torch.float64)
        problem = relocation.problem if relocation else None
        # A photo of another group fits that group's landmarks; an isolated photo may still have been localized.
        if problem is None and grouped and (group[i] > 0 or (group[i] < 0 and not relocation)):
            problem = "apart" if group[i] > 0 else "isolated"
        known = (
            relocation if relocation and not relocation.mirrored else None
        )  # a mirrored photo's pose cannot be compared
        metres, radians = (None, None) if known is None else known.update.view(2, 3).norm(dim=-1).tolist()
        photos.append(
            PhotoRecord(
                name=view.frame.name,
                position=(*pose.translation.tolist(),),
                direction=(*pose.rotation[:, 2].tolist(),),
                sharpness=float(sharpness[i]),
                exposure=float(exposure[i]) if compared[i] else None,
                overexposed=float(overexposed[i]),
                underexposed=float(underexposed[i]),
                keypoints=len(image.keypoints),
                landmarks=int(count[i]),
                linked=int(links.indptr[i + 1] - links.indptr[i]),
                group=int(group[i]),
                pose_translation=metres,
                pose_rotation_deg=None if radians is None else math.degrees(radians),
                pose_deviations=None if known is None else known.deviations,
                problems=(
                    *([problem] if problem else []),
                    *(name for name, has in defects.items() if has[i]),
                ),
            )
        )
    wrong = {"mirrored", "turned", "badly posed", "apart"}
    sound = [v for v, photo in zip(views, photos, strict=True) if not wrong & set(photo.problems)] or views
    low, high = exposure.nan_to_num().quantile(torch.tensor([0.1, 0.9], dtype=exposure.dtype))
    return CaptureReport(
        tuple(photos),
        coverage(sound, tracked.matched, seen, positions, up),
        trial or HeldOutTrial(),
        float(high - low),
    )


def _by_own_landmarks(
    seen: TrackedKeypoints, positions: Float[Tensor, "n 3"], views: Sequence[View]
) -> dict[int, Relocation]:
    """Compare the given poses with the poses that best fit the photos' own landmarks, relative to the scatter in this capture.

    Poses from fewer landmarks scatter more: the variance is inversely proportional to their number.
    """
    updates = pose_updates(seen, positions)
    if len(updates) < ENOUGH_IMAGES:
        return {}
    scatter = robust_covariance(torch.stack(list(updates.values())))
    depth, image = seen.sightings.in_camera(positions)[:, 2], seen.image
    count = torch.bincount(image, minlength=len(views))
    usual = float(count[list(updates)].double().median())
    relocations = {}
    for number, update in updates.items():
        own = scatter * max(1.0, usual / float(count[number]))
        deviations = float((update @ torch.linalg.pinv(own, hermitian=True) @ update).clamp(min=0).sqrt())
        relocations[number] = Relocation(
            update, deviations, image_motion(update, views[number], float(depth[image == number].median()))
        )
    return relocations


def link_photos(seen: TrackedKeypoints) -> csr_array:
    """Return the pairs of images that share enough landmarks, in both directions, as a sparse matrix (v, v).

    ``seen`` holds the keypoints consistent with their triangulated points. Five shared landmarks link two images: images of
    different places may share one by chance, but rarely two, since a match must lie on the epipolar line, stand out from
    all others, and yield a point in front of both cameras.
    """
    shows = csr_array(
        (np.ones(len(seen.point), np.int32), (seen.image.numpy(), seen.point.numpy())),
        shape=(len(seen.images), max(1, seen.count)),
    )
    shared = (shows @ shows.T).tocoo()
    row, column = shared.coords
    enough = (shared.data >= 5) & (row != column)
    return csr_array((np.ones(int(enough.sum()), bool), (row[enough], column[enough])), shape=(len(seen.images),) * 2)


def groups(links: csr_array) -> Int[Tensor, "v"]:
    """Return the group index of each image, 0 for the largest group; -1 if too few images are linked to form a group."""
    label = torch.from_numpy(connected_components(links, directed=False)[1]).long()
    sizes = torch.bincount(label)
    return torch.where(sizes >= LEAST_GROUP, sizes.argsort(descending=True, stable=True).argsort(), -1)[label]


@dataclass(frozen=True, eq=False)
class Relocation:
    """A photo's pose estimated from landmarks, compared with its given pose."""

    update: Float[Tensor, "6"]  # right update from the given pose, translation (metres) first
    deviations: float  # length of the update, in standard deviations
    pixels: float  # how far the image moves with the update
    mirrored: bool = False

    @property
    def problem(self) -> PhotoProblem | None:
        """What is wrong with the given pose, or None.

        The given pose counts as right if the photo is not mirrored and the pose is off by less than six standard deviations or less
        than four pixels, which is twice the distance allowed between a match and its epipolar line.
        """
        angle = float(torch.linalg.vector_norm(self.update[3:]))
        if self.mirrored:
            return "mirrored"
        if self.deviations < 6 or self.pixels < 4:
            return None
        # 0.9 is the smallest cosine between the axis of the rotation and the optical axis.
        about_axis = abs(float(self.update[5])) >= 0.9 * angle
        return "turned" if about_axis and math.degrees(angle) >= 60 else "badly posed"


def suspects(seen: TrackedKeypoints, links: csr_array) -> list[int]:
    """Return the indices of the photos whose given poses the others do not support, 32 at most.

    ``links`` holds the pairs of photos that share landmarks, see ``linked``.

    A photo is suspect if it belongs to no group, or if the fraction of its keypoints that are landmarks is less than half of
    what is usual in its group, unless enough linked photos agree with its pose. Photos that agree among themselves are not
    suspect even if they are linked to none of the others: a place that looks like another is more likely than the
    same error in all of them.
    """
    group = groups(links)
    if not bool((group >= 0).any()):
        return []
    keypoints = torch.tensor([len(image.keypoints) for image in seen.images])
    share = torch.bincount(seen.image, minlength=len(group)) / keypoints.clamp(min=1)
    doubtful = group < 0
    for number in range(int(group.max()) + 1):
        own = group == number
        doubtful |= own & (share < 0.5 * share[own].median())
    unsupported = [i for i in doubtful.nonzero()[:, 0].tolist() if not _has_support(seen.images, links, i)]
    # Of more than 32, an evenly spread selection is returned.
    return [unsupported[int(i * max(1.0, len(unsupported) / 32))] for i in range(min(len(unsupported), 32))]


def _has_support(images: Sequence[ImageKeypoints], links: csr_array, number: int) -> bool:
    """Return whether a photo's given pose agrees with enough linked photos to form a group with it.

    Matches are found without using the poses, so a wrong pose agrees with none of the linked photos.
    """
    poses, needed = SE3.stack([image.T_ref_camera for image in images]), LEAST_GROUP - 1
    pairs = (
        match_pair(images, number, other)
        for other in links.indices[links.indptr[number] : links.indptr[number + 1]].tolist()
    )
    agreeing = (pair for pair in pairs if pair is not None and bool(pair.agreeing(poses[None])[0]))
    return len(list(islice(agreeing, needed))) == needed


def relocate_photos(tracked: TrackedViews, views: Sequence[View], numbers: Sequence[int]) -> dict[int, Relocation]:
    """Localize the photos ``numbers`` with landmarks built without them; photos that cannot be localized are left out.

    If several poses explain a photo, as in a building with identical rooms, the pose nearest to the given
    pose is returned.
    """
    if not numbers:
        return {}
    try:
        matcher = LandmarkMatcher(tracked.without(numbers).landmarks(DEFAULT_LANDMARKS))
    except InputError:  # the other photos do not overlap
        return {}
    answers: dict[int, Relocation] = {}
    for number in numbers:
        view, features = views[number], tracked.detector_of(views[number], number)
        answer = Loop([View(view.frame, SE3.identity())], matcher, features=features)()
        # Only these outcomes determine the pose, or the poses that look the same.
        if answer is None or answer.verdict.outcome not in (Outcome.CONVERGED, Outcome.AMBIGUOUS, Outcome.MIRRORED):
            continue
        mirrored = answer.verdict.outcome is Outcome.MIRRORED
        others = [answer.posterior.place(g) for g, mode in enumerate(answer.modes) if not mode.mirrored]
        given = view.T_ref_camera.to("cpu", torch.float64).inverse()
        updates = [(given @ T).log() for T in (answer.T_world_rig, *([] if mirrored else others))]
        update = min(updates, key=lambda each: float(each[:3].norm()))
        deviations = float((update @ torch.linalg.solve(answer.covariance, update)).clamp(min=0).sqrt())
        pixels = image_motion(update, view, answer.distance)
        answers[number] = Relocation(update, deviations, pixels, mirrored)
    return answers


def image_motion(update: Float[Tensor, "6"], view: View, distance: float) -> float:
    """Return roughly how far (pixels) a pose update (metres, then radians) moves the image of a point at ``distance`` (metres)."""
    translation, rotation = (float(torch.linalg.vector_norm(part)) for part in update.split(3))
    return view.frame.intrinsics.fx * (rotation + translation / max(distance, 1e-9))
