"""Faults of sensors and scenes: named, seeded changes of an image.

Faults test whether a localizer rejects its wrong answers.
"""

from bidnerf.evaluation.faults.fault import (
    FAULTS,
    NO_FAULT,
    AppliedFault,
    Fault,
    check_depth,
    expand_faults,
    faulty,
    parse_faults,
)

__all__ = [
    "FAULTS",
    "NO_FAULT",
    "AppliedFault",
    "Fault",
    "check_depth",
    "expand_faults",
    "faulty",
    "parse_faults",
]
