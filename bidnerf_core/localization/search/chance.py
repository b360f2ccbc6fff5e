"""How likely chance would bring as good an agreement."""

from __future__ import annotations

import math


def log10_nfa(matches: int, agreeing: int, probability: float, sample: int = 3) -> float:
    """Logarithm of the number of false alarms (Moisan and Stival 2004, eq. 10): how many poses with so much agreement
    are to be expected among ``matches`` that are all wrong; below 0 it is no chance.

    ``probability`` is that of a wrong match to agree with a pose; ``sample`` correspondences make a pose.
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
