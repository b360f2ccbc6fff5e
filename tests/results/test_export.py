"""Maps for other software: what is written is what other readers and our own find again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import bidnerf as bn
import tiny
from bidnerf.testing import BOUNDS, textured_map, training_views
from bidnerf_core.camera import Orientation
from bidnerf_core.captures import stored_cameras
from bidnerf_core.datasets import read_frames
from bidnerf_core.io import read_record
from bidnerf_core.maps import Map, MapInfo
from bidnerf_core.registry import PluginError, registered
from optional import require
from refusals import refused


@pytest.fixture(scope="module")
def scene() -> Map:
    known = textured_map(surface=True)
    cameras = tuple(replace(camera, file=f"images/{camera.name}.JPG") for camera in stored_cameras(training_views()))
    info = MapInfo("ground", {}, BOUNDS, 1, True, "ground", weights="w", cameras=cameras, unit="metres")
    return Map(info, known.field, known.surface, known.landmarks)


def exported_to_colmap(scene: Map, folder: Path) -> Any:
    """Return COLMAP's reconstruction of the model that is exported into a folder."""
    pycolmap = pytest.importorskip("pycolmap")
    bn.export_map(scene, folder, "colmap")
    return pycolmap.Reconstruction(str(folder))


def read_ply(file: Path) -> tuple[list[str], np.ndarray]:
    head, _, body = file.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    end = next((n for n, line in enumerate(lines) if line.startswith("element face")), len(lines))
    row = [(word[2], kinds[word[1]]) for word in map(str.split, lines[:end]) if word[0] == "property"]
    return lines, np.frombuffer(body, np.dtype(row), count)


def test_point_clouds(scene: Map, tmp_path: Path) -> None:
    files = bn.export_map(scene, tmp_path / "out", "ply")
    assert [file.name for file in files] == ["cameras.json", "cameras.ply", "landmarks.ply", "surface.ply"]
    assert scene.surface is not None
    lines, surface = read_ply(files[3])
    assert "comment lengths in metres" in lines
    places = np.stack([surface[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_array_equal(places, scene.surface.surfels.positions.numpy())
    assert np.abs(surface["red"] / 255 - scene.surface.surfels.rgb[:, 0].numpy()).max() < 0.01
    _, landmarks = read_ply(files[2])
    assert landmarks["photos"].tolist() == require(scene.landmarks).views.tolist()
    _, cameras = read_ply(files[1])
    centre = scene.info.cameras[1].pose.translation
    np.testing.assert_allclose([cameras[axis][5] for axis in "xyz"], centre, atol=1e-6)


def test_transforms_json_is_read_again(scene: Map, tmp_path: Path) -> None:
    bn.export_map(scene, tmp_path / "out", "transforms.json")
    frames = read_frames(read_record(tmp_path / "out" / "transforms.json"))
    assert {frame.record.value("unit") for frame in frames} == {scene.unit}
    for frame, camera in zip(frames, scene.info.cameras, strict=True):
        assert frame.stem == camera.name
        torch.testing.assert_close(frame.T_world_camera.matrix(), camera.pose.matrix(), atol=1e-9, rtol=0)
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert content["unit"] == "metres"
    assert (tmp_path / "out" / content["ply_file_path"]).exists()


def test_colmap_reads_the_model(scene: Map, tmp_path: Path) -> None:
    """The model has the keypoints that the landmarks were built from, which lie near their projections."""
    model = exported_to_colmap(scene, tmp_path / "out")
    landmarks = require(scene.landmarks)
    assert len(model.points3D) == len(landmarks)
    np.testing.assert_allclose(model.points3D[1].xyz, landmarks.positions[0], atol=1e-6)
    assert {image.name for image in model.images.values()} == {f"{camera.name}.JPG" for camera in scene.info.cameras}
    assert [model.points3D[n + 1].track.length() for n in range(len(landmarks))] == landmarks.views.tolist()
    assert model.compute_num_observations() == len(require(landmarks.tracks).landmark)
    first = model.points3D[1]
    seen = first.track.elements[0]
    image = model.images[seen.image_id]
    keypoint = image.points2D[seen.point2D_idx]
    assert keypoint.point3D_id == 1
    assert np.linalg.norm(image.project_point(first.xyz) - keypoint.xy) < 5 * landmarks.noise
    assert all(p.error == -1 for p in model.points3D.values() if p.track.length() == 1)  # unknown
    several = [n for n, point in model.points3D.items() if point.track.length() > 1]
    stated = np.mean([model.points3D[n].error for n in several])
    model.update_point_3d_errors()
    computed = np.mean([model.points3D[n].error for n in several])
    assert stated == pytest.approx(computed, rel=0.02)
    assert computed < 3 * landmarks.noise


def test_names_that_would_break_a_row_are_escaped(scene: Map, tmp_path: Path) -> None:
    first, *others = scene.info.cameras
    odd = replace(scene, info=replace(scene.info, cameras=(replace(first, file="a\nb\x1b.jpg"), *others)))
    model = exported_to_colmap(odd, tmp_path / "out")
    assert b"\x1b" not in (tmp_path / "out" / "images.txt").read_bytes()
    assert len(model.images) == len(scene.info.cameras)
    assert model.images[1].name.endswith("a\\nb\\x1b.jpg")


@pytest.mark.parametrize("code", [3, 6, 8])
def test_photos_that_were_turned_upright_are_exported_as_their_files_store_them(
    scene: Map, code: int, tmp_path: Path
) -> None:
    first, *others = scene.info.cameras
    turned = replace(first, orientation=Orientation.from_exif(code))
    model = exported_to_colmap(replace(scene, info=replace(scene.info, cameras=(turned, *others))), tmp_path / "out")
    image = model.images[1]
    size = (image.camera.width, image.camera.height)
    assert size == Orientation.from_exif(code).upright_size(first.intrinsics.width, first.intrinsics.height)
    keypoints = [point for point in image.points2D if point.has_point3D()]
    assert len(keypoints) > 10
    for keypoint in keypoints:
        projected = image.project_point(model.points3D[keypoint.point3D_id].xyz)
        assert np.linalg.norm(projected - keypoint.xy) < 10


def test_images_of_a_dataset_keep_the_names_of_their_files(tmp_path: Path) -> None:
    data = tiny.write_dataset(tmp_path / "data")
    trained = bn.train(data, config=tiny.config(2), bake=False)
    bn.export_map(trained, tmp_path / "out", "transforms.json")
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert all((data / frame["file_path"]).is_file() for frame in frames)


def test_landmarks_without_tracks_are_points_alone(scene: Map, tmp_path: Path) -> None:
    """There are none in maps that earlier versions stored, and in those whose landmarks come from rendered images."""
    landmarks = require(scene.landmarks)
    model = exported_to_colmap(replace(scene, landmarks=replace(landmarks, tracks=None)), tmp_path / "out")
    assert (len(model.points3D), model.compute_num_observations()) == (len(landmarks), 0)


def test_what_cannot_be_exported_is_said(scene: Map, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "bidnerf"):
        bn.export_map(replace(scene, surface=None, landmarks=None), tmp_path / "cameras", "ply")
    assert "ground: has neither a surface nor landmarks to export; 'bidnerf bake' makes both" in caplog.text
    bare = replace(scene, info=replace(scene.info, cameras=()), surface=None, landmarks=None)
    with refused(where="ground", found="no cameras, but colmap needs some"):
        bn.export_map(bare, tmp_path / "out", "colmap")
    with refused(where="ground", found="no surface, landmarks or cameras"):
        bn.export_map(bare, tmp_path / "out", "ply")
    with refused(found="format 'obj'", expected="one of ply"):
        bn.export_map(scene, tmp_path / "out", "obj")
    with refused(found="format 'obj'"):  # before the map is read
        bn.export_map(tmp_path / "missing", tmp_path / "out", "obj")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with refused(where=tmp_path / "full", found="exists already and is not empty"):
        bn.export_map(scene, tmp_path / "full", "ply")


def test_a_registered_exporter_gets_the_map(scene: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(map_: Map, out: Path) -> list[Path]:
        (out / "count.txt").write_text(str(len(map_.landmarks or ())))
        return [out / "count.txt"]

    monkeypatch.setitem(registered, ("exporters", "count"), write)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    (file,) = bn.export_map(scene, tmp_path / "out", "count", overwrite=True)
    assert file.read_text() == str(len(require(scene.landmarks)))

    monkeypatch.setitem(registered, ("exporters", "count"), lambda: None)
    with refused(where="exporter 'count'", found="not an exporter: it does not take (scene, out)", error=PluginError):
        bn.export_map(scene, tmp_path / "out", "count", overwrite=True)
