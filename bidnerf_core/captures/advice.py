"""A capture's report in words: what is wrong, and what to photograph next."""

from __future__ import annotations

from collections.abc import Iterator

from bidnerf_core.captures.report import Arrangement, CaptureReport, Gap, PhotoProblem
from bidnerf_core.errors import amount

SUMMARY_LINES = 5
"""Largest number of lines of a summary."""
ARRANGEMENTS: dict[Arrangement, str] = {
    "around": "taken all around the scene",
    "inside": "taken from inside the scene",
    "one side": "taken from one side of the scene",
    "one place": "taken from one place",
    "unknown": "too few to tell how they are arranged",
}
PROBLEMS: dict[PhotoProblem, tuple[str, str]] = {
    "mirrored": ("mirrored", "flip the image back, and turn off the mirroring of selfies"),
    "turned": (
        "rotated against the pose",
        "rotate the image, or the pose, so that both agree on what is up",
    ),
    "badly posed": ("not where the given pose says, according to the landmarks of other photos", "re-estimate such poses, or leave the photos out"),
    "apart": (
        "not linked to the rest by any landmark",
        "photos of another place need a map of their own; otherwise take more in between",
    ),
    "isolated": (
        "short of landmarks in common with others",
        "leave such photos out, or take more between them and the rest",
    ),
    "blurred": ("blurred compared with nearby photos", "retake such photos with more light or a steadier camera"),
    "badly exposed": ("exposed differently from the rest", "retake such photos with locked exposure"),
}  # fmt: skip
"""How each problem reads after "is" or "are", and what helps."""


def summary(report: CaptureReport) -> list[str]:
    """Return at most ``SUMMARY_LINES`` lines; the last one says how many were left out, if any."""
    lines = sentences(report)
    left = len(lines) - SUMMARY_LINES + 1
    more = f"{left} more remarks: 'bidnerf info' prints them all, and --draw plots the capture"
    return lines if left <= 1 else [*lines[: SUMMARY_LINES - 1], more]


def sentences(report: CaptureReport) -> list[str]:
    """Return all remarks on a capture, one or two sentences per line, the most serious problems first."""
    return list(_sentences(report))


def _sentences(report: CaptureReport) -> Iterator[str]:
    covered, trial, count = report.coverage, report.trial, len(report.photos)
    low, high = covered.heights_deg
    outside = covered.arrangement in ("around", "one side")
    heights = f", {low:.0f}° to {high:.0f}° above the horizon" if outside else ""
    if covered.arrangement == "inside":
        tilts = f"{-low:.0f}° down to {high:.0f}° up"
        if low >= 0 or high < 0:
            tilts = f"{abs(low):.0f}° to {abs(high):.0f}° {'up' if low >= 0 else 'down'}"
        heights = f", looking {tilts}"
    landmarks = "no landmark seen by several of them could be triangulated"
    if covered.landmarks:
        landmarks = (
            f"{covered.landmarks} triangulated landmarks, typically seen in {covered.seen_by:.0f}"
            f" photos within {covered.seen_within_deg:.0f}°"
        )
    yield f"{amount(count, 'photo')}, {ARRANGEMENTS[covered.arrangement]}{heights}; {landmarks}"
    if trial.images:
        errors = (
            f", median error {trial.translation:.3g} and {trial.rotation_deg:.2g}°" if trial.found else ""
        )
        yield (
            f"of {amount(trial.images, 'photo')} of the map, {trial.found} {'was' if trial.found == 1 else 'were'} localized with"
            f" the landmarks of the others alone{errors}; expect similar results for new photos taken the same way"
        )
    if covered.arrangement == "one place":
        yield (
            f"rays to the same point differ by {covered.parallax_deg:.1f}°: photos from one place do"
            " not determine distances; move by at least a tenth of the distance to the scene between photos"
        )
    for problem, (what, advice) in PROBLEMS.items():
        if found := [photo.name for photo in report.with_problem(problem)]:
            more = f" and {len(found) - 6} more" if len(found) > 6 else ""
            yield f"{', '.join(found[:6])}{more} {'is' if len(found) == 1 else 'are'} {what}: {advice}"
    few = count < 8
    if few:
        is_ = "is" if count == 1 else "are"
        yield f"{amount(count, 'photo')} {is_} hardly enough for a map; take twenty or more, with much overlap"
    for gap in covered.gaps:
        yield f"there are no photos in {_between(gap)}: take some there, every 10 to 15°"
    if covered.open_side is not None:
        yield (
            f"there are no photos from {_between(covered.open_side)}: take some there if you expect queries"
            " from that side"
        )
    if outside and high - low < 10:  # degrees
        yield "all photos were taken at the same height: add some from higher and lower"
    if not few and covered.seen_by_two > 0.6:
        yield (
            f"{covered.seen_by_two:.0%} of the landmarks are seen in only two photos: photos in between"
            " would constrain them better"
        )
    if report.exposure_range > 1:
        yield f"exposure varies by {report.exposure_range:.1f} stops: lock it if the camera allows"


def _between(gap: Gap) -> str:
    return f"the {gap.degrees:.0f}° between {gap.after} and {gap.before}"
