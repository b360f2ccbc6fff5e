"""The answers to a run of images in several maps, each image showing one of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.maps import MapCollection, Placement
from bidnerf_core.progress import Cancel, ProgressCallback
from bidnerf_core.results.answers import Answer, Answers, Failure, answer_each


@dataclass(frozen=True, eq=False)
class PlacedAnswer(Answer):
    """The pose found for an image in one of several maps."""

    placement: Placement | None = None
    own_backend: str = ""  # of the map

    @staticmethod
    def placed(
        frame: Frame, number: int, placement: Placement, backend: str, file: Path | None
    ) -> PlacedAnswer:
        """Build the answer for a frame, without the parts that take much memory."""
        found = Answer.of(frame, number, placement.found, file=file)
        return PlacedAnswer(
            found.name, number, found.intrinsics, found.found, None, None, file, placement, backend
        )

    def plain(self, backend: str) -> dict[str, Any]:
        """Return the JSON object of ``localize --json``, with the map and the runner-up."""
        placement = self.placement
        assert placement is not None
        second = placement.runner_up
        cosines = {similarity.map: similarity.cosine for similarity in placement.ranking}
        runner_up = None
        if second is not None:
            name, other = second
            runner_up = {
                "map": name, "outcome": str(other.outcome), "converged": other.converged,
                "similarity": round(cosines[name], 4),
            }  # fmt: skip
        place = {"map": placement.map, "similarity": round(cosines[placement.map], 4), "runner_up": runner_up}
        return super().plain(self.own_backend) | place


class Placements(Answers):
    """The answers to the images of a run in several maps. Their poses are in the frames of different maps."""

    def __init__(self) -> None:
        super().__init__("")

    def plain(self, answer: Answer | Failure) -> dict[str, Any]:
        """Return an answer as JSON values; ``map`` is null for an image that could not be read."""
        if isinstance(answer, Answer):
            return answer.plain(self.backend)
        unit: LengthUnit = "units"
        return answer.plain("", unit) | {"map": None, "similarity": None, "runner_up": None}


def place_each(
    maps: MapCollection,
    queries: QuerySource,
    *,
    seed: int = 0,
    answers: Placements | None = None,
    each: Callable[[Query, Answer | Failure], None] | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Placements:
    """Find the map and pose of each query, as ``localize_each`` does in one map; queries with several views
    are rejected.

    Raises ``InputError``, and ``Cancelled`` once ``cancel`` returns True.
    """

    def place(query: Query, number: int) -> PlacedAnswer:
        if len(query.views) != 1 or query.depth_rays is not None:
            raise InputError(
                "is a rig or has points from a sensor",
                where=query.name,
                expected="single images for several maps",
            )
        placement = maps(query.views[0].frame, seed)
        backend = getattr(getattr(maps.localizer(placement.map).scene, "info", None), "backend", "")
        frame = query.frame.replace(name=query.name)
        return PlacedAnswer.placed(frame, number, placement, backend, query.file)

    answers = Placements() if answers is None else answers
    return answer_each(queries, place, answers, maps.method, each, progress, cancel)
