"""The unknowns of a query: projections against other models of a camera, and derivatives against numerical ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import baked
import blob_images
from bidnerf import SE3, Intrinsics, View
from bidnerf.testing import textured_map, training_views, unseen

# Inside: the terms of the loop one by one
from bidnerf_core.localization.terms.rays import RenderedRays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import (
    MOTION,
    NUISANCES,
    Landmarks,
    Normal,
    Sights,
    States,
    imaged,
    project,
    rays_by_camera,
    rays_through,
)
from optional import require

CAMERA = Intrinsics(310.0, 290.0, 190.0, 160.0, 400, 300, (0.05, -0.02, 0.001, 0.002))
LENGTHS = {"vx": 0.02, "vy": 0.02, "vz": 0.02, "wx": 0.01, "wy": 0.01, "wz": 0.01}
DEVIATION = torch.tensor([LENGTHS.get(name, 0.05) for name in NUISANCES], dtype=torch.float64)
UNKNOWNS = ("tx", "ty", "tz", "rx", "ry", "rz", *NUISANCES)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def drawn(h: int = 3, seed: int = 0, moving: bool = True, about: SE3 | None = None) -> States:
    """Return states with random nuisances, each a standard deviation from its mean, near a pose."""
    z = random(h, len(NUISANCES), seed=seed)
    if not moving:
        z[:, MOTION] = 0
    number, zero = torch.arange(h), torch.zeros(h, dtype=torch.float64)
    T = SE3.identity().to("cpu", torch.float64) if about is None else about
    T = SE3(T.rotation.expand(h, 3, 3), T.translation.expand(h, 3)).retract(0.01 * random(h, 6, seed=seed + 1))
    return States(T, z, 0 * z, DEVIATION.expand_as(z), zero, zero + 1, 0 * number, number)


def scene(m: int = 40, seed: int = 3) -> Tensor:
    """Return points (m 3) two to six metres before a camera, within its image."""
    flat = random(m, 2, seed=seed).clamp(-2, 2) * 0.2
    z = 4 + random(m, 1, seed=seed + 1).clamp(-2, 2)
    return torch.cat([flat * z, z], -1)


def sights(m: int, rig: bool, times: bool = True) -> Sights:
    """Return sights of a single camera, or of the cameras of a rig that each point in another direction."""
    T = SE3.exp(0.1 * random(m, 6, seed=9) * float(rig))
    exposed = torch.linspace(-0.5, 0.5, m, dtype=torch.float64) * float(times)
    return Sights(torch.zeros((m, 2), dtype=torch.float64), exposed, T.rotation, T.translation)


def derivative(value: Callable[[States], Tensor], at: States, step: float = 1e-6) -> Tensor:
    """Return the central differences of ``value`` (h ...) by each unknown, in the last axis."""
    columns = []
    for axis in range(len(UNKNOWNS)):
        update = torch.zeros((len(at), len(UNKNOWNS)), dtype=torch.float64)
        update[:, axis] = step
        columns.append((value(at.retract(update)) - value(at.retract(-update))) / (2 * step))
    return torch.stack(columns, -1)


# Projections


def test_a_known_camera_at_rest_projects_as_its_intrinsics_do() -> None:
    T, points = SE3.exp(0.3 * random(6)), scene()
    at = States.known(T, torch.zeros(6, dtype=torch.float64))
    flat = project(at, T.apply(points), sights(len(points), rig=False)).image[0]
    seen = CAMERA.project(torch.cat([flat, torch.ones_like(flat[:, :1])], -1))
    torch.testing.assert_close(seen, CAMERA.project(points))


def test_a_corrected_camera_projects_as_that_of_opencv() -> None:
    points, at = scene(), drawn(moving=False)
    found = project(at, at.T[0].apply(points)[None], sights(len(points), rig=False)).image
    for h, values in enumerate(at.nuisances.tolist()):
        log_focal, cx, cy, k1, log_aspect, skew, *_ = values
        here = at.T[h].inverse().apply(at.T[0].apply(points)).numpy()
        bent, _ = cv2.projectPoints(here, np.zeros(3), np.zeros(3), np.eye(3), np.array([k1, 0.0, 0.0, 0.0]))
        fx, fy = np.exp(log_focal + log_aspect / 2), np.exp(log_focal - log_aspect / 2)
        K = np.array([[fx, skew, cx], [0.0, fy, cy]])
        expected = bent[:, 0] @ K[:, :2].T + K[:, 2]
        torch.testing.assert_close(found[h], torch.from_numpy(expected))


def test_rows_are_seen_from_where_the_camera_was_when_they_were_exposed() -> None:
    """The motion counts to the second order, so that half of the motion leaves an eighth of the error."""
    points, errors = scene(), []
    times = sights(len(points), rig=False).times
    motion = 0.2 * random(6)
    for factor in (1.0, 0.5):
        at = drawn(1, moving=False)
        z = at.z.clone()
        z[:, MOTION] = factor * motion / DEVIATION[MOTION]
        found = imaged(replace(at, z=z), points[None], times).local[0]
        there = SE3.exp(times[:, None] * factor * motion).inverse()
        expected = (there.rotation @ points[..., None])[..., 0] + there.translation
        errors.append(float((found - expected).norm(dim=-1).max()))
    assert errors[0] < 0.01
    assert errors[1] < errors[0] / 6


def test_rays_through_a_pixel_are_projected_to_it() -> None:
    at, pixels = drawn(4, moving=False), 0.3 * random(50, 2).clamp(-2, 2)
    rays = rays_through(at, pixels)
    found = imaged(at, rays, torch.zeros(50, dtype=torch.float64))
    torch.testing.assert_close(found.image, pixels.expand(4, 50, 2), rtol=0, atol=1e-4)
    assert torch.equal(rays[..., 2], torch.ones_like(rays[..., 2]))


def test_the_derivative_of_rays_by_the_camera_is_that_of_central_differences() -> None:
    """Also far from the stated camera, where every correction counts."""
    at, pixels = drawn(4, moving=False), 0.3 * random(50, 2).clamp(-2, 2)
    at = replace(
        at, z=at.z + at.z.new_tensor([0.2, 0.05, -0.05, 0.1, 0.05, 0.02, *[0.0] * 7]) / at.deviation.clamp(min=1e-9)
    )
    expected = derivative(lambda states: rays_through(states, pixels), at)[..., 6:12]
    torch.testing.assert_close(rays_by_camera(rays_through(at, pixels), at), expected, rtol=2e-3, atol=1e-5)


def test_what_is_behind_the_camera_is_not_in_front() -> None:
    points = torch.tensor([[0.1, 0.1, -2.0], [0.0, 0.0, 0.0], [0.1, 0.1, 2.0]], dtype=torch.float64)
    at = States.known(SE3.identity().to("cpu", torch.float64), torch.zeros(6, dtype=torch.float64))
    seen = project(at, points[None], sights(3, rig=False))
    assert seen.front.tolist() == [[False, False, True]]
    assert bool(seen.image.isfinite().all())


# Derivatives


def term_of_landmarks(rig: bool, moving: bool = False) -> tuple[Landmarks, States]:
    """Return matches in two modes, some of which are wrong, and states about the truth."""
    m, points = 40, torch.stack([scene(40), scene(40, seed=20)])
    own = sights(m, rig)
    truth = drawn(1, moving=False)
    parts = [project(truth, points[g : g + 1], own).image[0] for g in range(2)]
    image = torch.stack(parts) + 0.003 * random(2, m, 2)
    image[:, :5] += 0.3
    wide = Sights(image, *(x.expand(2, *x.shape) for x in (own.times, own.rotation, own.translation)))
    ones = torch.ones((2, m), dtype=torch.float64)
    valid = ones.clone()
    valid[1, 30:] = 0
    each = ones[:, 0]
    term = Landmarks(points, wide, valid, 0.3 * ones, 300 * ones, 4 * each, 0.25 * each, 400 * 300.0, 4.0)
    at = drawn(moving=moving)
    return term, replace(at, mode=torch.tensor([0, 1, 0]), z=truth.z + 0.1 * at.z)


def test_points_behind_the_camera_have_no_influence() -> None:
    term, at = term_of_landmarks(rig=False)
    behind, without = term.points.clone(), term.valid.clone()
    behind[:, 7] = at.T.apply(torch.tensor([0.1, 0.1, -3.0], dtype=torch.float64))[:2]
    without[:, 7] = 0
    found, expected = replace(term, points=behind)(at), replace(term, valid=without)(at)
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))


def term_of_the_surface(rig: bool) -> tuple[Surface, States]:
    view, others = unseen(), training_views()[:2] if rig else ()
    surface = baked.exact(require(textured_map(surface=True).surface))
    truth = view.T_ref_camera
    views = [View(v.frame, truth.inverse() @ v.T_ref_camera) for v in (*others, view)]
    term = require(Surface.of(views, None, surface, 0, 300))
    at = drawn(2, moving=False, about=truth)
    term = replace(term, rgb=term.rgb.double(), coloured=term.coloured.double(), colour_weight=0.7, noise=0.05)
    return term, replace(at, z=0.1 * at.z)


def term_of_rays(depth: bool, rig: bool) -> tuple[RenderedRays, States]:
    truth = blob_images.TRUTH
    others = (blob_images.POSES[0],) if rig else ()
    views = [View(blob_images.photograph(T), truth.inverse() @ T) for T in (*others, truth)]
    term = RenderedRays.of(views, blob_images.FIELD, blob_images.BOUNDS, 200, 0)
    loss = replace(term.loss, scale=0.2) if depth else None
    at = drawn(2, moving=False, about=truth)
    return replace(term, exposure=False, depth_loss=loss), replace(at, z=0.1 * at.z)


# The step of numerical derivatives, and the largest difference. Derivatives ignore that points beyond a surfel's disc approach its
# edge, and that the samples along a ray move with its bounds; fields are in float32.
TERMS: dict[str, tuple[Callable[[], tuple[Callable[[States], Normal], States]], float, float]] = {
    "landmarks": (lambda: term_of_landmarks(rig=False), 1e-6, 1e-5),
    "landmarks, rig": (lambda: term_of_landmarks(rig=True), 1e-6, 1e-5),
    # A motion enters derivatives to first order only.
    "landmarks, moving": (lambda: term_of_landmarks(rig=True, moving=True), 1e-6, 0.03),
    "surface": (lambda: term_of_the_surface(rig=False), 1e-6, 0.05),
    "surface, rig": (lambda: term_of_the_surface(rig=True), 1e-6, 0.05),
    "rays": (lambda: term_of_rays(depth=False, rig=False), 1e-3, 0.08),
    "rays with depth": (lambda: term_of_rays(depth=True, rig=False), 1e-3, 0.08),
    "rays, rig": (lambda: term_of_rays(depth=False, rig=True), 1e-3, 0.08),
}
PER_UNIT = torch.cat([torch.ones(6, dtype=torch.float64), 1 / DEVIATION])


@pytest.mark.parametrize("name", TERMS)
def test_the_gradient_of_each_term_is_the_derivative_of_its_cost_by_each_unknown(name: str) -> None:
    make, step, tolerance = TERMS[name]
    with torch.no_grad():
        term, at = make()
        found, expected = term(at), PER_UNIT * derivative(lambda s: term(s).cost, at, step)
    error = (PER_UNIT * found.gradient - expected).abs() / expected.abs().amax(-1, keepdim=True)
    assert {u: x for u, x in zip(UNKNOWNS, error.amax(0).tolist(), strict=True) if x > tolerance} == {}
    assert bool((torch.linalg.eigvalsh(found.hessian) >= -1e-9 * found.hessian.abs().amax()).all())
    torch.testing.assert_close(found.hessian, found.hessian.mT)


def test_a_single_image_is_seen_from_a_moving_camera_and_those_of_a_rig_are_not() -> None:
    """Views of a rig may be from different times."""
    for make in (term_of_landmarks, term_of_the_surface, lambda rig: term_of_rays(depth=False, rig=rig)):
        for rig in (False, True):
            term, at = make(rig=rig)
            z = at.z.clone()
            z[:, MOTION] = 1
            with torch.no_grad():
                differs = not torch.equal(term(at).cost, term(replace(at, z=z)).cost)
            assert differs is (not rig or isinstance(term, Landmarks))  # whose sights are given here


# Rows


def test_where_takes_the_poses_and_nuisances_of_the_rows_that_hold() -> None:
    one, other = drawn(4), drawn(4, seed=50)
    mask = torch.tensor([True, False, True, False])
    found = one.where(mask, other)
    for index in range(4):
        expected = (one if mask[index] else other)[index : index + 1]
        assert torch.equal(found.T.matrix()[index], expected.T.matrix()[0])
        assert torch.equal(found.z[index], expected.z[0])


def test_states_are_the_same_after_they_are_joined_and_indexed() -> None:
    one, other = drawn(2), drawn(3, seed=50)
    joined = States.cat([one, other])
    assert len(joined) == 5
    for part, index in ((one, slice(0, 2)), (other, torch.tensor([2, 3, 4]))):
        assert torch.equal(joined[index].T.matrix(), part.T.matrix())
        assert torch.equal(joined[index].nuisances, part.nuisances)
        assert torch.equal(joined[index].row, part.row)


def test_another_prior_changes_no_value_that_it_leaves_free() -> None:
    one = drawn()
    mean, deviation = 0.01 * random(len(NUISANCES)), 3 * DEVIATION
    deviation[2] = 0
    found = one.under(mean, deviation)
    free = deviation > 0
    torch.testing.assert_close(found.nuisances[:, free], one.nuisances[:, free])
    assert found.nuisances[:, 2].tolist() == [float(mean[2])] * len(one)
    assert torch.equal(found.T.matrix(), one.T.matrix())
