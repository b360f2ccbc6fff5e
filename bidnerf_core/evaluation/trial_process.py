"""Trials in a process of their own, so that memory and time are those of one map."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.trials import Trial, TrialResult, opened, run_trial, settings_of
from bidnerf_core.field import levels
from bidnerf_core.frames import View
from bidnerf_core.pixels import draw, uniform
from bidnerf_core.se3 import SE3
from bidnerf_core.serialization import from_plain, to_plain
from bidnerf_core.settings import to_flat

RAYS = 2048
"""On how many the samples are counted."""


@dataclass(frozen=True)
class Measured:
    """A trial's result, and how many samples of the field a ray of its last frame takes, seen from the true pose."""

    result: TrialResult
    samples_per_ray: float  # at the level that the method's settings name, else at the finest


class TrialProcess:
    """Runs trials one after another elsewhere; what it has read stays there. Use as a context: leaving it ends it.

    It is a new Python that speaks JSON, not a fork: it shares no memory, and no script needs a guard for it.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            start_new_session=True,  # Ctrl-C is for us: we end it
        )  # fmt: skip

    def run(self, trial: Trial) -> Measured:
        """Raises ``InputError`` where the trial cannot be, or where the process did not live to its end."""
        try:
            _send(self._process.stdin, to_plain(trial))
            line = self._process.stdout.readline() if self._process.stdout else ""
        except BrokenPipeError:
            line = ""
        if not line:
            raise InputError(
                f"{trial.map}: the process that tried frame {trial.frame} ended with status {self._process.wait()},"
                " expected a result; was memory short?"
            )
        answer = json.loads(line)
        if "refused" in answer:
            raise InputError(answer["refused"])
        return from_plain(Measured, answer, "result")

    def __enter__(self) -> TrialProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()


def samples_per_ray(trial: Trial) -> float:
    """Valid samples on uniformly drawn rays."""
    stored, dataset = opened(trial.map, trial.data)
    (view,) = dataset.views(trial.split, trial.frames[-1:])
    number = to_flat(settings_of(trial.method, trial.config)).get("level")
    field = stored.field if number is None else levels(stored.field)[number]
    pixels = draw(
        [View(view.frame, SE3.identity())], RAYS, uniform, torch.Generator().manual_seed(trial.seed)
    )
    with torch.no_grad():
        samples = field.sampler(pixels.rays(view.T_ref_camera, stored.bounds))
    return float(samples.valid.sum()) / RAYS


def _serve(questions: Iterable[str], answers: Any) -> None:
    """A line for each line, until there are no more."""
    for line in questions:
        trial = from_plain(Trial, json.loads(line), "trial")
        try:
            _send(answers, to_plain(Measured(run_trial(trial), samples_per_ray(trial))))
        except InputError as error:
            _send(answers, {"refused": str(error)})


def _send(stream: Any, value: dict[str, Any]) -> None:
    stream.write(json.dumps(value, allow_nan=False) + "\n")
    stream.flush()


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # whatever a backend prints is no answer
        _serve(sys.stdin, answers)
