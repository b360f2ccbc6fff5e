"""Photos with which structure from motion begins: each scene once, and through a lens that a pinhole camera can be."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bidnerf.structure import photos_of, refuse_panoramas
from bidnerf_core.datasets import lacks_poses
from bidnerf_core.errors import InputWarning
from optional import require
from refusals import refused


def files(folder: Path) -> list[Path]:
    return [require(shot.file) for shot in photos_of(folder).shots]


def test_smaller_copies_of_photos_are_left_out(tmp_path: Path) -> None:
    for number in range(3):
        image = Image.fromarray(np.full((63, 85, 3), 60 * number, np.uint8))
        for folder, factor in (("images", 1), ("images_2", 2), ("images_4", 4), ("right", 1)):
            (tmp_path / folder).mkdir(exist_ok=True)
            size = round(85 / factor), round(63 / factor)
            image.resize(size).save(tmp_path / folder / f"{number}.png")
    with pytest.warns(InputWarning, match="images_2 and images_4: smaller copies"):
        found = photos_of(tmp_path)
    assert {require(shot.file).parent.name for shot in found.shots} == {"images", "right"}  # two cameras of a rig


def test_panoramas_are_not_taken_for_pinhole_images(tmp_path: Path) -> None:
    image = Image.fromarray(np.zeros((20, 40, 3), np.uint8))
    image.save(tmp_path / "1.jpg", xmp=b'<x:xmpmeta GPano:ProjectionType="equirectangular"/>')
    image.save(tmp_path / "0.jpg")
    photos = files(tmp_path)
    (tmp_path / "0.jpg").unlink()  # a photo that cannot be read is left out later
    with refused(where=tmp_path / "1.jpg", found="is a panorama", expected="EQUIRECTANGULAR"):
        refuse_panoramas(photos)


def test_signals_go_on_to_their_handlers_after_pycolmap_is_imported() -> None:
    pytest.importorskip("pycolmap", reason="the extra 'sfm' is not installed")
    program = (
        "import os, signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(7));"
        "from bidnerf.structure.colmap import import_pycolmap; import_pycolmap('photos'); os.kill(os.getpid(), 15)"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (7, b"")


@pytest.mark.parametrize(
    ("names", "remark"),
    {
        "16-bit grey": (
            ["a_rgb/1.jpg", "a_measured/1.png"],
            "a_measured: grey images of 16 bits or more, such as depth",
        ),
        "pictures computed from photos": (["1.jpg", "1_depth_vis.png"], "1_depth_vis.png: computed from photos"),
        "another format": (["1.jpg", "1.png"], "1.png: the same photos in another format"),
        "folders of derived pictures": (["rgb/1.jpg", "rgb/normal_vis.txt", "normal_vis/1.png"], None),
        "poses of an app": (["1.jpg", "my_poses.txt"], "my_poses.txt: usually poses, but in a format that is not read"),
        "poses of each image": (["images/1.jpg", "cams/1_cam.txt"], "cams: usually poses"),
        "RealityCapture's sidecars": (["1.jpg", "1.xmp"], "1.xmp: usually poses"),
        "a COLMAP camera": (["1.jpg", "cameras.txt", "camera.json", "purpose.txt", "1.xml"], None),
    }.values(),
)
def test_what_lies_beside_photos_is_no_photo_and_is_named(tmp_path: Path, names: list[str], remark: str | None) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        if name.endswith((".jpg", ".png")):
            shape, kind = ((48, 64), np.uint16) if "measured" in name else ((48, 64, 3), np.uint8)
            noise = np.random.default_rng(0).integers(0, 255, shape).astype(kind)
            Image.fromarray(noise).save(tmp_path / name)
        else:
            (tmp_path / name).write_text('<rdf xcr:Position="1 2 3"/>')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert lacks_poses(tmp_path)
        found = photos_of(tmp_path)
    assert [require(shot.file).name for shot in found.shots] == ["1.jpg"]
    texts = [str(warning.message) for warning in caught]
    assert len(texts) == (remark is not None)
    assert all(text.startswith(f"{tmp_path}: {remark}") for text in texts)


def test_pictures_whose_edges_continue_each_other_are_panoramas_without_xmp(tmp_path: Path) -> None:
    columns = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    for number in range(3):
        joined = 128 + 100 * np.sin(columns + number)[None].repeat(60, 0)[..., None].repeat(3, 2)
        Image.fromarray(joined.astype(np.uint8)).save(tmp_path / f"{number}.png")
    with refused(where=tmp_path, found="edges continue each other", expected="EQUIRECTANGULAR"):
        refuse_panoramas(files(tmp_path))
    for number in range(3):
        ramp = np.linspace(0, 255, 120)[None].repeat(60, 0)[..., None].repeat(3, 2)
        Image.fromarray(ramp.astype(np.uint8)).save(tmp_path / f"{number}.png")
    refuse_panoramas(files(tmp_path))


def test_a_whole_disk_is_not_searched_for_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.datasets.unposed.MOST_FOLDERS", 20)
    for number in range(21):
        (tmp_path / f"{number}").mkdir()
    with refused(where=tmp_path, found="more than 20 subfolders", expected="the folder of photos of one scene"):
        photos_of(tmp_path)
