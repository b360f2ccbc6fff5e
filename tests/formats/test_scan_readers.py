"""Readers of phone apps and data sets: what they read is what was written, and they fulfil the contract of readers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

# Inside: a limit of size that small images reach, and pictures that are no files
from bidnerf.formats import lidar
from bidnerf.testing import ReaderContract, training_views
from bidnerf_core.datasets import (
    READERS,
    Capture,
    DatasetFrames,
    DatasetOptions,
    Shot,
    find_reader,
    open_dataset,
    open_sequence,
)
from bidnerf_core.datasets.capture import drop_missing_files
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.maps import read_views
from bidnerf_core.registry import list_plugins
from optional import require
from scan_layouts import LAYOUTS, PERIOD, SMALL, message, read_all, small_views, write_ace

COUNT = 10
LAWS = [name for name in dir(ReaderContract) if name.startswith("test_")]
OF_IMAGE_FILES = [kind for kind in LAYOUTS if kind not in ("record3d", "stray-scanner")]

pytestmark = pytest.mark.filterwarnings("ignore::bidnerf_core.errors.InputWarning")


@pytest.fixture(scope="module")
def written() -> list[View]:
    return list(training_views())[:COUNT]


@pytest.fixture(scope="module", params=LAYOUTS)
def layout(
    request: pytest.FixtureRequest, written: list[View], tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    """A layout, and a capture in it."""
    return request.param, LAYOUTS[request.param].write(tmp_path_factory.mktemp("capture"), written)


def test_the_contract_of_readers(layout: tuple[str, Path]) -> None:
    """Among its laws: rigid poses, axes by epipolar lines, depth in the unit of the poses, frames in order of time."""
    kind, folder = layout
    attributes = {
        "name": LAYOUTS[kind].reader,
        "folder": folder,
        "options": DatasetOptions(**LAYOUTS[kind].options),
    }
    subject = type("Subject", (ReaderContract,), attributes)()
    for law in LAWS:
        getattr(subject, law)()


def test_every_bundled_reader_has_a_layout() -> None:
    assert {layout.reader for layout in LAYOUTS.values()} == {x.name for x in list_plugins("readers") if x.is_bundled}


def test_what_is_read_is_what_was_written(layout: tuple[str, Path], written: list[View]) -> None:
    kind, folder = layout
    expected = LAYOUTS[kind]
    assert find_reader(folder) is READERS[expected.reader]
    frames, views = list(open_sequence(folder, **expected.options)), read_all(folder, **expected.options)
    assert open_dataset(folder).unit == expected.unit
    assert len(frames) == len(views) == COUNT
    held_out = (0, 1) if kind == "twelve-scenes" else (0, 8)  # by its split.txt; else every eighth
    assert [timed.split for timed in frames] == ["test" if n in held_out else "train" for n in range(COUNT)]
    for timed, view in zip(frames, written, strict=True):
        assert timed.truth is not None
        torch.testing.assert_close(timed.truth.matrix(), view.T_ref_camera.matrix(), atol=1e-6, rtol=0)
        assert torch.equal(timed.truth.matrix(), views[timed.frame.name].T_ref_camera.matrix())
        found, camera = timed.frame.intrinsics, view.frame.intrinsics
        assert (found.width, found.height) == (camera.width, camera.height)
        torch.testing.assert_close(found.matrix(), camera.matrix(), atol=1e-4, rtol=0)
        rgb = timed.frame.rgb.float() / (255 if timed.frame.rgb.dtype == torch.uint8 else 1)
        colour = (rgb - view.frame.rgb).abs()
        assert float(colour.max() if expected.lossless else colour.mean()) < (
            0.51 / 255 if expected.lossless else 0.05 if kind == "stray-scanner" else 0.03
        )  # a video has colours of half the resolution
        assert (timed.frame.depth is not None) == expected.depth
        if timed.frame.depth is not None and view.frame.depth is not None:
            known = timed.frame.depth > 0
            assert float((timed.frame.depth - view.frame.depth)[known].abs().max()) < 0.002
    times = [timed.time for timed in frames]
    assert (None not in times) == expected.times
    if expected.times:
        gaps = [b - a for a, b in pairwise(times)]  # type: ignore[operator]
        assert gaps == pytest.approx([PERIOD] * (COUNT - 1), abs=1e-6)


@pytest.mark.parametrize("kind", LAYOUTS)
def test_poses_in_all_directions_come_back(kind: str, tmp_path: Path) -> None:
    views, options = small_views(6), LAYOUTS[kind].options
    frames = open_sequence(LAYOUTS[kind].write(tmp_path, views), **options)
    for timed, view in zip(frames, views, strict=True):
        torch.testing.assert_close(require(timed.truth).matrix(), view.T_ref_camera.matrix(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", OF_IMAGE_FILES)
def test_an_image_that_is_damaged_is_named_when_its_turn_comes(kind: str, tmp_path: Path) -> None:
    """A whole header gives the size; no image is decoded before."""
    folder = LAYOUTS[kind].write(tmp_path, small_views(4))
    images = [file for file in sorted(tmp_path.rglob("*")) if file.suffix in (".png", ".jpg")]
    for image in {(image.parent, image.name.partition(".")[2]): image for image in images}.values():
        content = image.read_bytes()
        for damaged, said in (
            (content[:-40], ""),
            (b"", "file is empty"),
            (b"text", "none of the formats PNG"),
        ):
            image.write_bytes(damaged)
            if not said:
                assert len(open_sequence(folder, **LAYOUTS[kind].options)) == 4
            text = message(folder, **LAYOUTS[kind].options)
            assert text.startswith(f"{image}: not readable as an image (")
            assert said in text
            assert "BufferedReader" not in text
        image.write_bytes(content)


@pytest.mark.data
@pytest.mark.parametrize(
    ("kind", "scene"),
    [
        ("tum", "tum_fr1_xyz"),
        ("seven-scenes", "room_living"),
        ("colmap", "phone_doll"),
        ("colmap, binary", "phone_doll"),
        ("transforms", "phone_doll"),
    ],
)
def test_a_recorded_scene_is_the_same_in_another_layout(kind: str, scene: str, data_dir: Path, tmp_path: Path) -> None:
    recorded = open_dataset(data_dir / scene)
    expected = recorded.views("train", recorded.frame_names("train")[:3])
    found = open_sequence(LAYOUTS[kind].write(tmp_path, expected), **LAYOUTS[kind].options)
    for timed, view in zip(found, expected, strict=True):
        assert timed.frame.intrinsics == view.frame.intrinsics
        assert torch.equal(timed.frame.rgb, view.frame.rgb)
        if LAYOUTS[kind].depth:
            torch.testing.assert_close(timed.frame.depth, view.frame.depth)
        torch.testing.assert_close(require(timed.truth).matrix(), view.T_ref_camera.matrix(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", ["record3d", "polycam", "stray-scanner"])
def test_photos_of_phone_apps_have_the_size_that_is_asked_for(
    kind: str, written: list[View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their usual size is small, and a larger one is had for the asking."""
    folder = LAYOUTS[kind].write(tmp_path, written)
    monkeypatch.setattr(lidar, "LARGEST_SIDE", 40)
    whole = written[0].frame.intrinsics
    for asked, side in ((None, 40), (30, 30), (50, 50), (2000, max(whole.width, whole.height))):
        frames = [view.frame for view in read_views(folder, DatasetOptions(largest=asked)).views]
        assert {max(frame.rgb.shape[:2]) for frame in frames} == {side}
        found, expected = frames[0].intrinsics, whole.scaled(side / max(whole.width, whole.height))
        torch.testing.assert_close(found.matrix(), expected.matrix(), atol=1e-4, rtol=0)


def test_a_damaged_photo_of_a_known_size_prevents_no_others(tmp_path: Path) -> None:
    """Headers are read only where cameras have no size."""
    folder = LAYOUTS["polycam"].write(tmp_path, small_views(4))
    next(folder.rglob("corrected_images/*.jpg")).write_bytes(b"damaged")
    dataset = open_dataset(folder)
    with pytest.raises(InputError):
        read_all(folder)
    assert len(dataset.names) == 4


def test_pictures_need_no_hash(tmp_path: Path) -> None:
    @dataclass
    class Plain:
        size: tuple[int, int] = (8, 6)

        def pixels(self) -> torch.Tensor:
            return torch.zeros(6, 8, 3, dtype=torch.uint8)

    shots = [Shot(image=Plain(), stem="a"), Shot(image=tmp_path / "b.png"), Shot(image=Plain(), stem="c")]
    (tmp_path / "b.png").touch()
    assert len(drop_missing_files(Capture(tmp_path, shots))) == 3


@pytest.mark.parametrize(
    ("kind", "up"), [("polycam", (0.0, 1.0, 0.0)), ("stray-scanner", (0.0, 1.0, 0.0)), ("record3d", None)]
)
def test_scans_know_their_vertical_axis(kind: str, up: tuple[float, float, float] | None, tmp_path: Path) -> None:
    """Whatever masks or splits are chosen. The world of Record3D is the camera of the first frame, however it was held."""
    scan = open_dataset(LAYOUTS[kind].write(tmp_path, small_views(3)))
    assert all((part.unit, part.up) == ("metres", up) for part in (scan, scan.split("all"), scan.in_time_order()[:1]))


@pytest.mark.parametrize("kind", OF_IMAGE_FILES)
def test_an_answer_knows_its_image_file(kind: str, tmp_path: Path) -> None:
    folder = LAYOUTS[kind].write(tmp_path, small_views(3))
    for split in ("test", "all"):
        source = DatasetFrames(open_dataset(folder, **LAYOUTS[kind].options), split)
        files = [source.read(place).file for place in range(len(source.names))]
        assert all(file is not None and file.is_file() and file.suffix in (".png", ".jpg") for file in files)
        assert len(set(files)) == len(files)


def test_folders_of_ace_are_splits_and_digits_of_nsvf_too(tmp_path: Path) -> None:
    views = small_views(3)
    for split in ("train", "test"):
        write_ace(tmp_path / "ace", views, split=split)
    capture = open_dataset(tmp_path / "ace")
    assert {shot.splits for shot in capture.shots if "train" in shot.parts} == {("train",)}
    assert {shot.splits for shot in capture.shots if "test" in shot.parts} == {("test",)}
    write_ace(tmp_path / "nsvf", views, nsvf=True)
    for file in list((tmp_path / "nsvf").rglob("frame_0*")):
        file.rename(file.with_name(file.name.replace("frame_0000", "").replace(".", "_frame.")))
    assert [shot.splits for shot in open_dataset(tmp_path / "nsvf").shots] == [("train",), ("val",), ("test",)]
    (tmp_path / "nsvf" / "intrinsics.txt").write_text("20 8.5 6.25 0\n")
    assert open_dataset(tmp_path / "nsvf").shots[0].camera == replace(SMALL, fy=20.0)
