"""Poses of photos that have none: truth, what is left out and why, interruptions, and photos that show too little."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import av
import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import bidnerf as bn
import tiny
from bidnerf.cli.train import SearchOptions
from bidnerf.results import pose_error
from bidnerf.structure import FoundPoses
from bidnerf.structure.colmap import list_photos, to_colmap
from bidnerf.structure.gps import align_to_gps
from bidnerf.structure.joining import join
from bidnerf.structure.matching import NEIGHBOURS, PARTNERS, candidate_pairs, chosen_pairs
from bidnerf.structure.model import count_contradictions, from_colmap, reasons_left_out
from bidnerf.structure.record import digest, open_work, remove_output
from bidnerf.structure.sources import (
    FRAME_STEP,
    MOST,
    choose_frames,
    measure_frames,
    photos_of,
    write_frames,
)
from bidnerf.testing import PoserContract
from bidnerf_core.camera import CentralLens
from bidnerf_core.datasets import Capture, Shot, lacks_poses
from bidnerf_core.errors import UsageError
from bidnerf_core.geometry import fit_similarity, look_at

# Inside: each stage of the search for poses, with its rare geometry
from bidnerf_core.maps.training import open_posed_images, poses_folder
from bidnerf_core.progress import Progress, job_context
from commands import Run, assert_refused
from optional import require
from photo_files import write_photo
from photo_room import CAMERA, photograph, room_depth, walk, write_photos
from refusals import refused
from scan_layouts import write_tum
from trainings import stopping_at

pytestmark = pytest.mark.slow


pytest.importorskip("pycolmap")


class TestColmap(PoserContract):
    name = "colmap"


PLACED, OTHERS = 6, 3


@dataclass
class Search:
    """A search for poses that was cancelled and went on."""

    photos: Path
    out: Path
    found: FoundPoses
    cancelled: str
    stages: list[list[str]]  # of each run


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> Search:
    """Six photos of a room and three of another, with a plain photo and two broken files among them."""
    place = tmp_path_factory.mktemp("structure")
    photos, out = place / "my photos", place / "poses"
    write_photos(photos, walk(PLACED))
    write_photos(photos, walk(PLACED)[2 : 2 + OTHERS], seed=1, first=100)
    Image.new("RGB", (CAMERA.width, CAMERA.height), (90, 90, 90)).save(photos / "200.png")
    (photos / "201.png").write_bytes((photos / "000.png").read_bytes()[:3000])
    (photos / "202.jpg").write_bytes(b"no image")
    stages: list[list[str]] = [[], []]
    with pytest.raises(bn.Cancelled) as stopped:
        bn.find_poses(
            photos,
            out,
            progress=lambda now: stages[0].append(now.stage),
            cancel=lambda: "matching photos" in stages[0],
        )
    found = bn.find_poses(photos, out, progress=lambda now: stages[1].append(now.stage))
    return Search(photos, out, found, str(stopped.value), stages)


def errors(views: dict[str, bn.View], truth: dict[str, bn.SE3]) -> tuple[float, float]:
    """Return the largest errors (metres, degrees) of poses after their frame is aligned with the true one."""
    names = sorted(views)
    align = fit_similarity(
        torch.stack([views[name].T_ref_camera.translation for name in names]),
        torch.stack([truth[name].translation for name in names]),
    )
    found = [pose_error(align.move(views[name].T_ref_camera), truth[name]) for name in names]
    return max(float(e.translation) for e in found), max(float(e.rotation_deg) for e in found)


def test_photos_without_poses_get_the_true_ones(search: Search) -> None:
    views = {view.frame.name: view for view in bn.open_dataset(search.out).views("all")}
    assert sorted(views) == [f"{number:03d}" for number in range(PLACED)]
    truth = {f"{number:03d}": pose for number, pose in enumerate(walk(PLACED))}
    metres, degrees = errors(views, truth)
    assert metres < 0.01
    assert degrees < 0.2
    camera = views["000"].frame.intrinsics
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.02)
    assert (camera.width, camera.height) == (CAMERA.width, CAMERA.height)


def test_the_largest_of_several_models_is_kept_and_every_photo_accounted_for(search: Search) -> None:
    found = search.found
    assert (found.photos, found.placed, found.models) == (PLACED + OTHERS + 3, PLACED, (PLACED, OTHERS))
    reasons = {left.photo: left.reason for left in found.left_out}
    assert sorted(reasons) == ["100", "101", "102", "200", "201", "202"]
    assert all("another model, of 3 photos" in reasons[name] for name in ("100", "101", "102"))
    assert "keypoint" in reasons["200"]
    assert "not readable as an image" in reasons["202"]
    assert "not readable as an image" in reasons["201"]
    assert "2 models of 6, 3 photos, of which a photo may be in several and which share too few points" in str(found)
    assert json.loads((search.out / "poses.json").read_text())["placed"] == PLACED


def test_another_scene_is_a_dataset_of_its_own(search: Search) -> None:
    assert all(left.reason.endswith("to be joined: part-2") for left in search.found.left_out[:OTHERS])
    assert "the others are datasets of their own in part-2" in str(search.found)
    views = {view.frame.name: view for view in bn.open_dataset(search.out / "part-2").views("all")}
    assert sorted(views) == ["100", "101", "102"]
    truth = {f"{100 + number}": pose for number, pose in enumerate(walk(PLACED)[2 : 2 + OTHERS])}
    metres, degrees = errors(views, truth)
    assert metres < 0.03
    assert degrees < 2


def test_models_that_share_photos_say_so_and_a_minority_is_advised(search: Search) -> None:
    listed = [SimpleNamespace(number=number, shot=SimpleNamespace(name=f"{number}")) for number in range(7)]
    models: list[Any] = [
        SimpleNamespace(reg_image_ids=lambda: [0, 1, 2, 3], num_reg_images=lambda: 4),
        SimpleNamespace(reg_image_ids=lambda: [3, 4, 5], num_reg_images=lambda: 3),
    ]
    photos: Any = SimpleNamespace(photos=listed, unusable={})
    reasons = reasons_left_out(photos, models, Counter(), dict.fromkeys(range(7), 9))
    assert sorted(reasons) == ["4", "5", "6"]
    assert reasons["4"].endswith("to be joined: part-2; 1 photo of it is in the largest as well")
    advice = "most photos have no pose here: take more"
    assert advice not in str(search.found)
    assert advice in str(replace(search.found, photos=30))
    assert "'bidnerf train POSES/part-2'" in str(replace(search.found, photos=30))


@pytest.mark.parametrize("shared", [0, 1])
def test_models_of_two_halves_become_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared: int) -> None:
    """The halves have one photo in common, or none but matches. Work that stops before they are joined does not place photos again."""
    import pycolmap

    poses, placed = walk(9), list[Path]()
    write_photos(tmp_path / "photos", poses)
    write_photos(tmp_path / "photos", walk(3), seed=1, first=100)

    def place_parts(database: Path, total: int, options: Any, pycolmap: Any, folder: Path) -> None:
        placed.append(folder)
        for part, numbers in enumerate((range(1, 6), range(6 - shared, 10), range(10, 13))):
            options.image_names = [f"{number:06d}" for number in numbers]
            (model,) = pycolmap.incremental_mapping(database, folder, tmp_path, options).values()
            model.transform(pycolmap.Sim3d(1.0 + part, pycolmap.Rotation3d(), np.array([0, 0, part])))
            (folder / str(part)).mkdir()
            model.write_binary(folder / str(part))

    def stop(*_: Any) -> NoReturn:
        raise bn.Cancelled("stopped")

    monkeypatch.setattr("bidnerf.structure.model._place_singly", place_parts)
    with monkeypatch.context() as stopped:
        stopped.setattr("bidnerf.structure.model.join", stop)
        with pytest.raises(bn.Cancelled):
            bn.find_poses(tmp_path / "photos", tmp_path / "out")
    found = bn.find_poses(tmp_path / "photos", tmp_path / "out")
    assert len(placed) == 1
    assert found.models == (9, 3)
    views = {view.frame.name: view for view in bn.open_dataset(tmp_path / "out").views("all")}
    metres, degrees = errors(views, {f"{number:03d}": pose for number, pose in enumerate(poses)})
    assert metres < 0.01
    assert degrees < 0.2
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    photos = [sorted({element.image_id for element in point.track.elements}) for point in model.points3D.values()]
    assert sum(seen[0] < 6 - shared and seen[-1] > 5 for seen in photos) > 50
    assert model.compute_mean_reprojection_error() < 0.5


@pytest.mark.parametrize(("wrong", "sizes"), [(False, [10]), (True, [5, 5])])
def test_models_whose_shared_points_are_scattered_are_not_joined(tmp_path: Path, wrong: bool, sizes: list[int]) -> None:
    import pycolmap

    options, generator = pycolmap.SyntheticDatasetOptions(num_frames_per_rig=10), np.random.default_rng(0)
    options.num_rigs = options.num_cameras_per_rig = 1
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        whole = pycolmap.synthesize_dataset(options, database)
        first = sorted(whole.reg_image_ids())[:5]
        for pair, seen in zip(*database.read_two_view_geometries(), strict=True):
            i, j = pycolmap.pair_id_to_image_pair(pair)
            if wrong and (i in first) != (j in first):
                seen.inlier_matches = np.stack([seen.inlier_matches[:, 0], generator.permutation(100)], axis=1)
                database.delete_two_view_geometry(i, j)
                database.write_two_view_geometry(i, j, seen)
    models = [pycolmap.Reconstruction(whole) for _ in range(2)]
    for part, model in enumerate(models):
        for number in [n for n in whole.reg_image_ids() if (n in first) == (part == 1)]:
            model.deregister_frame(model.image(number).frame_id)
    turn = pycolmap.Rotation3d(np.array([0, 0, 0.5]))
    models[1].transform(pycolmap.Sim3d(2.0, turn, np.array([1, 0, 0])))
    (tmp_path / "joined").mkdir()
    join(models, tmp_path / "database.db", tmp_path / "joined", pycolmap.IncrementalPipelineOptions(), pycolmap)
    joined = [pycolmap.Reconstruction(folder) for folder in sorted((tmp_path / "joined").iterdir())]
    assert [model.num_reg_images() for model in joined] == sizes
    assert [model.num_points3D() for model in joined] == [100] * len(sizes)
    assert max(model.compute_mean_reprojection_error() for model in joined) < 1e-6


def test_interrupted_work_goes_on(search: Search) -> None:
    assert "the same command resumes" in search.cancelled
    assert "finding keypoints" in search.stages[0]
    assert "finding keypoints" in search.stages[1]  # of the file that cannot be decoded, which is tried again
    assert search.stages[1].count("finding keypoints") == 1
    assert not (search.out / "work").exists()


def test_the_world_is_upright(search: Search) -> None:
    views = sorted(bn.open_dataset(search.out).views("all"), key=lambda view: view.frame.name)
    up = torch.stack([-view.T_ref_camera.rotation[:, 1] for view in views])
    true = torch.stack([-pose.rotation[:, 1] for pose in walk(PLACED)])
    torch.testing.assert_close(up[:, 2], true[:, 2], atol=0.01, rtol=0)


def test_the_model_is_beside_the_dataset(search: Search) -> None:
    from bidnerf_core.datasets import read_model

    images, points = read_model(search.out / "sparse" / "0")
    assert sorted(image.name for image in images) == [f"{number:03d}.png" for number in range(PLACED)]
    assert len(points.ids) == search.found.points


def test_poses_that_were_found_are_not_sought_again(search: Search, tmp_path: Path, bidnerf: Run) -> None:
    stages = list[str]()
    again = bn.find_poses(search.photos, search.out, progress=lambda now: stages.append(now.stage))
    assert again == search.found
    assert stages == []
    fewer = tmp_path / "fewer"
    write_photos(fewer, walk(3))
    with refused(where=search.out, found="the poses of other photos"):
        bn.find_poses(fewer, search.out)
    name = min(search.photos.iterdir()).stem
    with refused(where=search.out, found="the poses of other photos"):  # nor those found without the known ones
        bn.find_poses(search.photos, search.out, known={name: bn.SE3.identity()})
    with refused(where=search.photos, found="known has none of the"):
        bn.find_poses(search.photos, search.out, known={f"{name}.png": bn.SE3.identity()})
    known = tmp_path / "known.json"
    known.write_text(json.dumps([{"frame": "elsewhere", "T_world_camera": torch.eye(4).tolist()}]))
    ran = bidnerf("poses", search.photos, "--out", search.out, "--known", known)
    assert_refused(ran, 1, "known has none of the")
    with pytest.raises(UsageError, match="for the poser colmap, but --poser is other"):
        SearchOptions("other", known=known).find(search.photos, search.out, None, False)


def test_train_takes_photos_without_poses(search: Search, bidnerf: Run, caplog: pytest.LogCaptureFixture) -> None:
    """Poses that were found before are in the folder beside the map."""
    out, beside = search.out.with_name("room"), search.out.with_name("room-poses")
    search.out.rename(beside)
    try:
        quick = ("--split", "all", "--refine-poses", "never", "--largest", 128, *tiny.options())
        ran = bidnerf("train", search.photos, "--out", out, *quick).succeed()
        assert "already has the poses of these photos" in ran.err
        assert len(bn.load_map(out).info.cameras) == PLACED
        with (
            caplog.at_level("INFO", "bidnerf"),
            open_posed_images(search.photos, bn.DatasetOptions(), out) as (data, _),
        ):
            assert data == beside
        assert "1 photo of 6 is held out" in caplog.text
    finally:
        beside.rename(search.out)


def test_photos_inside_the_folder_of_the_poses_are_never_removed(tmp_path: Path) -> None:
    """Nor are those that are called as the frames of a video are."""
    photos = tmp_path / "capture" / "images"
    photos.mkdir(parents=True)
    for number in range(2):
        Image.new("RGB", (64, 48)).save(photos / f"{number:06d}.jpg")
    with refused(where=photos, found="2 photos", expected="at least 3"):
        bn.find_poses(photos, tmp_path / "capture", overwrite=True)
    with refused(where=photos, found="exists already, and the video's frames"):
        open_work(tmp_path / "capture", "a video", video=True)
    assert len(list(photos.iterdir())) == 2
    open_work(tmp_path / "other", "a video", video=True)
    photos.rename(tmp_path / "other" / "images")
    remove_output(tmp_path / "other")
    assert list((tmp_path / "other").iterdir()) == []


def test_files_of_others_within_the_model_of_a_part_are_never_removed(search: Search, tmp_path: Path) -> None:
    out = tmp_path / "poses"
    shutil.copytree(search.out, out)
    own = out / "part-2" / "sparse" / "0" / "notes.txt"
    own.touch()
    remove_output(out)
    assert [path for path in out.rglob("*") if path.is_file()] == [own]
    own.unlink()
    (out / "part-2" / "transforms.json").touch()
    remove_output(out)
    assert not any(out.iterdir())


def test_the_poses_are_beside_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert poses_folder(Path("maps/room")) == Path("maps/room-poses")
    monkeypatch.chdir(tmp_path)
    assert poses_folder(Path(".")) == tmp_path.with_name(f"{tmp_path.name}-poses")


def test_a_folder_inside_and_names_that_occur_twice(tmp_path: Path) -> None:
    for folder in ("cam0", "cam1", "depth", ".hidden"):
        write_photos(tmp_path / "capture" / folder, walk(2))
    assert lacks_poses(tmp_path / "capture")
    images = photos_of(tmp_path / "capture")
    assert images.names == ["cam0_000", "cam0_001", "cam1_000", "cam1_001"]


def test_keypoints_are_detected_where_the_job_says(search: Search, tmp_path: Path) -> None:
    tasks = list[str]()

    class Elsewhere(ThreadPoolExecutor):
        def submit(self, task: Callable[..., Any], /, *given: Any, **more: Any) -> Future[Any]:
            tasks.append(Path(given[0].file).name if hasattr(given[0], "file") else task.__name__)
            return super().submit(task, *given, **more)

    with Elsewhere(1) as executor, job_context(executor=executor), pytest.raises(bn.Cancelled):
        bn.find_poses(search.photos, tmp_path / "out", **stopping_at("matching photos"))
    readable = sorted(photo.name for photo in search.photos.iterdir() if photo.name != "202.jpg")
    assert tasks == readable


def test_a_cluster_whose_worker_is_killed_places_the_same_photos(search: Search) -> None:
    distributed = pytest.importorskip("distributed")
    killed = list[int]()

    def kill_a_worker(now: Progress) -> None:
        if now.stage == "matching photos" and not killed:
            killed.append(local.workers[0].process.pid)
            os.kill(killed[0], signal.SIGKILL)

    out = search.out.with_name("poses of a cluster")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as local,
        bn.cluster(local.scheduler_address),
    ):
        bn.find_poses(search.photos, out, progress=kill_a_worker)
    assert killed
    assert (out / "transforms.json").read_bytes() == (search.out / "transforms.json").read_bytes()


def test_what_has_no_photos_or_has_poses(search: Search, tmp_path: Path, bidnerf: Run) -> None:
    (tmp_path / "empty").mkdir()
    cases = [
        (tmp_path / "nothing", "no such file or folder"),
        (tmp_path / "empty", "the folder is empty"),
        (search.out, "dataset whose poses are known"),
        (search.photos / "000.png", "is a single photo, expected a folder of photos from several places, or a video"),
        (tmp_path / "clip.mp4", "no such file"),
    ]
    for place, message in cases:
        ran = bidnerf("poses", place, "--out", tmp_path / "out")
        assert ran.status == 1
        assert message in ran.err
        assert len(ran.err.splitlines()) == 1
        assert not (tmp_path / "out").exists()


def test_too_few_photos_and_photos_without_overlap(tmp_path: Path) -> None:
    one, apart = tmp_path / "one", tmp_path / "apart"
    write_photos(one, walk(1))
    with refused(where=one, found="1 photo", expected="at least 3"):
        bn.find_poses(one, tmp_path / "out")
    for seed in range(3):
        write_photos(apart, walk(1), seed, first=seed)
    assert not (tmp_path / "out").exists()
    with refused(where=apart, found="no three of 3 photos could be placed: no two of them overlap"):
        bn.find_poses(apart, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_database_is_refused_and_removed(tmp_path: Path) -> None:
    photos, out = tmp_path / "photos", tmp_path / "out"
    write_photos(photos, walk(3))
    files = [require(shot.file) for shot in photos_of(photos).shots]
    (open_work(out, digest(files, None), video=False) / "database.db").write_bytes(b"no database" * 100)
    with refused(where=out / "work" / "database.db", found="cannot be read", expected="begins anew"):
        bn.find_poses(photos, out)
    assert not (out / "work").exists()


def test_a_damaged_record_is_replaced_only_on_request(search: Search) -> None:
    record = search.out / "poses.json"
    whole = record.read_bytes()
    record.write_bytes(whole[:20])
    try:
        with refused(where=record, found="not JSON", expected="the record of found poses"):
            bn.find_poses(search.photos, search.out)
    finally:
        record.write_bytes(whole)


def test_photos_from_one_place_are_refused(tmp_path: Path) -> None:
    write_photos(tmp_path / "turned", [look_at((0, 0, 0), (1.7, 0.5 + 0.25 * n, 0.1)) for n in range(4)])
    with refused(where=tmp_path / "turned", found="by a camera that only turns", expected="moving sideways, or depth"):
        bn.find_poses(tmp_path / "turned", tmp_path / "out")


def test_three_photos_of_one_wall_by_a_known_camera(tmp_path: Path) -> None:
    """A plane determines poses if the camera is known; the camera that was given is kept.

    EXIF turns one photo: the dataset has the camera of the image as stored, and a remark says so.
    """
    poses = [look_at((0.2, -0.9 + 0.8 * n, 0.3 * (n % 2) - 0.2), (2, 0.1 * n, 0.1)) for n in range(4)]
    files = write_photos(tmp_path / "wall", poses, walls=1)
    write_photo(files[2], np.asarray(Image.open(files[2])), 6)
    found = bn.find_poses(tmp_path / "wall", tmp_path / "out", camera=CAMERA)
    assert (found.placed, found.turned) == (4, 1)
    assert "1 photo turned by EXIF: the dataset has the cameras of the images as stored" in str(found)
    views = {view.frame.name: view for view in bn.open_dataset(tmp_path / "out").views("all")}
    metres, degrees = errors(views, {f"{number:03d}": pose for number, pose in enumerate(poses)})
    assert metres < 0.02
    assert degrees < 0.5
    assert views["000"].frame.intrinsics.fx == CAMERA.fx


def test_without_the_extra_one_line_says_what_to_install(
    search: Search, tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for command in ("poses", "train"):
        ran = bidnerf(command, search.photos, "--out", tmp_path / "out")
        assert ran.status == 1
        assert "pip install 'bidnerf[sfm]'" in ran.err
        assert len(ran.err.splitlines()) == 1


def test_photos_of_one_lens_share_a_camera_however_they_are_turned(tmp_path: Path) -> None:
    pixels = photograph(walk(1)[0])
    files = [
        write_photo(tmp_path / "a.jpg", pixels, FocalLengthIn35mmFilm=26),
        write_photo(tmp_path / "b.jpg", pixels, 6, FocalLengthIn35mmFilm=26),
        write_photo(tmp_path / "c.jpg", pixels, FocalLengthIn35mmFilm=52),
        write_photo(tmp_path / "d.jpg", pixels[:100]),
    ]
    found = list_photos(Capture(tmp_path, [Shot(image=file) for file in files]), None)
    assert [photo.camera for photo in found.photos] == [1, 1, 2, 3]
    assert (found.known_focal, found.fixed) == ({1, 2}, set())
    assert found.cameras[2].pinhole.fx == pytest.approx(2 * found.cameras[1].pinhole.fx)
    frames = [
        {"file_path": f"{n}.png", "fl_x": f, "w": CAMERA.width, "h": CAMERA.height}
        for n, f in (("a", 300), ("b", 300), ("c", 310))
    ]
    (tmp_path / "transforms_train.json").write_text(
        json.dumps({"frames": frames})
    )  # a dataset that states a camera for each
    given = list_photos(
        Capture(tmp_path, [Shot(image=file) for file in files[:3:2]]), tmp_path / "transforms_train.json"
    )
    assert ([camera.pinhole.fx for camera in given.cameras.values()], given.fixed) == ([300, 310], {1, 2})


@given(
    numbers=st.tuples(st.floats(200, 400), st.floats(200, 400), st.floats(100, 220), st.floats(80, 160)),
    lens=st.sampled_from((0, 4, 8)).flatmap(lambda count: st.tuples(*[st.floats(-0.05, 0.05)] * count)),
)
def test_lenses_go_to_colmap_and_back(numbers: tuple[float, ...], lens: tuple[float, ...]) -> None:
    import pycolmap

    pinhole = bn.Intrinsics(*numbers, 320, 240)
    for model, count in (("OPENCV_FISHEYE", 4), ("DIVISION", 1)):
        fisheye = CentralLens(model, pinhole, (*lens, *[0.0] * 4)[:count])
        assert from_colmap(to_colmap(fisheye, 1, pycolmap)) == fisheye
    there = from_colmap(to_colmap(replace(pinhole, distortion=lens), 1, pycolmap))
    assert isinstance(there, bn.Intrinsics)
    assert (*there.distortion, *[0] * 8)[: len(lens)] == pytest.approx(lens)
    assert (there.fx, there.fy, there.cx, there.cy) == numbers
    assert (there.width, there.height) == (320, 240)


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_recording_without_poses_is_photos_with_a_camera_and_depth(tmp_path: Path, fisheye: bool) -> None:
    """The camera is the recording's, or the given fisheye lens, and the measured depth determines the scale."""
    poses, folder = walk(PLACED), tmp_path / "recording"
    lens = CentralLens("OPENCV_FISHEYE", CAMERA, (0.02, 0.0, 0.0, 0.0))
    views = [bn.View(bn.Frame.from_numpy(photograph(pose), CAMERA), pose) for pose in poses]
    if fisheye:
        write_photos(folder, poses)
    else:
        write_tum(folder, [bn.View(v.frame.replace(depth=room_depth(v.T_ref_camera)), v.T_ref_camera) for v in views])
        (folder / "groundtruth.txt").unlink()
        assert lacks_poses(folder)
    found = bn.find_poses(folder, tmp_path / "poses", lens if fisheye else None)
    data = bn.open_dataset(tmp_path / "poses")
    assert (found.placed, found.metric, data.unit) == (PLACED, not fisheye, "units" if fisheye else "metres")
    shots = sorted(data.shots, key=lambda shot: shot.name)
    assert all(shot.camera == (lens if fisheye else CAMERA) for shot in shots)
    if not fisheye:
        assert all(shot.depth is not None for shot in shots)
        steps = [
            torch.linalg.vector_norm(a.T_world_camera.translation - b.T_world_camera.translation)
            for a, b in pairwise(shots)
        ]
        truth = [torch.linalg.vector_norm(a.translation - b.translation) for a, b in pairwise(poses)]
        assert torch.stack(steps) == pytest.approx(torch.stack(truth), rel=0.03)


def test_a_camera_that_only_turns_is_refused_though_its_focal_length_is_unknown(tmp_path: Path) -> None:
    eye = walk(1)[0].translation
    turn = [bn.SE3(pose.rotation, eye) for pose in walk(PLACED)]
    write_photos(tmp_path / "photos", turn)
    with refused(where=tmp_path / "photos", found="no three of 6 photos could be placed: although 15 pairs overlap"):
        bn.find_poses(tmp_path / "photos", tmp_path / "poses")


def test_many_photos_are_matched_with_those_whose_keypoints_vote_for_each_other() -> None:
    generator = np.random.default_rng(0)
    count = 150
    visits = [generator.integers(0, 256, (40, 128)) for _ in range(count // 2)]  # each is visited twice
    seen = [
        np.clip(visits[n % (count // 2)] + generator.integers(-9, 10, (40, 128)), 0, 255).astype(np.uint8)
        for n in range(count)
    ]
    pairs = candidate_pairs(seen)
    assert pairs == sorted(set(pairs))
    assert all(0 <= i < j < count for i, j in pairs)
    assert {(i, i + d) for i in range(count - NEIGHBOURS) for d in range(1, NEIGHBOURS + 1)} <= set(pairs)
    again = [(i, i + count // 2) for i in range(count // 2)]
    assert set(again) <= set(pairs)
    assert len(pairs) < 0.9 * count * (count - 1) / 2
    assert chosen_pairs(seen, pairs) == again
    # Of many that vote, the best are matched; and all pairs of few photos.
    alike = [seen[0]] * 20 + seen[1:61]
    partners = [pair for pair in chosen_pairs(alike, candidate_pairs(alike)) if 0 in pair]
    assert PARTNERS <= len(partners) < 20
    assert len(chosen_pairs(seen[:9], candidate_pairs(seen[:9]))) == 36


def test_photos_that_are_near_by_gps_are_candidates() -> None:
    generator = np.random.default_rng(0)
    seen = [generator.integers(0, 256, (40, 128)).astype(np.uint8) for _ in range(400)]
    places = {0: [0.0, 0.0, 0.0], 200: [1.0, 0.0, 0.0], 399: [0.0, 2.0, 0.0]}
    positions = {number: bn.SE3(torch.eye(3), torch.tensor(place)) for number, place in places.items()}
    assert not {(0, 200), (0, 399), (200, 399)} <= set(candidate_pairs(seen))
    assert {(0, 200), (0, 399), (200, 399)} <= set(candidate_pairs(seen, positions))


def test_photos_whose_known_poses_are_near_and_look_the_same_way_are_candidates() -> None:
    generator = np.random.default_rng(0)
    seen = [generator.integers(0, 256, (40, 128)).astype(np.uint8) for _ in range(400)]
    numbers = range(0, 400, 5)
    away = {n: float(generator.uniform(0, 100)) for n in numbers}  # along a street, most photos look to its left
    sides = {n: 1.0 if n < 300 else -1.0 for n in numbers}
    poses = {n: look_at((away[n], 0.0, 0.0), (away[n], 5.0 * sides[n], 0.0)) for n in numbers}
    without = set(candidate_pairs(seen))
    found = set(candidate_pairs(seen, poses)) - without
    assert all(i in poses and j in poses for i, j in found)
    for number in (0, 150, 350):
        same = [n for n in numbers if sides[n] == sides[number] and n != number]
        nearest = sorted(same, key=lambda n, number=number: abs(away[n] - away[number]))[:5]
        assert {(min(number, n), max(number, n)) for n in nearest} <= found | without
    assert np.mean([abs(away[i] - away[j]) for i, j in found]) < 25


@pytest.mark.parametrize(("latitude", "crs"), [(48.1, "EPSG:32632"), (-33.9, "EPSG:32732")])
def test_gps_places_a_model_that_it_does_not_bend(tmp_path: Path, latitude: float, crs: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    generator = np.random.default_rng(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=12, num_points3D=20
    )
    model = pycolmap.synthesize_dataset(options)
    numbers = sorted(model.reg_image_ids())
    true = np.array([[40.0 * (n % 4), 30.0 * (n // 4), 5.0 * (n % 3)] for n in range(12)])
    for number, centre in zip(numbers, true, strict=True):
        pose = model.image(number).cam_from_world()
        frame = model.frame(model.image(number).frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, -(pose.rotation.matrix() @ (centre / 7)))

    def photos(metres: np.ndarray) -> dict[int, Any]:
        local = pycolmap.GPSTransform().enu_to_ellipsoid(metres, latitude, 9.0, 300.0)
        for number, position in zip(numbers, local.tolist(), strict=True):
            write_photo(tmp_path / f"{number}.jpg", np.zeros((8, 8, 3), np.uint8), gps=tuple(position))
        return {number: SimpleNamespace(file=tmp_path / f"{number}.jpg") for number in numbers}

    before = [model.image(number).projection_center() for number in numbers]
    straight = np.column_stack([true[:, 0], np.zeros((12, 2))])
    assert align_to_gps(model, photos(straight), pycolmap) is None
    assert np.array_equal(before, [model.image(number).projection_center() for number in numbers])
    wrong = true + generator.normal(0, 1, true.shape)
    wrong[5] += 500
    frame = require(align_to_gps(model, photos(wrong), pycolmap))
    assert (frame.crs, frame.photos) == (crs, 12)
    assert 0.3 < frame.deviation < 3
    centres = np.array([model.image(number).projection_center() for number in numbers])
    scale, parts = np.linalg.norm(centres[11] - centres[0]), np.linalg.norm(centres - centres[0], axis=1)
    assert scale == pytest.approx(np.linalg.norm(true[11] - true[0]), rel=0.03)
    assert np.allclose(parts / scale, np.linalg.norm(true - true[0], axis=1) / np.linalg.norm(true[11] - true[0]))


def test_frames_are_chosen_at_equal_steps_of_motion_the_sharpest_near_each() -> None:
    still = [(0.0, 0.0)] * 20
    assert choose_frames(still) == [0]
    moving = [(0.1 * FRAME_STEP * n, -float(n % 10 != 1)) for n in range(101)]
    assert choose_frames(moving) == [1, 11, 21, 31, 41, 51, 61, 71, 81, 91, 98]
    long = [(FRAME_STEP * n, 0.0) for n in range(3 * MOST)]
    assert MOST / 2 < len(choose_frames(long)) <= MOST


def test_a_video_is_thinned_by_its_motion_and_not_by_its_shaking(tmp_path: Path) -> None:
    """The camera moves, rests with trembling hands, and moves again; one frame in three is blurred."""
    generator = np.random.default_rng(0)
    moves = walk(31)
    poses = [*moves[:16], *[moves[15]] * 20, *moves[16:]]
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "15"})
        stream.width, stream.height, stream.pix_fmt = CAMERA.width, CAMERA.height, "yuv420p"
        for number, pose in enumerate(poses):
            image = photograph(pose)
            if 16 <= number < 36:
                image = np.roll(image, generator.integers(-1, 2, 2), (0, 1))
            if number % 3 == 1:
                image = cv2.blur(image, (9, 1))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    measures = measure_frames(photos_of(tmp_path / "clip.mp4"))
    assert len(measures) == len(poses)
    rest = measures[35][0] - measures[16][0]
    assert rest < 0.2 * measures[-1][0]
    frames = choose_frames(measures)
    assert sum(16 <= number < 36 for number in frames) <= 2
    assert sum(number % 3 == 1 for number in frames) <= len(frames) / 6
    written = write_frames(photos_of(tmp_path / "clip.mp4"), tmp_path / "images", frames)
    assert [int(name) for name in written.names] == frames
    assert written.shots[-1].time == pytest.approx(frames[-1] / 30, abs=1e-3)
    assert lacks_poses(tmp_path / "clip.mp4")


def test_pairs_with_many_matches_tell_a_folded_model() -> None:
    """Three photos of a cloud of points; that of the third place was put elsewhere, so two pairs contradict it."""
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[500.0, 320.0, 240.0, 0.02])
    points = np.random.default_rng(0).uniform([-2, -1.5, 4], [2, 1.5, 8], (400, 3))
    true = {n: pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0.05 * n, 0])), [0.4 * n, 0, 0]) for n in (1, 2, 3)}
    seen = {n: camera.img_from_cam(T * points) for n, T in true.items()}
    every = np.column_stack([np.arange(400)] * 2)
    pairs = {(1, 2): every, (2, 3): every[:100], (1, 3): every[:99]}
    database = SimpleNamespace(
        read_two_view_geometries=lambda: (
            [pycolmap.image_pair_to_pair_id(*pair) for pair in pairs],
            [SimpleNamespace(inlier_matches=matches) for matches in pairs.values()],
        ),
        read_keypoints=lambda number: seen[number],
    )

    def model(poses: dict[int, Any]) -> Any:
        return SimpleNamespace(
            reg_image_ids=lambda: list(poses),
            image=lambda number: SimpleNamespace(camera_id=1, cam_from_world=lambda: poses[number]),
            camera=lambda number: camera,
        )

    assert count_contradictions(model(true), database, pycolmap) == (2, 0)
    folded = true | {3: pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0.6, 0])), [-1.5, 0.5, 0])}
    assert count_contradictions(model(folded), database, pycolmap) == (2, 1)
    assert count_contradictions(model({1: true[1], 3: folded[3]}), database, pycolmap) == (0, 0)


def test_poses_that_many_pairs_contradict_are_doubted(search: Search) -> None:
    assert search.found.doubt is None
    assert search.found.sure_pairs > 0
    doubt = require(replace(search.found, sure_pairs=400, contradicting=3).doubt)
    assert doubt.startswith("3 of 400 pairs of photos that share many keypoints (0.8%)")
    assert replace(search.found, sure_pairs=400, contradicting=2).doubt is None
