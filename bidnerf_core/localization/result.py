"""The result of a localization, common to all methods."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import write_file
from bidnerf_core.io.json import to_plain


class Outcome(StrEnum):
    """The reason why a pose is accepted or rejected; only ``CONVERGED`` means accepted."""

    CONVERGED = "converged"
    AMBIGUOUS = "ambiguous"  # another pose explains the measurements about as well
    OFF_SURFACE = "off surface"  # too few of the measured points lie on the map's surface
    COLOUR_MISMATCH = "colour mismatch"  # too few of them have its colour
    FREE_SPACE_VIOLATED = "free space violated"  # lines of sight pass through the surface
    RENDERING_MISMATCH = "rendering mismatch"  # the field renders something else from there
    UNDETERMINED = "undetermined"  # the measurements do not constrain all six degrees of freedom
    NOT_SETTLED = "not settled"  # newly drawn rays still call for a large step
    HIGH_LOSS = "high loss"  # a descent ended above the loss that counts as converged
    DIVERGED = "diverged"  # the loss or the pose became infinite or not a number
    MISCALIBRATED = "miscalibrated"  # the image contradicts the intrinsics, or the map's may be right instead
    MIRRORED = "mirrored"  # the mirror image fits the map better than the image
    IMPRECISE = "imprecise"  # the pose is too uncertain, compared with the distance of what is in view
    UNCERTAIN = "uncertain"  # the diagnostics together make a wrong pose too likely
    TOO_FEW_MATCHES = "too few matches"  # of image features with the map's landmarks


@runtime_checkable
class Diagnostics(Protocol):
    """The measures by which a pose is judged: a dataclass of numbers, whose fields depend on how the pose was found."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


@dataclass(frozen=True)
class Verdict:
    """An outcome and the sentence that explains it."""

    outcome: Outcome
    reason: str

    @property
    def accepted(self) -> bool:
        return self.outcome is Outcome.CONVERGED


@dataclass(frozen=True, eq=False)
class Localization:
    """The pose found for the last view's camera, and how it was found."""

    T_world_camera: SE3
    outcome: Outcome  # judged without knowledge of the true pose
    reason: str  # the outcome in a sentence
    steps: int
    seconds: float
    loss: float
    method: str
    poses: SE3  # (steps + 1): the start or the winning hypothesis, then the pose after each step
    losses: Float[Tensor, "s"]  # at the start and before each further step
    # Covariance of a right update at the camera: translation (metres) before rotation (radians). None if unknown.
    covariance: Float[Tensor, "6 6"] | None = None
    focal_factor: float = 1.0  # ratio of the estimated to the given focal length; 1 if it was not corrected
    # Probability that the pose is right, from the diagnostics; None where no model of it was learned.
    confidence: float | None = None
    diagnostics: Diagnostics | None = None  # the measures by which the pose was judged
    intrinsics: Intrinsics | None = None  # of the last image, if other than the given ones were taken

    @property
    def converged(self) -> bool:
        """Whether the method accepts its own answer."""
        return self.outcome is Outcome.CONVERGED

    def frame_as_taken(self, frame: Frame) -> Frame:
        """Return the last image's frame with the intrinsics that go with the pose: the given or the corrected ones."""
        return frame if self.intrinsics is None else replace(frame, intrinsics=self.intrinsics)

    def plain(self) -> dict[str, Any]:
        """Return the result as JSON values, with the keys of ``bidnerf localize --json``.

        Numbers that are not finite are None.
        """
        finite = bool(self.T_world_camera.matrix().isfinite().all())
        return {
            "T_world_camera": self.T_world_camera.matrix().tolist() if finite else None,
            "converged": self.converged,
            "outcome": str(self.outcome),
            "reason": self.reason,
            "steps": self.steps,
            "seconds": self.seconds,
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "loss": self.loss if self.loss == self.loss and abs(self.loss) != float("inf") else None,
            "method": self.method,
            "focal_factor": self.focal_factor,
            "intrinsics": None if self.intrinsics is None else to_plain(self.intrinsics),
            "confidence": self.confidence,
        }

    def save(self, path: str | Path) -> None:
        """Write ``plain()`` to a JSON file atomically. ``localize --start`` reads it back as a start."""
        write_file(Path(path), (json.dumps(self.plain(), indent=1, allow_nan=False) + "\n").encode())
