"""Registration of depth to colour images against a scene of a wall and a box that both cameras see directly."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import DepthCamera, TimedFrame, open_dataset, open_sequence
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from optional import require
from tum_folder import Recorded, write_recording

COLOUR = Intrinsics(131.0, 132.0, 79.0, 61.0, 160, 120)
BARREL = replace(COLOUR, distortion=(-0.28, 0.07, 0.001, -0.001))
DEPTH = Intrinsics(146.0, 146.0, 80.0, 60.0, 160, 120)
T_COLOUR_DEPTH = SE3(
    torch.from_numpy(Rotation.from_rotvec([0.01, -0.008, 0.003]).as_matrix()),
    torch.tensor([-0.15, 0.01, 0.004], dtype=torch.float64),
)
SENSOR = DepthCamera(DEPTH, T_COLOUR_DEPTH)
WALL = 2.0
BOX = torch.tensor([[-0.3, -0.2, 0.9], [0.2, 0.25, 1.2]], dtype=torch.float64)
"""The wall is the plane z = 2 m of the depth camera, the box lies before it (metres)."""
ERROR = 0.004
"""Metres by which planar z may change within a pixel of the slightly turned wall."""


def seen(camera: Intrinsics, T_depth_camera: SE3) -> Float[Tensor, "h w"]:
    """Return planar z as a camera measures it, by intersecting the rays of all pixels with the wall and the box."""
    rays = camera.unproject(camera.pixel_centres(torch.float64))
    origin, direction = T_depth_camera.translation, T_depth_camera.rotate(rays)
    wall = (WALL - origin[2]) / direction[..., 2]
    ends = (BOX[:, None, None] - origin) / direction  # (2 h w 3); rays have z = 1, so that lengths are planar z
    first, last = ends.amin(0).amax(-1), ends.amax(0).amin(-1)
    return torch.where((first < last) & (first > 0), first, wall).float()


def visible(depth: Float[Tensor, "h w"], camera: Intrinsics) -> Bool[Tensor, "h w"]:
    """Return the pixels of the colour camera whose points the depth camera sees."""
    rays = camera.unproject(camera.pixel_centres(torch.float64))
    points = T_COLOUR_DEPTH.inverse().apply(rays * depth.double()[..., None])
    pixel = DEPTH.project(points)
    inside = ((pixel >= 0) & (pixel < torch.tensor([DEPTH.width, DEPTH.height]))).all(-1)
    column, row = pixel.nan_to_num(0).floor().long().clamp(min=0).unbind(-1)
    nearest = seen(DEPTH, SE3.identity())[row.clamp(max=DEPTH.height - 1), column.clamp(max=DEPTH.width - 1)]
    return inside & (points[..., 2] <= nearest + 0.02)


def uniform(mask: Tensor, radius: int) -> Bool[Tensor, "h w"]:
    """Return the pixels around which a map has one value, up to a small slope."""
    size = 2 * radius + 1
    there = F.pad(mask[None, None].float(), (radius,) * 4, mode="replicate")
    most, least = F.max_pool2d(there, size, 1), -F.max_pool2d(-there, size, 1)
    return (most - least)[0, 0] < 0.05


@pytest.mark.parametrize("camera", [COLOUR, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("size", [(160, 120), (80, 60)], ids=["same resolution", "half the resolution"])
def test_registered_depth_is_what_the_colour_camera_would_measure(camera: Intrinsics, size: tuple[int, int]) -> None:
    """Occlusions included: depth of the wall never shows through the box, and what the box hides stays empty."""
    sensor = DepthCamera(DEPTH.resized(*size), T_COLOUR_DEPTH)
    measured = seen(sensor.camera, SE3.identity())
    found, expected = sensor.register(measured, camera, "depth"), seen(camera, T_COLOUR_DEPTH.inverse())
    known, radius = visible(expected, camera), 320 // size[0]
    plain = uniform(expected, radius) & uniform(known, radius)
    full, empty = known & plain, ~known & plain
    assert int(full.sum()) > 8_000
    assert int(empty.sum()) > 100
    assert float((found[full] > 0).float().mean()) > 0.999
    there = full & (found > 0)
    assert float((found - expected)[there].abs().max()) < ERROR * 160 / size[0]
    assert float((found[empty] == 0).float().mean()) > 0.999
    hidden = empty & (expected > WALL - 0.1)  # the wall behind the box, and beside the depth image
    assert int(hidden[20:100, 20:140].sum()) > 50


def test_what_was_not_measured_stays_empty() -> None:
    measured = seen(DEPTH, SE3.identity())
    measured[50:62, 110:126] = 0
    found = SENSOR.register(measured, COLOUR, "depth")
    changed = found != SENSOR.register(seen(DEPTH, SE3.identity()), COLOUR, "depth")
    assert bool((found[changed] == 0).all())
    scale = COLOUR.fx / DEPTH.fx
    assert int(changed.sum()) == pytest.approx(12 * 16 * scale**2, rel=0.15)


def test_a_lens_does_not_fold_points_beside_the_image_into_it() -> None:
    """The polynomial of this lens comes back to the image for directions beyond 50 degrees."""
    folding = Intrinsics(100.0, 100.0, 50.0, 40.0, 100, 80, (-0.4, 0.0, 0.0, 0.0))
    wide = Intrinsics(30.0, 30.0, 80.0, 60.0, 160, 120)
    depth = torch.zeros(120, 160)
    depth[60, 150:160] = 1.0
    assert not bool(DepthCamera(wide, SE3.identity()).register(depth, folding, "depth").any())
    far = folding.project(torch.tensor([[1.55, 0.0, 1.0]], dtype=torch.float64))
    assert 0 < float(far[0, 0]) < 100  # it would be in the image


def write_sensor(file: Path, **changes: object) -> Path:
    values = {"fl_x": DEPTH.fx, "fl_y": DEPTH.fy, "cx": DEPTH.cx, "cy": DEPTH.cy, "w": 160, "h": 120}
    content = values | {"T_colour_depth": T_COLOUR_DEPTH.matrix().tolist()} | changes
    file.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return file


def test_a_folder_of_images_is_registered_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    depth = (seen(DEPTH, SE3.identity()) * 1000).round()
    iio.imwrite(tmp_path / "photos" / "a.png", np.zeros((120, 160, 3), np.uint8))
    iio.imwrite(tmp_path / "photos" / "a.depth.png", depth.numpy().astype(np.uint16))
    sensor = write_sensor(tmp_path / "sensor.json")
    (timed,) = open_sequence(tmp_path / "photos", camera=COLOUR, register_depth=sensor)
    torch.testing.assert_close(timed.frame.depth, SENSOR.register(depth / 1000, COLOUR, "depth"))
    (plain,) = open_sequence(tmp_path / "photos", camera=COLOUR, register_depth=False)
    torch.testing.assert_close(plain.frame.depth, depth / 1000)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording in the layout of TUM RGB-D whose depth is not registered."""
    frame = Frame("a", torch.zeros(120, 160, 3), COLOUR, seen(DEPTH, SE3.identity()))
    frames = [Recorded(10.0 + number / 10, View(frame, SE3.identity())) for number in range(3)]
    return write_recording(tmp_path / "freiburg2_recording", frames)


def first(path: Path, **options: object) -> TimedFrame:
    return next(iter(open_sequence(path, **options)))  # type: ignore[arg-type]


def test_a_recording_like_tums_is_registered_from_a_sensor(recording: Path, tmp_path: Path) -> None:
    stored = require(first(recording, camera=COLOUR).frame.depth)
    found = first(recording, camera=COLOUR, register_depth=str(write_sensor(tmp_path / "sensor.json")))
    torch.testing.assert_close(found.frame.depth, SENSOR.register(stored, COLOUR, "depth"))
    (view,) = open_dataset(recording, camera=COLOUR, register_depth=SENSOR).views("test")
    assert torch.equal(view.frame.depth, require(found.frame.depth))  # type: ignore[arg-type]
    assert bool(torch.equal(view.T_ref_camera.translation, require(found.truth).translation))
    assert torch.equal(first(recording, camera=COLOUR, register_depth=False).frame.depth, stored)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"T_colour_depth": None}, "no T_colour_depth, expected a 4x4 matrix"),
        ({"T_colour_depth": [[1, 2], [3, 4]]}, "T_colour_depth is not 3x4 or 4x4"),
        ({"T_colour_depth": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "rotation of T_colour_depth is off"),
        ({"w": None}, "no w and h, expected the size"),
        ({"fl_x": None}, "no focal length"),
    ],
)
def test_broken_files_of_sensors_are_refused(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"sensor\.json: .*{message}"):
        DepthCamera.read(write_sensor(tmp_path / "sensor.json", **changes))


def test_depth_of_another_shape_than_its_sensors_is_refused(recording: Path) -> None:
    square = DepthCamera(Intrinsics(50.0, 50.0, 30.0, 30.0, 60, 60), SE3.identity())
    with pytest.raises(InputError, match=r"depth is 160x120, expected the aspect ratio of its camera, 60x60"):
        first(recording, register_depth=square)


def test_a_transform_that_loses_all_depth_is_named() -> None:
    there = SE3(torch.eye(3, dtype=torch.float64), torch.tensor([500.0, 0.0, 0.0], dtype=torch.float64))
    depth = seen(DEPTH, SE3.identity())
    with pytest.raises(InputError, match=r"d\.png: no measurement falls .* 500 m from"):
        DepthCamera(DEPTH, there).register(depth, COLOUR, "d.png")
