"""Folders of "3D Scanner App": conventions against a scene that the test renders, and every kind of bad file."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Capture, open_dataset, open_sequence
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_scanner_app.reader import LARGEST_SIDE, ScannerAppReader

WIDTH, HEIGHT, FOCAL, CENTRE = 960, 720, 800.0, (473.5, 363.25)
"""The photo's camera; ``CENTRE`` counts pixels from the centre of the upper left one, as ARKit does."""
SMALL = (64, 48)
"""Columns and rows of depth."""
WALL = -3.0
"""The scene is the plane z = -3 m of a world with y up, red right of x = 0.5 m and green above y = 0.2 m."""
EDGE_X, EDGE_Y = 0.5, 0.2
Json = dict[str, Any]


def pose_of(number: int) -> np.ndarray:
    """Camera to world, OpenGL axes: near the origin and looking along -z, slightly turned."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (number + 1) * np.array([0.02, -0.03, 0.05])).as_matrix()
    pose[:3, 3] = [0.05 * number, 0.02 * number, 0.1]
    return pose


def seen(number: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Intersect the rays of all pixels with the wall; return world points (h, w, 3) and planar z (h, w), metres."""
    x, y = ((np.arange(n) + 0.5) * full / n - 0.5 for n, full in zip(size, (WIDTH, HEIGHT), strict=True))
    u, v = np.meshgrid(x, y)
    rays = np.stack([(u - CENTRE[0]) / FOCAL, -(v - CENTRE[1]) / FOCAL, -np.ones_like(u)], -1)
    pose = pose_of(number)
    world = rays @ pose[:3, :3].T
    z = (WALL - pose[2, 3]) / world[..., 2]
    return pose[:3, 3] + z[..., None] * world, z


def description(number: int) -> Json:
    centre = [2 * (c + 0.5) / n for c, n in zip(CENTRE, (WIDTH, HEIGHT), strict=True)]
    projection = np.zeros((4, 4))
    projection[[0, 1, 0, 1], [0, 1, 2, 2]] = (
        2 * FOCAL / WIDTH,
        2 * FOCAL / HEIGHT,
        1 - centre[0],
        centre[1] - 1,
    )
    projection[2, 2:], projection[3, 2] = (-1, -0.001), -1
    return {
        "frame_index": number,
        "time": 100.0 + number / 6,
        "cameraPoseARFrame": pose_of(number).ravel().tolist(),
        "intrinsics": [FOCAL, 0, CENTRE[0], 0, FOCAL, CENTRE[1], 0, 0, 1],
        "projectionMatrix": projection.ravel().tolist(),
    }


def write_frame(folder: Path, number: int, name: str, photo: bool = True) -> None:
    (folder / f"frame_{name}.json").write_text(json.dumps(description(number)))
    if photo:
        world, _ = seen(number, (WIDTH, HEIGHT))
        red, green = world[..., 0] > EDGE_X, world[..., 1] > EDGE_Y
        image = np.stack([red, green, np.zeros_like(red)], -1) * np.uint8(255)
        iio.imwrite(folder / f"frame_{name}.jpg", image, quality=95, subsampling=0)
    depth = np.round(seen(number, SMALL)[1] * 1000).astype(np.uint16)
    depth[0, 0] = 5000 + 1
    iio.imwrite(folder / f"depth_{name}.png", depth)
    sure = np.full(depth.shape, 2, np.uint8)
    sure[10, 20], sure[11, 20] = 1, 0
    iio.imwrite(folder / f"conf_{name}.png", sure)


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames, of which the third has no photo, with numbers that sort otherwise as text."""
    folder = tmp_path_factory.mktemp("scan")
    for number, name in enumerate(("0", "2", "5", "10", "11")):
        write_frame(folder, number, name, photo=name != "5")
    return folder


@pytest.fixture
def scan(written: Path, tmp_path: Path) -> Path:
    """A copy of these frames."""
    return Path(shutil.copytree(written, tmp_path / "scan"))


def every_view(dataset: Capture) -> dict[str, View]:
    views = [view for split in dataset.splits for view in dataset.views(split)]
    return {view.frame.name: view for view in views}


def edge_error(view: View) -> float:
    """Return the share of pixels that have another colour than the point of the wall that their depth gives."""
    frame = view.frame
    rays = frame.intrinsics.unproject(frame.intrinsics.pixel_centres(torch.float64))
    depth = (WALL - view.T_ref_camera.translation[2]) / view.T_ref_camera.rotate(rays)[..., 2]
    world = view.T_ref_camera.apply(rays * depth[..., None])
    assert (frame.depth - depth)[frame.depth > 0].abs().max() < 0.02  # another row of depth differs by 5 mm
    expected = torch.stack([world[..., 0] > EDGE_X, world[..., 1] > EDGE_Y], -1)
    return float(((frame.rgb[..., :2] > 0.5) != expected).float().mean())


def test_pixels_and_depth_reproject_to_the_scene(scan: Path) -> None:
    for view in every_view(open_dataset(scan)).values():
        assert edge_error(view) < 3e-4
        for shift in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
            assert edge_error(moved(view, *shift)) > 1.5 * edge_error(view)


def moved(view: View, right: float, down: float) -> View:
    """Return the view with its principal point shifted (pixels)."""
    camera = view.frame.intrinsics
    camera = replace(camera, cx=camera.cx + right, cy=camera.cy + down)
    return replace(view, frame=view.frame.replace(intrinsics=camera))


def test_photos_are_reduced_with_their_camera(scan: Path) -> None:
    small = every_view(open_dataset(scan))["frame_0"].frame.intrinsics
    assert (small.width, small.height) == (LARGEST_SIDE, LARGEST_SIDE * HEIGHT // WIDTH)
    whole = every_view(open_dataset(scan, readers=[ScannerAppReader(largest=2000)]))["frame_0"]
    assert whole.frame.intrinsics == Intrinsics(FOCAL, FOCAL, CENTRE[0] + 0.5, CENTRE[1] + 0.5, WIDTH, HEIGHT)
    assert whole.frame.intrinsics.resized(small.width, small.height) == small
    assert edge_error(whole) < 3e-4
    asked = every_view(open_dataset(scan).at_most(2000))["frame_0"]
    assert asked.frame.intrinsics == whole.frame.intrinsics


def test_poses_have_opencv_axes(scan: Path) -> None:
    view = every_view(open_dataset(scan))["frame_10"]
    pose = pose_of(3)
    ahead, down = view.T_ref_camera.rotate(torch.tensor([[0.0, 0, 1], [0, 1, 0]], dtype=torch.float64))
    assert np.allclose(ahead, -pose[:3, 2])
    assert np.allclose(down, -pose[:3, 1])
    assert np.allclose(view.T_ref_camera.translation, pose[:3, 3])


def test_only_sure_depth_within_range_is_kept(scan: Path) -> None:
    (view,) = open_dataset(scan).views("test")
    depth = view.frame.depth
    dropped = depth.reshape(SMALL[1], 10, SMALL[0], 10).eq(0).all(3).all(1)
    assert dropped.nonzero().tolist() == [[0, 0], [10, 20], [11, 20]]
    assert int((depth == 0).sum()) == 300


def test_photos_are_ordered_by_number_and_every_eighth_is_held_out(scan: Path) -> None:
    dataset = open_dataset(scan)
    assert dataset.splits == ("train", "test")
    assert dataset.frame_names("test") == ["frame_0"]
    assert dataset.frame_names("train") == ["frame_2", "frame_10", "frame_11"]
    for number in range(12, 18):
        write_frame(scan, 0, str(number))
    assert open_dataset(scan).frame_names("test") == ["frame_0", "frame_16"]
    assert len(open_dataset(scan).frame_names("train")) == 8


def test_camera_without_projection_matrix_counts_from_pixel_centres(scan: Path) -> None:
    before = every_view(open_dataset(scan))["frame_0"].frame.intrinsics
    rewrite(scan, lambda content: content.pop("projectionMatrix"), "0")
    assert every_view(open_dataset(scan))["frame_0"].frame.intrinsics == before


def test_half_the_size_with_halved_intrinsics_is_the_same_camera(scan: Path) -> None:
    before = every_view(open_dataset(scan))["frame_0"].frame.intrinsics
    iio.imwrite(scan / "frame_0.jpg", iio.imread(scan / "frame_0.jpg")[::2, ::2])

    def halve(content: Json) -> None:
        content["intrinsics"] = [x / 2 for x in content["intrinsics"][:6]] + [0, 0, 1]

    rewrite(scan, halve, "0")
    after = every_view(open_dataset(scan))["frame_0"].frame.intrinsics
    assert after.matrix().allclose(before.resized(480, 360).matrix())


def test_a_phone_without_lidar_has_photos_alone(scan: Path) -> None:
    for file in [*scan.glob("depth_*"), *scan.glob("conf_*")]:
        file.unlink()
    assert [timed.frame.has_depth for timed in open_sequence(scan)] == [False] * 4


def rewrite(folder: Path, edit: Callable[[Json], Any], name: str = "2") -> None:
    file = folder / f"frame_{name}.json"
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def truncate(file: Path, size: int) -> None:
    file.write_bytes(file.read_bytes()[:size])


def write_confidence(folder: Path, value: int, shape: tuple[int, ...] = SMALL[::-1]) -> None:
    iio.imwrite(folder / "conf_2.png", np.full(shape, value, np.uint8))


def square_depth(folder: Path) -> None:
    iio.imwrite(folder / "depth_2.png", np.ones((9, 9), np.uint16))
    write_confidence(folder, 2, (9, 9))


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no json": (lambda f: (f / "frame_2.json").unlink(), r"frame_2\.json: no such file"),
    "no depth": (lambda f: (f / "depth_2.png").unlink(), r"depth_2\.png: no such file"),
    "no conf": (lambda f: (f / "conf_2.png").unlink(), r"conf_2\.png: no such file"),
    "cut photo": (lambda f: truncate(f / "frame_2.jpg", 3000), r"frame_2\.jpg: not readable as an image"),
    "cut depth": (lambda f: truncate(f / "depth_2.png", 90), r"depth_2\.png: not readable as an image"),
    "cut json": (lambda f: truncate(f / "frame_2.json", 90), r"frame_2\.json: not JSON"),
    "conf of 255": (
        lambda f: write_confidence(f, 255),
        r"conf_2\.png: has values up to 255, expected confidences from 0 to 2",
    ),
    "conf size": (
        lambda f: write_confidence(f, 2, (4, 5)),
        r"conf_2\.png: is 5x4, expected 64x48 like its depth",
    ),
    "depth shape": (
        square_depth,
        r"depth_2\.png: depth is 9x9, but its image is 960x720; expected the same aspect ratio",
    ),
    "scaled pose": (
        lambda f: rewrite(f, lambda c: c["cameraPoseARFrame"].__setitem__(0, 2.0)),
        r"frame_2\.json: the rotation of cameraPoseARFrame is off orthonormal by .*, expected a rigid",
    ),
    "mirrored pose": (
        lambda f: rewrite(f, lambda c: c.update(cameraPoseARFrame=np.diag([1.0, 1, -1, 1]).ravel().tolist())),
        r"the rotation of cameraPoseARFrame is a mirror image",
    ),
    "transposed pose": (
        lambda f: rewrite(f, lambda c: c.update(cameraPoseARFrame=pose_of(1).T.ravel().tolist())),
        r"the last row of cameraPoseARFrame is .*, expected \[0, 0, 0, 1\]",
    ),
    "short pose": (
        lambda f: rewrite(f, lambda c: c["cameraPoseARFrame"].pop()),
        r"cameraPoseARFrame has 15 entries, expected 16 numbers",
    ),
    "no intrinsics": (lambda f: rewrite(f, lambda c: c.pop("intrinsics")), r"no intrinsics, expected 9"),
    "pose NaN": (
        lambda f: rewrite(f, lambda c: c["cameraPoseARFrame"].__setitem__(3, float("nan"))),
        r"an entry of cameraPoseARFrame is NaN, expected a finite number",
    ),
    "transposed intrinsics": (
        lambda f: rewrite(f, lambda c: c.update(intrinsics=[FOCAL, 0, 0, 0, FOCAL, 0, *CENTRE, 1])),
        r"intrinsics is not \[fx, 0, cx, 0, fy, cy, 0, 0, 1\]",
    ),
    "photo of half the size": (
        lambda f: iio.imwrite(f / "frame_2.jpg", np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8)),
        r"intrinsics do not match its photo of 480x360; expected intrinsics scaled with the photo",
    ),
    "no conf between photos": (
        lambda f: (f / "conf_5.png").unlink(),
        r"conf_5\.png: no such file, although frame_5\.json exists",
    ),
    "no json between photos": (lambda f: (f / "frame_5.json").unlink(), r"frame_5\.json: no such file"),
    "depth size between photos": (
        lambda f: iio.imwrite(f / "depth_5.png", np.ones((48, 48), np.uint16)),
        r"conf_5\.png: is 64x48, expected 48x48",
    ),
    "depth shape between photos": (
        lambda f: [iio.imwrite(f / f"{kind}_5.png", np.ones((48, 48), np.uint8)) for kind in ("depth", "conf")],
        r"depth_5\.png: depth is 48x48, but its camera's photos are 960x720",
    ),
    "no projection between photos": (
        lambda f: rewrite(f, lambda c: c.update(projectionMatrix=None), "5"),
        r"frame_5\.json: no projectionMatrix, expected 16 numbers",
    ),
    "no photos": (
        lambda f: [photo.unlink() for photo in f.glob("*.jpg")],
        r"scan: has frame_N.json but no photo",
    ),
    "number twice": (
        lambda f: (f / "frame_02.jpg").write_bytes((f / "frame_2.jpg").read_bytes()),
        r"frame_02\.jpg and frame_2\.jpg have the same number",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_file_is_named_in_one_line(scan: Path, kind: str) -> None:
    spoil, message = BAD[kind]
    spoil(scan)
    with pytest.raises(InputError, match=message) as caught:
        list(open_sequence(scan))
    assert "\n" not in str(caught.value)


def test_folder_of_other_json_is_not_a_scan(tmp_path: Path) -> None:
    (tmp_path / "frame_0.json").write_text('{"pose": []}')
    with pytest.raises(InputError, match=r"is no dataset; expected .*scanner-app"):
        open_dataset(tmp_path)


DATA = os.environ.get("BIDNERF_DATA")


def test_the_sequence_has_the_depth_between_photos(scan: Path) -> None:
    """The third frame has no photo: its depth lies on the wall in the camera of the depth image."""
    frames = list(open_sequence(scan))
    assert [timed.frame.name for timed in frames] == ["frame_0", "frame_2", "frame_5", "frame_10", "frame_11"]
    assert [timed.time for timed in frames] == pytest.approx([100 + n / 6 for n in range(5)])
    assert [timed.split for timed in frames] == ["test", "train", None, "train", "train"]
    assert [timed.frame.has_colour for timed in frames] == [True, True, False, True, True]
    views = every_view(open_dataset(scan))
    for number, timed in enumerate(frames):
        expected = pose_of(number)[:3, 3]
        np.testing.assert_allclose(timed.truth.translation, expected, atol=1e-12)
        if timed.frame.has_colour:
            assert torch.equal(timed.frame.rgb, views[timed.frame.name].frame.rgb)
    between = frames[2].frame
    assert (between.intrinsics.width, between.intrinsics.height) == SMALL
    rays = between.intrinsics.unproject(between.intrinsics.pixel_centres(torch.float64))
    world = frames[2].truth.apply(rays * between.depth.double()[..., None])
    on_wall = between.depth > 0
    assert float(on_wall.float().mean()) > 0.99
    assert float((world[..., 2][on_wall] - WALL).abs().max()) < 0.002


@pytest.mark.skipif(DATA is None, reason="BIDNERF_DATA is not set")
def test_a_recorded_scan_in_the_order_of_time() -> None:
    sequence = open_sequence(Path(str(DATA)) / "iphone_corridor")
    assert len(sequence) == 436
    times = np.array([shot.time for shot in sequence.shots], dtype=float)
    assert (np.diff(times) > 0).all()
    kinds = [timed.frame.has_colour for timed in sequence[:30]]
    assert kinds == [number % 3 == 0 for number in range(30)]
    assert all(timed.frame.has_depth for timed in sequence[:30])
