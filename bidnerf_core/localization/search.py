"""Search without landmarks: successive halving of many poses, with finer terms as fewer poses remain."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.quasirandom import SobolEngine

from bidnerf_core.devices import moved, without_waiting
from bidnerf_core.errors import amount
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.accept import DISPLACEMENT, same_pose
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import current_record
from bidnerf_core.localization.terms.images import ColourScales, Images, Renderer, Thumbnail
from bidnerf_core.mapping import CostTerm, States, descend
from bidnerf_core.progress import check_cancelled


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of a search: steps from all remaining poses; the best ``keep`` poses pass to the next stage."""

    terms: Sequence[CostTerm]
    steps: int
    keep: int
    score: Callable[[States], Float[Tensor, "h"]] | None = None  # by which poses are compared; None: the cost


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The remaining poses of a search, and how much better the best one is than any different one; on the CPU."""

    states: States  # (h), best first
    scores: Float[Tensor, "h"]
    margin: float  # score of the best different pose minus that of the best; infinite if there was none
    rivals: States  # the best ones that differed from the best pose when there were several for the last time
    before: States  # (1) the best one of the stage before the last
    path: SE3  # (s + 1): from the winning hypothesis to the best pose
    losses: Float[Tensor, "s"]  # of the path before each step; costs of different stages are not comparable


def halve(
    start: States, stages: Iterable[Stage], middle: Float[Tensor, "3"], device: torch.device | str = "cpu"
) -> SearchResult:
    """Run the stages on the hypotheses ``start`` (h) and return the poses that remain.

    ``middle`` is the middle of the visible scene (metres, last camera's frame). If the best poses of a stage are all the same
    answer, the last of them is replaced by the best different pose. Steps are taken on ``device``; the host waits for the device
    between stages, but not within a stage.
    """
    states, middle = moved(start, device), middle.to(device, torch.float64)
    poses, losses, margin, scores = [states.T[None]], list[Tensor](), float("inf"), states.noise
    rivals = before = states[:0]
    for stage in stages:
        check_cancelled()
        path: list[tuple[SE3, Tensor]] = []
        before = states[:1]
        with without_waiting():
            states, here = descend(states, stage.terms, stage.steps, middle, path)
            scores = here.cost if stage.score is None else stage.score(states)
        order = scores.argsort()
        # Twice the displacement of a rival, since poses are still on their way to a minimum.
        other = order[~same_pose(states.T[order[0]], states.T[order], middle, 2 * DISPLACEMENT)]
        passing = order[: stage.keep]
        if len(other):
            # The best pose is compared with three others at most.
            margin, rivals = float(scores[other[0]] - scores[order[0]]), states[other[:3]]
            if stage.keep > 1 and not torch.isin(passing, other).any():
                passing = torch.cat([passing[:-1], other[:1]])
        if (record := current_record()) is not None:
            taken = f"after {stage.steps} steps from each" if stage.steps else "as they were drawn"
            record.add(
                f"{amount(len(scores), 'pose')} {taken}; {len(passing)} kept", states.T, scores, len(passing)
            )
        poses += [T[None] for T, _ in path[1:]] + ([states.T[None]] if path else [])
        losses += [cost for _, cost in path]
        poses, losses = [T[:, passing] for T in poses], [values[passing] for values in losses]
        states, scores = states[passing], scores[passing]
    path_losses = torch.stack([values[0] for values in losses]) if losses else scores[:0]
    path_poses = SE3.cat([T[:, 0] for T in poses])
    return moved(SearchResult(states, scores, margin, rivals, before, path_poses, path_losses), "cpu")


def image_stages(
    problem: Problem, renderer: Renderer, device: torch.device, scales: ColourScales,
    stages: Sequence[tuple[int, int, int]],
) -> Iterator[Stage]:  # fmt: skip
    """Yield the ``stages`` of a search with small images, given as pixels of the longer side, steps, and poses to keep."""
    for width, steps, keep in stages:
        thumbnails = [moved(Thumbnail.of(view, width), device) for view in problem.views]
        yield Stage([Images(renderer, thumbnails, scales)], steps, keep)


def states_at(T: SE3) -> States:
    """Return static states with known cameras at the poses ``T`` (h)."""
    one = States.known(SE3.identity(), torch.zeros(6, dtype=torch.float64))
    return replace(one[torch.zeros(len(T.translation), dtype=torch.long)], T=T.to("cpu", torch.float64))


def neighbours(T: SE3, count: int, translation: float, rotation: float, seed: int) -> SE3:
    """Return ``T`` and ``count`` - 1 right updates of ``T``, quasi-random samples of a normal distribution.

    ``translation`` (metres) and ``rotation`` (radians) are the standard deviations along and about each axis of the camera;
    the samples are a Sobol sequence, scrambled with ``seed``. Shape (count).
    """
    even = SobolEngine(6, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    size = torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64)
    xi = size * torch.special.ndtri(even.clamp(1e-6, 1 - 1e-6))
    xi[0] = 0
    return SE3(T.rotation[None], T.translation[None]).retract(xi)
