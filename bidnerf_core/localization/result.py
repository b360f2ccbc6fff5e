"""The result of a localization, common to all methods.

The module also holds the meaning of each outcome with what to try first, and the record of a search for visualization, which is kept only
if one is requested.
"""

from __future__ import annotations

import html
import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import move_to
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import (
    SE3,
    CovarianceConvention,
    LengthUnit,
    covariance_in,
    pose_from_matrix,
    symbol,
)
from bidnerf_core.io import from_plain, read_record, to_plain, write_file

if TYPE_CHECKING:
    from bidnerf_core.localization.loop import LandmarkAnswer


class Outcome(StrEnum):
    """Why a pose was accepted or rejected; only ``CONVERGED`` means accepted."""

    CONVERGED = "converged"
    AMBIGUOUS = "ambiguous"  # another pose explains the measurements about as well
    OFF_SURFACE = "off surface"  # too few of the measured points lie on the map's surface
    COLOUR_MISMATCH = "colour mismatch"  # too few of the measured points have the surface's colour
    FREE_SPACE_VIOLATED = "free space violated"  # lines of sight pass through the surface
    RENDERING_MISMATCH = "rendering mismatch"  # the field's rendering differs from the image or its depth
    UNDETERMINED = "undetermined"  # the measurements do not constrain all six degrees of freedom
    NOT_SETTLED = "not settled"  # newly drawn rays still give a large step
    HIGH_LOSS = "high loss"  # a descent ended above the convergence threshold
    DIVERGED = "diverged"  # the loss or the pose became infinite or not a number
    MISCALIBRATED = "miscalibrated"  # the image contradicts the given intrinsics
    MIRRORED = "mirrored"  # the mirror image fits the map better than the image
    IMPRECISE = "imprecise"  # the pose is too uncertain, relative to the distance to the scene
    UNCERTAIN = "uncertain"  # the diagnostics together make a wrong pose too likely
    TOO_FEW_MATCHES = "too few matches"  # of image features with the map's landmarks


@dataclass(frozen=True)
class Verdict:
    """An outcome, the sentence that explains it, and the probability that the pose is right."""

    outcome: Outcome
    reason: str
    confidence: float | None = None  # None if unknown, or if it ignores the reason of a rejection

    @property
    def accepted(self) -> bool:
        return self.outcome is Outcome.CONVERGED


@dataclass(frozen=True, eq=False)
class Localization:
    """The pose found for the last view's camera, with its uncertainty and acceptance."""

    T_world_camera: SE3  # NaN in a refused answer that found no pose
    outcome: Outcome  # determined without ground truth
    reason: str  # the outcome in a sentence
    steps: int
    seconds: float
    loss: float
    method: str
    poses: SE3  # (steps + 1): the start or the winning hypothesis, then the pose after each step
    losses: Float[Tensor, "s"]  # at the start and before each further step
    # Covariance of a right update at the camera: translation (``unit``) before rotation (radians). None if unknown.
    covariance: Float[Tensor, "6 6"] | None = None
    focal_factor: float = 1.0  # ratio of the estimated to the given focal length; 1 if it was not corrected
    # Probability that the pose is right: by landmarks, from a learned model of the diagnostics, otherwise by comparison with
    # rivals. None if unknown, and if the pose is rejected for a reason that the model or the comparison ignores.
    confidence: float | None = None
    diagnostics: Any = None  # the measures by which the pose was accepted or rejected, a dataclass
    intrinsics: Intrinsics | None = None  # of the last image, if other than the given ones were used
    unit: LengthUnit = "units"  # of the position and its covariance: that of the map
    picture: Callable[[Localization], str] | None = None  # returns the HTML of a picture for a notebook; not stored
    name: str = ""  # of the image; not stored

    def _repr_html_(self) -> str:
        """Return HTML for a notebook: the photo, the map rendered at the estimated pose, and a blend of both, above a line of text."""
        picture = "" if self.picture is None else self.picture(self)
        return f"{picture}<div>{html.escape(repr(self))}</div>"

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the function that refers to the map, which other processes do not need."""
        return self.__dict__ | {"picture": None}

    def __repr__(self) -> str:
        """Return a one-line description, without the steps and the covariance."""
        x, y, z = self.T_world_camera.translation.tolist()
        sure = "" if self.confidence is None else f", confidence {self.confidence:.3g}"
        where = (
            f"at ({x:.4g}, {y:.4g}, {z:.4g}) {symbol(self.unit)}" if self.T_world_camera.is_finite else "without a pose"
        )
        return f"<Localization {self.name and f'of {self.name}: '}{self.outcome.value} {where}{sure}: {self.reason}>"

    @staticmethod
    def of(
        verdict: Verdict,
        poses: SE3,
        losses: Float[Tensor, "s"],
        method: str,
        began: float,
        loss: float,
        covariance: Float[Tensor, "6 6"] | None = None,
        diagnostics: Any = None,
    ) -> Localization:
        """Return the answer whose pose is the last of ``poses``; ``began`` is when the search started (``time.perf_counter``)."""
        count, seconds = len(poses.translation) - 1, time.perf_counter() - began
        return Localization(
            poses[-1],
            verdict.outcome,
            verdict.reason,
            count,
            seconds,
            loss,
            method,
            poses,
            losses,
            covariance,
            confidence=verdict.confidence,
            diagnostics=diagnostics,
        )

    def covariance_in(self, convention: CovarianceConvention) -> Float[Tensor, "6 6"] | None:
        """Return the covariance in another convention, see ``CovarianceConvention``; None if the covariance is unknown.

        Raises ``InputError`` for an unknown convention.
        """
        if self.covariance is None:
            return None
        return covariance_in(self.covariance, self.T_world_camera, convention)

    @property
    def converged(self) -> bool:
        """Whether the method accepts its own answer."""
        return self.outcome is Outcome.CONVERGED

    def translated(self, offset: Float[Tensor, "3"]) -> Localization:
        """Return the answer in a world frame with parallel axes, in which ``offset`` (same unit) is added to all positions."""
        T, poses = self.T_world_camera.translated(offset), self.poses.translated(offset)
        return replace(self, T_world_camera=T, poses=poses)

    def rejected(self, why: Verdict) -> Localization:
        """Return the answer with another verdict, whose reason is prepended to the current one."""
        reason = f"{why.reason}; {self.reason}"
        return replace(self, outcome=why.outcome, reason=reason, confidence=why.confidence)

    def frame_as_taken(self, frame: Frame) -> Frame:
        """Return ``frame``, the last image, with the corrected intrinsics if there are any."""
        return frame if self.intrinsics is None else frame.replace(intrinsics=self.intrinsics)

    def plain(self) -> dict[str, Any]:
        """Convert the result to JSON values, with the keys of ``bidnerf localize --json``.

        Numbers and matrices that are not finite are None.
        """
        return {
            "T_world_camera": _finite(self.T_world_camera.matrix().tolist()),
            "converged": self.converged,
            "outcome": str(self.outcome),
            "reason": self.reason,
            "steps": self.steps,
            "seconds": self.seconds,
            "covariance": None if self.covariance is None else _finite(self.covariance.tolist()),
            "loss": _finite(self.loss),
            "method": self.method,
            "focal_factor": _finite(self.focal_factor),
            "intrinsics": None if self.intrinsics is None else to_plain(self.intrinsics),
            "confidence": _finite(self.confidence),
            "unit": self.unit,
        }

    def save(self, path: str | Path) -> None:
        """Write ``plain()`` to a JSON file atomically. ``localize --start`` reads it back as a start."""
        write_file(Path(path), (json.dumps(self.plain(), indent=1, allow_nan=False) + "\n").encode())

    @staticmethod
    def load(path: str | Path) -> Localization:
        """Read a file written by ``save``. The file contains no diagnostics and no intermediate poses or losses.

        Raises ``InputError`` for any other file, and for a pose that is not finite.
        """
        where = str(path)
        saved = from_plain(_Saved, dict(read_record(Path(path)).values), where)
        if saved.T_world_camera is None:
            raise InputError("T_world_camera is null", where=where, expected="a finite pose")
        rows = _matrix(saved.T_world_camera, 4, "T_world_camera", where)
        T = pose_from_matrix(rows, "T_world_camera", where)
        covariance = None if saved.covariance is None else _matrix(saved.covariance, 6, "covariance", where)
        loss = math.nan if saved.loss is None else saved.loss
        return Localization(
            T,
            saved.outcome,
            saved.reason,
            saved.steps,
            saved.seconds,
            loss,
            saved.method,
            SE3.stack([T]),
            torch.tensor([loss], dtype=torch.float64),
            covariance,
            math.nan if saved.focal_factor is None else saved.focal_factor,
            saved.confidence,
            None,
            saved.intrinsics,
            saved.unit,
        )


@dataclass(frozen=True)
class _Saved:
    """The contents of a localization's file."""

    T_world_camera: list[list[float]] | None
    converged: bool
    outcome: Outcome
    reason: str
    steps: int
    seconds: float
    covariance: list[list[float]] | None
    loss: float | None
    method: str
    focal_factor: float | None
    intrinsics: Intrinsics | None
    confidence: float | None
    unit: LengthUnit


def _matrix(rows: list[list[float]], size: int, what: str, where: str) -> Float[Tensor, "n n"]:
    if {len(row) for row in rows} != {size} or len(rows) != size:
        raise InputError(f"{what} has {len(rows)} rows", where=where, expected=f"{size} rows of {size} numbers")
    return torch.tensor(rows, dtype=torch.float64)


def _finite(value: Any) -> Any:
    """Return the number or rows of numbers, or None if any number is not finite, which JSON cannot represent."""
    rows = value if isinstance(value, list) else [[value]]
    return value if all(x is not None and math.isfinite(x) for row in rows for x in row) else None


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """Poses considered in one step of a search."""

    caption: str
    T: SE3  # T_world_camera (h), best first, on the CPU
    scores: Float[Tensor, "h"]  # lower is better; only those of one step can be compared
    passing: int  # number of poses passed on to the next step


@dataclass(eq=False)
class SearchRecord:
    """The steps of a search and the landmark-based answers, in order."""

    steps: list[RecordedStep]
    answers: list[LandmarkAnswer]

    def add(self, caption: str, T: SE3, scores: Float[Tensor, "h"] | None = None, passing: int = 1) -> None:
        """Record poses T (h) or a single pose; without scores, the poses must be sorted, best first."""
        T = T if T.translation.ndim == 2 else T[None]
        if scores is None:
            scores = torch.arange(len(T.translation), dtype=torch.float64)
        best = scores.argsort()[:400]  # only the best poses of a step are kept
        T, scores = move_to((T[best], scores[best]), "cpu")
        self.steps.append(RecordedStep(caption, T, scores.double(), min(passing, len(best))))


_RECORD: ContextVar[SearchRecord | None] = ContextVar("record", default=None)


@contextmanager
def record_search() -> Iterator[SearchRecord]:
    """Yield a record that collects the steps and answers of this thread's localizations within the block."""
    token = _RECORD.set(record := SearchRecord([], []))
    try:
        yield record
    finally:
        _RECORD.reset(token)


def current_record() -> SearchRecord | None:
    """Return the active record; None if no record was requested."""
    return _RECORD.get()


@dataclass(frozen=True)
class Advice:
    """What an outcome means, and what to try first; code is between backticks."""

    meaning: str
    first: str


ADVICE = {
    Outcome.AMBIGUOUS: Advice(
        "Another pose explains the image about as well.",
        "Give several views with known relative poses, or a rough start (`--start`). If there is one such place, check whether the map holds it twice.",
    ),
    Outcome.OFF_SURFACE: Advice(
        "Fewer than 85% of the measured points lie on the map's surface.",
        "Check the unit and the kind of the depth first, then whether the map covers what the image shows.",
    ),
    Outcome.COLOUR_MISMATCH: Advice(
        "The shape fits, but fewer than 42% of the points have the colour of the surface.",
        "Check whether red and blue are swapped, then the exposure.",
    ),
    Outcome.FREE_SPACE_VIOLATED: Advice(
        "More than 15% of the lines of sight pass through the surface.",
        "Update the map if something was removed, else give more views or a start.",
    ),
    Outcome.RENDERING_MISMATCH: Advice(
        "The geometry fits, but the field renders something else.",
        "Check with `bidnerf render` whether the field is sharp, then whether the light has changed.",
    ),
    Outcome.UNDETERMINED: Advice("The image does not fix all six degrees of freedom.", "Add depth or views."),
    Outcome.NOT_SETTLED: Advice(
        "Newly drawn rays still ask for a step of more than 0.02.",
        "Localize again from the pose, or raise `--fine-steps` and `--fine-rays`.",
    ),
    Outcome.HIGH_LOSS: Advice(
        "A descent of `bid` or `inerf` ended where the rendering differs too much from the image.",
        "Use `auto`, a closer start, more `--max-steps` or several views.",
    ),
    Outcome.DIVERGED: Advice(
        "The loss or the pose is infinite or not a number.",
        "Check that the start is camera to world with OpenCV axes and lies within the scene, then lower `--learning-rate`.",
    ),
    Outcome.MISCALIBRATED: Advice(
        "The image contradicts the given intrinsics.",
        "Give the right camera (`--camera`), or mark the focal length as approximate.",
    ),
    Outcome.MIRRORED: Advice(
        "The mirror image fits the map better.",
        "Turn mirroring off in the front camera, check the image reader for flipped rows, or flip the image.",
    ),
    Outcome.IMPRECISE: Advice(
        "The position is too uncertain.", "Add depth of the same image, or views with known relative poses."
    ),
    Outcome.UNCERTAIN: Advice(
        "The diagnostics together make a wrong pose too likely.",
        "Take a sharper image, closer to where the map's images were taken.",
    ),
    Outcome.TOO_FEW_MATCHES: Advice(
        "The map has many landmarks, but hardly any appear in the image.",
        "If the image shows another place, try that place's map; else take a sharper, brighter one from nearer to where the map's images were taken, and check its camera.",
    ),
}
"""Advice for each outcome except ``CONVERGED``; a test compares it with the documentation."""
