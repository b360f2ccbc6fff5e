"""Trials in a process of their own, so that its memory and time are those of one map."""

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
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import opened, parse_settings, run_trial
from bidnerf_core.fields.contract import levels
from bidnerf_core.frames.frame import View
from bidnerf_core.frames.pixels import draw, uniform
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.json import from_plain, parse_json, to_plain
from bidnerf_core.settings import to_flat

COUNTED_RAYS = 2048
"""The number of rays on which samples are counted."""


@dataclass(frozen=True)
class Measured:
    """The result of a trial, and the mean number of samples on a ray of its last frame at the true pose."""

    result: TrialResult
    samples_per_ray: float  # of the field's level in the method's settings, else of the finest


class TrialProcess:
    """A process that runs trials one after another and keeps its map in memory. Use it as a context manager.

    It is a new interpreter that exchanges JSON, not a fork: it shares no memory, and scripts need no ``__main__`` guard.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            start_new_session=True,  # so that Ctrl-C reaches only this process, which ends the other
        )  # fmt: skip

    def run(self, trial: Trial) -> Measured:
        """Run a trial. Raises ``InputError`` if it is impossible, or if the process ends before its result."""
        try:
            _send(self._process.stdin, to_plain(trial))
            line = self._process.stdout.readline() if self._process.stdout else ""
        except BrokenPipeError:
            line = ""
        if not line:
            raise InputError(
                f"{trial.map}: the process that localized frame {trial.frame} ended with status {self._process.wait()},"
                " expected a result; was memory short?"
            )
        answer = parse_json(line, trial.map, "the result of a trial")
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
    """Return the mean number of valid samples on uniformly drawn rays."""
    stored, dataset = opened(trial.map, trial.data)
    (view,) = dataset.views(trial.split, trial.frames[-1:])
    number = to_flat(parse_settings(trial.method, trial.config)).get("level")
    level = stored.field if number is None else levels(stored.field)[number]
    own = (View(view.frame, SE3.identity()),)
    pixels = draw(own, COUNTED_RAYS, uniform, torch.Generator().manual_seed(trial.seed))
    with torch.no_grad():
        samples = level.sampler(pixels.rays(view.T_ref_camera, stored.bounds))
    return float(samples.valid.sum()) / COUNTED_RAYS


def _serve(questions: Iterable[str], answers: Any) -> None:
    """Answer each line with a line, until there are none left."""
    for line in questions:
        trial = from_plain(Trial, parse_json(line, "trial", "a trial"), "trial")
        try:
            _send(answers, to_plain(Measured(run_trial(trial), samples_per_ray(trial))))
        except InputError as error:
            _send(answers, {"refused": str(error)})


def _send(stream: Any, value: dict[str, Any]) -> None:
    stream.write(json.dumps(value, allow_nan=False) + "\n")
    stream.flush()


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # output that a backend prints must not be mistaken for an answer
        _serve(sys.stdin, answers)
