"""Significance of an agreement: the number of equally good ones expected by chance (false alarms)."""

from __future__ import annotations

import math

CONVINCING = -20.0
"""Log10 of the number of false alarms below which a pose is certain to be no accident."""
DECISIVE = 4.0
"""Log odds beyond which one of two explanations is accepted."""
BY_SHARE = 10.0
"""Log odds per factor e between the numbers of matching landmarks: the right place rarely has fewer than two thirds as many as
another.
"""


def log10_nfa(matches: int, agreeing: int, probability: float, sample: int = 3) -> float:
    """Return log10 of the number of false alarms (Moisan and Stival 2004, eq. 10).

    This is the expected number of poses with ``agreeing`` inliers among ``matches`` if all matches are wrong. The lower it is,
    the less likely the agreement is due to chance. ``probability`` is the probability that a wrong match is an inlier of a
    given pose; ``sample`` is the number of correspondences that determine a pose.
    """
    if agreeing <= sample:
        return 0.0
    log = (
        math.log(max(1, matches - sample))
        + _log_binomial(matches, agreeing)
        + _log_binomial(agreeing, sample)
        + (agreeing - sample) * math.log(probability)
    )
    return log / math.log(10)


def odds(log_odds: float) -> float:
    """Return the odds of given logarithm, limited to what floating-point numbers can hold."""
    return math.exp(max(-500.0, min(500.0, log_odds)))


def probability_of(log_odds: float) -> float:
    """Return the probability of the first of two explanations whose log odds against the second are given."""
    return 1 / (1 + odds(-log_odds))


def log_odds_of(probability: float) -> float:
    """Return the log odds of an explanation with a given probability."""
    return math.log(probability / (1 - probability))


def log_odds_of_share(share: float) -> float:
    """Return the log odds of a pose against an explanation with this fraction of its evidence by landmarks."""
    return -BY_SHARE * math.log(share) if share > 0 else math.inf


def _log_binomial(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
