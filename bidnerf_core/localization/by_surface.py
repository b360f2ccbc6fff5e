"""Localization on a map's baked surface, without landmarks: by measured depth, or by comparing images with renderings of the surface."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Generator, Tensor
from torch.nn.functional import normalize

from bidnerf_core.devices import move_to
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.accept import Support, support
from bidnerf_core.localization.problem import Pivot, Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search import (
    COLOUR_SIGMA,
    SHAPE_SIGMA,
    RayTerms,
    SearchResult,
    Stage,
    colour_stages,
    halve,
    image_stages,
    localization_by_rays,
    states_at,
)
from bidnerf_core.localization.settings import LEAST_POINTS, AutoConfig, ColourSettings, DepthLossSettings
from bidnerf_core.localization.terms.images import ColourScales, Thumbnail, surface_renderer
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import States, SurfaceMap, cast, descend, trace

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
IMAGE_STAGES = ((16, 0, 48), (16, 8, 12), (24, 8, 4), (48, 8, 2), (96, 5, 2))
"""Stages of the search by images: pixels of the longer side, steps, poses kept."""
DETAILED_STAGES = ((32, 0, 64), (32, 6, 16), (48, 8, 6), (96, 6, 2), (192, 4, 1))
"""Stages for partly hidden images: in smaller thumbnails, nearly every pixel would contain part of the occluders."""


@torch.no_grad()
def localize_by_depth(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization | None:
    """Align measured points with the surface, in rounds until a pose is acceptable, then refine this pose with rendered rays as well.

    Returns None if too few points were measured.
    """
    began = time.perf_counter()
    points = Surface.of(problem.views, problem.depth_rays, surface, seed, config.points)
    if points is None:
        return None
    middle = points.points.median(0).values.cpu()
    found: SearchResult
    for number in range(config.rounds):
        again = by_depth(problem, points, config.hypotheses, seed + number)
        found = again if number == 0 or again.scores[0] < found.scores[0] else found
        best, exposed = _exposed(points, found.states[:1], middle)
        evidence = _evidence(exposed, best, found.margin)
        supported = Support(evidence).verdict("").accepted
        if supported:
            break
    score = _score(exposed)
    finest = replace(exposed, noise=surface.cell, colour_weight=1.0)
    refined, path, losses = finest.fitted_noise(best), found.path, found.losses
    if config.refine_steps and supported:
        terms = RayTerms(ColourSettings(), DepthLossSettings(depth_weight=1.0))
        # The pose is nearly right, hence a small uncertainty of the field's surfaces.
        term = terms.term(problem, config.refine_rays, seed, sigma=SHAPE_SIGMA / 4)
        rays = replace(term, noise=problem.colour_noise or term.noise)
        steps: list[tuple[SE3, Tensor]] = []
        there, _ = descend(best, [refined, rays], config.refine_steps, middle, steps)
        inliers = 0.0
        # If the refinement raises the cost on the surface by more, field and surface contradict each other.
        if float(score(there)) <= float(score(best)) + 0.05:
            path = SE3.cat([path, *(T for T, _ in steps[1:]), there.T])
            losses = torch.cat([losses, *(cost for _, cost in steps)])
            best, inliers = there, float(term.agreement(there)[0])
        evidence = _evidence(exposed, best, found.margin) | {"rendered_inliers": inliers}
    T = best.T[0].normalized()
    evidence |= support(lambda T: finest.costs(states_at(T)), T, middle)
    covariance, precision = _covariance(problem, refined, best, middle)
    # With the right camera, landmarks should confirm the pose; where they do not, only a precise alignment is accepted.
    found_by = Support(evidence | {"precision": None if problem.matcher is None else precision})
    verdict = found_by.verdict(
        f"{evidence['colour_inliers']:.0%} of the measured points match the surface in position and colour"
    )
    first = path[:1] if problem.start is None else problem.start[None]
    path = SE3.cat([first, path[1:-1], T[None]])
    return Localization.of(verdict, path, losses, "auto", began, float(score(best)), covariance, found_by)


def localize_by_images(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Localize by comparing the images with renderings of the surface, in rounds until an answer is accepted.

    Each answer is refined on rays rendered from the field. The first round is fast; later rounds assume that part of the scene is occluded.
    If no answer is accepted, the one with the smallest loss is returned.
    """
    began, steps, answers = time.perf_counter(), config.by_colour, list[Localization]()
    problem, count = problem.without_depth(), config.hypotheses
    if all(is_blank(view.frame) for view in problem.views):
        found, _ = by_images(problem, surface, count, seed)
        why = Verdict(Outcome.UNDETERMINED, "the image has a single colour, as if the lens were covered")
        return Localization.of(why, found.path, found.losses, "auto", began, float(found.scores[0]))
    for number in range(config.rounds):
        terms = RayTerms(steps.colour, None)
        stages = colour_stages(problem, terms, steps, seed)
        if number > 0:
            # If half of the rays are outliers, refinement on few rays or at a coarse level drifts away from the true pose.
            robust = RayTerms(replace(steps.colour, colour_loss="geman-mcclure"), None)
            rays = robust.term(problem, 4 * steps.fine_rays, seed, wide=0.5, sigma=COLOUR_SIGMA / 2)
            stages = iter([Stage([rays], steps.fine_steps, 1)])
        found, middle = by_images(problem, surface, count, seed + number, number > 0, stages)
        fresh = terms.term(problem, steps.fine_rays, seed + 2, sigma=COLOUR_SIGMA / 2)
        least = steps.converged_inliers
        answers.append(localization_by_rays(problem, found, fresh, middle, least, "auto", began))
        if answers[-1].converged:
            return answers[-1]
    return min(answers, key=lambda answer: answer.loss)


def by_depth(problem: Problem, points: Surface, count: int, seed: int) -> SearchResult:
    """Align measured points with the surface from ``count`` hypotheses throughout the scene; return the result, best pose first.

    Scores are mean costs per point, from 0 to 2.
    """
    surface, middle, stages = points.surface, points.points.median(0).values, list[Stage]()
    for n, steps, keep, distance, colour in POINT_STAGES:
        noise = distance * surface.extent / 2 or surface.cell
        # Poses are compared on at least 200 points, even if fewer suffice for the steps.
        score = _score(points.first(max(n, 200))) if steps else None
        stages.append(Stage([replace(points.first(n), noise=noise, colour_weight=colour)], steps, keep, score))
    start = hypotheses(surface, problem.start, middle, count, True, seed)
    return halve(states_at(start), stages, middle, surface.device)


def by_images(
    problem: Problem, surface: SurfaceMap, count: int, seed: int, detailed: bool = False, later: Iterable[Stage] = ()
) -> tuple[SearchResult, Float[Tensor, "3"]]:
    """Compare the images with renderings of the surface from ``count`` hypotheses throughout the scene, then run ``later`` stages.

    Returns the result, best pose first, and the middle of the visible scene (metres, last camera's frame). Rays cast from keyframes give
    the typical distance of the scene, and whether it has a background. ``detailed`` is for partly occluded images: colour scales are
    narrow, as wider ones favour poses that partly explain the occluders' colours, and the exposure stays close to the map's.
    """
    small = move_to(Thumbnail.of(problem.views[-1], 16), surface.device)
    keyframes = SE3.from_matrix(surface.keyframes[:: max(1, len(surface.keyframes) // 16)]).to(small.flat)
    directions = normalize(small.flat, dim=-1) @ keyframes.rotation.mT
    origins = keyframes.translation[:, None].expand_as(directions)
    seen = cast(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))
    away = float(seen.along[seen.met].median()) if bool(seen.met.any()) else surface.extent
    # A map has a background if more than a fifth of the keyframes' rays hit nothing.
    has_background = float(seen.met.float().mean()) < 1 - 0.2
    middle = torch.tensor([0.0, 0.0, away], dtype=torch.float64)
    renderer = surface_renderer(surface, problem.bounds.background if has_background else None)
    # Wide scales cope with images exposed twice or half as long as the map's.
    scales = ColourScales(colour=0.07) if detailed else ColourScales(gain=1.0, rounds=5)
    sizes = DETAILED_STAGES if detailed else IMAGE_STAGES
    start = states_at(hypotheses(surface, problem.start, middle, count, False, seed))
    stages = chain(image_stages(problem, renderer, surface.device, scales, sizes), later)
    return halve(start, stages, middle, surface.device), middle


def hypotheses(
    surface: SurfaceMap, start: SE3 | None, middle: Float[Tensor, "3"], count: int, by_points: bool, seed: int
) -> SE3:
    """Return ``count`` poses from which a query may have been taken, on the CPU so that a seed gives the same poses on any device.

    Half are keyframe poses, slightly displaced if ``by_points`` is true or keyframes repeat. With ``by_points``, the other half align the
    points' ``middle`` (metres, last camera's frame) with the middle of the scene, which suits cameras around an object; their orientations
    are near those of keyframes or, for a quarter of them, random. For images, the other half are keyframe poses displaced about ``middle``,
    every fourth one rolled. If there is a start, a quarter of all poses are the start and poses near it.
    """
    generator, extent = Generator().manual_seed(seed), surface.extent
    keyframes = SE3.from_matrix(surface.keyframes).to("cpu", torch.float64)
    about = Pivot.at_point(middle.cpu())

    def noise(many: int, translation: float, rotation: float) -> Float[Tensor, "h 6"]:
        size = torch.tensor([translation * extent] * 3 + [rotation] * 3, dtype=torch.float64)
        return torch.randn((many, 6), generator=generator, dtype=torch.float64) * size

    def displaced(T: SE3, translation: float, rotation: float) -> SE3:
        return about.moved(T, noise(len(T.translation), translation, rotation))

    def drawn(many: int) -> SE3:
        """Draw keyframes, none repeated before all have been drawn."""
        total = len(keyframes.translation)
        order = [torch.randperm(total, generator=generator) for _ in range(max(1, -(-many // total)))]
        return keyframes[torch.cat(order)[:many]]

    parts = list[SE3]()
    if start is not None:
        many = max(1, count // 4)
        own = SE3(start.rotation.expand(many, 3, 3), start.translation.expand(many, 3))
        turned = own[: many // 2].retract(noise(many // 2, 0.05, 0.25))
        near = displaced(own[many // 2 + 1 :], 0.1 if by_points else 0.05, 0.25)
        parts += [own[:1], turned, near]
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


def _score(points: Surface) -> Callable[[States], Float[Tensor, "h"]]:
    """Return the function that scores poses: the mean cost of the points at a fixed scale."""
    compared = compared_at(points)
    return lambda states: compared.costs(states).mean(-1)


def compared_at(points: Surface) -> Surface:
    """Return the points' term at the fixed scale at which poses are compared."""
    return replace(points, noise=ON_SURFACE / 2 * points.surface.extent, colour_weight=1.0)


def _exposed(points: Surface, best: States, middle: Float[Tensor, "3"]) -> tuple[States, Surface]:
    """Convert the points' colours to the map's exposure and align the pose again; return the pose and the points."""
    rgb = compared_at(points).exposed(best).rgb
    if rgb is points.rgb:
        return best, points
    found = replace(points, rgb=rgb)
    finest = replace(found, noise=points.surface.cell, colour_weight=1.0)
    return descend(best, [finest], 4, middle)[0], found


def _evidence(points: Surface, best: States, margin: float) -> dict[str, float | None]:
    """Return the measures of ``Support`` for the points at one pose; each point counts with its inlier weight.

    Points without a colour are left out of the colour inliers, unless no point has a colour.
    """
    near, alike = compared_at(points).inliers(best)
    coloured = (points.coloured > 0).to(near.device)
    both = (near * alike)[:, coloured] if bool(coloured.any()) else near
    some, surface = points.points[:SIGHT_LINES], points.surface
    T = best.T[0].to(surface.device)
    ends, origin = T.apply(some), T.apply(points.origins[:SIGHT_LINES])
    length = (ends - origin).norm(dim=-1).float()
    met = trace(surface, origin.float(), ((ends - origin).float() / length.clamp(min=1e-9)[:, None]))
    # Only hits well before the point count, because grazing rays hit coarse cells early.
    slack = max(2 * ON_SURFACE * surface.extent, 4 * surface.cell)
    violations = float((met < length - slack).double().mean())
    fractions = {"on_surface": float(near.mean()), "colour_inliers": float(both.mean())}
    return {**fractions, "free_space_violations": violations, "runner_up_margin": margin}


def _covariance(
    problem: Problem, points: Surface, best: States, middle: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "6 6"], float]:
    """Return the positive definite covariance of a pose that aligns measured points with the surface, and the pose's precision.

    In directions that the points do not constrain, such as along a bare wall, the standard deviation is the size of the scene
    or half a turn. The uncertainties of the sensor's scale and offset, which all points share, are added. The precision is the standard
    deviation of the position without these shared errors, relative to the distance of the points.
    """
    prior = torch.tensor([points.surface.extent] * 3 + [math.pi] * 3, dtype=torch.float64)
    about = torch.eye(6, dtype=torch.float64)
    about[:3, 3:] = torch.linalg.cross(middle.expand(3, 3), about[:3, :3]).mT
    hessian = about.mT @ points(best).hessian[0, :6, :6] @ about
    found = torch.linalg.inv(hessian + torch.diag(prior**-2))
    precision = float((about @ found @ about.mT)[:3, :3].trace().sqrt() / middle.norm())
    sight = normalize((points.points - points.origins).cpu(), dim=-1).mean(0)
    for change in (problem.sensor.scale * middle, problem.sensor.offset * sight):
        shared = torch.cat([-change, torch.zeros(3, dtype=torch.float64)])
        found = found + shared[:, None] * shared
    found = about @ found @ about.mT
    return (found + found.mT) / 2, precision


def is_blank(frame: Frame) -> bool:
    """Return whether the image has a single colour, as if the lens were covered, or the frame has no colours at all."""
    shown = frame.rgb.flatten(0, 1) if frame.hidden is None else frame.rgb[~frame.hidden]
    # A gain and an offset can fit any view to an image whose colours, in [0, 1], deviate by less.
    return not frame.has_colour or float(shown.std(0, correction=0).max()) < 0.02


# Occluders: the nearest segment of a depth image, cut out along depth discontinuities.


@dataclass(frozen=True, eq=False)
class Occluder:
    """The nearest large segment of a depth image, and the problem without its pixels."""

    rest: Problem
    share: float  # fraction of the measured pixels that it covers
    points: Float[Tensor, "n 3"]  # some of its points, in the camera's frame, metres

    @torch.no_grad()
    def share_in_front(self, surface: SurfaceMap, T_world_camera: SE3) -> float:
        """Return the fraction of the occluder's points that, seen from a pose, are clearly in front of the surface or of empty space."""
        T = T_world_camera.to(surface.device)
        lines = (T.apply(self.points.to(T.translation)) - T.translation).float()
        length = torch.linalg.vector_norm(lines, dim=-1)
        met = cast(surface, T.translation.float().expand_as(lines), lines / length[:, None])
        before = ~met.met | (length < met.along - ON_SURFACE * surface.extent)
        return float(before.float().mean())


def nearest_piece(problem: Problem) -> Occluder | None:
    """Return the nearest large segment of a single depth image as a possible occluder.

    Returns None if there is no such segment or hardly any depth outside it, or if there are several images or another depth sensor.
    """
    view = problem.views[-1]
    if len(problem.views) != 1 or problem.depth_rays is not None or view.frame.depth is None:
        return None
    depth = view.frame.depth.cpu().numpy()
    number, measured = np.arange(depth.size).reshape(depth.shape), (depth > 0) & np.isfinite(depth)
    values, pairs = np.where(measured, depth, 0), []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near, far = np.minimum(values[a], values[b]), np.maximum(values[a], values[b])
        # Neighbouring pixels belong to different segments if their depths differ by more than 5 %.
        joined = (near > 0) & (far - near <= 0.05 * near)
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(depth.size, depth.size))
    label = connected_components(graph, directed=False)[1].reshape(depth.shape)
    counts = np.bincount(label[measured], minlength=1)
    total = counts.sum()
    # Neither the occluder nor the rest may be small.
    pieces = (counts >= max(LEAST_POINTS, 0.15 * total)).nonzero()[0]
    if len(pieces) == 0:
        return None
    nearest = min(pieces, key=lambda piece: float(np.median(values[measured & (label == piece)])))
    if total - counts[nearest] < max(LEAST_POINTS, 0.05 * total):
        return None
    piece = torch.from_numpy(measured & (label == nearest))
    hidden, given = piece.to(view.frame.depth.device), view.frame.hidden
    frame = view.frame.replace(
        depth=torch.where(hidden, 0, view.frame.depth), hidden=hidden if given is None else hidden | given
    )
    pixels = piece.nonzero()
    some = pixels[torch.linspace(0, len(pixels) - 1, min(len(pixels), SIGHT_LINES)).long()]
    along = torch.from_numpy(values).double()[some[:, 0], some[:, 1], None]
    points = view.frame.intrinsics.unproject(some.flip(-1).double() + 0.5) * along
    rest = replace(problem, views=(replace(view, frame=frame),))
    return Occluder(rest, len(pixels) / int(total), points.float())
