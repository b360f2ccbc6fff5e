"""The significance of an agreement: how many equally good ones are expected by chance."""

from __future__ import annotations

import math


def log10_nfa(matches: int, agreeing: int, probability: float, sample: int = 3) -> float:
    """Return the decimal logarithm of the number of false alarms (Moisan and Stival 2004, eq. 10).

    This is the expected number of poses with which ``agreeing`` of ``matches`` agree, if all matches are wrong. The lower it
    is, the less likely the agreement is due to chance. ``probability`` is the probability that a wrong match agrees with a
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


def _log_binomial(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
