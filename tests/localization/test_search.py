"""Proposed poses: hypotheses anywhere, their centring, successive halving, and the search by whole images.

The methods themselves have what a search leads to; its parts are needed here for the distribution of hypotheses, the margin over
other poses, and what is told from a hole in the map.
"""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import kstest
from torch import Generator

import baked
from bidnerf_core.fields import Observations
from bidnerf_core.frames import View, all_pixels, observe
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import NormalEquations, Pivot, SurfaceRenderer

# Inside: the distribution of proposals and how far apart they are kept, of which one is left
from bidnerf_core.localization.costs.images import FieldRenderer
from bidnerf_core.localization.refinement import centred, rendered_middle
from bidnerf_core.localization.search.by_images import APART, IMAGE_STAGES, TURNED, ImageSearch
from bidnerf_core.localization.search.by_points import PointSearch
from bidnerf_core.localization.search.halving import Distinct, SearchStage, search
from bidnerf_core.localization.search.starts import (
    Surroundings,
    hypotheses_for_images,
    hypotheses_for_points,
    neighbours,
    random_rotations,
)
from bidnerf_core.results import pose_error
from blob_images import BOUNDS, FIELD, FRAME, TRUTH, photograph


@pytest.mark.parametrize("started", [True, False])
@pytest.mark.parametrize("count", [1, 2, 5, 33])
def test_they_are_as_many_as_were_asked_for(count: int, started: bool, generator: Generator) -> None:
    view = baked.unseen()[0]
    start = view.T_ref_camera if started else None
    pool = hypotheses_for_points(
        PointSearch(baked.toy(), baked.cloud(view)).surroundings, start, count, generator
    )
    assert pool.rotation.shape == (count, 3, 3)
    assert pool.translation.shape == (count, 3)
    assert pool.rotation.dtype == torch.float64
    assert pool.is_rigid().all()
    assert len(torch.unique(pool.translation, dim=0)) == count
    if start is not None:
        assert torch.allclose(pool[0].matrix(), start.matrix())


def test_those_about_a_start_keep_what_was_seen_about_where_it_was(generator: Generator) -> None:
    view, surface = baked.unseen()[0], baked.toy()
    known = PointSearch(baked.toy(), baked.cloud(view)).surroundings
    near = hypotheses_for_points(known, view.T_ref_camera, 400, generator)[:100]
    middle = known.seen_middle.double()
    off = torch.linalg.vector_norm(near.apply(middle) - view.T_ref_camera.apply(middle), dim=-1)
    assert 0.1 * surface.extent < off[1:].median() < 0.25 * surface.extent


def test_rotations_are_uniform(generator: Generator) -> None:
    """Angles have density (1 - cos) / pi, and vectors come to all directions alike (Archimedes: z is uniform)."""
    rotations = random_rotations(4000, generator)
    angles = ((rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).arccos()
    assert (
        kstest(angles.numpy(), lambda t: (t - torch.sin(torch.as_tensor(t)).numpy()) / torch.pi).pvalue > 0.01
    )
    for axis in range(3):
        assert kstest((rotations[:, 2, axis].numpy() + 1) / 2, "uniform").pvalue > 0.01
    assert random_rotations(0, generator).shape == (0, 3, 3)


def test_what_was_seen_is_put_on_the_middle_of_the_scene(generator: Generator) -> None:
    """The second half of the hypotheses: orientations, each placed so that the cloud's middle lies on the map's."""
    search = PointSearch(baked.toy(), baked.cloud(baked.unseen()[0]))
    poses = hypotheses_for_points(search.surroundings, None, 40, generator)[20:]
    middle = baked.toy().surfels.positions.median(0).values.double()
    assert torch.allclose(poses.apply(search.cloud.middle.double()), middle.expand(20, 3), atol=1e-6)


def test_neighbours_are_even_and_hold_the_start() -> None:
    T = baked.unseen()[0].T_ref_camera
    poses = neighbours(T, 512, 0.2, 0.1, seed=0)
    xi = (T[None].inverse() @ poses).log()
    assert float(xi[0].abs().max()) < 1e-9
    expected = torch.tensor([0.2] * 3 + [0.1] * 3, dtype=torch.float64)
    torch.testing.assert_close(xi.std(0), expected, rtol=0.1, atol=0)
    assert float(xi.mean(0).abs().max()) < 0.01
    assert neighbours(T, 1, 0.2, 0.1, seed=0).translation.shape == (1, 3)


AWAY = torch.tensor([0.4, -0.3, 0.2, 0, 0, 0], dtype=torch.float64)


def image_rays(depth: bool = True) -> Observations:
    frame = FRAME if depth else photograph(depth=False)
    return observe(View(frame, SE3.identity()), all_pixels(frame))


def test_most_of_a_shift_is_taken_back() -> None:
    start = TRUTH.retract(AWAY)
    found = start[None]
    for _ in range(3):
        found = centred(FIELD, image_rays(), BOUNDS, found)
    assert torch.equal(found.rotation[0], start.rotation)
    off = float((found.translation[0] - TRUTH.translation).norm())
    assert off < 0.3 * float(AWAY.norm())


def test_a_pose_stays_where_nothing_is_measured_or_rendered() -> None:
    start = TRUTH.retract(AWAY)[None]
    assert torch.equal(centred(FIELD, image_rays(depth=False), BOUNDS, start).matrix(), start.matrix())
    away = TRUTH.retract(torch.tensor([0, 0, 0, math.pi, 0, 0], dtype=torch.float64))[None]
    assert bool(rendered_middle(FIELD, image_rays(), BOUNDS, away).isnan().all())
    assert torch.equal(centred(FIELD, image_rays(), BOUNDS, away).matrix(), away.matrix())


def test_renderings_of_a_field_are_what_pixels_saw() -> None:
    """The renderer of thumbnails shows the image's own colours and distances from the true pose."""
    seen, T = image_rays(), TRUTH.to(torch.zeros(1))
    found = FieldRenderer(FIELD, BOUNDS, torch.device("cpu"))(
        T.apply(seen.origins), T.rotate(seen.directions)
    )
    torch.testing.assert_close(found.rgb, seen.rgb, rtol=0, atol=0.5 / 255 + 1e-4)  # rounded to bytes
    met = seen.measured
    torch.testing.assert_close(found.along[met], seen.distance[met], rtol=0, atol=0.01)
    assert bool((found.known == 1).all())


PLACES = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], dtype=torch.float64)
OFFSETS = torch.tensor([0.0, 0.3], dtype=torch.float64)
AT_CAMERA = Pivot(SE3.identity())
DISTINCT = Distinct(torch.zeros(3), 1.0, 0.5)


def two_valleys(T: SE3) -> NormalEquations:
    """Return the squared distance to the nearer of two places, of which the second is worse by 0.3."""
    away = T.translation[:, None] - PLACES
    nearer = (away**2).sum(-1).argmin(-1)
    off = away[torch.arange(len(away)), nearer]
    turned = (T.rotation.mT @ off[..., None])[..., 0]
    hessian = torch.diag(torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)).expand(len(off), 6, 6)
    return NormalEquations(
        (off**2).sum(-1) + OFFSETS[nearer], torch.cat([turned, torch.zeros_like(turned)], -1), hessian
    )


def at(*x: float) -> SE3:
    """Return poses along the x axis."""
    places = torch.tensor([[value, 0.0, 0.0] for value in x], dtype=torch.float64)
    return SE3(torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3), places)


STARTS = at(0.2, -0.1, 5.4, 0.3)
RANKED, DESCENDED = (
    SearchStage(two_valleys, AT_CAMERA, 0, 2, 1e-2),
    SearchStage(two_valleys, AT_CAMERA, 10, 2, 1e-2),
)


def test_a_runner_up_that_is_kept_measures_the_margin() -> None:
    found = search(STARTS, [RANKED, DESCENDED], DISTINCT, keep_runner_up=True)
    assert found.T.translation[:, 0].tolist() == pytest.approx([0.0, 5.0], abs=1e-6)
    assert found.scores.tolist() == pytest.approx([0.0, 0.3], abs=1e-9)
    assert found.margin == pytest.approx(0.3, abs=1e-9)


def test_the_last_stage_with_different_poses_tells_the_margin() -> None:
    stages = [DESCENDED, SearchStage(two_valleys, AT_CAMERA, 2, 1, 1e-2)]
    found = search(STARTS, stages, DISTINCT, keep_runner_up=False)
    assert len(found.T.translation) == 1
    assert found.margin == pytest.approx(0.3, abs=1e-9)


def test_the_path_leads_from_the_winning_hypothesis_to_the_answer() -> None:
    found = search(STARTS, [RANKED, DESCENDED], DISTINCT, keep_runner_up=True)
    assert torch.equal(found.path[0].matrix(), STARTS[1].matrix())
    assert torch.equal(found.path[-1].matrix(), found.T[0].matrix())
    assert len(found.path.translation) == 11
    assert len(found.losses) == 10
    assert bool((found.losses.diff() <= 0).all())
    assert float(found.losses[0]) == pytest.approx(0.01)


def test_a_stage_may_compare_poses_by_another_score() -> None:
    """Steps follow the cost; the score decides which pose is best, and is reported."""

    def score(T: SE3) -> torch.Tensor:
        return (T.translation[:, 0] - 5).abs()

    stage = SearchStage(two_valleys, AT_CAMERA, 10, 1, 1e-2, score=score)
    found = search(STARTS, [stage], DISTINCT, keep_runner_up=False)
    assert float(found.T.translation[0, 0]) == pytest.approx(5.0, abs=1e-6)
    assert float(found.scores[0]) == pytest.approx(0.0, abs=1e-6)


def test_poses_differ_by_where_they_put_what_is_seen_or_by_their_angle() -> None:
    """A turn about what is seen moves it nowhere, and counts by its angle."""
    about = Pivot.at_point(torch.tensor([0.0, 0.0, 3.0]))
    xi = torch.zeros((5, 6), dtype=torch.float64)
    xi[1, 0], xi[2, 0], xi[3, 4], xi[4, 4] = 0.9, 1.1, 0.45, 0.55
    different = Distinct(torch.tensor([0.0, 0.0, 3.0]), 1.0, 0.5)
    poses = about.moved(at(*[2.0] * 5), xi)
    assert different(poses).tolist() == [False, False, True, False, True]


KEYFRAMES = SE3.from_matrix(baked.toy().keyframes)


def image_search(*views: View) -> ImageSearch:
    return ImageSearch.on_surface(baked.problem(*views).without_depth(), baked.toy())


def hypotheses(search: ImageSearch, start: SE3 | None, count: int, generator: Generator) -> SE3:
    known = Surroundings(KEYFRAMES, search.extent, torch.zeros(3), search.middle)
    return hypotheses_for_images(known, start, count, generator)


@pytest.mark.parametrize("number", [1])
def test_the_pose_is_found_without_depth(number: int, generator: Generator) -> None:
    view = baked.unseen()[number]
    search = image_search(view)
    found = search(hypotheses(search, None, 64, generator), IMAGE_STAGES[:4])
    error = pose_error(found.T[0], view.T_ref_camera)
    # Of 3.5 m and with pixels and surfels that are 4 cm wide: what is left is the field's to take.
    assert float(error.translation) < 0.2
    assert float(error.rotation_deg) < 3


def test_a_rig_is_placed_by_its_last_camera(generator: Generator) -> None:
    views = baked.unseen()[:2]
    search = image_search(*views)
    found = search(hypotheses(search, None, 32, generator), IMAGE_STAGES[:3])
    assert float(pose_error(found.T[0], views[-1].T_ref_camera).rotation_deg) < 3


def test_what_looks_the_same_from_two_sides_has_no_margin(generator: Generator) -> None:
    """A box that half a turn maps onto itself."""
    scene = baked.even_box()
    surface, (view,) = baked.baked(scene), baked.images(scene, 1, seed=6)
    search = ImageSearch.on_surface(baked.problem(view, surface=surface), surface)
    half = SE3(
        torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
    )
    T = view.T_ref_camera
    found = search(SE3.stack([T, half @ T, T.retract(torch.full((6,), 0.05).double())]), IMAGE_STAGES[1:4])
    assert found.margin < 0.15 * float(found.scores[0])
    assert bool(Distinct(search.middle, APART * search.extent, TURNED)(found.T)[1])
    alone = search(T[None], IMAGE_STAGES[1:2])
    assert math.isinf(alone.margin)


def test_hypotheses_are_keyframes_and_what_is_about_them(generator: Generator) -> None:
    search, start = image_search(baked.unseen()[0]), baked.unseen()[0].T_ref_camera
    many = hypotheses(search, start, 64, generator)
    assert many.translation.shape == (64, 3)
    assert bool(many.is_rigid().all())
    assert torch.equal(many[0].matrix(), start.matrix())
    as_they_are = (many.matrix()[:, None] == KEYFRAMES.matrix()).flatten(2).all(-1).any(-1)
    assert int(as_they_are.sum()) == 24  # all there are
    near = pose_error(hypotheses(search, start, 1600, generator)[:400], start)
    assert 10 < float(near.rotation_deg.median()) < 40


def test_a_background_is_told_from_holes() -> None:
    """Keyframes look past the toy, so that it stands before a background, as bright as the map."""
    search = image_search(baked.unseen()[0])
    assert isinstance(search.renderer, SurfaceRenderer)
    assert search.renderer.background == baked.BOUNDS.background
    assert float(search.middle[2]) == pytest.approx(3.2, abs=0.5)  # cameras look at the toy from 3.5
