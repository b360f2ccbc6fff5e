"""How images are held: as bytes, in few blocks, and drawn from without copies; and how large captures are read."""

from __future__ import annotations

import copy
import json
import logging
import pickle
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from PIL import Image

import tiny
from bidnerf_core.camera import CameraBatch, Intrinsics, check_side
from bidnerf_core.datasets import DatasetOptions, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import (
    Frame,
    ImagePixels,
    PixelStore,
    View,
    as_floats,
    observe,
    storage,
)
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.landmarks import tracks
from bidnerf_core.maps import TrainOptions, read_views
from bidnerf_core.maps import views as views_of_map

# Inside: blocks are made so small that the images of a test fill several
from bidnerf_core.training import RayBank, excess, nearby_photos, ray_bank
from optional import require
from photo_files import noise
from simulated_device import DEVICE, Elsewhere

CAMERA = Intrinsics(30.0, 31.0, 12.3, 8.1, 24, 16)
LENS = replace(CAMERA, distortion=(0.1, -0.02, 0.003, 0.001))
BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 4.0)


def byte_frame(seed: int = 0, camera: Intrinsics = CAMERA) -> Frame:
    return Frame(f"f{seed}", torch.from_numpy(noise(camera.height, camera.width, seed=seed)), camera)


def some_views(count: int, camera: Intrinsics = CAMERA) -> list[View]:
    twists = 0.1 * torch.randn(count, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return [View(byte_frame(i, camera), SE3.exp(twists[i])) for i in range(count)]


def test_a_frame_of_bytes_is_one_of_floats_to_whoever_reads_it() -> None:
    held = torch.from_numpy(noise(16, 24))
    frame, floats = Frame("f", held, CAMERA), Frame("f", as_floats(held), CAMERA)
    assert frame.rgb_bytes is held
    assert torch.equal(frame.rgb, floats.rgb)
    pixels = torch.tensor([[0, 0], [23, 15], [7, 3]])
    view, other = (View(f, SE3.identity()) for f in (frame, floats))
    assert torch.equal(observe(view, pixels).rgb, observe(other, pixels).rgb)
    for same in (
        copy.deepcopy(frame),
        pickle.loads(pickle.dumps(frame)),
        replace(frame, name="g"),
        frame.to("cpu"),
    ):
        assert torch.equal(same.rgb, floats.rgb)
    assert floats.rgb_bytes.dtype == torch.uint8
    hidden = frame.replace(hidden=held[..., 0] > 200)
    assert hidden.rgb_bytes is held
    with pytest.raises(TypeError, match="brightness"):
        frame.replace(brightness=1)
    with pytest.raises(InputError, match="camera expects"):
        frame.replace(intrinsics=replace(CAMERA, width=20))


def test_pixels_on_a_device_are_those_of_their_own_images() -> None:
    images = [torch.from_numpy(noise(4, 6, seed=seed)) for seed in range(3)]
    image, pixel = torch.tensor([0, 1, 2, 1]), torch.tensor([5, 0, 23, 17])
    expected = ImagePixels.of(images, 3).at(image, pixel)
    with Elsewhere():
        there = ImagePixels.of(images, 3, device=DEVICE)
        assert torch.equal(there.at(image.to(DEVICE), pixel.to(DEVICE)).cpu(), expected)


def test_reducing_a_frame_keeps_colours_rays_and_what_is_hidden() -> None:
    held = torch.from_numpy(noise(16, 24)[:, :, :1].repeat(3, 2))
    depth, hidden = torch.ones(16, 24), torch.zeros(16, 24, dtype=torch.bool)
    depth[:, :12], hidden[0, 0] = 2.0, True
    frame = Frame("f", held, LENS, depth, hidden=hidden)
    assert frame.at_most(24) is frame
    small = frame.at_most(12)
    assert (small.intrinsics.width, small.intrinsics.height) == (12, 8)
    means = as_floats(held).reshape(8, 2, 12, 2, 3).mean((1, 3))
    torch.testing.assert_close(small.rgb, means, atol=0.51 / 255, rtol=0)
    assert require(small.hidden).nonzero().tolist() == [[0, 0]]
    assert require(small.depth)[4].tolist() == [2.0] * 6 + [1.0] * 6
    there = torch.tensor([[3.0, 5.0], [20.0, 11.0]], dtype=torch.float64)
    torch.testing.assert_close(small.intrinsics.unproject(there / 2), LENS.unproject(there))


@pytest.mark.parametrize("expected", [0, 2**40], ids=["memory", "file"])
def test_a_store_returns_what_is_put_into_it(expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "FILE_BLOCK", 9000)
    views = some_views(8)
    depth = torch.rand(16, 24)
    frames = [views[0].frame.replace(depth=depth, alpha=depth, hidden=depth > 0.5)]
    frames += [view.frame for view in views[1:]]
    store = PixelStore(expected, tmp_path)
    for frame in frames:
        kept = store.store(frame)
        for name in ("rgb", "depth", "alpha", "hidden"):
            a, b = getattr(frame, name), getattr(kept, name)
            assert (a is None) == (b is None)
            assert a is None or torch.equal(a, b)
    assert list(tmp_path.iterdir()) == [], "files of a store have no names"


def test_a_full_disk_is_an_error_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(storage.os, "posix_fallocate", full)
    with pytest.raises(InputError, match=rf"^{tmp_path}: no room for 5000 MB of images \(No space left on device\)"):
        PixelStore(5_000_000_000, tmp_path).store(byte_frame())


@pytest.mark.parametrize("most", [1, 64])
def test_pixels_of_images_are_found_wherever_they_lie(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "MOST_BLOCKS", most)
    images: list[torch.Tensor | None] = [torch.from_numpy(noise(4, 5)), None, torch.rand(6, 3, 3)]
    images.append(torch.rand(8, 7, 3)[2:5, 1:4])  # a part of another image
    pixels = ImagePixels.of(images, 3, default=0.5)
    for number, image in enumerate(images):
        expected = torch.full((4, 3), 0.5) if image is None else as_floats(image).reshape(-1, 3)
        index = torch.arange(len(expected))
        assert torch.equal(pixels.at(torch.full_like(index, number), index), expected)


@pytest.mark.parametrize("camera", [CAMERA, LENS])
def test_rays_are_the_same_whether_computed_before_or_for_a_batch(
    camera: Intrinsics, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = some_views(3, camera)
    views[1] = View(byte_frame(1, replace(CAMERA, cx=11.0)), views[1].T_ref_camera)
    batches = []
    for most in (2**24, 0):
        monkeypatch.setattr(ray_bank, "MOST_RAYS", most)
        batches.append(RayBank(views, BOUNDS).draw(400, torch.Generator().manual_seed(0)))
    before, after = batches
    torch.testing.assert_close(before.rays.directions, after.rays.directions)
    assert torch.equal(before.observed.rgb, after.observed.rgb)
    kinds = [v.frame.intrinsics for v in views]
    for number, kind in enumerate(kinds):
        centres = kind.pixel_centres(torch.float64).reshape(-1, 2)
        found = CameraBatch.of(kinds).unproject(centres, torch.full((len(centres),), number))
        torch.testing.assert_close(found, kind.unproject(centres))


def test_nearby_photos_are_those_that_are_matched() -> None:
    views = some_views(40)
    whole = tracks.likely_pairs([view.T_ref_camera for view in views], 8)
    near, values = nearby_photos(views), torch.arange(40.0)
    for photo in range(40):
        others = {j if i == photo else i for i, j in whole.tolist() if photo in (i, j)}
        assert set(near[near[:, 0] == photo, 1].tolist()) == others
        median = sorted(others)[(len(others) - 1) // 2]
        assert float(excess(values, near)[photo]) == photo - median


def test_large_images_are_read_at_the_size_that_is_of_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    camera, frames = {"fl_x": 150.0, "cx": 95.0, "cy": 60.0, "w": 192, "h": 120}, []
    for number in range(3):
        Image.fromarray(noise(120, 192, seed=number)).save(tmp_path / f"{number}.png")
        pose = torch.eye(4)
        pose[0, 3] = number
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    monkeypatch.setattr(logging.getLogger("bidnerf"), "propagate", True)
    caplog.set_level(logging.INFO, "bidnerf")
    assert read_views(tmp_path).views[0].frame.intrinsics.width == 192
    assert "read at" not in caplog.text

    small = read_views(tmp_path, DatasetOptions(largest=96)).views
    assert [view.frame.intrinsics for view in small] == [Intrinsics(75.0, 75.0, 47.5, 30.0, 96, 60)] * 2
    assert "2 images of 192x120 read at 96x60, 0 MB; `largest` sets another size" in caplog.text
    monkeypatch.setattr(views_of_map, "MOST_BYTES", 10_000)
    monkeypatch.setattr(views_of_map, "LEAST_SIDE", 20)
    frame = open_dataset(tmp_path).views("train", ["1"])[0].frame
    for count in (1, 10, 1000):
        side = views_of_map.useful_size(frame, count)
        assert side == 20 or 0.9 < count * 3 * side**2 * 120 / 192 / 10_000 <= 1
    for wrong in (0, 2.5, True):
        with pytest.raises(InputError, match=r"largest is .*, expected a positive whole number of pixels"):
            check_side(wrong)  # type: ignore[arg-type]


def test_a_map_of_reduced_images_is_resumed_at_their_size(tmp_path: Path) -> None:
    from bidnerf import resume, train
    from bidnerf_core.maps import load_info, longest_side

    data, out = tiny.write_dataset(tmp_path / "data"), tmp_path / "map"
    train(
        data,
        out=out,
        config=tiny.config(),
        bake=False,
        options=TrainOptions(images=DatasetOptions(largest=20)),
    )
    info = load_info(out)
    assert longest_side(info) == 20
    assert resume(out, data).info.cameras == info.cameras


@pytest.mark.parametrize("size", [(96, 64), (97, 64)], ids=["multiples", "others"])
@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK", "RGBA"])
def test_images_that_are_reduced_while_read_are_those_reduced_afterwards(
    mode: str, size: tuple[int, int], tmp_path: Path
) -> None:
    ramp = torch.linspace(0, 255, size[0]).byte().expand(size[1], size[0])
    colours = torch.stack([ramp, ramp.flip(1), torch.full_like(ramp, 90)], dim=-1).numpy()
    image = Image.fromarray(colours).convert(mode)
    path = tmp_path / ("a.png" if mode == "RGBA" else "a.jpg")
    image.save(path)
    frame = {"file_path": path.name, "transform_matrix": torch.eye(4).tolist()}
    content = {"fl_x": 80.0, "cx": 45.0, "cy": 30.0, "w": size[0], "h": size[1], "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    dataset = open_dataset(tmp_path)
    (whole,) = dataset.views("train")
    (read,) = dataset.views("train", limit=20)
    small = whole.frame.at_most(20)
    assert read.frame.intrinsics == small.intrinsics
    assert read.frame.rgb_bytes.dtype == small.rgb_bytes.dtype == torch.uint8
    torch.testing.assert_close(read.frame.rgb, small.rgb, atol=4 / 255, rtol=0)
    assert (read.frame.alpha is None) == (small.alpha is None)
