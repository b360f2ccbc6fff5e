"""Acceptance: one record of evidence, one table of thresholds."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from bidnerf_core.localization.result import Outcome, Verdict


@dataclass(frozen=True)
class Evidence:
    """All that the decision depends on; no number depends on the unit of length or the size of the image."""

    log10_nfa: float  # expected number of equally good poses by chance (a contrario), by descriptors alone
    inliers: int  # matches by projection within three standard deviations
    above_chance: float  # ratio to the number at displaced keypoints
    recall: float  # fraction of the landmarks in view, or of the keypoints, that match
    spread: float  # fraction of the image's 10 x 10 cells with a match
    noise_ratio: float  # keypoints' noise relative to that of the map's images
    mass: float  # posterior probability that the pose is within the tolerance, and the camera credible
    precision: float  # standard deviation of the position relative to the scene's distance
    other_mode: float  # probability of another place, a mirrored image, or the second pose of a plane
    credible: float  # probability of the explanations under which a pose counts as right
    surprise: (
        float  # squared deviations of the camera and its motion from their means, of the best explanation
    )
    on_surface: float = 1.0  # fraction of the measured points on the surface

    def plain(self) -> dict[str, float]:
        return asdict(self)


TABLE = (
    # measure, limit, whether the measure must be above it, outcome
    ("log10_nfa", -12.0, False, Outcome.TOO_FEW_MATCHES),
    ("inliers", 15, True, Outcome.TOO_FEW_MATCHES),
    ("above_chance", 3.0, True, Outcome.AMBIGUOUS),
    ("spread", 0.06, True, Outcome.UNDETERMINED),
    ("other_mode", 0.02, False, Outcome.AMBIGUOUS),
    ("credible", 0.5, True, Outcome.MISCALIBRATED),
    ("precision", 0.03, False, Outcome.IMPRECISE),
    ("mass", 0.8, True, Outcome.UNCERTAIN),
    ("recall", 0.02, True, Outcome.UNCERTAIN),
    ("noise_ratio", 6.0, False, Outcome.UNCERTAIN),
)


def accept(evidence: Evidence) -> Verdict:
    """Return the first row of the table that fails, or acceptance."""
    for name, limit, above, outcome in TABLE:
        value = getattr(evidence, name)
        if not (value >= limit if above else value <= limit) or not math.isfinite(value):
            return Verdict(
                outcome,
                f"{name} is {value:.3g}, expected {'at least' if above else 'at most'} {limit:g}",
                evidence.mass,
            )
    return Verdict(Outcome.CONVERGED, f"{evidence.inliers} landmarks", evidence.mass)
