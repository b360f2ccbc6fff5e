"""Answers questions of ``alternate.py`` in a process of its own, by the code of the checkout on its path.

It may use only what checkouts of different ages have in common. A question is a line of JSON on standard input: its first key is the
name of a method of ``Answers``, the others are the arguments. The answer is a line on standard output.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from itertools import islice
from typing import Any

from _lab import Scene, errors_of, one_thread, without_depth

from bidnerf import SE3, Localization, Localizer, Tracker, View, open_sequence
from bidnerf_core.datasets import open_dataset


class Answers:
    """A map with a localizer, its queries, and a tracker with its sequence."""

    def __init__(self) -> None:
        one_thread()
        self._views: dict[tuple[str, str], View] = {}

    def open(self, map: str, data: str) -> dict[str, Any]:
        """Open a map and its dataset; return what was opened."""
        self._scene = Scene.open(f"{map}:{data}")
        self._localizer = Localizer(self._scene.map)
        return {"weights": self._scene.map.info.weights}

    def localize(self, data: str, name: str, depth: bool) -> dict[str, Any]:
        """Localize a test frame of a dataset, which may show another scene."""
        if (data, name) not in self._views:
            dataset = open_dataset(data, self._scene.map.bounds.background)
            self._views[data, name] = dataset.views("test", [name])[0]
        view = self._views[data, name]
        view = view if depth else without_depth(view)
        if depth and not view.frame.has_depth:
            return {"no depth": True}
        truth = view if data == str(self._scene.data) else None
        return time_answer(lambda: self._localizer(view.frame), truth)

    def begin(self, data: str, first: int | None = None) -> dict[str, Any]:
        """Begin to track a sequence; its frames are read once."""
        if not hasattr(self, "_frames"):
            self._frames = list(islice(open_sequence(data), first))
        self._tracker = Tracker(self._localizer)
        return {"frames": len(self._frames), "with colour": [f.frame.has_colour for f in self._frames]}

    def track(self, number: int, depth: bool) -> dict[str, Any]:
        """Track a frame of the sequence."""
        shown = self._frames[number]
        view = View(shown.frame, SE3.identity() if shown.truth is None else shown.truth)
        frame = view.frame if depth else without_depth(view).frame
        truth = None if shown.truth is None else view
        return time_answer(lambda: self._tracker(frame, shown.time), truth)


def time_answer(ask: Callable[[], Localization], truth: View | None) -> dict[str, Any]:
    """Return an answer's CPU time, its errors where the truth is known, and whether it was accepted."""
    began = time.process_time()
    found = ask()
    seconds = time.process_time() - began
    accepted = {"converged": found.converged, "outcome": str(found.outcome), "cpu_seconds": seconds}
    return accepted | errors_of(found, truth)


def main() -> None:
    answers = Answers()
    for line in sys.stdin:
        question = json.loads(line)
        name = question.pop("question")
        print(json.dumps(getattr(answers, name)(**question)), flush=True)


if __name__ == "__main__":
    main()
