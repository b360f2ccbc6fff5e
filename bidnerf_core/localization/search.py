"""Search without landmarks: successive halving of many poses by measured points or small images, with finer terms as they become fewer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Generator, Tensor
from torch.nn.functional import normalize
from torch.quasirandom import SobolEngine

from bidnerf_core.devices import moved, without_waiting
from bidnerf_core.errors import amount
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.recording import current_record
from bidnerf_core.localization.support import same_pose
from bidnerf_core.localization.terms.images import (
    ColourScales,
    Images,
    Renderer,
    Thumbnail,
    surface_renderer,
)
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import States, SurfaceMap, Term, cast, descend
from bidnerf_core.progress import check_cancelled

RIVALS = 3
"""Maximum number of other poses with which the best one is compared."""
OTHER = 0.2
"""Displacement beyond which two poses of a search are different answers, see ``same_pose``: twice that of a rival, since poses are
still on their way to a minimum.
"""


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage: steps from all remaining poses, the best ``keep`` of which pass to the next stage."""

    terms: Sequence[Term]
    steps: int
    keep: int
    score: Callable[[States], Float[Tensor, "h"]] | None = None  # by which poses are compared; None: the cost


@dataclass(frozen=True, eq=False)
class Proposals:
    """The remaining poses of a search, and how much better the best one is than any different one; on the CPU."""

    states: States  # (h), best first
    scores: Float[Tensor, "h"]
    margin: float  # score of the best different pose minus that of the best; infinite if there was none
    rivals: States  # the best ones that differed from the best pose when there were several for the last time
    before: States  # (1) the best one of the stage before the last
    path: SE3  # (s + 1): from the winning hypothesis to the best pose
    losses: Float[Tensor, "s"]  # of the path before each step; costs of different stages are not comparable
    middle: Float[Tensor, "3"]  # of the visible scene, metres, last camera's frame

    def then(self, later: Proposals) -> Proposals:
        """Return the proposals of a later search, which began at these, with the path from the start of this one."""
        rivals = later.rivals if len(later.rivals) else self.rivals
        path, losses = SE3.cat([self.path[:-1], later.path]), torch.cat([self.losses, later.losses])
        return replace(later, rivals=rivals, path=path, losses=losses)


def halve(
    start: States, stages: Iterable[Stage], middle: Float[Tensor, "3"], device: torch.device | str = "cpu"
) -> Proposals:
    """Run the stages on the hypotheses ``start`` (h) and return the poses that remain.

    ``middle`` is that of the visible scene (metres, last camera's frame). If the best poses of a stage are all the same answer,
    the last of them is replaced by the best different one. Steps are taken on ``device``; the host waits for it between
    stages, but not within one.
    """
    states, middle = moved(start, device), middle.to(device, torch.float64)
    poses, losses, margin, scores = [states.T[None]], list[Tensor](), math.inf, states.noise
    rivals = before = states[:0]
    for stage in stages:
        check_cancelled()
        path: list[tuple[SE3, Tensor]] = []
        before = states[:1]
        with without_waiting():
            states, here = descend(states, stage.terms, stage.steps, middle, path)
            scores = here.cost if stage.score is None else stage.score(states)
        order = scores.argsort()
        other = order[~same_pose(states.T[order[0]], states.T[order], middle, OTHER)]
        kept = order[: stage.keep]
        if len(other):
            margin, rivals = float(scores[other[0]] - scores[order[0]]), states[other[:RIVALS]]
            if stage.keep > 1 and not torch.isin(kept, other).any():
                kept = torch.cat([kept[:-1], other[:1]])
        if (record := current_record()) is not None:
            taken = f"after {stage.steps} steps from each" if stage.steps else "as they were drawn"
            record.add(
                f"{amount(len(scores), 'pose')} {taken}; {len(kept)} kept", states.T, scores, len(kept)
            )
        poses += [T[None] for T, _ in path[1:]] + ([states.T[None]] if path else [])
        losses += [cost for _, cost in path]
        poses, losses = [T[:, kept] for T in poses], [values[kept] for values in losses]
        states, scores = states[kept], scores[kept]
    path_losses = torch.stack([values[0] for values in losses]) if losses else scores[:0]
    path_poses = SE3.cat([T[:, 0] for T in poses])
    found = Proposals(states, scores, margin, rivals, before, path_poses, path_losses, middle)
    return moved(found, "cpu")


def states_at(T: SE3) -> States:
    """Return the states of poses (h) of known cameras at rest."""
    one = States.known(SE3.identity(), torch.zeros(6, dtype=torch.float64))
    return replace(one[torch.zeros(len(T.translation), dtype=torch.long)], T=T.to("cpu", torch.float64))


# Starts.


def neighbours(T: SE3, count: int, translation: float, rotation: float, seed: int) -> SE3:
    """Return ``T`` and ``count`` - 1 right updates of it, quasi-random samples of a normal distribution.

    ``translation`` (metres) and ``rotation`` (radians) are its standard deviations along and about each axis of the camera;
    the samples are a Sobol sequence, scrambled with ``seed``. Shape (count).
    """
    even = SobolEngine(6, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    xi = _spread(translation, rotation) * torch.special.ndtri(even.clamp(1e-6, 1 - 1e-6))
    xi[0] = 0
    return SE3(T.rotation[None], T.translation[None]).retract(xi)


def hypotheses(
    surface: SurfaceMap, start: SE3 | None, middle: Float[Tensor, "3"], count: int, by_points: bool, seed: int
) -> SE3:
    """Return ``count`` poses from which a query may have been taken; on the CPU, so that a seed gives the same on any device.

    Half are poses of keyframes, slightly displaced where they repeat. For points, the others place their ``middle`` at that of the
    scene, which suits cameras around an object, with orientations near those of keyframes or, for a quarter, random. For
    images, they are keyframes displaced about the middle of their view, every fourth of them rolled. If there is a start, a
    quarter of all poses are the start and poses near it.
    """
    generator, extent = Generator().manual_seed(seed), surface.extent
    keyframes = SE3.from_matrix(surface.keyframes).to("cpu", torch.float64)
    about = Pivot.at_point(middle.cpu())

    def displaced(T: SE3, translation: float, rotation: float) -> SE3:
        noise = torch.randn((len(T.translation), 6), generator=generator, dtype=torch.float64)
        return about.moved(T, noise * _spread(translation * extent, rotation))

    def drawn(many: int) -> SE3:
        """Draw keyframes, none repeated before all have been drawn."""
        total = len(keyframes.translation)
        order = [torch.randperm(total, generator=generator) for _ in range(max(1, -(-many // total)))]
        return keyframes[torch.cat(order)[:many]]

    parts = list[SE3]()
    if start is not None:
        many = max(1, count // 4)
        own = SE3(start.rotation.expand(many, 3, 3), start.translation.expand(many, 3))
        half = torch.randn((many // 2, 6), generator=generator, dtype=torch.float64) * _spread(
            0.05 * extent, 0.25
        )
        near = displaced(own[many // 2 + 1 :], 0.1 if by_points else 0.05, 0.25)
        parts += [own[:1], own[: many // 2].retract(half), near]
        count -= many
    plain = drawn(count - count // 2)
    if len(plain.translation) > len(keyframes.translation) or by_points:
        plain = displaced(plain, 0.02, 0.05)
    parts.append(plain)
    if by_points:
        rest = count // 2
        quaternions = torch.randn((rest // 4, 4), generator=generator, dtype=torch.float64)
        turns = quaternion_to_rotation_matrix(normalize(quaternions, dim=-1))
        rotations = torch.cat([displaced(drawn(rest - len(turns)), 0.02, 0.05).rotation, turns])
        centre = surface.surfels.positions.median(0).values.cpu().double()
        parts.append(SE3(rotations, centre - rotations @ middle.cpu().double()))
    else:
        others = displaced(drawn(count // 2), 0.05, 0.15)
        roll = torch.zeros((len(others.translation), 6), dtype=torch.float64)
        turn = torch.rand(len(roll[::4]), generator=generator, dtype=torch.float64)
        roll[::4, 5] = math.pi * (2 * turn - 1)
        parts.append(others.retract(roll))
    return SE3.cat(parts)


def _spread(translation: float, rotation: float) -> Float[Tensor, "6"]:
    return torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64)


# By measured depth.

JUDGED = 0.02
"""Distance at which a point's inlier weight is one half when poses are compared, as a fraction of the scene's extent."""
COMPARED_POINTS = 200
"""Minimum number of points on which poses are compared."""
POINT_STAGES = (
    # points, steps, poses kept, distance as a fraction of the scene's extent (0: the finest), weight of colours
    (48, 0, 96, 0.3, 0.0),
    # Colour has no weight at first: its derivatives are valid only within a surfel, and would only slow down distant poses.
    (48, 8, 24, 0.3, 0.0),
    (100, 10, 6, 0.2, 0.0),
    (400, 6, 2, 0.05, 0.1),
    (2000, 4, 1, 0.0, 1.0),
)


def judge(points: Surface) -> Surface:
    """Return the term at the fixed scale at which poses are compared."""
    return replace(points, noise=JUDGED / 2 * points.surface.extent, colour_weight=1.0)


def _mean_cost(points: Surface) -> Callable[[States], Float[Tensor, "h"]]:
    return lambda states: points.costs(states).mean(-1)


def by_depth(problem: Problem, points: Surface, count: int, seed: int) -> Proposals:
    """Align measured points with the surface from ``count`` hypotheses all over the scene, best first.

    Scores are mean costs of points, from 0 to 2.
    """
    surface, middle = points.surface, points.points.median(0).values
    stages = []
    for n, steps, keep, distance, colour in POINT_STAGES:
        some = points.first(n)
        noise = distance * surface.extent / 2 or surface.cell
        score = _mean_cost(judge(points.first(max(n, COMPARED_POINTS)))) if steps else None
        stages.append(Stage([replace(some, noise=noise, colour_weight=colour)], steps, keep, score))
    start = hypotheses(surface, problem.start, middle, count, True, seed)
    return halve(states_at(start), stages, middle, surface.device)


# By images.

OPEN = 0.2
"""Fraction of the keyframes' rays that hit nothing above which the map counts as having a background."""
WIDE = ColourScales(gain=1.0, rounds=5)
"""Scales for finding images exposed twice or half as long."""
DETAILED = ColourScales(colour=0.07)
"""Scales for partly hidden images: wider ones favour poses that partly explain the occluders' colours.

They assume approximately the map's exposure, since wider priors would also explain more of the occluders.
"""
IMAGE_STAGES = ((16, 0, 48), (16, 8, 12), (24, 8, 4), (48, 8, 2), (96, 5, 2))
"""Pixels of the longer side, steps, poses kept."""
DETAILED_STAGES = ((32, 0, 64), (32, 6, 16), (48, 8, 6), (96, 6, 2), (192, 4, 2))
"""Stages for partly hidden images: in smaller thumbnails, nearly every pixel would contain part of the occluders."""


def image_stages(
    problem: Problem,
    renderer: Renderer,
    device: torch.device,
    scales: ColourScales,
    stages: Sequence[tuple[int, int, int]],
) -> Iterable[Stage]:
    """Yield the stages of a search by small images."""
    for width, steps, keep in stages:
        thumbnails = [moved(Thumbnail.of(view, width), device) for view in problem.views]
        yield Stage([Images(renderer, thumbnails, scales)], steps, keep)


def by_images(
    problem: Problem, surface: SurfaceMap, count: int, seed: int, detailed: bool = False
) -> Proposals:
    """Compare the images with renderings of the surface from ``count`` hypotheses all over the scene, best first.

    Rays cast from the keyframes give the typical distance of the scene, and whether it has a background. ``detailed``: for
    images that something partly hides.
    """
    small = moved(Thumbnail.of(problem.views[-1], 16), surface.device)
    keyframes = SE3.from_matrix(surface.keyframes[:: max(1, len(surface.keyframes) // 16)]).to(small.flat)
    directions = normalize(small.flat, dim=-1) @ keyframes.rotation.mT
    origins = keyframes.translation[:, None].expand_as(directions)
    seen = cast(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))
    away = float(seen.along[seen.met].median()) if bool(seen.met.any()) else surface.extent
    has_background = float(seen.met.float().mean()) < 1 - OPEN
    middle = torch.tensor([0.0, 0.0, away], dtype=torch.float64)
    renderer = surface_renderer(surface, problem.bounds.background if has_background else None)
    scales, stages = (DETAILED, DETAILED_STAGES) if detailed else (WIDE, IMAGE_STAGES)
    start = states_at(hypotheses(surface, problem.start, middle, count, False, seed))
    return halve(
        start, image_stages(problem, renderer, surface.device, scales, stages), middle, surface.device
    )
