"""Whose camera a query is from: corrections between cameras, the cameras of the map, and the prior probability of each explanation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bidnerf import SE3, Frame, Intrinsics, View

# Inside: the prior of each explanation, of which answers show the most probable one
from bidnerf_core.localization.explanations import (
    Explanations,
    cameras_of_map,
    correction_between,
    explanations,
)
from bidnerf_core.localization.matching import QueryKeypoints

# Inside: the fit under each explanation, whose noise and camera answers do not show
from bidnerf_core.localization.posterior import fit_landmarks
from bidnerf_core.mapping import (
    NUISANCES,
    Keypoints,
    LandmarkMap,
    Landmarks,
    Sights,
    States,
    project,
    rays_through,
    true_intrinsics,
)
from conditions import POSES, centred, part, point_landmarks, scaled
from landmark_scene import PINHOLE
from optional import require

BENT = replace(PINHOLE, distortion=(-0.02, 0.0, 0.0, 0.0))
LANDSCAPE = Intrinsics(520.0, 521.0, 310.0, 245.0, 640, 480, (0.05, -0.01, 0.001, 0.002))


def query(*cameras: Intrinsics, approximate: bool = False) -> QueryKeypoints:
    """Return images of these cameras that show nothing."""
    blank = Keypoints(torch.zeros((0, 2)), torch.zeros(0), torch.zeros((0, 64), dtype=torch.uint8))
    views = [
        View(
            Frame("f", torch.zeros((c.height, c.width, 3)), c, focal_is_approximate=approximate),
            SE3.identity(),
        )
        for c in cameras
    ]
    return QueryKeypoints.of(views, lambda rgb: blank)


def landmarks(*cameras: Intrinsics, moving: float = 0.0) -> LandmarkMap:
    return replace(point_landmarks(), cameras=cameras, moving=moving)


def given(*cameras: Intrinsics, of_map: tuple[Intrinsics, ...] = (), **options: bool) -> Explanations:
    return explanations(query(*cameras, **options), landmarks(*of_map), 4.0, 0.02)


def odds(found: Explanations, names: set[str]) -> float:
    """Return the prior odds of the explanations of these names, moving or not, against all others."""
    share = found.log_prior.softmax(0)
    own = sum(float(p) for p, name in zip(share, found.cameras, strict=True) if name in names)
    return own / (1 - own)


# Corrections between cameras


@pytest.mark.parametrize(
    "correction",
    [
        (),
        (-0.03,),
        (0.02, 0.01, -0.02),
        (0.01, 0.0, 0.0, 0.04),
        (-0.02, 0.01, 0.0, 0.0, 0.1),
    ],
)
@pytest.mark.parametrize("stated", [PINHOLE, BENT], ids=["pinhole", "bent"])
def test_the_correction_between_cameras_is_the_one_that_was_applied(
    stated: Intrinsics, correction: tuple[float, ...]
) -> None:
    expected = torch.tensor([*correction, *[0.0] * (6 - len(correction))], dtype=torch.float64)
    found = require(correction_between(stated, true_intrinsics(stated, expected)))
    tolerance = 3e-3 if stated.distortion else 1e-6  # two distortions make up one only approximately
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("k", [(-0.05, 0.01), (0.1, 0.0), (-0.28, 0.07)])
def test_a_corrected_camera_projects_as_the_true_one_or_there_is_no_correction(
    k: tuple[float, float],
) -> None:
    true = Intrinsics(320.0, 320.0, 320.0, 240.0, 640, 480, (*k, 0.0, 0.0))
    stated = scaled(1.02, true)
    found = correction_between(stated, true)
    if found is None:
        assert abs(k[0]) > 0.2
        return
    rays = true.unproject(true.pixel_centres(torch.float64)[::16, ::16]).reshape(-1, 3)
    flat = States.known(SE3.identity().to("cpu", torch.float64), found)
    there = rays_through(flat, stated.unproject(true.project(rays))[:, :2])[0]
    error = (true.project(there) - true.project(rays)).norm(dim=-1)
    assert float(error.median()) < 1.0


@pytest.mark.parametrize(("focal", "k"), [(150.0, (-0.5, 0.0)), (200.0, (-0.28, 0.07))])
def test_lenses_that_no_correction_describes_are_not_compared(focal: float, k: tuple[float, float]) -> None:
    fisheye = Intrinsics(focal, focal, 200.0, 150.0, 400, 300, (*k, 0.0, 0.0))
    assert correction_between(PINHOLE, fisheye) is None
    assert cameras_of_map(query(PINHOLE), landmarks(fisheye)) == []


# The cameras of the map


@pytest.mark.parametrize(
    ("stated", "of_map"),
    [
        (PINHOLE, [PINHOLE]),
        (PINHOLE.resized(200, 150), [PINHOLE]),
        (PINHOLE.resized(800, 600), [PINHOLE]),
        (scaled(1.05), [*(scaled(1 + 0.001 * i) for i in range(20)), scaled(1.05)]),
    ],
    ids=["same", "half", "twice", "of one of its images"],
)
def test_an_image_of_a_camera_of_the_map_of_any_size_needs_no_correction(
    stated: Intrinsics, of_map: list[Intrinsics]
) -> None:
    (found,) = cameras_of_map(query(stated), landmarks(*of_map))
    assert float(found.abs().max()) < 1e-9


def test_a_stretched_image_has_the_maps_camera_stretched() -> None:
    (found,) = cameras_of_map(query(replace(PINHOLE, height=400, cy=200.0)), landmarks(PINHOLE))
    assert float(found[4]) == pytest.approx(math.log(3 / 4))
    assert cameras_of_map(query(PINHOLE), landmarks()) == []


def test_a_portrait_image_has_a_landscape_camera_turned_to_either_side() -> None:
    stated = Intrinsics.from_focal(540, 480, 640)
    found = cameras_of_map(query(stated), landmarks(LANDSCAPE, LANDSCAPE))
    expected = [correction_between(stated, camera) for camera in LANDSCAPE.quarter_turns()]
    assert len(found) == 2
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, require(other))
    portrait = replace(LANDSCAPE.quarter_turns()[0], fx=500.0, fy=500.0)
    (own,) = cameras_of_map(query(portrait), landmarks(LANDSCAPE, portrait))
    assert float(own.abs().max()) < 1e-9


def test_crops_are_compared_only_with_a_focal_length_that_is_approximate() -> None:
    square = Intrinsics.from_focal(400, 480, 480)
    cropped = require(correction_between(square, LANDSCAPE.centre_crop(480, 480)))
    for approximate in (False, True):
        found = cameras_of_map(query(square, approximate=approximate), landmarks(LANDSCAPE))
        assert any(torch.equal(each, cropped) for each in found) is approximate


# Prior probabilities


def test_images_of_different_cameras_have_the_stated_ones_as_their_only_explanation() -> None:
    found = given(PINHOLE, scaled(0.9), of_map=(PINHOLE,))
    assert found.cameras == ("exact",)
    assert bool((found.deviation[:, :6] == 0).all())
    assert cameras_of_map(query(PINHOLE, scaled(0.9)), landmarks(PINHOLE)) == []


def test_the_stated_camera_is_likelier_where_the_maps_images_have_it() -> None:
    own, unknown, other = (given(PINHOLE, of_map=of) for of in ((PINHOLE,), (), (scaled(1.05),)))
    stated = {"exact"}
    assert odds(own, stated) > 3 * odds(unknown, stated)
    assert odds(unknown, stated) > odds(other, stated)
    assert not any(name.startswith("map") for name in own.cameras)


def test_the_maps_camera_is_the_less_likely_the_more_the_stated_one_differs() -> None:
    found = [odds(given(PINHOLE, of_map=(scaled(f),)), {"map", "map, about"}) for f in (1.05, 2.0)]
    assert found[0] > 5 * found[1] > 0


def test_an_approximate_focal_length_may_be_off_by_far_and_is_credible_all_the_same() -> None:
    found = given(PINHOLE, approximate=True)
    nominal = found.cameras.index("nominal")
    assert float(found.deviation[nominal, 0]) >= 0.2
    assert bool(found.credible[nominal])
    stated = given(PINHOLE)
    for name, good in zip(stated.cameras, stated.credible.tolist(), strict=True):
        assert good is (name not in ("resized", "unlike"))


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_only_a_single_image_may_be_moving_and_the_likelier_the_more_the_maps_images_do(share: float) -> None:
    known = landmarks(PINHOLE, moving=share)
    single, rig = (explanations(query(*[PINHOLE] * n), known, 4.0, 0.02) for n in (1, 2))
    still = explanations(query(PINHOLE), known, 4.0, 0.02, moving=False)
    assert not bool(rig.moves.any() | still.moves.any())
    moves = single.moves
    probability = float(single.log_prior.softmax(0)[moves].sum())
    assert probability == pytest.approx(0.8 if share else 1 / 30)
    # Landmarks suggest motions even of cameras at rest, but not as large ones.
    motion, spurious = single.deviation[:, 6:12], single.scatter[6:12]
    assert bool((motion[~moves] == spurious).all())
    assert bool((motion[moves] > 2 * spurious).all())
    assert bool((spurious > 0).all())
    assert not bool(torch.cat([each.deviation[:, 6:12] for each in (rig, still)]).any())


def test_a_map_whose_images_do_not_determine_a_camera_leaves_it_free() -> None:
    known = landmarks(PINHOLE)
    vague = replace(known, calibration_scatter=torch.full((4,), 0.1, dtype=torch.float64))
    sharp, wide = (explanations(query(PINHOLE), each, 4.0, 0.02) for each in (known, vague))
    torch.testing.assert_close(
        wide.deviation[:, :4].square() - sharp.deviation[:, :4].square(),
        (vague.calibration_scatter.square() - known.calibration_scatter.square()).expand(len(wide.cameras), 4),
    )


# States under each explanation


@pytest.mark.parametrize("stated", [scaled(0.95), centred(part(60, 0, 1))], ids=["focal length", "crop"])
def test_the_camera_that_fits_is_found_from_a_free_fit(stated: Intrinsics) -> None:
    """The image is from the map's camera; the first fit begins at the stated one, near the pose with which it agrees best."""
    found, generator = given(stated, of_map=(PINHOLE,)), torch.Generator().manual_seed(0)
    (correction,) = cameras_of_map(query(stated), landmarks(PINHOLE))
    points = torch.rand((1, 80, 3), generator=generator, dtype=torch.float64) - 0.5
    one, eye = points.new_ones((1, 80)), torch.eye(3, dtype=torch.float64).expand(1, 80, 3, 3)
    sights = Sights(points[..., :2], 0 * one, eye, 0 * points, single=True)
    image = project(States.known(POSES[0], correction), points, sights).image
    image = image + 0.3 / stated.fx * torch.randn(image.shape, generator=generator, dtype=torch.float64)
    each, area = one[:, 0], float(stated.width * stated.height)
    term = Landmarks(points, replace(sights, image=image), one, 0 * one, stated.fx * one, each, each, area, 5.0)
    start = POSES[0].retract(torch.full((6,), 0.005, dtype=torch.float64))
    best = States.known(start, torch.zeros(6, dtype=torch.float64))
    best = best.under(found.mean[found.widest], found.deviation[found.widest])
    best = replace(best, row=best.row + found.widest)
    for _ in range(3):  # the noise is that at the start of each round
        best = fit_landmarks(best, term, found).likeliest
    assert found.cameras[int(best.row)].startswith("map")
    assert float((best.T[0].translation - POSES[0].translation).norm()) < 0.02
    assert float(best.noise) == pytest.approx(0.3, rel=0.3)


def test_each_mode_is_compared_under_every_explanation() -> None:
    found = given(PINHOLE, of_map=(scaled(1.05),))
    zero = torch.zeros((2, len(NUISANCES)), dtype=torch.float64)
    free = States(
        SE3.stack([POSES[0], POSES[1]]),
        zero,
        zero,
        zero + 1,
        zero[:, 0],
        zero[:, 0] + 1,
        torch.arange(2),
        torch.zeros(2, dtype=torch.long),
    )
    about = found.about(free)
    assert about.row.tolist() == [*range(len(found.cameras))] * 2
    assert about.mode.tolist() == [0] * len(found.cameras) + [1] * len(found.cameras)
    torch.testing.assert_close(about.nuisances, found.mean.repeat(2, 1))
    assert torch.equal(about.T.matrix()[: len(found.cameras)], POSES[0].matrix().expand(len(found.cameras), 4, 4))
