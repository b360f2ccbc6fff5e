"""Successive halving: reduce many poses to one, with finer costs as poses become fewer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.devices import moved, without_waiting
from bidnerf_core.errors import amount
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.normal_equations import Cost
from bidnerf_core.localization.recording import current_record
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.progress import check_stopped


@dataclass(frozen=True, eq=False)
class SearchStage:
    """A stage: steps from all remaining poses, the best ``keep`` of which pass to the next stage."""

    cost: Cost
    pivot: Pivot
    steps: int
    keep: int
    damping: float  # of the first step
    # The score by which poses are compared after the steps; None: the cost.
    score: Callable[[SE3], Float[Tensor, "h"]] | None = None


@dataclass(frozen=True)
class Distinct:
    """Decides whether two poses are different answers or approximations of the same one."""

    middle: Float[Tensor, "3"]  # centre of the visible scene, metres, last camera's frame
    distance: float  # poses that put it farther apart than this (metres) are different
    angle: float  # so are poses whose orientations differ by more than this (radians)

    def __call__(self, T: SE3) -> Bool[Tensor, "h"]:
        """Return a mask of the poses that differ from the first."""
        middles = T.apply(self.middle.to(T.translation))
        away = torch.linalg.vector_norm(middles - middles[0], dim=-1) > self.distance
        trace = (T.rotation[0].mT @ T.rotation).diagonal(dim1=-2, dim2=-1).sum(-1)
        return away | (trace < 1 + 2 * math.cos(self.angle))


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The remaining poses of a search, and the margin of the best over any different one; on the CPU."""

    T: SE3  # (h), best first
    scores: Float[Tensor, "h"]
    margin: float  # score of the best different pose minus that of the best; infinite if there was none
    path: SE3  # (s + 1): from the winning hypothesis to the best pose
    losses: Float[Tensor, "s"]  # of the path before each step; costs of different stages are not comparable


def search(
    start: SE3, stages: Iterable[SearchStage], distinct: Distinct, keep_runner_up: bool,
    device: torch.device | None = None,
) -> SearchResult:  # fmt: skip
    """Run the stages on the hypotheses ``start`` (h) and return the poses that remain.

    Steps are taken on ``device``, by default that of the hypotheses.

    With ``keep_runner_up``, if the best poses of a stage are all the same answer, the last of them is replaced by the best
    different one, and the margin is that of the last stage. Without it, the margin is that of the last stage with different
    poses. The host waits for the device between stages, but not within one.
    """
    device = start.device if device is None else device
    T, distinct = start.to(device), moved(distinct, device)
    paths, margin = [T[None]], math.inf
    losses = [torch.zeros((0, len(T.translation)), dtype=torch.float64, device=device)]
    scores = losses[0]
    for stage in stages:
        check_stopped()
        with without_waiting():
            done = descend(stage.cost, T, stage.steps, stage.pivot.to(device).moved, stage.damping)
            scores = done.equations.cost if stage.score is None else stage.score(done.T)
        best = _best(done.T, scores, stage.keep, distinct if keep_runner_up else None)
        if (record := current_record()) is not None:
            taken = f"after {stage.steps} steps from each" if stage.steps else "as they were drawn"
            record.add(f"{amount(len(scores), 'pose')} {taken}; {len(best)} kept", done.T, scores, len(best))
        paths = [path[:, best] for path in (*paths, done.poses[1:])]
        losses = [values[:, best] for values in (*losses, done.costs[:-1])]
        T, compared = done.T[best], best if keep_runner_up else scores.argsort()
        if stage.steps:
            now = _margin(done.T[compared], scores[compared], distinct)
            margin = now if keep_runner_up or math.isfinite(now) else margin
        scores = scores[best]
    path = SE3.cat([path[:, 0] for path in paths])
    found = SearchResult(T, scores, margin, path, torch.cat([values[:, 0] for values in losses]))
    return moved(found, "cpu")


def _best(T: SE3, scores: Float[Tensor, "h"], count: int, distinct: Distinct | None) -> Int[Tensor, "k"]:
    order = scores.argsort()
    best = order[:count]
    if distinct is None or count == 1 or bool(distinct(T[best]).any()):
        return best
    others = order[distinct(T[order])]
    return torch.cat([best[:-1], others[:1]]) if len(others) else best


def _margin(T: SE3, scores: Float[Tensor, "h"], distinct: Distinct) -> float:
    """Return the score of the best different pose minus that of the first; poses are sorted best first."""
    others = scores[distinct(T)]
    return float(others.min() - scores[0]) if len(others) else math.inf
