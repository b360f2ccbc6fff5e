"""COLMAP models: what is read of them, in which unit, and what localization and training make of it."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import sparse_model
import tiny
from bidnerf.scenes import orbit
from bidnerf_core.camera import Intrinsics
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.datasets import SparseChoice, SparsePoints, read_model, read_posed_images
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from optional import require
from refusals import refused
from sparse_model import Known

CHOICE = SparseChoice()
IMAGE = "id, pose, camera and name of an image"


@pytest.fixture(scope="module")
def scene() -> Known:
    views = tiny.views(6)
    return sparse_model.known(views, [f"train/{view.frame.name}.png" for view in views])


@pytest.fixture
def model(scene: Known, tmp_path: Path) -> Path:
    return sparse_model.write(tmp_path / "sparse", scene)


def places(what: Known) -> list[tuple[str, SE3]]:
    return [(view.frame.name, view.T_ref_camera) for view in what.views]


def opened(model: Path, what: Known, choice: SparseChoice = CHOICE) -> SparsePoints:
    return SparsePoints(model, places(what), choice)


def bare(view: View) -> View:
    return replace(view, frame=replace(view.frame, depth=None))


# Reading.


def test_text_binary_and_pycolmap_say_the_same(model: Path, tmp_path: Path, scene: Known) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Reconstruction(str(model))
    binary = tmp_path / "binary"
    binary.mkdir()
    theirs.write_binary(str(binary))  # with rigs.bin and frames.bin, as versions from 3.12 on write
    assert (binary / "frames.bin").is_file()
    (binary / "project.ini").write_text("whatever else is there")
    for folder in (model, binary):
        images, points = read_model(folder)
        assert [image.name for image in images] == [theirs.images[i].name for i in sorted(theirs.images)]
        for image in images:
            other = theirs.find_image_with_name(image.name)
            expected = torch.from_numpy(np.array(other.cam_from_world().matrix()))
            torch.testing.assert_close(image.T_camera_model.matrix()[:3], expected)
            assert set(image.points.tolist()) == {p.point3D_id for p in other.points2D if p.has_point3D()}
        assert points.ids.tolist() == sorted(theirs.points3D)
        for i, number in enumerate(points.ids.tolist()):
            other = theirs.points3D[number]
            np.testing.assert_allclose(points.positions[i].numpy(), other.xyz)
            assert (float(points.errors[i]), int(points.tracks[i])) == (other.error, other.track.length())
    assert len(points.ids) == len(scene.points)


def test_an_image_that_observes_nothing_and_names_with_blanks(tmp_path: Path) -> None:
    (tmp_path / "images.txt").write_text(
        "# a comment\n\n7 1 0 0 0 1 2 3 1 a folder/an image.jpg\n\n8 1 0 0 0 0 0 0 1 b.jpg\n"
    )
    (tmp_path / "points3D.txt").write_text("")
    images, points = read_model(tmp_path)
    assert [(image.name, len(image.points)) for image in images] == [
        ("a folder/an image.jpg", 0),
        ("b.jpg", 0),
    ]
    assert images[0].T_camera_model.translation.tolist() == [1, 2, 3]
    assert len(points.ids) == 0


def test_every_truncation_of_a_binary_model_is_refused(model: Path) -> None:
    pytest.importorskip("pycolmap")
    sparse_model.to_binary(model)
    for name, read in (("images.bin", read_model), ("points3D.bin", read_model), ("cameras.bin", read_posed_images)):
        file = model / name
        whole = file.read_bytes()
        for length in {*range(24), *range(0, len(whole), 53), len(whole) - 1}:
            file.write_bytes(whole[:length])
            with refused(where=file) as caught:
                read(model)
            told = rf"too early, at byte {length};|declares \d+ entries in {length - 8} bytes"
            assert re.search(told, caught.error.found)
        file.write_bytes(whole)


@pytest.mark.parametrize("length", [100, 2**64 - 1])
def test_an_image_that_declares_more_keypoints_than_its_file_holds_is_refused(model: Path, length: int) -> None:
    pytest.importorskip("pycolmap")
    sparse_model.to_binary(model)
    pose = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1)
    content = struct.pack("<Q", 1) + pose + b"a.png\0" + struct.pack("<Q", length)
    (model / "images.bin").write_bytes(content)
    with refused(where=model / "images.bin", found=f"ends too early, at byte {len(content)}"):
        read_model(model)


@pytest.mark.parametrize(
    ("file", "text", "where", "found", "expected"),
    [
        ("images.txt", "1 1 0 0 0 0 0 0 1\n\n", "images.txt", "line 1 has 9 entries", IMAGE),
        (
            "images.txt",
            "1 1 0 0 x 0 0 0 1 a.png\n\n",
            "images.txt",
            "line 1: could not convert string to float: 'x'",
            IMAGE,
        ),
        (
            "images.txt",
            "1 0 0 0 0 0 0 0 1 a.png\n\n",
            "images.txt: line 1",
            "'a.png' has an invalid pose",
            "a unit quaternion",
        ),
        (
            "images.txt",
            "1 nan 0 0 0 0 0 0 1 a.png\n\n",
            "images.txt",
            "line 1: '1 nan 0 0 0 0 0 0 1 a.png' is not finite",
            IMAGE,
        ),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n1 2\n", "images.txt", "line 2 has 2 entries", "x, y, id of points"),
        (
            "images.txt",
            f"1 1 0 0 0 0 0 0 1 a.png\n1 2 {10**30}\n",
            "images.txt",
            f"line 2: {10**30} has more than 64 bits",
            "x, y, id",
        ),
        (
            "points3D.txt",
            "1 0 0 0 1 2 3 0.5 1\n",
            "points3D.txt",
            "line 1 has 9 entries",
            "x y z, r g b, error and a track",
        ),
        ("points3D.txt", "1 0 0 0 1 2 3 0.5\n1 0 0 0 1 2 3 0.5\n", "points3D.txt", "the same id", "unique ids"),
        ("points3D.txt", "", "", "none of its 0 points", None),
        ("images.txt", "", "", "has 0 of the 6 training cameras", "at least 2"),
    ],
)
def test_files_that_are_wrong_are_told(
    model: Path, scene: Known, file: str, text: str, where: str, found: str, expected: str | None
) -> None:
    (model / file).write_text(text)
    with refused(where=model / where, found=found, expected=expected):
        opened(model, scene)


def test_a_folder_without_a_model_is_told(tmp_path: Path, scene: Known) -> None:
    with refused(where=tmp_path, expected="images.bin and points3D.bin"):
        opened(tmp_path, scene)


# Points in metres.


def test_the_points_that_a_frame_observes_come_back_in_metres(model: Path, scene: Known) -> None:
    sparse = opened(model, scene)
    assert sparse.metres == pytest.approx(sparse_model.UNIT, rel=1e-9)
    assert sparse.misfit < 1e-9
    for place, view in enumerate(scene.views):
        found, truth = sparse.seen(view.frame.name, "train"), scene.truth(place)
        assert len(found) == len(truth) > 5
        torch.testing.assert_close(found, truth)


def test_what_is_left_out_is_a_setting(model: Path, scene: Known) -> None:
    def count(choice: SparseChoice) -> int:
        return len(opened(model, scene, choice).seen(scene.views[0].frame.name, "train"))

    usual = count(CHOICE)
    all_of_them = count(SparseChoice(points_error=100, points_views=1))
    assert all_of_them > usual > count(SparseChoice(points_views=3)) > 0
    with refused(where=model, found=f"none of its {len(scene.points)} points has a reprojection error of 0.1 pixels"):
        opened(model, scene, SparseChoice(points_error=0.1))
    for name, value, expected in (
        ("points_error", 0.0, "more than 0"),
        ("points_error", float("nan"), "more than 0"),
        ("points_views", 0, "a whole number, from 1 up"),
    ):
        with refused(found=f"{name} is {value}", expected=expected):
            SparseChoice(**{name: value})  # type: ignore[arg-type]


MOTION = SE3.exp(torch.tensor([5.0, 1.0, -2.0, 0.3, 1.0, -0.6], dtype=torch.float64))
AWAY = SE3.exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("change", "used", "tolerance"),
    [
        (
            lambda known: [(name, MOTION @ T) for name, T in known],
            6,
            1e-6,
        ),  # only the shape that the cameras make counts
        (lambda known: known[:2] + known[3:], 5, 1e-6),  # the frame that is sought is of another split
        (lambda known: [(name, T @ AWAY if i == 3 else T) for i, (name, T) in enumerate(known)], 5, 0.02),
    ],
    ids=["a moved world", "without the frame", "a misplaced camera"],
)
def test_the_unit_follows_from_the_training_cameras(
    change: Callable[[list[tuple[str, SE3]]], list[tuple[str, SE3]]],
    used: int,
    tolerance: float,
    model: Path,
    scene: Known,
) -> None:
    sparse = SparsePoints(model, change(places(scene)), CHOICE)
    assert sparse.cameras == used
    assert sparse.metres == pytest.approx(sparse_model.UNIT, rel=tolerance)
    seen = sparse.seen(scene.views[2].frame.name, "train")
    torch.testing.assert_close(seen, scene.truth(2), rtol=tolerance, atol=1e-6)


def test_cameras_that_tell_no_unit_are_refused(model: Path, scene: Known) -> None:
    one = places(scene)[:1]
    here = [(name, one[0][1]) for name, _ in places(scene)]
    other = list(zip([n for n, _ in places(scene)], orbit(3.5, 6, seed=9, elevation=(-60, 10)), strict=True))
    shuffled = [other[i] for i in (3, 0, 5, 1, 4, 2)]
    unknown, mixed = (
        [("x", T) for _, T in here],
        [(a, T) for (a, _), (_, T) in zip(other, shuffled, strict=True)],
    )
    for wrong, found, expected in (
        (one, "1 of the 1 training cameras", "at least 2"),
        ([], "0 of the 0 training cameras", "at least 2"),
        (unknown, "0 of the 6 training cameras", "it has 6 images (train/"),
        (here, "6 pairs of points", "2 or more distinct ones"),
        (mixed, "away from the training cameras", "at most 20%; is it a model of these images?"),
    ):
        with refused(where=model, found=found, expected=expected):
            SparsePoints(model, wrong, CHOICE)
    two = SparsePoints(model, places(scene)[:2], CHOICE)
    assert two.metres == pytest.approx(sparse_model.UNIT)
    assert "unchecked" in two.summary


def test_names_are_matched_by_stem_and_by_folders(scene: Known, tmp_path: Path) -> None:
    def found(*names: str) -> SparsePoints:
        return opened(sparse_model.write(tmp_path, replace(scene, names=names)), scene)

    stems = [view.frame.name for view in scene.views]
    assert len(found(*(f"{stem}.JPG" for stem in stems)).seen(stems[0], "test")) > 0
    sided = [(f"{side}_{stem}", f"{side}/{stem}.png") for stem in stems[:3] for side in ("left", "right")]
    both = replace(scene, names=[file for _, file in sided])
    seen = [(name, T) for (name, _), (_, T) in zip(sided, places(scene), strict=True)]
    rig = SparsePoints(sparse_model.write(tmp_path, both), seen, CHOICE)
    assert len(rig.seen(f"right_{stems[0]}", "train")) == len(scene.truth(1))
    alike = f"left/{stems[1]}.png, right/{stems[1]}.png"
    with refused(where=tmp_path, found=f"frame '{stems[1]}' may be any of {alike}", expected="one image"):
        found(*(f"{side}/{stem}.png" for side in ("left", "right") for stem in stems[1:4]))


def test_splits_in_folders_of_their_own_are_not_mistaken_for_each_other(scene: Known, tmp_path: Path) -> None:
    """Names repeat between splits as in NeRF-Synthetic: train/r_0.png and test/r_0.png."""
    stems = [view.frame.name for view in scene.views]
    names = [f"test/{stems[0]}.png", *(f"train/{stem}.png" for stem in stems[:5])]
    model = sparse_model.write(tmp_path, replace(scene, names=names))
    seen = [(stem, view.T_ref_camera) for stem, view in zip(stems, scene.views[1:], strict=False)]
    sparse = SparsePoints(model, seen, CHOICE)
    torch.testing.assert_close(sparse.seen(stems[0], "test"), scene.truth(0))
    torch.testing.assert_close(sparse.seen(stems[0], "train"), scene.truth(1))
    assert len(sparse.seen(stems[3], "test")) == 0


# Depth from it.


def test_a_frame_that_the_model_does_not_have_gets_no_depth(model: Path, scene: Known) -> None:
    stranger = replace(scene.views[0], frame=replace(scene.views[0].frame, name="stranger"))
    assert opened(model, scene).onto(bare(stranger), "train").frame.depth is None


def test_a_depth_image_of_the_points(model: Path, scene: Known) -> None:
    """Points lie on pixel centres of one view; seen from others they are a pixel's width off at most."""
    sparse = opened(model, scene)
    for place, view in enumerate(scene.views):
        depth = require(sparse.onto(bare(view), "train").frame.depth)
        assert view.frame.depth is not None
        assert 0 < int((depth > 0).sum()) <= len(scene.truth(place))
        both = (depth > 0) & (view.frame.depth > 0)
        assert int(both.sum()) == int((depth > 0).sum())
        torch.testing.assert_close(depth[both], view.frame.depth[both], rtol=0.02, atol=0)
    assert sparse.onto(scene.views[0], "train") is scene.views[0]  # has depth of its own


def test_of_points_at_one_pixel_the_nearest_is_seen(model: Path, scene: Known) -> None:
    small = Intrinsics(1.0, 1.0, 0.5, 0.5, 1, 1)
    frame = Frame(scene.views[0].frame.name, torch.zeros(1, 1, 3), small)
    depth = require(opened(model, scene).onto(View(frame, scene.views[0].T_ref_camera), "train").frame.depth)
    assert float(depth) == pytest.approx(float(scene.truth(0)[:, 2].min()))


# What it is good for.


def test_the_scene_is_bounded_by_points_where_there_is_nothing_better(model: Path, scene: Known) -> None:
    """Silhouettes bound the scene where there are any; a box of points alone gets a wide margin."""
    sparse = opened(model, scene)
    outlined = [sparse.onto(bare(view), "train") for view in scene.views]
    assert estimate_bounds(outlined) == estimate_bounds([bare(view) for view in scene.views])
    plain = [replace(view, frame=replace(view.frame, alpha=None)) for view in outlined]
    bounds = estimate_bounds(plain)
    good = scene.points[: scene.good]
    assert bool((good > torch.tensor(bounds.lower)).all() and (good < torch.tensor(bounds.upper)).all())
    assert max(bounds.size) < 3
