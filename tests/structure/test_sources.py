"""Photos with which structure from motion begins: each scene once, and through a lens that a pinhole camera can be."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bidnerf.structure import photos_of, refuse_panoramas
from bidnerf_core.errors import InputWarning
from refusals import refused


def test_smaller_copies_of_photos_are_left_out(tmp_path: Path) -> None:
    for number in range(3):
        image = Image.fromarray(np.full((63, 85, 3), 60 * number, np.uint8))
        for folder, factor in (("images", 1), ("images_2", 2), ("images_4", 4), ("right", 1)):
            (tmp_path / folder).mkdir(exist_ok=True)
            size = round(85 / factor), round(63 / factor)
            image.resize(size).save(tmp_path / folder / f"{number}.png")
    with pytest.warns(InputWarning, match="images_2 and images_4: smaller copies"):
        found = photos_of(tmp_path)
    assert {image.file.parent.name for image in found} == {"images", "right"}  # two cameras of a rig


def test_panoramas_are_not_taken_for_pinhole_images(tmp_path: Path) -> None:
    image = Image.fromarray(np.zeros((20, 40, 3), np.uint8))
    image.save(tmp_path / "1.jpg", xmp=b'<x:xmpmeta GPano:ProjectionType="equirectangular"/>')
    image.save(tmp_path / "0.jpg")
    photos = photos_of(tmp_path)
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
