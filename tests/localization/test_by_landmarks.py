"""Poses by landmarks, alone and fused with depth and rendering, and what ``auto`` does where they do not convince.

``answer_by_landmarks`` shows which measurements were fused; ``DepthScale`` how far a sensor's scale is shrunk.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from bidnerf_core import Localization, Localizer, Outcome, View
from bidnerf_core.depth import find_depth_sensor
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    SHARPEST,
    LandmarkAnswer,
    LandmarkMatcher,
    answer_by_landmarks,
    localization_by_landmarks,
    rig,
)

# Inside: which measurements were fused, and how the scale of depth is shrunk
from bidnerf_core.localization.depth_scale import DepthScale
from bidnerf_core.mapping import Keypoints, Sift
from bidnerf_core.registry import registered
from bidnerf_core.results import pose_error
from bidnerf_core.testing import CAMERA, MapWithLandmarks, textured_map, unseen
from conditions import QUICK
from localizations import assert_covered, assert_near, colour_only

TRUTH = unseen().T_ref_camera
RAYS = 256


@functools.cache
def matcher() -> LandmarkMatcher:
    landmarks = textured_map().landmarks
    assert landmarks is not None
    scatter = torch.full((4,), 0.01, dtype=torch.float64)  # as a trial of these exact images would find
    return LandmarkMatcher(replace(landmarks, calibration_scatter=scatter, correlation=1.0))


def answer(*views: View, rays: int = 0, map: MapWithLandmarks | None = None, seed: int = 0) -> LandmarkAnswer:
    problem = rig(map or textured_map(), views, None, matcher=matcher())
    found = answer_by_landmarks(problem, matcher(), rays, seed)
    assert found is not None
    return found


def test_landmarks_alone_find_a_photo() -> None:
    found = answer(colour_only(unseen()))
    assert found.terms == ()
    assert torch.equal(found.T.matrix(), found.found.T_world_camera.matrix())
    assert_near(found.T, TRUTH, 0.02, 0.5)
    assert_covered(found.T, TRUTH, found.covariance)


@pytest.mark.parametrize(
    ("depth", "rays", "terms"),
    [(True, 0, ("depth",)), (False, RAYS, ("rendering",)), (True, RAYS, ("depth", "rendering"))],
    ids=["depth", "rendering", "both"],
)
def test_each_further_term_brings_the_pose_nearer(depth: bool, rays: int, terms: tuple[str, ...]) -> None:
    view = unseen() if depth else colour_only(unseen())
    found, alone = answer(view, rays=rays, map=textured_map(surface=True)), answer(colour_only(unseen()))
    assert found.terms == terms
    before, after = (pose_error(T, TRUTH) for T in (alone.T, found.T))
    assert float(after.translation) < float(before.translation)
    assert float(after.rotation_deg) < float(before.rotation_deg)
    assert_covered(found.T, TRUTH, found.covariance)


def test_more_terms_make_the_covariance_smaller() -> None:
    """Measurements beside the landmarks add information in every direction and take none away."""
    alone = answer(colour_only(unseen()))
    for more in (
        answer(unseen(), map=textured_map(surface=True)),
        answer(colour_only(unseen()), rays=RAYS),
    ):
        difference = alone.covariance - more.covariance
        root = torch.linalg.cholesky(torch.linalg.inv(alone.covariance))
        assert float(torch.linalg.eigvalsh(root.mT @ difference @ root)[0]) > -0.05
        assert torch.equal(more.covariance, more.covariance.mT)
        assert float(torch.linalg.eigvalsh(more.covariance)[0]) > 0


def test_rendering_brings_a_pose_by_blurred_keypoints_to_that_of_the_field() -> None:
    """The image is what the field renders, so that rendered rays alone have no error."""
    assert_near(answer(colour_only(unseen()), rays=RAYS).T, TRUTH, 0.002, 0.05)


@pytest.mark.parametrize("gain", [0.5, 1.6])
def test_another_exposure_does_not_mislead_rendering(gain: float) -> None:
    """Half of the exposure, or one at which bright colours are clipped."""
    view = colour_only(unseen())
    exposed = replace(view, frame=replace(view.frame, rgb=(gain * view.frame.rgb).clamp(max=1)))
    found = answer(exposed, rays=RAYS)
    assert found.terms == ("rendering",)
    assert_near(found.T, TRUTH, 0.004, 0.1)


@pytest.mark.parametrize(
    ("noise", "terms"),
    [(None, ("rendering",)), (SHARPEST, ("rendering",)), (1.01 * SHARPEST, ())],
    ids=["unknown", "sharp", "blurred"],
)
def test_a_blurred_field_is_not_rendered(noise: float | None, terms: tuple[str, ...]) -> None:
    blurred = replace(textured_map(), colour_noise=noise)
    assert answer(colour_only(unseen()), rays=RAYS, map=blurred).terms == terms


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_an_approximate_focal_length_is_found_and_no_other_term_uses_the_wrong_one(factor: float) -> None:
    camera = replace(CAMERA, fx=CAMERA.fx / factor, fy=CAMERA.fy / factor)
    frame = replace(unseen().frame, intrinsics=camera, focal_is_approximate=True)
    found = answer(replace(unseen(), frame=frame), rays=RAYS, map=textured_map(surface=True))
    assert found.found.focal_factor == pytest.approx(factor, rel=0.03)
    assert found.terms == ()
    assert_covered(found.T, TRUTH, found.covariance)


@pytest.mark.parametrize(("factor", "estimated"), [(1.0, False), (0.98, False), (0.85, True), (1.2, True)])
def test_a_calibrated_focal_length_is_replaced_only_where_it_cannot_be_right(
    factor: float, estimated: bool
) -> None:
    camera = replace(CAMERA, fx=CAMERA.fx / factor, fy=CAMERA.fy / factor)
    frame = replace(unseen().frame, intrinsics=camera, depth=None)
    found = answer(replace(unseen(), frame=frame))
    assert found.found.focal_factor == (pytest.approx(factor, rel=0.03) if estimated else 1)
    if estimated or factor == 1:
        assert_covered(found.T, TRUTH, found.covariance)


def test_the_scale_of_a_depth_sensor_is_found() -> None:
    """Depth that is 3 % too long would move the pose by 5 cm; landmarks tell its scale."""
    depth = unseen().frame.depth
    assert depth is not None
    view = replace(unseen(), frame=replace(unseen().frame, depth=1.03 * depth))
    found = answer(view, map=textured_map(surface=True))
    assert found.terms == ("depth",)
    assert found.found.depth_scale == pytest.approx(1 / 1.03, rel=0.01)
    assert_near(found.T, TRUTH, 0.015, 0.3)


@pytest.mark.parametrize("scale", [0.001, 0.3048, 0.8, 1.2])
def test_depth_of_another_unit_is_left_out(scale: float) -> None:
    """Millimetres, or feet, read as metres: the pose is that of the colours alone, and the reason says why."""
    depth = unseen().frame.depth
    assert depth is not None
    view = replace(unseen(), frame=replace(unseen().frame, depth=scale * depth))
    found, plain = (answer(v, rays=RAYS, map=textured_map(surface=True)) for v in (view, colour_only(view)))
    assert found.terms == plain.terms == ("rendering",)
    assert_near(found.T, TRUTH, 0.004, 0.1)
    problem = rig(textured_map(surface=True), (view,), None, matcher=matcher())
    reason = localization_by_landmarks(problem, found, 0.0).reason
    assert f"without depth: it is {1 / found.found.depth_scale:.3g} times that of the landmarks" in reason


def test_fusion_does_not_make_the_errors_of_the_maps_own_poses_smaller() -> None:
    landmarks = replace(matcher().landmarks, pose_covariance=1e-4 * torch.eye(6, dtype=torch.float64))
    scattered = LandmarkMatcher(landmarks)
    problem = rig(textured_map(surface=True), (unseen(),), None, matcher=scattered)
    found = answer_by_landmarks(problem, scattered, RAYS, 0)
    assert found is not None
    assert found.terms == ("depth", "rendering")
    least = torch.linalg.eigvalsh(found.covariance - landmarks.pose_covariance)[0]
    assert 0 < float(least) < 1e-4


@pytest.mark.parametrize(
    ("sensor", "kept"), [("rendered", 0.0), ("unknown", 0.8), ("kinect", 0.054**2 / (0.054**2 + 0.01**2))]
)
def test_a_depth_scale_is_shrunk_as_far_as_the_sensor_is_accurate(sensor: str, kept: float) -> None:
    found = replace(answer(unseen(), map=textured_map(surface=True)).found, depth_scale=1.05)
    model = find_depth_sensor(sensor)
    assert DepthScale.of(found, model).estimate == pytest.approx(1 + kept * 0.05)
    assert DepthScale.of(replace(found, depth_scale=None), model).estimate == 1


def test_the_answer_tells_its_path_and_what_was_fused() -> None:
    view = colour_only(unseen())
    start = TRUTH.retract(torch.full((6,), 0.1, dtype=torch.float64))
    problem = rig(textured_map(), [view], start)
    said = localization_by_landmarks(problem, answer(view, rays=RAYS), began=0.0)
    assert said.outcome is Outcome.CONVERGED
    assert said.reason.endswith("px, fused with rendering")
    assert said.steps == len(said.losses) == len(said.poses.translation) - 1 == 2
    assert torch.equal(said.poses[0].matrix(), start.matrix())
    assert torch.equal(said.poses[-1].matrix(), said.T_world_camera.matrix())


# Method ``auto`` decides whether landmarks are trusted.


def localized(view: View, map: MapWithLandmarks | None = None, start: SE3 | None = None) -> Localization:
    return Localizer(map or textured_map(), "auto", QUICK, warm_up=False)(view.frame, start=start)


def test_auto_takes_landmarks_first_with_a_start_or_without() -> None:
    start = TRUTH.retract(torch.full((6,), 0.5, dtype=torch.float64))  # far off: it must not matter
    for found in (localized(colour_only(unseen())), localized(colour_only(unseen()), start=start)):
        assert found.outcome is Outcome.CONVERGED
        assert "landmark inliers" in found.reason
        assert_near(found.T_world_camera, TRUTH, 0.02, 0.5)


def test_landmarks_can_be_switched_off() -> None:
    localizer = Localizer(textured_map(surface=True), "auto", replace(QUICK, landmarks=False))
    found = localizer(unseen().frame)
    assert "landmarks" not in found.reason
    assert "surface" in found.reason


def blank(grey: float = 0.5) -> View:
    rgb = torch.full_like(unseen().frame.rgb, grey)
    return View(replace(unseen().frame, rgb=rgb, name="blank"), SE3.identity())


def test_without_keypoints_measured_depth_is_searched_for_on_the_surface() -> None:
    found = localized(blank(), textured_map(surface=True))
    assert not found.converged
    assert "of the measured points" in found.reason


@pytest.mark.parametrize("grey", [0.0, 0.5])
def test_a_covered_lens_is_not_found_by_rendering_either(grey: float) -> None:
    """A gain and a bias fit a single colour to whatever the map shows."""
    view = colour_only(blank(grey))
    found = localized(view, textured_map(surface=True))
    assert found.outcome is Outcome.UNDETERMINED
    assert found.reason


@dataclass
class Misleading:
    """A detector that finds the keypoints of an image, all but a share of them with descriptors of something else."""

    right: float

    def __call__(self, rgb: Tensor) -> Keypoints:
        found, generator = Sift()(rgb), torch.Generator().manual_seed(0)
        wrong = torch.rand(len(found), generator=generator) >= self.right
        descriptors = found.descriptors.clone()
        descriptors[wrong] = descriptors[wrong][:, torch.randperm(128, generator=generator)]
        return replace(found, descriptors=descriptors)


def misled(right: float, most: int | None, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> Localization:
    """Localize a photo by its colours, from the true pose on, by a map with ``most`` landmarks of which it shows hardly any."""
    monkeypatch.setitem(registered, ("features", "misleading"), Misleading(right))
    scene = textured_map(surface=True)
    assert scene.landmarks is not None
    landmarks = replace(scene.landmarks[torch.arange(len(scene.landmarks))[:most]], features="misleading")
    config = replace(QUICK, **settings)
    found = Localizer(replace(scene, landmarks=landmarks), config=config)(colour_only(unseen()).frame, TRUTH)
    assert_near(found.T_world_camera, TRUTH, 0.02, 0.5)
    return found


@pytest.mark.parametrize(
    ("right", "most", "landmarks", "expected"),
    [
        (0.0, None, True, Outcome.TOO_FEW_MATCHES),
        (0.2, None, True, Outcome.CONVERGED),
        (0.0, 10, True, Outcome.CONVERGED),
        (0.0, None, False, Outcome.CONVERGED),
    ],
    ids=["contradicted", "above chance", "hardly any landmarks", "not asked for"],
)
def test_an_answer_of_the_surface_that_landmarks_contradict_is_not_accepted(
    right: float, most: int | None, landmarks: bool, expected: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole images may look alike where no keypoint does."""
    found = misled(right, most, monkeypatch, landmarks=landmarks)
    assert found.outcome is expected, found.reason
    assert ("by chance" in found.reason) == (expected is Outcome.TOO_FEW_MATCHES)
