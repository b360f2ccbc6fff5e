"""Photos that say nothing of their camera, as messengers send them: ``auto`` begins with the camera of the map's images."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch

from bidnerf import Frame, Intrinsics, Localizer
from bidnerf.evaluation import faulty
from bidnerf.results import pose_error
from bidnerf.testing import GROUND_CAMERA, textured_map, unseen
from bidnerf_core.camera import CameraSource
from bidnerf_core.geometry import SE3
from commands import Run
from optional import require
from stored_ground import landmarks_of, open_ground


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.png"
    iio.imwrite(path, (255 * unseen().frame.rgb).round().to(torch.uint8).numpy())
    return path


def longer(factor: float) -> Intrinsics:
    return replace(GROUND_CAMERA, fx=GROUND_CAMERA.fx * factor, fy=GROUND_CAMERA.fy * factor)


@pytest.mark.slow
def test_the_command_finds_the_pose(bidnerf: Run, photo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_ground(monkeypatch, assumed=(GROUND_CAMERA,))
    _, out, err = bidnerf("localize", "MAP", photo, "--json").succeed()
    answer = json.loads(out)
    assert answer["converged"]
    error = pose_error(SE3.from_matrix(torch.tensor(answer["T_world_camera"])), unseen().T_ref_camera)
    assert error.translation < 0.05
    assert error.rotation_deg < 3
    assert "camera unknown, assumed to be that of the map's images" in err


@pytest.mark.parametrize(
    ("has_landmarks", "options"),
    [(True, ["--no-landmarks"]), (True, ["--method", "inerf", "--start", "start.json"]), (False, [])],
)
def test_methods_and_maps_that_do_not_tell_a_focal_length_need_one(
    bidnerf: Run,
    photo: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    has_landmarks: bool,
    options: list[str],
) -> None:
    open_ground(monkeypatch, assumed=(GROUND_CAMERA,), has_landmarks=has_landmarks)
    monkeypatch.chdir(tmp_path)
    pose = unseen().T_ref_camera.matrix().tolist()
    (tmp_path / "start.json").write_text(json.dumps({"T_world_camera": pose}))
    status, out, err = bidnerf("localize", *options, "MAP", photo)
    assert (status, out) == (1, "")
    assert "no focal length in EXIF, expected a camera" in err


@pytest.mark.parametrize("factor", [0.7, 2.0])
def test_a_wrong_focal_length_from_the_photo_gives_way_to_that_of_the_map(photo: Path, factor: float) -> None:
    frame = Frame.read(photo, CameraSource(assumed=(longer(factor),)))
    assert frame.focal_is_approximate
    localizer = Localizer(replace(textured_map(surface=True), landmarks=landmarks_of(GROUND_CAMERA)))
    for given, remark in (
        (frame, ", with the map's camera"),
        (frame.replace(focal_is_approximate=False), ", with the map's camera instead of the stated one"),
    ):
        found = localizer(given)
        assert found.converged
        assert found.focal_factor == pytest.approx(1 / factor, rel=0.01)
        assert found.reason.endswith(remark)
        assert pose_error(found.T_world_camera, unseen().T_ref_camera).translation < 0.02


def test_a_portrait_photo_in_a_map_of_landscape_ones_has_their_camera() -> None:
    rgb = torch.rot90(unseen().frame.rgb, 1, (0, 1)).contiguous()
    camera = Intrinsics.from_focal(1.2 * GROUND_CAMERA.fx, GROUND_CAMERA.height, GROUND_CAMERA.width)
    frame = Frame("portrait", rgb, camera, focal_is_approximate=True)
    found = Localizer(replace(textured_map(surface=True), landmarks=landmarks_of(GROUND_CAMERA)))(frame)
    assert found.converged
    assert require(found.intrinsics).fx == pytest.approx(GROUND_CAMERA.fx, rel=0.03)
    turn = SE3.exp(torch.tensor([0, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64))
    error = pose_error(found.T_world_camera, unseen().T_ref_camera @ turn)
    assert error.translation < 0.02
    assert error.rotation_deg < 1


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "has_landmarks"), [(0.7, True), (1.0, False), (1.15, False)])
def test_colours_tell_an_approximate_focal_length_only_with_landmarks(
    photo: Path, factor: float, has_landmarks: bool
) -> None:
    """The ground looks nearly flat."""
    frame = Frame.read(photo, CameraSource(assumed=(longer(factor),)))
    known = landmarks_of() if has_landmarks else None
    found = Localizer(replace(textured_map(surface=True), landmarks=known))(frame)
    assert found.converged == has_landmarks, found.reason
    if has_landmarks:
        assert found.focal_factor == pytest.approx(1 / factor, rel=0.01)
        assert pose_error(found.T_world_camera, unseen().T_ref_camera).translation < 0.01


def test_nor_do_those_of_a_blurred_photo() -> None:
    blurred = faulty(unseen(), "blur:3.5", 0).frame
    frame = replace(blurred, depth=None, intrinsics=longer(1.1), focal_is_approximate=True)
    assert not Localizer(replace(textured_map(surface=True), landmarks=None))(frame).converged


def test_colours_alone_suffice_with_a_known_focal_length(photo: Path) -> None:
    frame = Frame.open(photo, camera=GROUND_CAMERA)
    assert Localizer(replace(textured_map(surface=True), landmarks=None))(frame).converged
