"""Bags are read as they were written, whatever their format; what cannot be read is refused with a reason."""

from __future__ import annotations

import io
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import bags
from bidnerf import InputError, open_dataset, open_sequence
from bidnerf_ros2.bag import _same_lens
from bidnerf_ros2.messages import colour_image, depth_image, intrinsics, is_depth

CAMERA = (30.0, 31.0, 15.5, 11.5)
DRAWN = np.random.default_rng(0)
MOMENTS = [
    (
        10.0 + 0.1 * n,
        DRAWN.integers(0, 255, (24, 32, 3), np.uint8),
        DRAWN.integers(500, 4000, (24, 32)).astype(np.uint16),
    )
    for n in range(5)
]


@pytest.mark.parametrize("kind", ["mcap", "sqlite", "ros1"])
def test_frames_are_those_that_were_written(kind: str, tmp_path: Path) -> None:
    path = bags.write(tmp_path / ("b.bag" if kind == "ros1" else "b"), MOMENTS, CAMERA, kind)
    frames = open_sequence(path)
    assert len(frames) == len(MOMENTS)
    for _ in range(2):  # iterating again starts over
        found = list(frames)
        assert [timed.time for timed in found] == pytest.approx([time for time, *_ in MOMENTS])
        for timed, (_, colour, depth) in zip(found, MOMENTS, strict=True):
            assert np.array_equal((timed.frame.rgb * 255).round().numpy(), colour)
            assert timed.frame.depth.numpy() == pytest.approx(depth / 1000)
            camera = timed.frame.intrinsics
            assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 31.0, 16.0, 12.0)


def test_a_single_file_of_a_bag_is_one(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "b", MOMENTS, CAMERA)
    (file,) = path.glob("*.mcap")
    assert len(list(open_sequence(file))) == len(MOMENTS)


def test_depth_that_was_not_recorded_is_missing(tmp_path: Path) -> None:
    some = [(time, colour, depth if number % 2 else None) for number, (time, colour, depth) in enumerate(MOMENTS)]
    found = list(open_sequence(bags.write(tmp_path / "b", some, CAMERA, late=0.001)))
    assert [timed.frame.depth is not None for timed in found] == [depth is not None for *_, depth in some]
    none = [(time, colour, None) for time, colour, _ in MOMENTS]
    assert all(timed.frame.depth is None for timed in open_sequence(bags.write(tmp_path / "c", none, CAMERA)))


def test_the_lens_of_a_depth_camera_decides_whether_its_depth_is_registered() -> None:
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    camera = SimpleNamespace(distortion_model="plumb_bob", d=[0.0] * 5, r=np.eye(3), roi=roi, binning_x=0, binning_y=0)

    def info(fx: float, cx: float, factor: float = 1.0) -> SimpleNamespace:
        K = np.array([[fx, 0, cx], [0, fx, 240], [0, 0, 1 / factor]]) * factor
        P = np.concatenate([K, np.zeros((3, 1))], 1).ravel()
        size = {"width": round(640 * factor), "height": round(480 * factor)}
        return SimpleNamespace(**{**vars(camera), **size, "k": K.ravel(), "p": P})

    colour = intrinsics(info(600, 320), rectified=True)
    fits = [_same_lens(each, colour) for each in (info(600, 320), info(600, 320, 0.5), info(420, 320), info(600, 350))]
    assert fits == [True, True, False, False]


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "b", MOMENTS, CAMERA)
    with pytest.raises(InputError, match="has no pose for any of 5 images, expected 'bidnerf track"):
        open_dataset(path)
    (tmp_path / "junk.bag").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk\.bag: not a readable bag"):
        open_sequence(tmp_path / "junk.bag")
    with pytest.raises(InputError, match="no topic of colour images with a matching camera_info"):
        open_sequence(bags.write(tmp_path / "empty", [], CAMERA))
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:3000])
    with pytest.raises(InputError, match="bag"):
        list(open_sequence(path))


def test_images_of_all_encodings() -> None:
    colour, depth = MOMENTS[0][1], MOMENTS[0][2]
    alpha = np.dstack([colour, np.full((24, 32, 1), 9, np.uint8)])
    for encoding, pixels in (
        ("rgb8", colour),
        ("bgr8", colour[..., ::-1]),
        ("rgba8", alpha),
        ("bgra8", alpha[..., [2, 1, 0, 3]]),
    ):
        for padding in (0, 7):
            assert np.array_equal(colour_image(bags.image(bags.ROS2, 0, pixels, encoding, padding)), colour), encoding
    assert np.array_equal(colour_image(bags.image(bags.ROS2, 0, colour[..., 0], "mono8")), colour[..., 0])
    assert np.array_equal(colour_image(bags.compressed(bags.ROS2, 0, colour)), colour)
    metres = (depth / 1000).astype(np.float32)
    found, unit = depth_image(bags.image(bags.ROS2, 0, metres, "32FC1"))
    assert unit == 1.0
    assert np.array_equal(found, metres)
    big = bags.image(bags.ROS2, 0, depth.astype(">u2"), "16UC1")
    big.is_bigendian = 1
    assert np.array_equal(depth_image(big)[0], depth)
    with pytest.raises(InputError, match="bayer_rggb8"):
        colour_image(bags.image(bags.ROS2, 0, colour[..., 0], "bayer_rggb8"))
    padded = bags.image(bags.ROS2, 0, colour[:1], "rgb8")
    padded.step = 2**32 - 1  # of the only row, whose end may be missing
    assert np.array_equal(colour_image(padded), colour[:1])
    broken = bags.image(bags.ROS2, 0, colour, "rgb8")
    broken.data = broken.data[:100]
    with pytest.raises(InputError, match="has 100 bytes"):
        colour_image(broken)


def test_depth_as_plain_png_is_depth() -> None:
    """The plugin "compressed" of image_transport records it so, in a topic beside the colour images."""
    depth = np.arange(500, 500 + 24 * 32, dtype=np.uint16).reshape(24, 32)
    content = io.BytesIO()
    Image.fromarray(depth).save(content, format="PNG")
    message = SimpleNamespace(format="16UC1; png compressed ", data=content.getvalue())
    assert is_depth(message)
    stored, unit = depth_image(message)
    assert np.array_equal(stored, depth)
    assert unit == 0.001
    message.format = "16UC1; jpeg compressed "
    assert is_depth(message)
    with pytest.raises(InputError, match="has lost its values"):
        depth_image(message)
    assert not is_depth(SimpleNamespace(format="rgb8; jpeg compressed bgr8", data=b""))


def test_a_compressed_image_of_endless_segments_is_refused() -> None:
    content = io.BytesIO()
    Image.new("RGB", (8, 6)).save(content, format="JPEG")
    data = content.getvalue()[:2] + b"\xff\xfe\0\2" * 2000 + content.getvalue()[2:]
    with pytest.raises(InputError, match="a compressed image: has more than"):
        colour_image(SimpleNamespace(format="rgb8; jpeg compressed bgr8", data=data))


def test_cameras_after_binning_and_in_a_region() -> None:
    info = bags.camera_info(bags.ROS2, 0, 400.0, 400.0, 319.5, 239.5, 640, 480)
    info.d = np.array([0.1, 0.01, 0.0, 0.0, 0.0])
    whole = intrinsics(info)
    assert (whole.cx, whole.cy, whole.distortion) == (320.0, 240.0, (0.1, 0.01, 0.0, 0.0, 0.0))
    assert intrinsics(info, rectified=True).distortion == ()
    info.binning_x = info.binning_y = 2
    info.roi = SimpleNamespace(x_offset=100, y_offset=40, width=400, height=300)
    part = intrinsics(info)
    assert (part.fx, part.cx, part.cy, part.width, part.height) == (200.0, 110.0, 100.0, 200, 150)
    info.distortion_model = "equidistant"
    with pytest.raises(InputError, match="equidistant"):
        intrinsics(info)
    with pytest.raises(InputError, match="calibrated"):
        intrinsics(bags.camera_info(bags.ROS2, 0, 0.0, 0.0, 0.0, 0.0, 640, 480))


@pytest.mark.skipif("BIDNERF_DATA" not in os.environ, reason="BIDNERF_DATA is not set")
def test_a_recorded_scene_is_the_same_as_a_bag(tmp_path: Path) -> None:
    folder = Path(os.environ["BIDNERF_DATA"]) / "tum_fr1_xyz"
    moments, camera = bags.moments_of(folder)
    frames = list(open_sequence(bags.write(tmp_path / "b", moments[:8], camera)))
    read = {timed.frame.name: timed.frame for timed in open_sequence(folder)[:8]}
    assert len(frames) == len(read) == 8
    for timed, frame in zip(frames, read.values(), strict=True):
        assert (timed.frame.rgb - frame.rgb).abs().max() < 1e-6
        assert (timed.frame.depth - frame.depth).abs().max() < 1e-6
        assert timed.frame.intrinsics == frame.intrinsics
