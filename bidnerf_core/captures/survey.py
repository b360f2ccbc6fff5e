"""Survey of a capture: measure its photos, find those with problems, and localize the suspects among them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures.coverage import coverage
from bidnerf_core.captures.photos import blurred, exposures, nearby, photo_measures, standing_out
from bidnerf_core.captures.relocated_photos import (
    Relocation,
    groups,
    image_motion,
    linked,
    relocated,
    suspects,
)
from bidnerf_core.captures.report import CaptureReport, PhotoProblem, PhotoRecord
from bidnerf_core.captures.up_direction import UpDirection
from bidnerf_core.frames import View
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    ENOUGH_IMAGES,
    HeldOutTrial,
    LandmarkConfig,
    TrackedKeypoints,
    TrackedViews,
    pose_updates,
    robust_covariance,
)


def surveyed(
    tracked: TrackedViews,
    views: Sequence[View],
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    trial: HeldOutTrial | None = None,
    up: UpDirection | None = None,
) -> CaptureReport:
    """Return the report on a capture whose keypoints are matched in ``tracked``, in the order of ``views``.

    Photos whose poses the others do not support are localized with the landmarks of those, both as they are
    and mirrored; this distinguishes a wrong pose from a photo of something else. ``trial``
    holds the errors of held-out photos, and ``up`` is the upward direction of the scene if known.
    """
    seen, positions = tracked.triangulated(config)
    links = linked(seen)
    sharp, brightness, overexposed, underexposed = photo_measures(views)
    group = groups(links)
    near = nearby(views).within(group)
    count = torch.bincount(seen.image, minlength=len(views))
    doubtful = suspects(seen, links)
    posed: dict[int, Relocation | None] = dict(_by_own_landmarks(seen, positions, views))
    posed |= dict.fromkeys(doubtful) | relocated(tracked, views, doubtful, config)
    exposure, sharpness = exposures(views, seen, brightness, near), near.excess(sharp)
    clipped = torch.maximum(near.excess(overexposed), near.excess(underexposed))
    is_blurred = blurred(-sharpness)
    # Training corrects differences of less than a stop.
    is_badly_exposed = standing_out(exposure.abs(), 1.0) | (clipped > 0.25)
    grouped = bool((group >= 0).any())  # if no photos are linked at all, no photo is reported as unlinked
    photos = []
    for i, (view, image) in enumerate(zip(views, seen.images, strict=True)):
        found, pose, problems = posed.get(i), view.T_ref_camera.to("cpu", torch.float64), list[PhotoProblem]()
        if found and found.problem:
            problems.append(found.problem)
        # A photo of another group fits its own landmarks; an isolated one may have been localized all the same.
        elif grouped and (group[i] > 0 or (group[i] < 0 and not found)):
            problems.append("apart" if group[i] > 0 else "isolated")
        if is_blurred[i]:
            problems.append("blurred")
        if is_badly_exposed[i]:
            problems.append("badly exposed")
        record = PhotoRecord(
            view.frame.name, (*pose.translation.tolist(),), (*pose.rotation[:, 2].tolist(),),
            float(sharpness[i]), float(exposure[i]), float(overexposed[i]), float(underexposed[i]),
            len(image.keypoints), int(count[i]), int(links.indptr[i + 1] - links.indptr[i]), int(group[i]), problems=(*problems,),
        )  # fmt: skip
        if found and not found.mirrored:  # a mirrored photo's pose cannot be compared
            metres, radians = torch.linalg.vector_norm(found.update.view(2, 3), dim=-1).tolist()
            record = replace(
                record,
                pose_translation=metres,
                pose_rotation_deg=math.degrees(radians),
                pose_deviations=found.deviations,
            )
        photos.append(record)
    wrong = {"mirrored", "turned", "badly posed", "apart"}
    sound = [v for v, photo in zip(views, photos, strict=True) if not wrong & set(photo.problems)] or views
    covered = coverage(sound, tracked.matched, seen, positions, config.parallax, up)
    low, high = exposure.quantile(torch.tensor([0.1, 0.9], dtype=exposure.dtype))
    return CaptureReport(tuple(photos), covered, trial or HeldOutTrial(), float(high - low))


def _by_own_landmarks(
    seen: TrackedKeypoints, positions: Float[Tensor, "n 3"], views: Sequence[View]
) -> dict[int, Relocation]:
    """Compare the poses that fit the photos' own landmarks with the given ones, relative to the scatter in this capture.

    Poses from fewer landmarks scatter more: the variance is inversely proportional to their number.
    """
    updates = pose_updates(seen, positions)
    if len(updates) < ENOUGH_IMAGES:
        return {}
    scatter = robust_covariance(torch.stack(list(updates.values())))
    depth, image = seen.sightings.in_camera(positions)[:, 2], seen.image
    count = torch.bincount(image, minlength=len(views))
    usual = float(count[list(updates)].double().median())
    found = {}
    for number, update in updates.items():
        own = scatter * max(1.0, usual / float(count[number]))
        deviations = float((update @ torch.linalg.pinv(own, hermitian=True) @ update).clamp(min=0).sqrt())
        pixels = image_motion(update, views[number], float(depth[image == number].median()))
        found[number] = Relocation(update, deviations, pixels)
    return found
