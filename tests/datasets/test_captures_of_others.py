"""Captures as people keep them: moved, copied through other systems, downscaled, exported and cloned. Each is read, or refused by name."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from PIL import Image

from bidnerf import Frame, open_dataset, open_sequence
from bidnerf_core.camera import CentralLens
from bidnerf_core.datasets import Shot
from bidnerf_core.geometry import SE3
from refusals import refused
from scan_layouts import (
    SMALL,
    edit_frame,
    message,
    pixels,
    read_all,
    remarks_of,
    small_views,
    write_colmap,
    write_image,
    write_llff,
    write_metashape,
    write_nerfstudio,
    write_opensfm,
    write_polycam,
    write_scannet,
    write_scannet_pp,
    write_stray_scanner,
    write_video,
)

COUNT = 4
JSON = "transforms.json"
Write = Callable[[Path, Any], Path]
Edit = Callable[[Path], object]


def moved(to: str, folder: Path) -> None:
    """Paths relative to the folder in which the converter ran; the photos lie in ``to`` beside the file."""
    for number in range(COUNT):
        edit_frame(folder / JSON, number, file_path=f"./data/desk/images/r_{number}.png", depth_file_path=None)
    (folder / to).mkdir(exist_ok=True)
    for image in (folder / "images").iterdir():
        image.rename(folder / to / image.name)


def companions(folder: Path) -> None:
    """Every file with the companion that macOS writes to other file systems."""
    for file in [file for file in folder.rglob("*") if file.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X")


def empty_columns(folder: Path) -> None:
    """What Stray Scanner writes since 2026; the second frame has no pose, and the third no lens of its own."""
    file = folder / "odometry.csv"
    head, *rows = file.read_text().splitlines()
    rows = [f"{row}, 20, 21, 8, 5.75, , " for row in rows]
    rows[1] = ", ".join([*rows[1].split(", ")[:2], *[""] * 7, *rows[1].split(", ")[9:]])
    rows[2] = rows[2].replace(", 20, 21, 8, 5.75", ", , , , ")
    columns = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    file.write_text("\n".join([head + columns, *rows]) + "\n")


def dense_workspace(root: Path) -> None:
    """COLMAP's automatic reconstruction whose photos lie elsewhere: only the undistorted images are there."""
    write_colmap(root / "dense/0", small_views(COUNT))
    (root / "dense/0/sparse/0").rename(root / "flat")
    (root / "dense/0/sparse").rmdir()
    (root / "flat").rename(root / "dense/0/sparse")
    other = write_colmap(root / "elsewhere", small_views(COUNT))
    (other / "sparse").rename(root / "sparse")
    cameras = root / "sparse/0/cameras.txt"
    cameras.write_text(f"1 SIMPLE_RADIAL {SMALL.width} {SMALL.height} 20 8 6 -0.18\n")


def reduced_only(folder: Path) -> None:
    """Only images of half the size are there, in ``images_2``."""
    for image in (folder / "images").iterdir():
        half = Image.open(image).reduce(2)
        write_image(folder / "images_2" / image.name, np.asarray(half))
        image.unlink()
    (folder / "images").rmdir()


def nanoseconds(folder: Path) -> None:
    for number in range(COUNT):
        edit_frame(folder / JSON, number, timestamp=1_403_636_579_000_000_000 + number * 50_000_000)


def elsewhere(suffix: str, folder: Path) -> None:
    """The images lie in a folder of another name, as another format, beside pictures computed from them."""
    for image in (folder / "images").iterdir():
        write_image(folder / "masks_vis" / image.name, np.zeros((12, 16), np.uint8))
        Image.open(image).save((folder / image.name).with_suffix(suffix))
        image.unlink()
        (folder / "colour" / "left").mkdir(parents=True, exist_ok=True)
        (folder / image.name).with_suffix(suffix).rename(folder / "colour/left" / f"{image.stem}{suffix}")


READ: dict[str, tuple[Write, Edit, str]] = {
    # What writes the capture, what then happens to its folder, and the remark.
    **{
        f"elsewhere, {write.__name__}": (
            write,
            partial(elsewhere, suffix),
            f"is taken for colour/left/{first}{suffix}",
        )
        for write, suffix, first in (
            (write_nerfstudio, ".jpg", "r_0"),
            (write_colmap, ".bmp", "r_0"),
            (write_metashape, ".png", "IMG_0"),
            (write_opensfm, ".jpg", "0"),
        )
    },
    "moved": (
        write_nerfstudio,
        partial(moved, "images"),
        "'./data/desk/images/r_0.png' is taken for images/r_0.png",
    ),
    "moved, flat": (write_nerfstudio, partial(moved, "."), "is taken for r_0.png"),
    "Polycam from a Mac": (write_polycam, companions, ""),
    "COLMAP from a Mac": (write_colmap, companions, ""),
    "Stray Scanner's empty columns": (
        lambda root, _: write_stray_scanner(root, small_views(COUNT + 1)),
        empty_columns,
        "1 of 5 images have no pose",
    ),
    "dense workspace": (lambda root, _: root, dense_workspace, "dense/0/images has a model of its own"),
    "reduced copies alone, COLMAP": (write_colmap, reduced_only, ""),
    "reduced copies alone, LLFF": (write_llff, reduced_only, ""),
    "masks beside a model": (
        write_colmap,
        lambda folder: (folder / "masks").mkdir(),
        "masks lies beside the images",
    ),
    "times in nanoseconds": (write_nerfstudio, nanoseconds, ""),
    "ScanNet++": (write_scannet_pp, lambda folder: None, ""),
}


@pytest.mark.parametrize("kind", READ)
def test_what_is_kept_otherwise_is_read(kind: str, tmp_path: Path) -> None:
    write, edit, expected = READ[kind]
    folder = write(tmp_path, small_views(COUNT))
    edit(folder)
    remarks = remarks_of(folder)
    assert len(remarks) == (expected != "")
    assert all(expected in remark for remark in remarks)
    views = read_all(folder)
    assert len(views) == COUNT
    assert all(view.frame.intrinsics.distortion == () for view in views.values())
    sizes = {(view.frame.intrinsics.width, view.frame.intrinsics.height) for view in views.values()}
    assert sizes == {(8, 6) if "reduced" in kind else (SMALL.width, SMALL.height)}
    times = [shot.time for shot in open_sequence(folder).shots if shot.time is not None]
    assert not times or max(times) - min(times) < 2 * COUNT


def in_metashape(change: Callable[[str], str], folder: Path) -> list[Shot]:
    """Write two photos, change the XML, and return the shots that have a pose."""
    file = write_metashape(folder, small_views(2)) / "cameras.xml"
    file.write_text(change(file.read_text()))
    return [shot for shot in open_dataset(folder).shots if shot.T_world_camera is not None]


COMPONENT = (
    "<components><component id='1'><transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>1 2 3</translation>"
    "<scale>2</scale></transform></component></components><cameras>"
)
TURNED = SE3(torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double(), torch.tensor([1.0, 2, 3]).double())


def test_metashape_joins_components_and_rigs_and_leaves_out_what_is_not_connected(tmp_path: Path) -> None:
    first, second = (view.T_ref_camera for view in small_views(2))
    both = in_metashape(
        lambda x: re.sub("<camera ", '<camera component_id="1" ', x).replace("<cameras>", COMPONENT), tmp_path / "a"
    )
    expected = TURNED @ SE3(second.rotation, 2 * second.translation)
    torch.testing.assert_close(both[1].T_world_camera.matrix(), expected.matrix(), atol=1e-9, rtol=0)
    apart = in_metashape(lambda x: x.replace('<camera id="1"', '<camera id="1" component_id="2"'), tmp_path / "b")
    assert len(apart) == 1
    assert [text.rpartition(": ")[2] for text in remarks_of(tmp_path / "b")] == [
        "its components are not connected; the largest is used, with 1 image"
    ]
    sensor = '<sensor id="1" type="frame"><resolution width="16" height="12"/><rotation>0 -1 0 1 0 0 0 0 1</rotation><location>1 2 3</location><calibration><f>20</f></calibration></sensor></sensors>'
    slave = re.compile(r'<camera id="1" sensor_id="0"([^>]*)><transform>.*?</transform>')
    rig = in_metashape(
        lambda x: slave.sub(r'<camera id="1" sensor_id="1" master_id="0"\1>', x).replace("</sensors>", sensor),
        tmp_path / "c",
    )
    torch.testing.assert_close(rig[1].T_world_camera.matrix(), (first @ TURNED).matrix(), atol=1e-9, rtol=0)
    empty = in_metashape(lambda x: x.replace("<chunk>", "<chunk/><chunk>"), tmp_path / "d")
    assert len(empty) == 2
    fisheye = in_metashape(lambda x: x.replace('type="frame"', 'type="equidistant_fisheye"'), tmp_path / "e")
    assert isinstance(fisheye[0].camera, CentralLens)
    for scale in ("0", "-1", "1e308"):
        with refused(found=f"is {float(scale):g}", expected="a positive number"):
            in_metashape(
                lambda x, s=scale: x.replace("<cameras>", f"<transform><scale>{s}</scale></transform><cameras>"),
                tmp_path / "f",
            )


def test_rows_of_llff_are_in_the_order_of_sorted(tmp_path: Path) -> None:
    folder = write_llff(tmp_path, small_views(3))
    for number, name in enumerate(("IMG_10", "IMG_8", "IMG_9")):
        (folder / "images" / f"{number:03d}.png").rename(folder / "images" / f"{name}.png")
    shots = {shot.stem: shot.T_world_camera for shot in open_dataset(folder).shots}
    for name, view in zip(("IMG_10", "IMG_8", "IMG_9"), small_views(3), strict=True):
        torch.testing.assert_close(shots[name].translation, view.T_ref_camera.translation, atol=1e-6, rtol=0)


def test_a_folder_of_images_is_named_where_several_fit(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, small_views(COUNT))
    elsewhere(".png", folder)
    shutil.copytree(folder / "colour/left", folder / "colour/right")
    with refused(where=folder / "images/r_0.png", found="no such image"):
        read_all(folder)
    assert len(read_all(folder, images=folder / "colour/right")) == COUNT
    with refused(where=tmp_path / "none", found="no such file or folder", expected="the folder of the images"):
        open_dataset(folder, images=tmp_path / "none")
    (tmp_path / "scannet").mkdir()
    with refused(found="has its images where its format says"):
        open_dataset(write_scannet(tmp_path / "scannet", small_views(COUNT)), images=folder)


def edit_text(file: Path, old: str, new: str) -> None:
    file.write_text(file.read_text().replace(old, new))


def two_for_one(folder: Path) -> None:
    """Tails of two names fit the same file: which of them it is, nobody knows."""
    for number, side in ((0, "left"), (1, "right")):
        edit_frame(folder / JSON, number, file_path=f"{side}/r_0.png")
    (folder / "images/r_0.png").rename(folder / "r_0.png")


def splat(folder: Path) -> None:
    (folder / "point_cloud/iteration_7000").mkdir(parents=True)
    (folder / "cameras.json").write_text(json.dumps([{"id": 0, "img_name": "a", "width": 8, "height": 6}]))


REFUSED: dict[str, tuple[Write, Edit, tuple[str, ...]]] = {
    # What writes the capture, what then happens to its folder, and parts of the message.
    "turned after SfM": (
        write_nerfstudio,
        lambda folder: [
            write_image(folder / "images" / f"{view.frame.name}.png", np.rot90(pixels(view)).copy())
            for view in small_views(COUNT)
        ],
        ("image is 12x16", "not turned by a quarter"),
    ),
    "a pose far away": (
        write_nerfstudio,
        lambda folder: edit_frame(
            folder / JSON, 2, transform_matrix=[[1, 0, 0, 1e30], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        ),
        ("r_2 is at 1e+30", "below 1e+10"),
    ),
    "one file for two names": (write_nerfstudio, two_for_one, ("frame 1", "different images")),
    "a model without images": (
        write_colmap,
        lambda folder: [(folder / "sparse/0/points3D.txt").touch(), (folder / "sparse/0/images.txt").unlink()],
        ("sparse/0", "no cameras and images"),
    ),
    "output of a splat": (lambda root, _: root, splat, ("output of 3D Gaussian Splatting", "bidnerf import")),
    "entities in XML": (
        write_metashape,
        lambda folder: edit_text(folder / "cameras.xml", "?>", '?><!DOCTYPE d [<!ENTITY a "aaaa">]>'),
        ("cameras.xml", "document type"),
    ),
    "LLFF with fewer poses": (
        write_llff,
        lambda folder: np.save(folder / "poses_bounds.npy", np.load(folder / "poses_bounds.npy")[1:]),
        ("has 3 poses for 4 images", "one for each"),
    ),
    "OpenSfM with an unknown lens": (
        write_opensfm,
        lambda folder: edit_text(folder / "reconstruction.json", '"brown"', '"dual"'),
        ("projection_type is dual", "perspective"),
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_would_be_read_wrongly_is_refused(kind: str, tmp_path: Path) -> None:
    write, edit, expected = REFUSED[kind]
    folder = write(tmp_path, small_views(COUNT))
    edit(folder)
    text = message(folder)
    assert all(part in text for part in expected), text


def test_pointers_of_git_lfs_are_named(tmp_path: Path) -> None:
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"
    for name, read in (
        ("photo.jpg", Frame.open),
        ("walk.mp4", lambda file: open_sequence(file, hfov=60)),
        ("transforms.json", lambda file: open_dataset(file.parent)),
    ):
        (tmp_path / name).write_text(pointer)
        with refused(where=tmp_path / name, found="is a pointer of Git LFS, not the file", expected="git lfs pull"):
            read(tmp_path / name)


def test_raw_photos_are_no_thumbnails(tmp_path: Path) -> None:
    """A DNG is a TIFF file whose first image is a thumbnail."""
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / "IMG_1.dng", format="TIFF")
    with refused(where=tmp_path / "IMG_1.dng", found="is a raw photo"):
        Frame.open(tmp_path / "IMG_1.dng", hfov=60)


def test_a_playlist_named_like_a_video_opens_no_other_file(tmp_path: Path) -> None:
    """FFmpeg would follow it, whatever its name."""
    write_video(tmp_path / "secret.mp4", [np.full((32, 48, 3), 200, np.uint8)] * 3)
    (tmp_path / "walk.mp4").write_text(f"ffconcat version 1.0\nfile '{tmp_path / 'secret.mp4'}'\n")
    with av.open(str(tmp_path / "walk.mp4"), options={"safe": "0"}) as followed:
        assert len(list(followed.decode(video=0))) == 3
    with refused(where=tmp_path / "walk.mp4", found="not readable as a video"):
        open_sequence(tmp_path / "walk.mp4", hfov=60)
