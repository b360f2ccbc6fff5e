"""Localization on a map's baked surface, without landmarks: by measured depth, or by comparing images with renderings of the surface."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import normalize

from bidnerf_core.devices import move_to
from bidnerf_core.fields import levels
from bidnerf_core.frames import Thumbnail, is_blank
from bidnerf_core.geometry import SE3, random_units
from bidnerf_core.localization.accept import Support, support
from bidnerf_core.localization.loop import Loop
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search import (
    SIGMA,
    SearchResult,
    Stage,
    conclude,
    draw_rays,
    halve,
    localization_by_rays,
    states_at,
    without_pose,
)
from bidnerf_core.localization.settings import AutoConfig, ColourSettings, DepthLossSettings
from bidnerf_core.localization.terms.images import Images, surface_renderer
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import GaussianPrior, States, SurfaceMap, cast, descend, trace

ON_SURFACE = 0.02
"""Distance at which a point's inlier weight is one half when poses are compared, as a fraction of the scene's extent."""
SIGHT_LINES = 300
"""Maximum number of lines of sight that are traced."""
POINT_STAGES = (
    # points, steps, poses kept, distance as a fraction of the scene's extent (0: the finest), weight of colours
    (48, 0, 96, 0.3, 0.0),
    # Colour has no weight at first: its derivatives are valid only within a surfel, and would only slow down distant poses.
    (48, 8, 24, 0.3, 0.0),
    (100, 10, 6, 0.2, 0.0),
    (400, 6, 2, 0.05, 0.1),
    (2000, 4, 1, 0.0, 1.0),
)
IMAGE_STAGES = (
    # pixels of the longer side, steps, poses kept, fraction of the pixels that must agree at the best pose, or the search ends
    (16, 0, 48, 0.6),
    (16, 8, 12, 0.7),
    (24, 8, 4, 0.7),
    (48, 8, 2, 0.7),
    (96, 5, 2, 0.7),
)


@torch.no_grad()
def localize_by_depth(
    problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int, loop: Loop | None
) -> Localization | None:
    """Align measured points with the surface, in rounds until a pose is acceptable, then refine this pose with rendered rays as well.

    Returns None if too few points were measured.
    """
    points = Surface.of(problem.views, problem.depth_rays, surface, seed, config.points)
    if points is None:
        return None
    middle, searches = points.points.median(0).values.cpu(), list[SearchResult]()
    for number in range(config.rounds):
        searches.append(by_depth(problem, points, config.hypotheses, seed + number))
        found = min(searches, key=lambda search: float(search.scores[0]))
        compared = for_comparison(points).match_exposure(found.states[:1])
        finest = replace(compared, noise=surface.cell)
        best, _ = descend(found.states[:1], [finest], 4, middle)
        measures = measure_support(compared, best)
        supported = Support({**measures, "runner_up_margin": found.margin}).verdict("").accepted
        if supported:
            break
    aligned, path, losses = finest.fitted_noise(best), found.path, found.losses
    if config.refine_steps and supported:
        # The pose is nearly right, hence a small uncertainty of the field's surfaces.
        depth = DepthLossSettings(depth_weight=1.0)
        rays = draw_rays(problem, ColourSettings(), depth, config.refine_rays, seed, sigma=1.25 * SIGMA)
        rays = replace(rays, noise=problem.colour_noise or rays.noise)
        steps: list[tuple[SE3, Tensor]] = []
        refined, _ = descend(best, [aligned, rays], config.refine_steps, middle, steps)
        inliers = 0.0
        # If the refinement raises the cost on the surface by more, field and surface contradict each other.
        if float(compared.costs(refined).mean()) <= float(compared.costs(best).mean()) + 0.05:
            path = SE3.cat([path, *(T for T, _ in steps[1:]), refined.T])
            losses = torch.cat([losses, *(cost for _, cost in steps)])
            best, inliers = refined, float(rays.at(refined, derivatives=False).agreement()[0])
        measures = {**measure_support(compared, best), "rendered_inliers": inliers}
    T = best.T[0].normalized()
    # In directions that the points do not constrain, such as along a bare wall, the standard deviation is the size of the scene or half a
    # turn. The precision is without the uncertainties of the sensor's scale and offset, which all points share.
    unconstrained = torch.tensor([surface.extent] * 3 + [math.pi] * 3, dtype=torch.float64)
    anywhere = GaussianPrior(best.T[0], unconstrained.square().reciprocal().diag())
    covariance = torch.linalg.inv((aligned(best) + anywhere(best)).hessian[0, :6, :6])
    precision = float(covariance[:3, :3].trace().sqrt() / middle.norm())
    sight = normalize((points.points - points.sights.translation).cpu(), dim=-1).mean(0)
    shared = torch.stack([problem.sensor.scale * middle, problem.sensor.offset * sight], -1)
    covariance[:3, :3] += shared @ shared.mT
    rivals = support(lambda T: finest.costs(states_at(T)), T, middle)
    # With the right camera, landmarks should confirm the pose; where they do not, only a precise alignment is accepted.
    measures |= {
        **rivals,
        "runner_up_margin": found.margin,
        "precision": None if problem.matcher is None else precision,
    }
    words = f"{measures['colour_inliers']:.0%} of the measured points match the surface in position and colour"
    loss = float(compared.costs(best).mean())
    path = SE3.cat([path[:-1], T[None]])
    return conclude(problem, loop, path, losses, Support(measures), words, loss, (covariance + covariance.mT) / 2)


def localize_by_images(
    problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int, loop: Loop | None
) -> Localization:
    """Localize by comparing the images with renderings of the surface, in rounds until an answer is accepted.

    Each answer is refined on rays rendered from the field, unless too much of the image disagrees with the surface at all poses. If no
    answer is accepted, the one with the smallest loss is returned, of those whose search was completed if there are any.
    """
    problem, answers = problem.without_depth(), list[tuple[bool, bool, float, Localization]]()
    if all(is_blank(view.frame) for view in problem.views):
        why = Verdict(Outcome.UNDETERMINED, "the image has a single colour, as if the lens were covered")
        return without_pose(problem, why)
    for number in range(config.rounds):
        coarse = draw_rays(
            problem, config.colour, None, config.fine_rays // 4, seed, levels(problem.field)[0], 2, SIGMA
        )
        fine, fresh = (
            draw_rays(problem, config.colour, None, config.fine_rays, seed + more, sigma=SIGMA / 2) for more in (1, 2)
        )
        later = [Stage([coarse], min(4, config.fine_steps), 2), Stage([fine], config.fine_steps, 1)]
        found, middle = by_images(problem, surface, config.hypotheses, seed + number, later)
        if found.complete:
            answer = localization_by_rays(problem, loop, found, fresh, middle, config.converged_inliers)
        else:
            loss = float(found.scores[0])
            judged = Support({"image_inliers": 1 - loss / Images.INDEPENDENT})
            answer = conclude(problem, loop, found.path, found.losses, judged, "", loss, None)
        answers.append((answer.converged, found.complete, -answer.loss, answer))
        # Another round does not determine a focal length.
        if answer.outcome in (Outcome.CONVERGED, Outcome.IMPRECISE):
            break
    # The loss of a search that ended early is that of small images, on another scale.
    return max(answers, key=lambda answer: answer[:3])[-1]


def by_depth(problem: Problem, points: Surface, count: int, seed: int) -> SearchResult:
    """Align measured points with the surface from ``count`` hypotheses throughout the scene; return the result, best pose first.

    Scores are mean costs per point, from 0 to 2.
    """
    surface, middle, stages = points.surface, points.points.median(0).values, list[Stage]()
    for n, steps, keep, distance, colour in POINT_STAGES:
        term = replace(points.first(n), noise=distance * surface.extent / 2 or surface.cell, colour_weight=colour)
        # Poses are compared on at least 200 points, even if fewer suffice for the steps.
        compared = for_comparison(points.first(max(n, 200)))
        stages.append(Stage([term], steps, keep, compared.mean_cost if steps else None))
    start = hypotheses(surface, problem.start, middle, count, True, seed)
    return halve(states_at(start), stages, middle, surface.device)


def by_images(
    problem: Problem, surface: SurfaceMap, count: int, seed: int, later: Iterable[Stage] = ()
) -> tuple[SearchResult, Float[Tensor, "3"]]:
    """Compare the images with renderings of the surface from ``count`` hypotheses throughout the scene, then run ``later`` stages.

    Returns the result, best pose first, and the middle of the visible scene (metres, last camera's frame). Rays cast from keyframes give
    the typical distance of the scene, and whether it has a background.
    """
    small = move_to(Thumbnail.of(problem.views[-1], 16), surface.device)
    keyframes = SE3.from_matrix(surface.keyframes[:: max(1, len(surface.keyframes) // 16)]).to(small.flat)
    directions = normalize(small.flat, dim=-1) @ keyframes.rotation.mT
    origins = keyframes.translation[:, None].expand_as(directions)
    seen = cast(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))
    distance = float(seen.along[seen.met].median()) if bool(seen.met.any()) else surface.extent
    middle = torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
    # A map has a background if more than a fifth of the keyframes' rays hit nothing.
    background = problem.bounds.background if float(seen.met.float().mean()) < 1 - 0.2 else None
    renderer = surface_renderer(surface, background)
    stages = []
    for width, steps, keep, agreeing in IMAGE_STAGES:
        thumbnails = [move_to(Thumbnail.of(view, width), surface.device) for view in problem.views]
        # Wide scales cope with images exposed twice or half as long as the map's.
        term, most = Images(renderer, thumbnails, gain=1.0, rounds=5), (1 - agreeing) * Images.INDEPENDENT
        stages.append(Stage([term], steps, keep, most=most))
    start = states_at(hypotheses(surface, problem.start, middle, count, False, seed))
    return halve(start, [*stages, *later], middle, surface.device), middle


def hypotheses(
    surface: SurfaceMap, start: SE3 | None, middle: Float[Tensor, "3"], count: int, by_points: bool, seed: int
) -> SE3:
    """Return ``count`` poses from which a query may have been taken, on the CPU so that a seed gives the same poses on any device.

    Half are near keyframes. The other half are farther from keyframes, and a quarter of them are turned: with ``by_points``, about any axis,
    and then moved so that the points' ``middle`` (metres, last camera's frame) is the middle of the scene, which suits cameras around an
    object; otherwise, about the viewing direction. If there is a start, a quarter of all poses are the start and poses near it.
    """
    generator = Generator().manual_seed(seed)
    keyframes = SE3.from_matrix(surface.keyframes).to("cpu", torch.float64)
    middle, total = middle.to("cpu", torch.float64), len(keyframes.translation)
    # No keyframe is repeated before all have been drawn.
    order = torch.cat([torch.randperm(total, generator=generator) for _ in range(-(-count // total))])[:count]

    def displace(T: SE3, translation: float, rotation: float) -> SE3:
        """Displace poses about ``middle`` at random, with these standard deviations (fraction of the extent, radians)."""
        size = torch.tensor([translation * surface.extent] * 3 + [rotation] * 3, dtype=torch.float64)
        noise = torch.randn((len(T.translation), 6), generator=generator, dtype=torch.float64)
        return T.retract_about(middle, noise * size)

    near = 0 if start is None else max(1, count // 4)
    half = near + (count - near + 1) // 2
    others = displace(keyframes[order[half:]], 0.05, 0.15)
    turn = torch.zeros((len(order[half:]), 6), dtype=torch.float64)
    axes = random_units(len(turn), generator) if by_points else torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turn[:, 3:] = math.pi * (2 * torch.rand((len(turn), 1), generator=generator, dtype=torch.float64) - 1) * axes
    turn[torch.arange(len(turn)) % 4 > 0] = 0
    others = others.retract(turn)
    if by_points:
        centre = surface.surfels.positions.median(0).values.cpu().double()
        others = SE3(others.rotation, centre - others.rotation @ middle)
    around = [] if start is None else [start[None], displace(SE3.stack([start] * near)[1:], 0.1, 0.25)]
    return SE3.cat([*around, displace(keyframes[order[near:half]], 0.02, 0.05), others])


def for_comparison(points: Surface) -> Surface:
    """Return the points' term at the fixed scale at which poses are compared."""
    return replace(points, noise=ON_SURFACE / 2 * points.surface.extent, colour_weight=1.0)


def measure_support(points: Surface, best: States) -> dict[str, float | None]:
    """Return the measures of ``Support`` for the points at one pose; each point counts with its inlier weight.

    Points without a colour are left out of the colour inliers, unless no point has a colour.
    """
    near, alike = points.inliers(best)
    coloured = (points.coloured > 0).to(near.device)
    both = (near * alike)[:, coloured] if bool(coloured.any()) else near
    surface, T = points.surface, best.T[0].to(points.surface.device)
    origins = T.apply(points.sights.translation[:SIGHT_LINES])
    lines = (T.apply(points.points[:SIGHT_LINES]) - origins).float()
    length = lines.norm(dim=-1)
    hit = trace(surface, origins.float(), lines / length.clamp(min=1e-9)[:, None])
    # A line of sight violates free space only if it hits the surface well before its point, because grazing rays hit coarse cells early.
    early = hit < length - max(2 * ON_SURFACE * surface.extent, 4 * surface.cell)
    shares = {"on_surface": near, "colour_inliers": both, "free_space_violations": early.double()}
    return {name: float(share.mean()) for name, share in shares.items()}
