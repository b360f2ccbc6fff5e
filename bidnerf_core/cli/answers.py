"""The output of ``bidnerf localize``: stdout, a file of poses, and pictures."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
from torch import Tensor

from bidnerf_core.cli.another_scene import question_about_scene
from bidnerf_core.cli.options import UsageError
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.cli.queries import Query
from bidnerf_core.errors import InputError, amount
from bidnerf_core.evaluation.trials import plain_localization
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import write_file
from bidnerf_core.localization import Localization
from bidnerf_core.maps.map import Map
from bidnerf_core.results.errors import PoseError, pose_error
from bidnerf_core.results.overlays import Painter
from bidnerf_core.results.pose_files import POSE_WRITERS, PosedImage

TRANSFORMS = "transforms.json"
WRITERS = {ending: write for ending, write in POSE_WRITERS.items() if ending != ".json"}
"""Writers of files that hold only accepted poses, by the ending of the name; ``.json`` lists what ``--json`` prints."""


@dataclass(frozen=True, eq=False)
class Answer:
    """A query and the pose found."""

    number: int  # of the query, from 0
    query: Query
    start: SE3 | None
    found: Localization

    @property
    def error(self) -> PoseError | None:
        return self._off(self.found.T_world_camera)

    @property
    def start_error(self) -> PoseError | None:
        return None if self.start is None else self._off(self.start)

    @property
    def posed(self) -> PosedImage:
        query, intrinsics = self.query, self.found.frame_as_taken(self.query.frame).intrinsics
        return PosedImage(query.name, self.number, intrinsics, self.found.T_world_camera, query.file)

    def _off(self, pose: SE3) -> PoseError | None:
        return None if self.query.truth is None else pose_error(pose, self.query.truth)


@dataclass(frozen=True)
class OutputSpec:
    """The arguments for the output of answers."""

    out: Path | None = None
    draw: Path | None = None
    json: bool = False

    def prepare(self) -> None:
        """Make the folder of pictures. Raises, before any work is done, where a name or a folder cannot be used."""
        if self.out is not None:
            self._check_out(self.out)
        if self.draw is not None:
            try:
                self.draw.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    f"{self.draw}: {error.strerror}, expected a folder that can be made"
                ) from error

    @staticmethod
    def _check_out(out: Path) -> None:
        if _ending(out) not in (*WRITERS, ".json"):
            raise UsageError(
                f"--out is {out}, expected a name that ends with .json, .txt, .tum or {TRANSFORMS}"
            )
        if out.is_dir() or not out.parent.is_dir():
            what = "is a folder" if out.is_dir() else f"no folder {out.parent}"
            raise InputError(f"{out}: {what}, expected a file in a folder that exists")


class Answers:
    """Collects the answers of a run: prints each, draws it, and writes the file of poses at the end."""

    def __init__(self, stored: Map, spec: OutputSpec, total: int) -> None:
        self._stored, self._spec, self._total = stored, spec, total
        self._given: list[Answer] = []
        self._objects: list[dict[str, Any]] = []
        self.failures = 0

    def add(self, answer: Answer) -> None:
        """Print an answer and draw it."""
        plain = plain_localization(answer.found, self._stored.info.backend, answer.error)
        self._given.append(answer)
        self._objects.append({"frame": answer.query.name} | plain)
        if self._spec.json:
            print_json(self._objects[-1])
        elif self._total == 1:
            show_in_full(answer)
        else:
            show_in_short(answer)
        if self._spec.draw is not None:
            frame = answer.found.frame_as_taken(answer.query.frame)
            picture = Painter(self._stored, frame).overlay(answer.start, answer.found.T_world_camera)
            file = self._spec.draw / f"overlay-{answer.query.name}.png"
            write_file(file, bytes(iio.imwrite("<bytes>", picture, extension=".png")))

    def fail(self, name: str, method: str, error: InputError) -> None:
        """Report a query that could not be localized; with ``--json``, also as an object with the usual keys."""
        self.failures += 1
        say(f"{name}: {error}")
        failure = {
            "frame": name, "T_world_camera": None, "converged": False, "outcome": "bad input", "reason": str(error),
            "steps": 0, "seconds": 0.0, "covariance": None, "loss": None, "method": method, "focal_factor": 1.0,
            "intrinsics": None, "confidence": None, "backend": self._stored.info.backend, "error": None,
        }  # fmt: skip
        self._objects.append(failure)
        if self._spec.json:
            print_json(failure)

    def finish(self) -> None:
        """Write the file of poses, and print how many of several queries converged.

        Raises ``InputError`` if a file of accepted poses would be empty, or if a query failed.
        """
        accepted = [answer.posed for answer in self._given if answer.found.converged]
        if self._total > 1:
            question = question_about_scene([answer.found for answer in self._given])
            say(f"{len(accepted)} of {self._total} converged{question}")
        if self._spec.out is not None:
            self._write(self._spec.out, accepted)
        if self.failures:
            raise InputError(
                f"{self.failures} of {self._total} queries could not be read or localized, see above"
            )

    def keep(self) -> None:
        """Write the file of poses with the answers so far, if a run of several queries is interrupted."""
        accepted = [answer.posed for answer in self._given if answer.found.converged]
        out = self._spec.out
        if out is None or not (accepted or (_ending(out) == ".json" and self._objects)):
            return
        self._write(out, accepted)
        say(f"{out}: written after {len(self._objects)} of {self._total} images")

    def _write(self, out: Path, accepted: list[PosedImage]) -> None:
        if _ending(out) == ".json":
            write_file(out, (json.dumps(self._objects, indent=1, allow_nan=False) + "\n").encode())
            return
        if not accepted:
            raise InputError(
                f"{out}: not written, since no pose converged; a name ending with .json takes all"
            )
        WRITERS[_ending(out)](out, accepted)
        left_out = len(self._objects) - len(accepted)
        if left_out:
            say(f"{out}: {amount(len(accepted), 'pose')}; {left_out} without an accepted pose are left out")


def _ending(path: Path) -> str:
    return TRANSFORMS if path.name.endswith(TRANSFORMS) else path.suffix.lower()


def show_in_full(answer: Answer) -> None:
    """Print an answer in several lines: its errors where the truth is known, its uncertainty, the matrix."""
    found = answer.found
    show(f"{answer.query.name}: {_verdict(found)} ({found.reason})")
    if answer.error is not None:
        start = "no start" if answer.start_error is None else _shown(answer.start_error)
        show(f"  start error  {start}")
        show(f"  final error  {_shown(answer.error)}")
    if found.covariance is not None:
        show(f"  uncertainty  {_deviation(found.covariance)}")
    show(
        f"  {amount(found.steps, 'step')}, {found.seconds:.2f} s, loss {found.loss:.5f}, method {found.method}"
    )
    show("  T_world_camera")
    for row in found.T_world_camera.matrix().tolist():
        show("    " + " ".join(f"{value: .6f}" for value in row))


def _verdict(found: Localization) -> str:
    """Return the verdict in words; the troubleshooting page of the documentation explains each outcome."""
    return "converged" if found.converged else f"NOT converged: {found.outcome.value}"


def show_in_short(answer: Answer) -> None:
    """Print an answer in one line."""
    found, error = answer.found, answer.error
    known = "" if error is None else f"error {_shown(error)}; "
    took = f"{amount(found.steps, 'step')}, {found.seconds:.2f} s"
    show(f"{answer.query.name}: {known}{_verdict(found)} ({found.reason}); {took}")


def _shown(error: PoseError) -> str:
    return f"{float(error.translation):.4f} m, {float(error.rotation_deg):.3f} deg"


def _deviation(covariance: Tensor) -> str:
    """Return the standard deviations of position and rotation, according to the method, as text."""
    translation, rotation = (float(part.sum().clamp(min=0).sqrt()) for part in covariance.diagonal().split(3))
    return f"{translation:.4f} m, {math.degrees(rotation):.3f} deg (one standard deviation)"
