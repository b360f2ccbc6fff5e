"""The answers to a run of images: as JSON, and as a pose file."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.depth import noise_remark
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, LengthUnit, symbol
from bidnerf_core.io import write_file
from bidnerf_core.localization import (
    BOUNDS,
    Evidence,
    Localization,
    Localizer,
    Outcome,
    unit_of,
)
from bidnerf_core.progress import Cancel, ProgressCallback, counter
from bidnerf_core.results.errors import PoseError, pose_error, rotation_angle
from bidnerf_core.results.other_world import world_of_truth
from bidnerf_core.results.pose_files import PosedImage, pose_format, write_poses

log = logging.getLogger("bidnerf")

RECOGNISED = {
    Outcome.CONVERGED, Outcome.IMPRECISE, Outcome.MIRRORED, Outcome.MISCALIBRATED, Outcome.UNCERTAIN
}  # fmt: skip
"""Outcomes of images that show the scene."""
SEVERAL = 3
"""Minimum number of images, all of them rejected, at which the user is asked whether the map is the right one."""

BAD_INPUT = "bad input"
"""Outcome of an image that could not be read."""


@dataclass(frozen=True, eq=False)
class Answer:
    """The pose found for an image, and what is known about the image. The image itself is not kept."""

    name: str
    number: int  # index in the run or sequence, from 0
    intrinsics: Intrinsics  # of the upright image; corrected ones if the localization used such
    found: Localization
    truth: SE3 | None = None  # T_world_camera
    time: float | None = None  # seconds
    file: Path | None = None

    @staticmethod
    def of(
        frame: Frame, number: int, found: Localization, *, truth: SE3 | None = None, time: float | None = None,
        file: Path | None = None,
    ) -> Answer:  # fmt: skip
        """Build the answer for a frame.

        Only the final pose is kept: intermediate ones take up a lot of memory in long sequences.
        """
        intrinsics = found.frame_as_taken(frame).intrinsics
        found = replace(found, poses=found.poses[-1:])
        return Answer(frame.name, number, intrinsics, found, truth, time, file)

    @property
    def accepted(self) -> bool:
        """Whether the localization converged to a finite pose."""
        return self.found.converged and bool(self.found.T_world_camera.matrix().isfinite().all())

    @property
    def error(self) -> PoseError | None:
        """The error of the pose found, or None if the true pose is unknown."""
        found = self.found
        return None if self.truth is None else pose_error(found.T_world_camera, self.truth, found.unit)

    @property
    def posed(self) -> PosedImage:
        """The image as listed in pose files."""
        found = self.found
        return PosedImage(
            self.name,
            self.number,
            self.intrinsics,
            found.T_world_camera,
            self.file,
            self.time,
            found.covariance,
            found.unit,
        )

    def plain(self, backend: str) -> dict[str, Any]:
        """Return the JSON object that ``bidnerf localize --json`` prints."""
        return {"frame": self.name} | plain_localization(self.found, backend, self.error)


@dataclass(frozen=True)
class Failure:
    """An image that could not be read or localized."""

    name: str
    method: str
    reason: str

    def plain(self, backend: str, unit: LengthUnit = "units") -> dict[str, Any]:
        """Return an object with the keys of ``Answer.plain``, whose outcome is "bad input"."""
        return {
            "frame": self.name, "T_world_camera": None, "converged": False, "outcome": BAD_INPUT,
            "reason": self.reason, "steps": 0, "seconds": 0.0, "covariance": None, "loss": None, "method": self.method,
            "focal_factor": 1.0, "intrinsics": None, "confidence": None, "unit": unit, "backend": backend, "error": None,
        }  # fmt: skip


class Answers:
    """The answers to the images of a run, in order, for a map with the given ``backend``."""

    def __init__(self, backend: str, unit: LengthUnit = "units") -> None:
        self.backend, self.unit = backend, unit
        self.given: list[Answer | Failure] = []

    def __len__(self) -> int:
        return len(self.given)

    def append(self, answer: Answer | Failure) -> None:
        """Keep an answer."""
        self.given.append(answer)

    def plain(self, answer: Answer | Failure) -> dict[str, Any]:
        """Return an answer as JSON values; numbers and matrices that are not finite are None."""
        return (
            answer.plain(self.backend, self.unit)
            if isinstance(answer, Failure)
            else answer.plain(self.backend)
        )

    @property
    def accepted(self) -> list[Answer]:
        """The answers that were accepted."""
        return [answer for answer in self.answers if answer.accepted]

    @property
    def answers(self) -> list[Answer]:
        """The answers, without the failures."""
        return [answer for answer in self.given if isinstance(answer, Answer)]

    @property
    def question(self) -> str:
        """A question to append to a summary: empty unless there are several images and none shows the scene
        of the map.
        """
        return question_about_scene([answer.found for answer in self.answers])

    @property
    def remark(self) -> str | None:
        """A remark on all errors together: the true poses may be those of another world; None if there is none."""
        known = [(answer.found.T_world_camera, answer.truth) for answer in self.accepted if answer.truth]
        if not known:
            return None
        worlds = world_of_truth(*(SE3.stack(list(poses)) for poses in zip(*known, strict=True)))
        if worlds is None:
            return None
        T = worlds.T_target_source
        turn, shift = (
            float(part) for part in (rotation_angle(T.rotation), torch.linalg.vector_norm(T.translation))
        )
        return (
            f"all {len(known)} accepted poses differ from the dataset's by one transformation (a rotation by"
            f" {math.degrees(turn):.3g}°, a scale of {worlds.scale:.4g} and a shift of {shift:.3g} {symbol(self.unit)}): the"
            " dataset's world is not that of the map"
        )

    def save(self, path: str | Path) -> None:
        """Write the poses atomically, in the format selected by the file extension.

        A ``.json`` file lists all answers with all details; files in other formats contain only the accepted
        poses. Raises ``UsageError`` for an unknown extension, and ``InputError`` for images that the format
        cannot describe.
        """
        path = Path(path)
        if pose_format(path) == ".json":
            rows = ",\n".join(json.dumps(self.plain(answer), allow_nan=False) for answer in self.given)
            write_file(path, f"[\n{rows}\n]\n".encode())
            return
        accepted = self.accepted
        write_poses(path, [answer.posed for answer in accepted])
        if left_out := len(self) - len(accepted):
            log.info(
                "%s: %s; %d without an accepted pose are left out",
                path,
                amount(len(accepted), "pose"),
                left_out,
            )


def plain_localization(found: Localization, backend: str, error: PoseError | None) -> dict[str, Any]:
    """Return the JSON values of a localization, the backend of its map, and its error if known."""
    return found.plain() | {"backend": backend, "error": None if error is None else error.plain()}


def question_about_scene(found: Collection[Localization]) -> str:
    """Return a question to append to a summary: empty unless there are several images and none was recognized."""
    if len(found) < SEVERAL or any(map(_shows_scene, found)):
        return ""
    return "; do they show the scene of this map?"


def _shows_scene(found: Localization) -> bool:
    """Return whether an image was recognized. An ambiguous one counts if far more landmarks fit its pose than
    by chance.
    """
    evidence = found.diagnostics
    if found.outcome is Outcome.AMBIGUOUS and isinstance(evidence, Evidence):
        return all(evidence.above_chance >= each.limit for each in BOUNDS if each.measure == "above_chance")
    return found.outcome in RECOGNISED


AnswersT = TypeVar("AnswersT", bound=Answers)


def localize_each(
    localizer: Localizer,
    queries: QuerySource,
    *,
    start: Callable[[Query], SE3 | None] | None = None,
    seed: int = 0,
    answers: Answers | None = None,
    each: Callable[[Query, Answer | Failure], None] | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Answers:
    """Localize each query. One that cannot be read or localized does not stop the others; a single one raises its error.

    ``start`` returns the start of a query, T_world_camera; method ``auto`` needs none. ``answers`` collects
    the answers, by default a new object; it holds those so far if an error ends the run. ``each`` is called
    with each query and its answer; for a failure the query has only a name. Raises ``InputError``, and
    ``Cancelled`` once ``cancel`` returns True.
    """
    answers = (
        Answers(getattr(getattr(localizer.scene, "info", None), "backend", ""), unit_of(localizer.scene))
        if answers is None
        else answers
    )
    bare_before = False

    def localize(query: Query, number: int) -> Answer:
        nonlocal bare_before
        bare = [view.frame.name for view in query.views if not view.frame.has_depth]
        if bare and query.truth is not None and query.depth_rays is None and not bare_before:
            bare_before = True
            log.info("%s: no measured depth; colour only", ", ".join(bare))
        if number == 0:
            _log_depth_noise(query, localizer)
        found = localizer(query.views, None if start is None else start(query), query.depth_rays, seed)
        if not bool(found.T_world_camera.matrix().isfinite().all()):
            raise InputError(
                f"{found.method} diverged to a pose that is not finite; is the map valid?", where=query.name
            )
        frame = query.frame.replace(name=query.name)
        return Answer.of(frame, number, found, truth=query.truth, file=query.file)

    return answer_each(queries, localize, answers, localizer.method, each, progress, cancel)


def answer_each(
    queries: QuerySource,
    localize: Callable[[Query, int], Answer],
    answers: AnswersT,
    method: str,
    each: Callable[[Query, Answer | Failure], None] | None,
    progress: ProgressCallback | None,
    cancel: Cancel | None,
) -> AnswersT:
    """Answer each query and its number; one that cannot be read or localized does not stop the others, if there are any."""
    total = len(queries.names)
    count = counter("localizing", "images", progress, cancel)
    for number, name in enumerate(queries.names):
        answer: Answer | Failure
        query = Query(name, ())
        try:
            query = queries.read(number)
            answer = localize(query, number)
        except UsageError:
            raise
        except InputError as error:
            if total == 1:
                raise
            answer = Failure(name, method, str(error))
        answers.append(answer)
        if each is not None:
            each(query, answer)
        count(number + 1, total)
    return answers


def _log_depth_noise(query: Query, localizer: Localizer) -> None:
    """Compare the noise of a query's depth with that of the sensor named in the settings."""
    frame, sensor = query.frame, localizer.shared.depth_sensor
    if sensor != "unknown" and frame.depth is not None and frame.has_depth:
        remark = noise_remark(frame.depth, frame.intrinsics, sensor)
        if remark is not None:
            log.info("%s: %s", query.name, remark)
