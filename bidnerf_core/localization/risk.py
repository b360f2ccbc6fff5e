"""Tolerated risk: the fraction of wrong answers among the accepted ones, and the confidence that it requires.

``benchmarks/risk.py`` calibrates the minimum confidence on images with and without faults, and ``confidence.json`` stores it. The
threshold applies to the final answer, after all other acceptance criteria: these influence how an answer is found, and a
guarantee holds only for answers found in the same way as those of the calibration.
"""

from __future__ import annotations

import json
from functools import lru_cache
from importlib.resources import files

from bidnerf_core.errors import InputError
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.settings import Range


@lru_cache(maxsize=1)
def levels() -> tuple[tuple[float, float], ...]:
    """Return the calibrated risks in increasing order, each with the minimum confidence of an accepted answer."""
    stored = json.loads((files(__package__) / "confidence.json").read_text())
    return tuple((risk, least) for risk, least in stored.get("risk", {}).get("least_confidence", []))


def least_confidence(risk: float) -> float:
    """Return the confidence required by the largest calibrated risk that does not exceed ``risk``.

    Raises ``InputError`` for a risk outside the calibrated range.
    """
    if not levels():
        raise InputError(f"risk is {risk!r}, but no risk was calibrated for this confidence; leave it out")
    calibrated = Range(levels()[0][0], levels()[-1][0])
    if risk not in calibrated:
        raise InputError(
            f"risk is {risk!r}", expected=f"{calibrated}, for which the confidence was calibrated"
        )
    return min(confidence for level, confidence in levels() if level <= risk)


def within_risk(found: Localization, risk: float) -> Localization:
    """Return the answer, rejected as ``uncertain`` if its confidence is unknown or lower than the risk requires."""
    least = least_confidence(risk)
    if not found.converged or (found.confidence is not None and found.confidence >= least):
        return found
    said = "unknown" if found.confidence is None else f"{found.confidence:.3f}"
    why = f"the confidence is {said}, a risk of {risk:g} requires {least:.3f}"
    return found.rejected(Verdict(Outcome.UNCERTAIN, why, found.confidence))
