r"""An existing COLMAP model as a map: its import, and answers in its frame.

    python benchmarks/existing_model.py DATA --out DIR [--name existing_model]

pycolmap (extra sfm) makes a model of the photos of split "train" of the dataset DATA, each a file of its own: SIFT keypoints,
exhaustive matching and incremental mapping with its usual settings. The project is imported by its database, and again by
keypoints found in the photos; each map, which has no field, localizes the photos of split "test" from their files. Errors are
in the units of the dataset, after the similarity that aligns the cameras of the model with those of the dataset. The answers
are written as ``images.txt``, which pycolmap reads back. The digests of all files of the project are compared before and
after. Then a project of many images and points, with a database, is written and imported. Everything is kept in DIR.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import _lab
import numpy as np
import pycolmap
import torch
from scipy.spatial import cKDTree

import bidnerf as bn
from bidnerf import SE3
from bidnerf.results import Answer, Answers
from bidnerf_core.geometry import Similarity, fit_similarity

SIDE, IMAGES, POINTS, TRACK = 40.0, 320, 210_000, 6
"""The size of the large project: side of its square floor, number of images and of points, and images that observe a point."""


def make_model(data: Any, project: Path) -> None:
    """Let pycolmap make a model of the training photos, unless it is there."""
    if (project / "sparse" / "0" / "points3D.bin").exists():
        return
    (project / "images").mkdir(parents=True)
    (project / "sparse").mkdir()
    for shot in data.select("train"):
        (project / "images" / shot.file.name).write_bytes(shot.file.read_bytes())
    database, images = project / "database.db", project / "images"
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0)
    pycolmap.incremental_mapping(database, images, project / "sparse", options)


def make_large_project(project: Path) -> None:
    """Write a model of random points on a floor, seen from above, with a database of random descriptors."""
    if (project / "sparse" / "0" / "points3D.bin").exists():
        return
    (project / "sparse" / "0").mkdir(parents=True)
    random = np.random.default_rng(0)
    points = np.concatenate([random.uniform(0, SIDE, (POINTS, 2)), random.normal(0, 0.5, (POINTS, 1))], axis=1)
    descriptors = random.random((POINTS, 128), dtype=np.float32) ** 4
    descriptors = (512 * np.sqrt(descriptors / descriptors.sum(1, keepdims=True))).clip(0, 255).astype(np.uint8)
    columns = int(np.ceil(IMAGES**0.5))
    places = SIDE * (np.stack(np.divmod(np.arange(IMAGES), columns), -1)[:, ::-1] + 0.5) / columns
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=1600, height=1200, params=[1200.0, 1200.0, 800.0, 600.0]
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    near = np.asarray(cKDTree(places).query(points[:, :2], TRACK)[1])
    down = np.diag([1.0, -1.0, -1.0])
    keypoints: list[np.ndarray] = []
    of_image: list[np.ndarray] = []
    for number, place in enumerate(places):
        own = np.flatnonzero((near == number).any(1))
        local = (points[own] - [*place, 6.0]) @ down
        pixels = 1200 * local[:, :2] / local[:, 2:] + [800, 600] + random.normal(0, 0.5, (len(own), 2))
        inside = ((pixels > 0) & (pixels < [1600, 1200])).all(1)
        own, pixels = own[inside], pixels[inside]
        keypoints.append(pixels)
        of_image.append(own)
        image = pycolmap.Image(
            image_id=number + 1,
            name=f"{number:04d}.jpg",
            camera_id=1,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels]),
        )
        centre = np.array([*place, 6.0])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(down), -down @ centre))
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(POINTS)]
    for number, own in enumerate(of_image):
        for place, point in enumerate(own):
            tracks[point].append((number + 1, place))
    for point, seen in enumerate(tracks):
        track = pycolmap.Track()
        for number, place in seen:
            track.add_element(number, place)
        model.add_point3D(points[point], track)
    model.write(project / "sparse" / "0")
    with pycolmap.Database.open(project / "database.db") as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for number, (pixels, own) in enumerate(zip(keypoints, of_image, strict=True), start=1):
            database.write_image(
                pycolmap.Image(name=f"{number - 1:04d}.jpg", camera_id=1, image_id=number),
                use_image_id=True,
            )
            shape = np.tile([3.0, 0, 0, 3.0], (len(own), 1))
            database.write_keypoints(number, np.concatenate([pixels, shape], axis=1).astype(np.float32))
            database.write_descriptors(
                number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors[own])
            )


def digests(project: Path) -> dict[str, str]:
    files = sorted(path for path in project.rglob("*") if path.is_file())
    return {str(path.relative_to(project)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def imported(project: Path, out: Path, keypoints: str) -> dict[str, Any]:
    """Import a project; return the times and the sizes."""
    began, cpu = time.monotonic(), time.process_time()
    scene = bn.import_map(project, out, {"keypoints": keypoints}, options=bn.ImportOptions(overwrite=True))
    return {
        "seconds": time.monotonic() - began,
        "cpu_seconds": time.process_time() - cpu,
        "photos": len(scene.info.cameras),
        "landmarks": 0 if scene.landmarks is None else len(scene.landmarks),
    }


def localized(data: Any, out: Path, poses: Path) -> dict[str, Any]:
    """Localize the test photos from their files; write and read back the poses."""
    localizer, truth = bn.Localizer(out), {view.frame.name: view for view in data.views("train")}
    scene = localizer.scene
    cameras = {camera.name: camera.pose for camera in scene.info.cameras if camera.name in truth}
    here, there = (
        torch.stack([pose.translation for pose in part])
        for part in (cameras.values(), (truth[name].T_ref_camera for name in cameras))
    )
    align: Similarity = fit_similarity(here, there)
    answers, rows = Answers(scene), []
    for number, (shot, view) in enumerate(zip(data.select("test"), data.views("test"), strict=True)):
        began, found = time.process_time(), localizer(shot.file)
        answers.append(Answer.of(view.frame, number, found, file=shot.file))
        T = found.T_world_camera
        moved = align.T_target_source @ SE3(T.rotation, align.scale * T.translation)
        judged = {"converged": found.converged, "cpu_seconds": time.process_time() - began}
        rows.append(_lab.errors_of(replace(found, T_world_camera=moved, covariance=None), view) | judged)
    poses.mkdir(exist_ok=True)
    answers.save(poses / "images.txt")
    read = pycolmap.Reconstruction()
    read.read_text(poses)
    stored = {image.name: image.cam_from_world().matrix() for image in read.images.values()}
    off = max(
        float(np.abs(stored[answer.file.name] - answer.found.T_world_camera.inverse().matrix().numpy()[:3]).max())
        for answer in answers.accepted
    )
    return {
        "n": len(rows),
        "right": sum(map(_lab.within, rows)),
        "strict": sum(_lab.within(row, _lab.STRICT) for row in rows),
        "accepted": len(answers.accepted),
        "rates": _lab.rates(rows),
        "read_by_pycolmap": len(stored),
        "largest_difference_read": off,
    }


def main() -> None:
    parser = _lab.parser(__doc__, "existing_model")
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    given = parser.parse_args()
    _lab.one_thread()
    data, project = bn.open_dataset(given.data), given.out / "project"
    make_model(data, project)
    before, result = digests(project), dict[str, Any]()
    for name, keypoints in (("database", ""), ("photos", "photos")):
        result[name] = imported(project, given.out / name, keypoints)
        result[name] |= localized(data, given.out / name, given.out / f"{name}-poses")
    result["files"], result["files_unchanged"] = len(before), digests(project) == before
    large = given.out / "large"
    make_large_project(large)
    points = (large / "sparse" / "0" / "points3D.bin").stat().st_size
    result["large"] = imported(large, given.out / "large-map", "") | {"megabytes_of_points": points / 1e6}
    print(result)
    _lab.record(given.name, result)


if __name__ == "__main__":
    main()
