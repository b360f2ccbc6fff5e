"""Survey of a capture: measure its photos, find those with problems, and localize the suspects among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.captures.coverage import coverage
from bidnerf_core.captures.photos import (
    LEAST_BLUR,
    Nearby,
    PhotoMeasures,
    above_neighbours,
    exposures,
    nearby,
    photo_measures,
    standing_out,
)
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

NOT_TRIED = HeldOutTrial()
LEAST_EXPOSURE = 1.0
"""Smallest difference, in stops, of a badly exposed photo from the median exposure; training corrects smaller
ones."""
CLIPPED = 0.25
"""Largest excess of a photo's fraction of clipped pixels over that of its neighbours."""


def surveyed(
    tracked: TrackedViews,
    views: Sequence[View],
    config: LandmarkConfig = DEFAULT_LANDMARKS,
    trial: HeldOutTrial = NOT_TRIED,
    up: UpDirection | None = None,
) -> CaptureReport:
    """Return the report on a capture whose keypoints are matched in ``tracked``, in the order of ``views``.

    Photos whose poses the others do not support are localized with the landmarks of those, both as they are
    and mirrored; this distinguishes a wrong pose from a photo of something else. ``trial``
    holds the errors of held-out photos, and ``up`` is the upward direction of the scene if known.
    """
    seen, positions = tracked.triangulated(config)
    links, measures = linked(seen), photo_measures(views)
    group = groups(links)
    near = nearby(views).within(group)
    count = torch.bincount(seen.image, minlength=len(views))
    doubtful = suspects(seen, links)
    posed: dict[int, Relocation | None] = dict(_by_own_landmarks(seen, positions, views))
    posed |= dict.fromkeys(doubtful) | relocated(tracked, views, doubtful, config)
    exposure = exposures(views, seen, measures.brightness, near)
    problems = _problems(measures, exposure, near, group, posed)
    sharpness = above_neighbours(measures.sharpness, near)
    photos = []
    for i, (view, image) in enumerate(zip(views, seen.images, strict=True)):
        found = posed.get(i)
        record = PhotoRecord(
            view.frame.name, _three(view.T_ref_camera.translation), _three(view.T_ref_camera.rotation[:, 2]),
            float(sharpness[i]), float(exposure[i]), float(measures.overexposed[i]), float(measures.underexposed[i]),
            len(image.keypoints), int(count[i]), int(links.indptr[i + 1] - links.indptr[i]), int(group[i]), problems=problems[i],
        )  # fmt: skip
        photos.append(found.onto(record) if found else record)
    spread = exposure.quantile(torch.tensor([0.1, 0.9], dtype=exposure.dtype))
    covered = coverage(_sound(views, problems), tracked.matched, seen, positions, config.parallax, up)
    return CaptureReport(tuple(photos), covered, trial, float(spread[1] - spread[0]))


def _sound(views: Sequence[View], problems: Sequence[tuple[PhotoProblem, ...]]) -> Sequence[View]:
    """Return the views of the main group whose poses are right, as far as is known."""
    wrong = {"mirrored", "turned", "badly posed", "apart"}
    return [v for v, p in zip(views, problems, strict=True) if not wrong & set(p)] or views


def _by_own_landmarks(
    seen: TrackedKeypoints, positions: Float[Tensor, "n 3"], views: Sequence[View]
) -> dict[int, Relocation]:
    """Compare the poses that fit the photos' own landmarks with the given ones, relative to the scatter in
    this capture.

    Poses from fewer landmarks scatter more: the variance is inversely proportional to their number.
    """
    sightings = seen.sightings
    updates = pose_updates(seen, positions)
    if len(updates) < ENOUGH_IMAGES:
        return {}
    scatter = robust_covariance(torch.stack(list(updates.values())))
    depth, image = sightings.in_camera(positions)[:, 2], seen.image
    count = torch.bincount(image, minlength=len(views))
    usual = float(count[list(updates)].double().median())
    found = {}
    for number, update in updates.items():
        own = scatter * max(1.0, usual / float(count[number]))
        deviations = float((update @ torch.linalg.pinv(own, hermitian=True) @ update).clamp(min=0).sqrt())
        distance = float(depth[image == number].median())
        found[number] = Relocation(update, deviations, image_motion(update, views[number], distance))
    return found


def _problems(
    measures: PhotoMeasures,
    exposure: Float[Tensor, "v"],
    near: Nearby,
    group: Int[Tensor, "v"],
    posed: Mapping[int, Relocation | None],
) -> list[tuple[PhotoProblem, ...]]:
    """Return each photo's problems, most serious first."""
    blurred = standing_out(-above_neighbours(measures.sharpness, near), LEAST_BLUR)
    clipped = torch.maximum(
        above_neighbours(measures.overexposed, near), above_neighbours(measures.underexposed, near)
    )
    badly_exposed = standing_out(exposure.abs(), LEAST_EXPOSURE) | (clipped > CLIPPED)
    names: list[tuple[PhotoProblem, ...]] = []
    grouped = bool((group >= 0).any())  # if no photos are linked at all, none is reported for it
    for i in range(len(exposure)):
        found = posed.get(i)
        wrong = found.problem if found else None
        # A photo of another group fits its own landmarks; an isolated one may have been localized all the same.
        unlinked = grouped and (int(group[i]) > 0 or not found)
        place: PhotoProblem | None = wrong or (_place(int(group[i])) if unlinked else None)
        listed: tuple[PhotoProblem | None, ...] = (
            place, "blurred" if blurred[i] else None, "badly exposed" if badly_exposed[i] else None,
        )  # fmt: skip
        names.append(tuple(problem for problem in listed if problem is not None))
    return names


def _place(group: int) -> PhotoProblem | None:
    return "isolated" if group < 0 else "apart" if group > 0 else None


def _three(vector: Float[Tensor, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.double().tolist()
    return x, y, z
