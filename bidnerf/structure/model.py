"""The COLMAP model of photos: mapping, orientation, a consistency check, and export as a dataset."""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bidnerf.structure.colmap import LEAST_PHOTOS, ListedPhoto, PhotoSet
from bidnerf.structure.gps import GeoFrame, align_to_gps
from bidnerf.structure.joining import join
from bidnerf.structure.record import MODEL, TRANSFORMS, part_folder
from bidnerf_core.camera import CentralLens, Intrinsics, Raster, colmap_camera
from bidnerf_core.captures import up_direction
from bidnerf_core.datasets import frame_entry
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import fit_depth
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import write_file
from bidnerf_core.progress import counter

WIDEST_FIELD = 120.0
"""Largest horizontal field of view (degrees) of a pinhole camera whose focal length was found."""
MANY_PHOTOS = 80
"""Number of photos from which the global mapper places them. Of 80 photos of a flight, it placed 73, the incremental mapper 64 (record
``photos_without_poses``)."""
ENOUGH_PLACED = 0.9
"""Fraction of the photos that the global mapper must place, so that the incremental one is not tried as well."""
LEAST_DEPTHS = 30
"""Smallest number of points with measured depth that determine the scale of a model."""


def reconstruct(database: Path, folder: Path, photos: PhotoSet, threads: int, pycolmap: Any) -> list[Any]:
    """Reconstruct models from the photos in a database, and return them, the largest first; ``folder`` keeps those of each step.

    Fixed cameras are constant. Many photos are placed together, by the global mapper (Pan et al. 2024), which takes a fraction of the
    time, unless it leaves out many or a focal length is unknown; few ones are placed one after another. Models that share enough points
    are joined. Those of photos without overlap stay separate; there may be none.
    """
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, random_seed=0, extract_colors=False, min_model_size=LEAST_PHOTOS, max_num_models=20
    )
    options.constant_cameras = photos.fixed
    if photos.fixed == photos.cameras.keys():
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    total, is_known = len(photos.photos), photos.known_focal == photos.cameras.keys()
    models = list[Any]()
    if total >= MANY_PHOTOS and is_known and photos.fixed in (set(), photos.known_focal):
        together = partial(_place_together, database, photos, threads, pycolmap)
        models = _load_or_make(folder / "together", together, pycolmap)
    if not models or models[0].num_reg_images() < ENOUGH_PLACED * total:
        singly = _load_or_make(folder / "singly", partial(_place_singly, database, total, options, pycolmap), pycolmap)
        models = max(models, singly, key=lambda each: each[0].num_reg_images() if each else 0)
    if len(models) > 1:
        parts = models
        models = _load_or_make(folder / "joined", lambda into: join(parts, database, into, options, pycolmap), pycolmap)
    return models


def _load_or_make(folder: Path, write: Callable[[Path], Any], pycolmap: Any) -> list[Any]:
    """Return the models in a folder, the largest first, without photos that see too little of them; ``write`` makes them if there is none."""
    if not folder.exists():
        unfinished = folder.with_suffix(".part")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        write(unfinished)
        unfinished.rename(folder)
    models = [pycolmap.Reconstruction(each) for each in sorted(folder.iterdir())]
    # COLMAP also registers photos by matches that determine no depth, as between photos from one place.
    for model in models:
        for number in list(model.reg_image_ids()):
            if model.image(number).num_points3D < 15:
                model.deregister_frame(model.image(number).frame_id)
    good = [model for model in models if model.num_reg_images() >= LEAST_PHOTOS]
    return sorted(good, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _place_together(database: Path, photos: PhotoSet, threads: int, pycolmap: Any, folder: Path) -> None:
    """Write the models of the global mapper, which cannot be interrupted, to a folder."""
    count, total = counter("placing photos", "photos"), len(photos.photos)
    count(0, total)
    options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=0, min_model_size=LEAST_PHOTOS)
    if photos.fixed:
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = False
    pycolmap.global_mapping(database, folder, folder, options)
    count(total, total)


def _place_singly(database: Path, total: int, options: Any, pycolmap: Any, folder: Path) -> None:
    """Write the models of the incremental mapper to a folder."""
    count, placed = counter("placing photos", "photos"), itertools.count(1)
    pycolmap.incremental_mapping(
        database, folder, folder, options, next_image_callback=lambda: count(min(next(placed), total), total)
    )


def turn_upright(model: Any, photos: Mapping[int, ListedPhoto], pycolmap: Any) -> None:
    """Rotate the world of a model so that z points up, and move its origin to the middle of the cameras."""
    rotations, centres = [], []
    for number in model.reg_image_ids():
        image = model.image(number)
        R_world_camera = image.cam_from_world().inverse().rotation.matrix()
        right, down, _ = photos[number].exif.orientation.axes.numpy()
        rotations.append(R_world_camera @ np.stack([right, down, np.cross(right, down)], axis=1))
        centres.append(image.projection_center())
    poses = SE3(torch.from_numpy(np.stack(rotations)), torch.from_numpy(np.stack(centres)))
    rotation, _ = Rotation.align_vectors([[0, 0, 1]], [up_direction(poses).direction])
    R = rotation.as_matrix()
    centre = np.mean(centres, axis=0)
    model.transform(pycolmap.Sim3d(np.concatenate([R, -(R @ centre)[:, None]], axis=1)))


def restore_size(model: Any, photos: Mapping[int, ListedPhoto]) -> None:
    """Scale the cameras and keypoints of a model from the downscaled photos to the photos as stored."""
    for camera, photo in {photo.camera: photo for photo in photos.values()}.items():
        if model.exists_camera(camera):
            model.camera(camera).rescale(*photo.size)
    for number in model.reg_image_ids():
        scale = np.array(photos[number].size) / np.array(photos[number].reduced)
        for point in model.image(number).points2D if (scale != 1).any() else ():
            point.xy = point.xy * scale


def count_contradictions(model: Any, database: Any, pycolmap: Any) -> tuple[int, int]:
    """Count the verified pairs of photos, and those that contradict the poses and cameras of a model.

    Places that look alike, such as the doors of a corridor, can be taken for one place. The model is then folded, although its points
    project where they should. A folded model contradicts other pairs of photos, which have too many matches to be due to chance.

    Returns the number of pairs of registered photos with at least 100 verified matches (pairs that show different places with
    repeated details have up to 80), and how many of these pairs contradict the model: fewer than half of their matches are within
    four pixels of the epipolar lines, measured in the downscaled photos.
    """
    registered, pairs, contradicting = set(model.reg_image_ids()), 0, 0
    for (i, j), ends in _matched_keypoints(database, 100, pycolmap):
        if not {i, j} <= registered:
            continue
        cameras = [model.camera(model.image(number).camera_id) for number in (i, j)]
        rays = [
            np.column_stack([camera.cam_from_img(seen), np.ones(len(seen))])
            for camera, seen in zip(cameras, ends, strict=True)
        ]
        T = (model.image(j).cam_from_world() * model.image(i).cam_from_world().inverse()).matrix()
        t = T[:, 3] / max(np.linalg.norm(T[:, 3]), 1e-12)
        lines = np.cross(t, rays[0] @ T[:, :3].T)
        away = np.abs((lines * rays[1]).sum(-1)) / np.linalg.norm(lines[:, :2], axis=-1).clip(1e-12)
        pairs += 1
        contradicting += int(np.mean(away * cameras[1].mean_focal_length() < 4) < 0.5)
    return pairs, contradicting


def _matched_keypoints(
    database: Any, least: int, pycolmap: Any
) -> Iterator[tuple[tuple[int, int], tuple[np.ndarray, np.ndarray]]]:
    """Yield the numbers of two photos with at least ``least`` verified matches, and the matched keypoints (n, 2) of each."""
    read = cache(lambda number: database.read_keypoints(number)[:, :2].astype(np.float64))
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        (i, j), matches = pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches
        if len(matches) >= least:
            yield (i, j), (read(i)[matches[:, 0]], read(j)[matches[:, 1]])


def require_parallax(model: Any, database: Any, photos: PhotoSet, source: Path, pycolmap: Any) -> None:
    """Raise ``InputError`` if the cameras of a model were bent until photos from one place seemed to be from several.

    A focal length that is searched for can explain a mere turn by a walk. The matches of most pairs then fit a rotation of the
    rays, for one focal length and one distortion among those of usual lenses, as well as keypoints are measured.
    """
    for number, camera in model.cameras.items():
        degrees = math.degrees(2 * math.atan(camera.width / 2 / camera.mean_focal_length()))
        if number not in photos.fixed and degrees > WIDEST_FIELD:
            raise InputError(
                f"the photos fit a camera that sees {degrees:.0f} degrees, which no pinhole camera does",
                where=source,
                expected="their camera, such as a fisheye lens; or pinhole views cut from panoramas",
            )
    by_number, pairs = {photo.number: photo for photo in photos.photos}, list[np.ndarray]()
    for numbers, seen in _matched_keypoints(database, 30, pycolmap):
        if not {by_number[n].camera for n in numbers if n in by_number} & photos.fixed:
            sizes = [np.array(by_number[number].reduced) for number in numbers]
            ends = np.stack([(pixels - size / 2) / size.max() for pixels, size in zip(seen, sizes, strict=True)])
            if np.median(np.linalg.norm(ends[1] - ends[0], axis=-1)) > 0.03:  # of the longer side
                pairs.append(ends)
    pairs = pairs[:: max(1, len(pairs) // 40)]
    side = max(max(photo.reduced) for photo in photos.photos)
    lenses = itertools.product(
        np.geomspace(0.4, 3, 25), np.linspace(-0.25, 0.25, 11)
    )  # focal length, radial distortion
    misfits = [np.median([_misfit_of_turn(ends, *lens) for ends in pairs]) for lens in lenses if len(pairs) >= 3]
    if misfits and min(misfits) < max(0.7 / side, 0.0012):
        raise InputError(
            "the photos were taken from one place, by a camera that only turns: they do not determine distances",
            where=source,
            expected="photos taken while moving sideways, or depth",
        )


def _misfit_of_turn(ends: np.ndarray, focal: float, k: float) -> float:
    """Return the 80th percentile of the distances (relative to the longer side) of matches (2, n, 2) after the best rotation."""
    flat = ends / focal
    flat = flat * (1 + k * (flat**2).sum(-1, keepdims=True))
    rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    U, _, Vt = np.linalg.svd(rays[1].T @ rays[0])
    turned = rays[0] @ (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.percentile(np.linalg.norm(turned - rays[1], axis=-1), 80) * focal)


def reasons_left_out(
    photos: PhotoSet, models: list[Any], partners: Counter[int], keypoints: Mapping[int, int]
) -> dict[str, str]:
    """Return, by name, the reason why each photo that is not in the largest model was left out.

    ``partners`` counts the photos that overlap with each photo, and ``keypoints`` its keypoints, both by
    photo number.
    """
    rank_of = {photo: rank for rank in reversed(range(len(models))) for photo in models[rank].reg_image_ids()}
    reasons = dict(photos.unusable)
    for photo in photos.photos:
        rank, other = rank_of.get(photo.number), amount(partners[photo.number], "other photo")
        if rank == 0:
            continue
        reason = f"overlaps with {other}, judging by its {amount(keypoints[photo.number], 'keypoint')}, but too little with the placed ones"
        if rank is not None:
            size, part = amount(models[rank].num_reg_images(), "photo"), part_folder(Path(), rank)
            shared = len({*models[rank].reg_image_ids()} & {*models[0].reg_image_ids()})
            reason = (
                f"belongs to another model, of {size}, that shares too few points with the largest to be joined: {part}"
            )
            reason += (
                f"; {amount(shared, 'photo')} of it {'is' if shared == 1 else 'are'} in the largest as well"
                if shared
                else ""
            )
        reasons[photo.shot.name] = reason
    return reasons


def scale_to_depth(model: Any, photos: Mapping[int, ListedPhoto], pycolmap: Any) -> bool:
    """Scale a model to metres if its photos have depth: by the median of the depth of its points, measured and in the model.

    Return whether it was scaled.
    """
    ratios = list[float]()
    for number in model.reg_image_ids():
        image, photo = model.image(number), photos[number]
        depth = photo.shot.depth
        if depth is None or depth.sensor is not None:
            continue
        metres = fit_depth(depth.read(), Raster(*photo.size), photo.reduced, f"{depth.path}: depth").numpy()
        for point in (point for point in image.points2D if point.has_point3D()):
            column, row = np.clip(point.xy.astype(int), 0, np.array(photo.reduced) - 1)
            far = (image.cam_from_world() * model.point3D(point.point3D_id).xyz)[2]
            if metres[row, column] > 0 and far > 0:
                ratios.append(float(metres[row, column]) / far)
    if len(ratios) < LEAST_DEPTHS:
        return False
    model.transform(pycolmap.Sim3d(float(np.median(ratios)), pycolmap.Rotation3d(), np.zeros(3)))
    return True


def write_dataset(
    folder: Path, photos: Mapping[int, ListedPhoto], model: Any, base: Path, depth_unit: float | None, pycolmap: Any
) -> tuple[bool, GeoFrame | None]:
    """Write a model of ``photos`` (by number) and its ``transforms.json`` to ``folder``; the model names images relative to ``base``.

    The model is put in its frame before: in metres by depth or GPS, if there is enough, otherwise upright. ``depth_unit`` is the length
    of a step of depth images (metres), if there are any. Returns whether the unit is metres, and the model's place by GPS.
    """
    metric = scale_to_depth(model, photos, pycolmap)
    geo_frame = None if metric else align_to_gps(model, photos, pycolmap)
    if geo_frame is None:
        turn_upright(model, photos, pycolmap)
    restore_size(model, photos)
    unit: LengthUnit | Literal["units"] = "metres" if metric or geo_frame else "units"
    entries = []
    for number in sorted(model.reg_image_ids()):
        photo, image = photos[number], model.image(number)
        image.name = relative_path(photo.file, base)
        camera = from_colmap(model.camera(image.camera_id))
        matrix = torch.from_numpy(image.cam_from_world().matrix()).double()
        T_world_camera = SE3(matrix[:, :3].clone(), matrix[:, 3].clone()).inverse()
        path, depth = relative_path(photo.file, folder), photo.shot.depth
        entry = frame_entry(path, photo.shot.name, camera, T_world_camera, photo.shot.time)
        if depth is not None and depth.sensor is None and isinstance(depth.path, Path) and depth_unit:
            entry |= {"depth_file_path": relative_path(depth.path, folder), "depth_unit_scale_factor": depth_unit}
        entries.append(entry)
    (folder / MODEL).mkdir(parents=True, exist_ok=True)
    model.write_binary(folder / MODEL)
    write_file(
        folder / TRANSFORMS,
        json.dumps({"camera_model": "OPENCV", "unit": unit, "frames": entries}, indent=1, allow_nan=False).encode(),
    )
    return unit == "metres", geo_frame


def from_colmap(camera: Any) -> Intrinsics | CentralLens:
    """Return the camera of pycolmap's one, which is no panorama."""
    found = colmap_camera("COLMAP", camera.model.name, camera.width, camera.height, list(camera.params))
    assert isinstance(found, Intrinsics | CentralLens)
    return found


def relative_path(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder."""
    return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
