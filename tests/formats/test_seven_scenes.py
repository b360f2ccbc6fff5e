"""Folders of 7-Scenes: registration against a rendered scene, split files, and sequences that lack poses."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

# Inside: the published calibration, with which the recording is rendered
from bidnerf.formats.seven_scenes import COLOUR_CAMERA, DEPTH_CAMERA, T_COLOUR_DEPTH
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Capture, open_dataset, open_sequence
from bidnerf_core.depth import DepthCamera
from bidnerf_core.geometry import SE3
from optional import require
from refusals import refused

SIZE = (160, 120)
COLOUR, DEPTH = COLOUR_CAMERA.resized(*SIZE), DEPTH_CAMERA.resized(*SIZE)
EDGE_X, EDGE_Y = 0.2, -0.1
"""The scene is the plane z = 2 m of the world, red right of the first, green below the second (metres)."""


def pose_of(number: int) -> SE3:
    """Return ``T_world_depth``: near the origin, looking along z, slightly turned."""
    turn = torch.tensor([0.02, -0.03, 0.05], dtype=torch.float64) * (number + 1)
    shift = torch.tensor([0.05 * number, -0.02 * number, 0.1], dtype=torch.float64)
    return SE3(torch.from_numpy(Rotation.from_rotvec(turn).as_matrix()), shift)


def on_plane(camera: Intrinsics, T_world_camera: SE3) -> tuple[np.ndarray, np.ndarray]:
    """Intersect the rays of all pixels with the plane; return world points (h, w, 3) and planar z (h, w), metres."""
    rays = camera.unproject(camera.pixel_centres(torch.float64))
    depth = (2.0 - T_world_camera.translation[2]) / T_world_camera.rotate(rays)[..., 2]
    return T_world_camera.apply(rays * depth[..., None]).numpy(), depth.numpy()


def write_frame(folder: Path, number: int) -> None:
    """Write a frame as the dataset has them: colours seen by the colour camera, depth and pose of the depth camera."""
    folder.mkdir(parents=True, exist_ok=True)
    T_world_depth = pose_of(number)
    world, _ = on_plane(COLOUR, T_world_depth @ T_COLOUR_DEPTH.inverse())
    red, green = world[..., 0] > EDGE_X, world[..., 1] > EDGE_Y
    stem = folder / f"frame-{number:06d}"
    iio.imwrite(f"{stem}.color.png", np.stack([red, green, np.zeros_like(red)], -1) * np.uint8(255))
    depth = (on_plane(DEPTH, T_world_depth)[1] * 1000).round().astype(np.uint16)
    depth[40:44, 50:54], depth[60:64, 90:94] = 65535, 0
    iio.imwrite(f"{stem}.depth.png", depth)
    rows = T_world_depth.matrix().tolist()
    Path(f"{stem}.pose.txt").write_text("\n".join("\t ".join(f"{x:.10e}" for x in row) + "\t" for row in rows) + "\n")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Three sequences of three frames, of which the second is the test."""
    for sequence in (1, 2, 10):
        for number in range(3):
            write_frame(tmp_path / "scene" / f"seq-{sequence:02d}", number)
    (tmp_path / "scene" / "TrainSplit.txt").write_bytes(b"sequence1\r\nsequence10\r\n")
    (tmp_path / "scene" / "TestSplit.txt").write_text("sequence2")
    return tmp_path / "scene"


def wrong_share(dataset: Capture) -> float:
    """Return the share of pixels with depth whose point of the plane has another colour than the pixel."""
    shares = []
    for view in dataset.views("test"):
        frame = view.frame
        assert frame.depth is not None
        rays = frame.intrinsics.unproject(frame.intrinsics.pixel_centres(torch.float64))
        world = view.T_ref_camera.apply(rays * frame.depth.double()[..., None])
        expected = torch.stack([world[..., 0] > EDGE_X, world[..., 1] > EDGE_Y], -1)
        wrong = ((frame.rgb[..., :2] > 0.5) != expected).any(-1)[frame.depth > 0]
        shares.append(float(wrong.float().mean()))
    return float(np.mean(shares))


def test_registered_depth_lies_under_its_colours(scene: Path) -> None:
    registered = open_dataset(scene)
    assert wrong_share(registered) < 0.005
    assert wrong_share(open_dataset(scene, register_depth=False)) > 0.03
    for view in registered.views("test"):
        depth = require(view.frame.depth)
        plane = on_plane(COLOUR, view.T_ref_camera)[1]
        measured = depth > 0
        assert float((depth - torch.from_numpy(plane))[measured].abs().max()) < 0.01
        assert 0.8 < float(measured.float().mean()) < 1
        assert not bool(measured[:2].all())  # the colour camera sees more than the depth camera


def test_without_registration_everything_is_as_stored(scene: Path) -> None:
    dataset = open_dataset(scene, register_depth=False)
    for number, view in enumerate(dataset.views("test")):
        assert view.frame.intrinsics == DEPTH
        torch.testing.assert_close(view.T_ref_camera.matrix(), pose_of(number).matrix(), atol=1e-9, rtol=0)
        depth = require(view.frame.depth)
        plane = torch.from_numpy(on_plane(DEPTH, pose_of(number))[1]).float()
        plane[40:44, 50:54] = plane[60:64, 90:94] = 0
        torch.testing.assert_close(depth, plane, atol=0.00051, rtol=0)


def test_splits_and_names(scene: Path) -> None:
    for name in ("seq-01_old2", "seq-02-2", "seq2x"):
        write_frame(scene / name, 7)  # no sequence, though its name resembles one
    dataset = open_dataset(scene)
    assert dataset.splits == ("train", "test")
    assert dataset.frame_names("train") == [f"seq-{s}_frame-00000{n}" for s in ("01", "10") for n in range(3)]
    assert dataset.frame_names("test") == [f"frame-00000{n}" for n in range(3)]
    assert [timed.split for timed in open_sequence(scene)] == ["train"] * 3 + ["test"] * 3 + ["train"] * 3
    for name in ("TrainSplit.txt", "TestSplit.txt"):
        (scene / name).unlink()
    held_out = open_dataset(scene)
    assert len(held_out.frame_names("train")) == 7
    assert held_out.frame_names("test") == ["frame-000000", "frame-000002"]


def test_one_sequence_is_a_dataset(scene: Path) -> None:
    dataset = open_dataset(scene / "seq-01")
    assert dataset.frame_names("test") == ["frame-000000"]
    assert dataset.frame_names("train") == ["frame-000001", "frame-000002"]


def test_a_sequence_may_lack_all_poses(scene: Path) -> None:
    for file in (scene / "seq-01").glob("*.pose.txt"):
        file.unlink()
    frames = list(open_sequence(scene / "seq-01"))
    assert [(timed.truth, timed.time) for timed in frames] == [(None, None)] * 3
    with refused(where=scene / "seq-01", found="has no pose for any of 3 images", expected="frame-000000.pose.txt"):
        open_dataset(scene / "seq-01")


def test_a_camera_in_the_folder_is_that_of_the_images(scene: Path) -> None:
    (scene / "cameras.txt").write_text("1 PINHOLE 160 120 140 141 80 60\n")
    view = open_dataset(scene).views("test")[0]
    assert view.frame.intrinsics == Intrinsics(140, 141, 80, 60, 160, 120)


@pytest.mark.parametrize(
    ("text", "line", "found", "expected"),
    [
        ("", "", "lists no sequences", "lines such as sequence1"),
        ("sequence2\nsequence7", ": line 2", "no folder for sequence7", "seq-07"),
        ("the second", "", "line 1: 'the second'", "a sequence such as sequence1"),
        ("sequence" + 5000 * "1", "", "line 1: 'sequence" + 32 * "1" + "'", "a sequence such as sequence1"),
    ],
)
def test_broken_split_files_name_the_line(text: str, line: str, found: str, expected: str, scene: Path) -> None:
    file = scene / "TestSplit.txt"
    file.write_text(text)
    with refused(where=f"{file}{line}", found=found, expected=expected):
        open_dataset(scene)


def test_another_calibration_moves_depth_and_poses(scene: Path) -> None:
    """A sensor at the colour camera's place: depth and poses are then those of the files."""
    same = DepthCamera(COLOUR_CAMERA, SE3.identity())
    found = open_dataset(scene, camera=COLOUR_CAMERA, register_depth=same).views("test")
    stored = open_dataset(scene, camera=COLOUR_CAMERA, register_depth=False).views("test")
    for view, other in zip(found, stored, strict=True):
        assert torch.equal(view.T_ref_camera.matrix(), other.T_ref_camera.matrix())
        torch.testing.assert_close(view.frame.depth, other.frame.depth)
