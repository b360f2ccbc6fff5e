"""Results in Python: a sequence is tracked in a thread, cancelled, interrupted by its callback; poses are written and read."""

from __future__ import annotations

import json
import logging
import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import PIL.Image
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bidnerf as bn
import drawn
from bidnerf import SE3, Frame, Localization, Outcome
from bidnerf.results import (
    Answer,
    Answers,
    Failure,
    PosedImage,
    TrajectoryErrors,
    overlay,
    read_pose,
)
from bidnerf.testing import textured_map
from bidnerf_core.datasets import write_transforms
from bidnerf_core.frames import View
from bidnerf_core.localization import Verdict
from bidnerf_core.progress import Progress
from drawn import record
from flights import covered, flight
from optional import require
from refusals import refused

FRAMES = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames, of which the third was taken with the lens cap on."""
    place = tmp_path_factory.mktemp("results") / "data"
    frames = [(covered(f) if n == 2 else f, T) for n, (_, f, T) in enumerate(flight()[:FRAMES])]
    write_transforms(place, {"test": [View(frame, T) for frame, T in frames]}, (0.0, 0.0, 0.0))
    return place


def scene() -> Any:
    return textured_map(surface=True)


def test_a_sequence_is_tracked_in_a_thread_of_any_kind(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    reports, paths = list[Progress](), list[Answers]()
    with caplog.at_level(logging.INFO, "bidnerf"):
        worker = threading.Thread(target=lambda: paths.append(bn.track(scene(), folder, progress=reports.append)))
        worker.start()
        worker.join()
    (path,) = paths
    assert [(report.done, report.total) for report in reports] == [(n + 1, FRAMES) for n in range(FRAMES)]
    assert path.lost == [(2, 2)]
    errors = path.errors()
    assert isinstance(errors, TrajectoryErrors)
    assert errors.poses == FRAMES - 1
    assert errors.raw.translation_p95 < 0.02
    assert [line for line in caplog.messages if "tracking again after 1 frame" in line]
    path.write(folder.parent / "path.json")
    path.write(folder.parent / "transforms.json")
    written = json.loads((folder.parent / "transforms.json").read_text())["frames"]
    assert [(folder.parent / frame["file_path"]).suffix for frame in written] == [".png"] * (FRAMES - 1)
    assert all((folder.parent / frame["file_path"]).is_file() for frame in written)
    assert [pose["converged"] for pose in json.loads((folder.parent / "path.json").read_text())] == [
        n != 2 for n in range(FRAMES)
    ]


def test_a_cancelled_and_an_interrupted_tracking_leave_their_frames(folder: Path) -> None:
    path, done = Answers(is_sequence=True), threading.Event()
    with pytest.raises(bn.Cancelled):
        bn.track(scene(), folder, answers=path, each=lambda frame, answer: done.set(), cancel=done.is_set)
    assert len(path) == 1
    path = Answers(is_sequence=True)
    with pytest.raises(ZeroDivisionError, match="of the callback"):
        bn.track(scene(), folder, answers=path, progress=Mock(side_effect=ZeroDivisionError("of the callback")))
    assert len(path) == 1
    with refused(found="every is 0", expected="1 or more"):
        bn.track(scene(), folder, every=0)


def test_an_overlay_shows_photo_rendering_and_both(folder: Path) -> None:
    _, frame, T = flight()[0]
    picture = overlay(scene(), frame, T)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[1] > 2 * picture.shape[0]  # three tiles beside each other
    off = overlay(scene(), frame, T @ SE3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]).double()))
    third = picture.shape[1] // 3
    assert np.array_equal(picture[:, :third], off[:, :third])  # the photo
    assert not np.array_equal(picture[:, third:], off[:, third:])
    with_start = overlay(scene(), frame, T, start=T)
    assert with_start.shape[0] > picture.shape[0]
    assert np.array_equal(overlay(scene(), frame, T.matrix().numpy()), picture)
    wide = frame.replace(
        rgb=torch.zeros((10, 800, 3)), depth=None, intrinsics=bn.Intrinsics(400.0, 400.0, 400.0, 5.0, 800, 10)
    )
    assert overlay(scene(), wide, T).shape[1] // 3 // 10 == 64  # a tile has 640 pixels of the photo
    answer = bn.localize(scene(), frame).answers[0].localization
    assert answer.converged
    accepted, rejected = (
        overlay(scene(), frame, found) for found in (answer, answer.rejected(Verdict(Outcome.AMBIGUOUS, "")))
    )
    assert not np.array_equal(accepted, rejected)  # only a caption differs


def test_an_answer_that_found_nothing_has_no_pose() -> None:
    black = flight()[0][1].replace(rgb=torch.zeros((96, 128, 3)), depth=None)
    answers = bn.localize(scene(), black)
    answer, found = answers.answers[0], answers.answers[0].localization
    assert (found.converged, found.T_world_camera.is_finite, answer.error) == (False, False, None)
    assert "without a pose" in repr(found)
    assert "<img" not in found._repr_html_()
    plain = answers.plain(answer)
    assert (plain["T_world_camera"], plain["covariance"]) == (None, None)
    third = np.split(overlay(scene(), black, found), 3, axis=1)[1]
    assert (third[30:-10, 10:-10] == 255).all()


@pytest.mark.usefixtures("unchecked")
def test_an_overlay_of_something_else_is_refused() -> None:
    _, frame, T = flight()[0]
    wrong: list[tuple[tuple[Any, Any, Any], str | None, str, str]] = [
        ((7, frame, T), "overlay", "got a int", "a Map, or the folder of one"),
        ((scene(), bn.View(frame, T), T), "overlay", "frame is a View", "a Frame"),
        ((scene(), frame, "pose.json"), None, "pose is a str", "an SE3 or a 4x4 matrix"),
        ((scene(), frame, np.eye(3)), None, "pose has shape (3, 3)", "a 4x4 matrix"),
    ]
    for arguments, where, found, expected in wrong:
        with refused(where=where, found=found, expected=expected):
            overlay(*arguments)


# Files of localizations.


T = SE3.exp(torch.tensor([0.1, -2.0, 3.0, 0.4, -0.5, 0.6], dtype=torch.float64))
CAMERA = bn.Intrinsics(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5)
FOUND = Localization(
    T,
    Outcome.AMBIGUOUS,
    "two places fit",
    2,
    0.25,
    0.125,
    "auto",
    SE3.stack([T, T, T]),
    torch.tensor([0.5, 0.125]).double(),
    torch.eye(6).double(),
    0.9,
    0.25,
    None,
    CAMERA,
)


@settings(max_examples=30)
@given(
    found=record(
        Localization,
        T_world_camera=drawn.poses(),
        outcome=st.sampled_from(Outcome),
        poses=st.just(FOUND.poses),
        losses=st.just(FOUND.losses),
        loss=st.floats(),
        focal_factor=st.floats(),
        diagnostics=st.none(),
        picture=st.none(),
        covariance=st.none() | st.floats(0.01, 1).map(lambda x: x * torch.eye(6).double()),
    )
)
def test_any_localization_is_loaded_as_it_was_saved(found: Localization, tmp_path: Path) -> None:
    found.save(tmp_path / "found.json")
    again, T = Localization.load(tmp_path / "found.json"), found.T_world_camera.matrix()
    assert again.plain() | {"T_world_camera": None} == found.plain() | {"T_world_camera": None}
    for pose in (again.T_world_camera, read_pose(tmp_path / "found.json")):
        torch.testing.assert_close(pose.matrix(), T, rtol=0, atol=1e-12)
    assert math.isnan(again.loss) or again.loss == found.loss


@pytest.mark.parametrize(
    ("change", "where", "found", "expected"),
    [
        ({"T_world_camera": None}, "found.json", "T_world_camera is null", "a finite pose"),
        ({"T_world_camera": [[1.0]]}, "found.json", "T_world_camera has 1 rows", "4 rows of 4 numbers"),
        (
            {"T_world_camera": (2 * torch.eye(4)).tolist()},
            "found.json",
            "T_world_camera has the last row [0.0, 0.0, 0.0, 2.0]",
            "[0, 0, 0, 1]",
        ),
        ({"covariance": [[1.0]]}, "found.json", "covariance has 1 rows", "6 rows of 6 numbers"),
        ({"outcome": "fine"}, "found.json: outcome", "found 'fine'", "'converged', "),
        ({"steps": "two"}, "found.json: steps", "found 'two'", "int"),
        ({"more": 1}, "found.json", "no field 'more'", "any of T_world_camera"),
    ],
)
def test_a_file_of_another_kind_is_no_localization(
    tmp_path: Path, change: dict[str, Any], where: str | None, found: str, expected: str
) -> None:
    (tmp_path / "found.json").write_text(json.dumps(FOUND.plain() | change))
    with refused(where=where and tmp_path / where, found=found, expected=expected):
        Localization.load(tmp_path / "found.json")


@pytest.mark.parametrize("name", ["poses.txt", "transforms.json"])
def test_a_pose_that_is_not_finite_is_refused_where_a_format_has_no_null(tmp_path: Path, name: str) -> None:
    image = PosedImage("a", 0, CAMERA, SE3(T.rotation, T.translation * math.nan))
    with refused(found="the pose of a is not finite", expected="a .json file"):
        bn.write_poses(tmp_path / name, [image])
    with refused(found="the time of a is nan", expected="seconds, or None if it is unknown"):
        replace(image, time=math.nan)
    bn.write_poses(tmp_path / "poses.json", [image])
    assert json.loads((tmp_path / "poses.json").read_text())[0]["T_world_camera"] is None


# Several queries.


def test_answers_in_a_format_of_poses_hold_the_accepted_ones(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    answers = Answers()
    frame = Frame("a", torch.zeros((3, 4, 3)), CAMERA)
    for found in (FOUND, replace(FOUND, outcome=Outcome.CONVERGED)):
        answers.append(Answer.of(frame, len(answers), found))
    with caplog.at_level(logging.INFO, "bidnerf"):
        answers.write(tmp_path / "poses.tum")
    refused_one = f"a: {FOUND.outcome} ({FOUND.reason})"
    _, remark, name, _ = (tmp_path / "poses.tum").read_text().splitlines()
    assert (remark, name) == (f"# without a pose: {refused_one}", "# a")
    assert (tmp_path / "poses.refused.txt").read_text() == f"{refused_one}\n"
    assert "poses.tum: 1 pose; 1 image without an accepted pose: see poses.refused.txt" in caplog.text
    answers_with([FOUND.T_world_camera], [FOUND.T_world_camera]).write(tmp_path / "poses.tum")
    assert (tmp_path / "poses.refused.txt").read_text() == ""  # that of the earlier run is replaced


def test_answers_for_a_folder_have_names_and_become_a_colmap_model(folder: Path, tmp_path: Path) -> None:
    """The points of the model are the map's landmarks, at the keypoints that agree with them; a refused image is named."""
    pycolmap, known = pytest.importorskip("pycolmap"), scene()
    answers = bn.localize(known, folder)
    assert answers.names == [answer.name for answer in answers] == [frame.name for _, frame, _ in flight()[:FRAMES]]
    assert [each.accepted for each in answers.answers] == [number != 2 for number in range(FRAMES)]
    answers.write(tmp_path / "new" / "images.txt")
    model = pycolmap.Reconstruction(str(tmp_path / "new"))
    assert len(model.cameras) == 1
    assert model.num_reg_images() == FRAMES - 1
    distances = list[float]()
    for image in model.images.values():
        seen = [each for each in image.points2D if each.has_point3D()]
        assert len(seen) > 20
        for keypoint in seen:
            point = model.points3D[keypoint.point3D_id]
            np.testing.assert_allclose(point.xyz, known.landmarks.positions[keypoint.point3D_id - 1], atol=1e-6)
            distances.append(float(np.linalg.norm(image.project_point(point.xyz) - keypoint.xy)))
    assert np.median(distances) < 1.0
    left_out = f"{answers.names[2]}: {answers.answers[2].localization.outcome}"
    assert f"# without a pose: {left_out}" in (tmp_path / "new" / "images.txt").read_text()
    assert (tmp_path / "new" / "images.refused.txt").read_text().startswith(left_out)
    answers.write(tmp_path / "poses.hloc.txt")
    for row, image in zip(
        (tmp_path / "poses.hloc.txt").read_text().splitlines(), sorted(model.images.items()), strict=True
    ):
        name, *numbers = row.split()
        assert name == image[1].name
        rigid = image[1].cam_from_world()
        x, y, z, w = rigid.rotation.quat
        np.testing.assert_allclose(np.array(numbers, float), [w, x, y, z, *rigid.translation], atol=1e-9)


def test_what_is_localized_may_be_given_in_any_form(folder: Path) -> None:
    """Files of photos, frames in memory, views and rigs; anything else is refused."""
    known, frames = scene(), [frame for _, frame, _ in flight()[:2]]
    known = replace(known, landmarks=replace(known.landmarks, cameras=(frames[0].intrinsics,)))
    (first, second) = bn.localize(bn.Localizer(known, warm_up=False), [frames[0], bn.View(frames[1], SE3.identity())])
    assert (first.name, second.name) == (frames[0].name, frames[1].name)
    assert bn.localize(known, frames[0]).accepted[0].name == frames[0].name
    photo = next((folder / "images").rglob("*.png"))
    with PIL.Image.open(photo) as opened:  # pixels without a camera: that of the map is assumed, as for the file
        forms = [opened.convert("RGB"), np.asarray(opened), torch.from_numpy(np.array(opened))]
    by_path, *by_pixels = (bn.localize(known, given)[0] for given in (photo, [forms[0]], *forms[1:]))
    for found in by_pixels:
        assert found.name == "0"
        assert torch.equal(found.localization.T_world_camera.matrix(), by_path.localization.T_world_camera.matrix())
    again = bn.Localizer(known, warm_up=False)(forms[0], start=by_path.localization)
    assert again.converged
    assert bn.localize(known, [photo, photo.parent / "none.png"]).names == [photo.stem, "none"]
    with refused(
        where="queries",
        found="got a int",
        expected="photos or a dataset by path, or pixels, a Frame, View or list of Views",
    ):
        bn.localize(known, [7])  # type: ignore[list-item]
    with refused(where="queries", found="got a int"):
        bn.localize(known, 7)  # type: ignore[arg-type]
    assert repr(first).startswith(f"<Answer {first.name}: <Localization of {first.name}: converged at (")


def answers_with(poses: list[SE3], truths: list[SE3]) -> Answers:
    found, frame = replace(FOUND, outcome=Outcome.CONVERGED), Frame("a", torch.zeros((3, 4, 3)), CAMERA)
    answers = Answers()
    for pose, truth in zip(poses, truths, strict=True):
        moved = replace(found, T_world_camera=pose)
        answers.append(replace(Answer.of(frame, len(answers), moved), truth=truth))
    return answers


def test_answers_become_a_table() -> None:
    pytest.importorskip("pandas")
    moved = FOUND.T_world_camera.translated(torch.tensor([0.0, 3.0, 4.0], dtype=torch.float64))
    answers = answers_with([FOUND.T_world_camera], [moved])
    answers.append(Failure("b", "auto", "no such file"))
    known, failed = answers.to_pandas().to_dict("records")
    assert [known["x"], known["y"], known["z"]] == FOUND.T_world_camera.translation.tolist()
    assert [known["qx"], known["qy"], known["qz"], known["qw"]] == FOUND.T_world_camera.quaternion("xyzw").tolist()
    assert (known["frame"], known["outcome"], known["confidence"]) == ("a", "converged", 0.25)
    assert known["error_translation"] == pytest.approx(5.0)
    assert known["sigma_translation"] == pytest.approx(3**0.5)
    assert known["sigma_rotation_deg"] == pytest.approx(math.degrees(3**0.5))
    assert not any(isinstance(value, list | dict) for value in known.values())
    assert (failed["outcome"], failed["reason"]) == ("bad input", "no such file")


@pytest.mark.parametrize("line", [False, True])
def test_errors_by_another_world_are_told_from_errors_of_poses(line: bool) -> None:
    """Also where all cameras are on a line, about which positions alone do not determine the rotation."""
    generator = torch.Generator().manual_seed(0)
    tangents = torch.randn((6, 6), dtype=torch.float64, generator=generator)
    truths = [SE3.exp(tangent) for tangent in tangents]
    if line:
        truths = [SE3(truth.rotation, truth.translation * T.translation.new_tensor([1, 0, 0])) for truth in truths]
    there = [SE3(T.rotation @ truth.rotation, T.apply(1.7 * truth.translation)) for truth in truths]
    noise = 0.01 * torch.randn((6, 6), dtype=torch.float64, generator=generator)
    noisy = [pose.retract(step) for pose, step in zip(there, noise, strict=True)]
    remark = require(answers_with(noisy, truths).world_mismatch)
    assert remark.startswith("all 6 accepted poses differ from the dataset's by one transformation")
    scale = float(remark.partition("a scale of ")[2].split()[0])
    assert scale == pytest.approx(1.7, rel=0.02)
    for others in (
        truths,
        [truth.retract(step) for truth, step in zip(truths, noise, strict=True)],
        [*noisy[:5], noisy[5].retract(50 * noise[5])],
        noisy[::-1],
    ):
        assert answers_with(others, truths).world_mismatch is None
    assert answers_with(noisy[:2], truths[:2]).world_mismatch is None
