"""Existing COLMAP models as maps of landmarks: by their database, by hloc's features, and by their photos."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import re
import shutil
import sqlite3
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import bidnerf as bn
import tiny
from bidnerf import SE3, Frame, View
from bidnerf.cli import main
from bidnerf_core.datasets import read_posed_images, stored_keypoints
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import look_at
from bidnerf_core.mapping import DEFAULT_LANDMARKS, Keypoints, track_views
from bidnerf_core.maps import IMPORTERS
from optional import require
from photo_room import CAMERA, photograph, walk, write_photos
from refusals import refused
from sparse_model import write_model

COUNT = 6
pytestmark = pytest.mark.skipif(
    "colmap" not in IMPORTERS, reason="bidnerf was installed before it had this importer: reinstall it"
)
UNSEEN = look_at((-0.5, 0.1, -0.2), (1.7, 1.4, 0.2))


@dataclass(frozen=True)
class Model:
    """A project with photos and a text model of exact poses, whose points are triangulated from SIFT keypoints."""

    folder: Path
    poses: list[SE3]
    keypoints: list[Keypoints]

    @property
    def digests(self) -> dict[str, str]:
        files = sorted(path for path in self.folder.rglob("*") if path.is_file())
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}

    def write_database(self, path: Path, drop: int = 0, shape: tuple[float, ...] = (1.0, 0.0)) -> None:
        """Write the keypoints as COLMAP does, without the last ``drop`` of each image.

        ``shape`` is what is stored of a keypoint of scale 1 besides its place: scale and orientation, or an affine matrix.
        """
        with contextlib.closing(sqlite3.connect(path)) as opened, opened:
            opened.execute("CREATE TABLE images (image_id INTEGER, name TEXT, camera_id INTEGER)")
            for name in ("keypoints", "descriptors"):
                opened.execute(f"CREATE TABLE {name} (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
            for number, found in enumerate(self.keypoints):
                count = len(found) - drop
                scale = (found.sizes[:count, None] / 2).numpy()
                rows = np.concatenate([found.pixels[:count].numpy(), scale * shape], axis=1).astype("<f4")
                opened.execute("INSERT INTO images VALUES (?, ?, 1)", (number, f"{number:03d}.png"))
                opened.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (number, *rows.shape, rows.tobytes()))
                descriptors = found.descriptors[:count].numpy().tobytes()
                opened.execute("INSERT INTO descriptors VALUES (?, ?, 128, ?)", (number, count, descriptors))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Model:
    folder, poses = tmp_path_factory.mktemp("model") / "project", walk(COUNT)
    write_photos(folder / "images", poses)
    views = [
        View(Frame.open(folder / "images" / f"{number:03d}.png", camera=CAMERA), T) for number, T in enumerate(poses)
    ]
    tracked = track_views(views)
    seen, positions = tracked.triangulate(DEFAULT_LANDMARKS)
    images, keypoints = [], [image.keypoints for image in tracked.observations.images]
    first = np.cumsum([0, *map(len, keypoints)])
    point_of = dict(zip(seen.number.tolist(), seen.point.tolist(), strict=True))
    tracks: list[list[str]] = [[] for _ in positions]
    for number, (T, found) in enumerate(zip(poses, keypoints, strict=True)):
        observed = []
        for place, (u, v) in enumerate(found.pixels.tolist()):
            point = point_of.get(int(first[number]) + place, -1)
            observed.append(f"{u} {v} {point + 1 if point >= 0 else -1}")
            if point >= 0:
                tracks[point].append(f"{number + 1} {place}")
        images.append((f"{number:03d}.png", 1, T, " ".join(observed)))
    points = [
        f"{number + 1} {x} {y} {z} 0 0 0 0.5 {' '.join(track)}"
        for number, ((x, y, z), track) in enumerate(zip(positions.tolist(), tracks, strict=True))
    ]
    c = CAMERA
    write_model(folder / "sparse", [f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}"], images, points)
    return Model(folder, poses, keypoints)


@pytest.fixture
def model(original: Model, tmp_path: Path) -> Model:
    """A copy of the model, which a test may change."""
    return replace(original, folder=Path(shutil.copytree(original.folder, tmp_path / "project")))


@pytest.fixture(scope="module")
def imported(original: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the map imported by the photos, which are only read."""
    folder, before = tmp_path_factory.mktemp("imported") / "map", original.digests
    bn.import_map(original.folder, folder)
    assert original.digests == before
    return folder


def error_of(found: bn.Localization, true: SE3) -> float:
    return float((found.T_world_camera.translation - true.translation).norm())


def unseen() -> Frame:
    return Frame.from_numpy(photograph(UNSEEN).round().clip(0, 255).astype(np.uint8), CAMERA)


@pytest.mark.parametrize("shape", [(1.0, 0.3), (2.0, 1.0, 0.5, 0.75), (0.0, -1.0, 1.0, 0.0)])
def test_an_affine_shape_has_the_scale_of_a_circle_of_its_area(shape: tuple[float, ...], tmp_path: Path) -> None:
    keypoints = Keypoints(
        torch.tensor([[3.0, 4.0], [5.0, 6.0]]),
        torch.tensor([4.0, 7.0]),
        torch.zeros((2, 128), dtype=torch.uint8),
    )
    Model(tmp_path, [], [keypoints]).write_database(tmp_path / "database.db", shape=shape)
    (found,) = stored_keypoints(tmp_path / "database.db", ["000.png"]).values()
    torch.testing.assert_close(found.sizes, keypoints.sizes)
    assert torch.equal(found.pixels, keypoints.pixels)


@pytest.mark.parametrize("source", ["photos", "database"])
def test_a_model_becomes_a_map_of_landmarks_in_its_own_frame(
    model: Model, imported: Path, source: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = imported
    if source == "database":
        model.write_database(model.folder / "database.db")
        before, folder = model.digests, tmp_path / "map"
        with caplog.at_level(logging.INFO, "bidnerf"):
            bn.import_map(model.folder, folder)
        assert model.digests == before
        assert "the keypoints and their descriptors" in caplog.text
    scene = bn.load_map(folder)
    assert not scene.has_field
    assert "landmarks alone localize photos" in str(scene.describe())
    assert scene.describe().plain()["backend"] is None
    assert [camera.name for camera in scene.info.cameras] == [f"{number:03d}" for number in range(COUNT)]
    assert [camera.file for camera in scene.info.cameras] == [f"images/{n:03d}.png" for n in range(COUNT)]
    for camera, T in zip(scene.info.cameras, model.poses, strict=True):
        assert camera.intrinsics == CAMERA
        torch.testing.assert_close(camera.pose.matrix(), T.matrix())
    found = bn.Localizer(scene, warm_up=False)(unseen())
    assert found.converged, found.reason
    assert error_of(found, UNSEEN) < 0.01


def test_a_database_replaces_the_photos(model: Model, tmp_path: Path) -> None:
    model.write_database(tmp_path / "keypoints.db")
    for photo in (model.folder / "images").iterdir():
        photo.unlink()
    scene = bn.import_map(model.folder / "sparse", None, {"keypoints": str(tmp_path / "keypoints.db")})
    assert error_of(bn.Localizer(scene, warm_up=False)(unseen()), UNSEEN) < 0.01
    assert {camera.file for camera in scene.info.cameras} == {None}


def test_keypoints_of_another_model_are_not_used(
    model: Model, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model.write_database(model.folder / "database.db", drop=1)
    with caplog.at_level(logging.INFO, "bidnerf"):
        scene = bn.import_map(model.folder, bake=False)
    assert "not used: it has" in caplog.text
    assert len(scene.info.cameras) == COUNT
    given = {"keypoints": str(model.folder / "database.db")}
    with refused(where="database.db", found="keypoints of 000.png, the model", expected="the keypoints of"):
        bn.import_map(model.folder, None, given)
    (tmp_path / "other.db").write_bytes(b"no database")
    with refused(where="other.db", found="cannot be read", expected="a database of COLMAP"):
        bn.import_map(model.folder, None, {"keypoints": str(tmp_path / "other.db")})


def write_features(path: Path, keypoints: Sequence[Keypoints], channels: int = 128) -> None:
    """Write features as hloc does."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(path, "w") as opened:
        for number, found in enumerate(keypoints):
            group = opened.create_group(f"{number:03d}.png")
            group["keypoints"], group["scales"] = (found.pixels - 0.5).numpy(), (found.sizes / 2).numpy()
            group["descriptors"] = (found.descriptors.float() / 512).T.numpy()[:channels]


def test_features_of_hloc_are_read_with_their_detector(
    model: Model, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "features.h5"
    file.write_bytes(b"")
    with refused(where="features.h5", found="features of hloc needs the extra 'hloc'"), monkeypatch.context() as patch:
        patch.setitem(sys.modules, "h5py", None)
        bn.import_map(model.folder, None, {"keypoints": str(file)})
    write_features(file, model.keypoints)
    scene = bn.import_map(model.folder, None, {"keypoints": str(file)})
    assert error_of(bn.Localizer(scene, warm_up=False)(unseen()), UNSEEN) < 0.01
    write_features(file, model.keypoints, 64)
    with refused(found="its descriptors have 64 channels, those of 'sift' 128"):
        bn.import_map(model.folder, None, {"keypoints": str(file)})


VIEW = "CREATE VIEW {} AS SELECT 0 image_id, 56250000 rows, 4 cols, zeroblob(900000000) data"
ENDLESS = (
    "CREATE VIEW images AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
    " SELECT 0 image_id, '000.png' name FROM c WHERE n < 0"
)
DATABASES = {
    "ALTER TABLE images RENAME TO other; " + ENDLESS: "its 'images' is a view",
    "DROP TABLE keypoints; " + VIEW.format("keypoints"): "its 'keypoints' is a view",
    "DROP TABLE descriptors; CREATE VIRTUAL TABLE descriptors USING fts5(image_id, rows, cols, data)": "is a view",
    "ALTER TABLE images ADD COLUMN more AS (zeroblob(900000000))": "",  # which nobody reads
    "DROP TABLE images; CREATE TABLE images (image_id, name AS (zeroblob(900000000)));"
    "INSERT INTO images VALUES (0)": "too big",
    "UPDATE keypoints SET cols = 0, data = x''": "keypoints (x, y)",
    "UPDATE descriptors SET cols = 4 * cols, data = zeroblob(4 * rows * cols)": "have 512 bytes, those of SIFT 128",
    "UPDATE keypoints SET rows = 'many'": "image '000.png'",
    "UPDATE descriptors SET rows = 9223372036854775807": "image '000.png'",
    "DROP TABLE descriptors": "no such table",
}


@pytest.mark.parametrize("change", DATABASES)
def test_a_database_is_only_what_it_stores(model: Model, change: str) -> None:
    """Views, generated columns and virtual tables compute values of any size, and types are those of each value."""
    file = model.folder / "other.db"
    model.write_database(file)
    with contextlib.closing(sqlite3.connect(file)) as opened, opened:
        opened.executescript(change)
    if not DATABASES[change]:
        assert len(stored_keypoints(file, ["000.png"])) == 1
        return
    with pytest.raises(bn.InputError, match=re.escape(DATABASES[change])) as error:
        bn.import_map(model.folder, None, {"keypoints": str(file)})
    assert str(file) in str(error.value)


DATASETS: dict[str, tuple[str, dict[str, Any]]] = {
    "000.png/keypoints is a link": ("keypoints", {}),
    "declares 3,200,000,000 bytes that are not stored": (
        "keypoints",
        {"shape": (400_000_000, 2), "dtype": "f4", "chunks": (1000, 2)},
    ),
    "scales is compressed or in another file": (
        "scales",
        {"shape": (10**8,), "dtype": "f4", "fillvalue": 1, "compression": "gzip"},
    ),
    "descriptors is compressed or in another file": (
        "descriptors",
        {"shape": (128, 9), "dtype": "u1", "external": [("other", 0, 1280)]},
    ),
    "[9, 2]": ("scales", {"data": np.ones((9, 2))}),
    "an array of numbers": ("scales", {"data": np.array([b"a"] * 9)}),
    "keypoints of NaN": ("scales", {"data": np.full(9, np.nan)}),
}


@pytest.mark.parametrize("expected", DATASETS)
def test_features_are_arrays_of_numbers_in_the_file_itself(tmp_path: Path, expected: str) -> None:
    h5py = pytest.importorskip("h5py")
    file = tmp_path / "features.h5"
    write_features(file, [Keypoints(torch.ones((9, 2)), torch.ones(9), torch.zeros((9, 128), dtype=torch.uint8))])
    with h5py.File(file, "r+") as opened:
        opened["a"] = opened["/"]  # a cycle, which no name of an image leads into
    assert list(stored_keypoints(file, ["000.png"])) == ["000.png"]
    name, options = DATASETS[expected]
    with h5py.File(file, "r+") as opened:
        group = opened["000.png"]
        del group[name]
        if options:
            group.create_dataset(name, **options)
        else:
            group[name] = h5py.SoftLink("/000.png")
    with refused(where=file, found=None) as caught:
        stored_keypoints(file, ["000.png"])
    assert expected in str(caught.error)
    file.write_bytes(file.read_bytes()[:3000] + bytes(2000))
    with refused(where=file, expected="features of hloc"):
        stored_keypoints(file, ["000.png"])


def test_each_photo_that_is_left_out_has_a_reason(model: Model, caplog: pytest.LogCaptureFixture) -> None:
    (model.folder / "images" / "003.png").unlink()
    lines = (model.folder / "sparse" / "images.txt").read_text().splitlines()
    lines[2 + 2 * 5] = ""
    (model.folder / "sparse" / "images.txt").write_text("\n".join(lines) + "\n")
    with caplog.at_level(logging.INFO, "bidnerf"):
        scene = bn.import_map(model.folder, bake=False)
    assert len(scene.info.cameras) == COUNT - 2
    assert "left out: 003.png: no such photo" in caplog.text
    assert "left out: 005.png: it observes fewer than 6 points" in caplog.text


def test_photos_elsewhere_are_named_as_of_any_dataset(model: Model, tmp_path: Path) -> None:
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    (model.folder / "images").rename(photos)
    with refused(found="no such photo in ", where=model.folder / "sparse") as caught:
        bn.import_map(model.folder / "sparse", bake=False)
    assert "(`images` names another folder)" in str(caught.error)
    masks.mkdir()
    Image.fromarray(np.zeros((CAMERA.height, CAMERA.width), dtype=np.uint8)).save(masks / "000.png")
    given = bn.ImportOptions(bn.DatasetOptions(images=photos, masks=masks))
    scene = bn.import_map(model.folder / "sparse", bake=False, options=given)
    assert [camera.name for camera in scene.info.cameras] == [f"{number:03d}" for number in range(1, COUNT)]
    (masks / "000.png").rename(masks / "other.png")
    with refused(where=masks, found="no mask in it matches an image by name"):
        bn.import_map(model.folder / "sparse", bake=False, options=given)
    with refused(found=f"no such photo in {masks}"):
        bn.import_map(model.folder, options=bn.ImportOptions(bn.DatasetOptions(images=masks)))
    model.write_database(model.folder / "database.db")
    with refused(found="masks do not apply to stored keypoints", expected="none, or the keypoints of photos"):
        bn.import_map(model.folder / "sparse", bake=False, options=given)


def test_an_import_leaves_a_whole_map_or_nothing(model: Model, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    model.write_database(model.folder / "database.db")
    out, there = tmp_path / "map", list[str]()

    def killed(*_: Any, **__: Any) -> Any:
        there.extend(file.name for file in out.iterdir())
        raise InputError("no memory")

    with monkeypatch.context() as patch, refused(found="no memory"):
        patch.setattr(bn.Map, "with_landmarks", killed)
        bn.import_map(model.folder, out)
    assert (there, out.exists()) == ([], False)
    assert bn.import_map(model.folder, out).landmarks is not None
    assert bn.load_map(out).landmarks is not None


def test_a_model_is_scaled_and_placed(model: Model) -> None:
    place = SE3.exp(torch.tensor([5.0, -3.0, 1.0, 0.4, 0.2, -0.7], dtype=torch.float64))
    model.write_database(model.folder / "database.db")
    scene = bn.import_map(model.folder, options=bn.ImportOptions(scale=2.0, T_world_file=place))
    found = bn.Localizer(scene, warm_up=False)(unseen())
    assert found.converged
    assert scene.unit == "metres"
    expected = place.apply(2 * UNSEEN.translation)
    assert float((found.T_world_camera.translation - expected).norm()) < 0.02


def test_answers_are_written_in_the_frame_of_the_model(imported: Path, tmp_path: Path) -> None:
    write_photos(tmp_path / "queries", [UNSEEN])
    photo = next((tmp_path / "queries").iterdir())
    out = tmp_path / "answers" / "images.txt"
    out.parent.mkdir()
    main(["localize", str(imported), str(photo), "--focal", str(CAMERA.fx), "--out", str(out)])
    ((image,), _) = read_posed_images(out.parent)
    assert image.name == photo.name
    assert float((image.T_camera_model.inverse().translation - UNSEEN.translation).norm()) < 0.02


def test_what_needs_a_field_says_so_in_one_sentence(imported: Path) -> None:
    scene = bn.load_map(imported)
    view, start = View(unseen(), UNSEEN), UNSEEN.translated(torch.tensor([0.01, 0, 0], dtype=torch.float64))
    no_field = "the map has no radiance field"
    for work in (
        lambda: scene.render(view),
        lambda: bn.Localizer(scene, "bid")(view.frame, start),
        scene.bake,
    ):
        with refused(found=no_field):
            work()
    with refused(found="has no radiance field to extend"):
        bn.extend(scene, [view.frame])


def test_training_adds_a_field_and_keeps_landmarks_and_cameras(original: Model, imported: Path, tmp_path: Path) -> None:
    shutil.copytree(imported, tmp_path / "map")
    before = bn.load_map(tmp_path / "map")
    after = bn.train(original.folder, out=tmp_path / "map", config=tiny.config(), bake=False)
    assert after.has_field
    assert after.info.cameras == before.info.cameras
    assert torch.equal(require(after.landmarks).positions, require(before.landmarks).positions)
    assert bn.load_map(tmp_path / "map").info.step == tiny.STEPS
    with pytest.raises(InputError, match=r"not empty|holds"):
        bn.train(original.folder, out=tmp_path / "map", config=tiny.config())


def test_damaged_landmarks_are_named_before_a_field_is_added(original: Model, imported: Path, tmp_path: Path) -> None:
    shutil.copytree(imported, tmp_path / "map")
    (file,) = (tmp_path / "map").glob("landmarks-*")
    file.write_bytes(file.read_bytes()[:100])
    with refused(where=file):
        bn.train(original.folder, out=tmp_path / "map", config=tiny.config())
