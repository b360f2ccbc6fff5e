"""A capture's report in words: what is wrong, and what to photograph next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bidnerf_core.captures.report import Arrangement, CaptureReport, Gap, PhotoProblem, PhotoRecord

SUMMARY_LINES = 5
"""Largest number of lines of a summary."""
MOST_NAMES = 6
"""Number of photos listed in a sentence; the rest are only counted."""
SAME_HEIGHT = 10.0
"""Range of camera elevations (degrees) below which all cameras count as equally high."""
THIN = 0.6
"""Fraction of landmarks seen in only two photos above which more overlap is advised."""
DRIFTING = 1.0
"""Exposure range (stops) between the darkest and brightest tenth of the photos above which locking it is
advised."""
LEAST_PHOTOS = 8
"""Number of photos below which a map is hardly possible."""

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


def sentences(report: CaptureReport) -> list[str]:
    """Return all remarks on a capture, one or two sentences per line, the most serious problems first."""
    return [_overview(report), *_trial(report), *_problems(report), *_advice(report)]


def summary(report: CaptureReport) -> list[str]:
    """Return at most ``SUMMARY_LINES`` lines; the last one says how many were left out, if any."""
    lines = sentences(report)
    if len(lines) <= SUMMARY_LINES:
        return lines
    left = len(lines) - SUMMARY_LINES + 1
    return [
        *lines[: SUMMARY_LINES - 1],
        f"{left} more remarks: 'bidnerf info' prints them all, and --draw plots the capture",
    ]


def _overview(report: CaptureReport) -> str:
    covered = report.coverage
    count = len(report.photos)
    low, high = covered.heights_deg
    heights = ""
    if covered.arrangement == "inside":
        heights = f", looking {_tilts(low, high)}"
    elif covered.arrangement in ("around", "one side"):
        heights = f", {low:.0f}° to {high:.0f}° above the horizon"
    first = f"{_photos(count)}, {ARRANGEMENTS[covered.arrangement]}{heights}"
    if not covered.landmarks:
        return f"{first}; no landmark seen by several of them could be triangulated"
    return (
        f"{first}; {covered.landmarks} triangulated landmarks, typically seen in {covered.seen_by:.0f}"
        f" photos within {covered.seen_within_deg:.0f}°"
    )


def _tilts(low: float, high: float) -> str:
    """Return a range of elevations (degrees) of optical axes in words."""
    if low >= 0:
        return f"{low:.0f}° to {high:.0f}° up"
    return f"{-low:.0f}° to {-high:.0f}° down" if high < 0 else f"{-low:.0f}° down to {high:.0f}° up"


def _trial(report: CaptureReport) -> Iterator[str]:
    trial = report.trial
    if not trial.images:
        return
    errors = f", median error {trial.translation:.3g} and {trial.rotation_deg:.2g}°" if trial.found else ""
    yield (
        f"of {_photos(trial.images)} held out, {trial.found} {_were(trial.found)} localized with the"
        f" landmarks of the others alone{errors}; expect similar results for new photos taken the same way"
    )


def _problems(report: CaptureReport) -> Iterator[str]:
    if report.coverage.arrangement == "one place":
        yield (
            f"rays to the same point differ by {report.coverage.parallax_deg:.1f}°: photos from one place do"
            " not determine distances; move by at least a tenth of the distance to the scene between photos"
        )
    for problem, (what, advice) in PROBLEMS.items():
        if found := report.with_problem(problem):
            yield f"{_listed(found)} {_is(len(found))} {what}: {advice}"


def _advice(report: CaptureReport) -> Iterator[str]:
    covered = report.coverage
    if len(report.photos) < LEAST_PHOTOS:
        yield f"{_photos(len(report.photos))} {_is(len(report.photos))} hardly enough for a map; take twenty or more, with much overlap"
    for gap in covered.gaps:
        yield f"there are no photos in {_between(gap)}: take some there, every 10 to 15°"
    if covered.open_side is not None:
        yield (
            f"there are no photos from {_between(covered.open_side)}: take some there if you expect queries"
            " from that side"
        )
    low, high = covered.heights_deg
    if covered.arrangement in ("around", "one side") and high - low < SAME_HEIGHT:
        yield "all photos were taken at the same height: add some from higher and lower"
    if len(report.photos) >= LEAST_PHOTOS and covered.seen_by_two > THIN:
        yield (
            f"{covered.seen_by_two:.0%} of the landmarks are seen in only two photos: photos in between"
            " would constrain them better"
        )
    if report.exposure_range > DRIFTING:
        yield f"exposure varies by {report.exposure_range:.1f} stops: lock it if the camera allows"


def _between(gap: Gap) -> str:
    return f"the {gap.degrees:.0f}° between {gap.after} and {gap.before}"


def _listed(photos: Sequence[PhotoRecord]) -> str:
    named = ", ".join(photo.name for photo in photos[:MOST_NAMES])
    more = len(photos) - MOST_NAMES
    return f"{named} and {more} more" if more > 0 else named


def _photos(count: int) -> str:
    return "one photo" if count == 1 else f"{count} photos"


def _is(count: int) -> str:
    return "is" if count == 1 else "are"


def _were(count: int) -> str:
    return "was" if count == 1 else "were"
