"""Registration of photos by COLMAP's incremental mapper, and the choice of the model that is kept."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.captures import up_direction
from bidnerf_core.errors import amount
from bidnerf_core.geometry import SE3
from bidnerf_core.progress import counter
from bidnerf_core.structure.keypoints import Described, ListedPhoto
from bidnerf_core.structure.matching import Overlaps

LEAST_PHOTOS = 3
"""Photos in the smallest model: two have a single baseline, which allows no check."""


def reconstructed(
    database: Path, folder: Path, found: Described, fixed: bool, threads: int, pycolmap: Any
) -> list[Any]:
    """Reconstruct the photos of a database, keeping their cameras if ``fixed``; models are written to ``folder``.

    Returns the models, largest first; parts without overlap have one each. There may be no model at all.
    """
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads,
        random_seed=0,
        extract_colors=False,
        min_model_size=LEAST_PHOTOS,
        max_num_models=20,
    )
    if fixed:
        options.constant_cameras = set(found.cameras)
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    total, placed, count = len(found.photos), 0, counter("placing photos", "photos")

    def show(number: int) -> None:
        nonlocal placed
        placed = min(number, total)
        count(placed, total)

    folder.mkdir(parents=True, exist_ok=True)
    models = pycolmap.incremental_mapping(
        database, folder, folder, options,
        initial_image_pair_callback=lambda: show(2), next_image_callback=lambda: show(placed + 1),
    )  # fmt: skip
    # COLMAP also registers photos by matches without depth, which occur between photos from one place.
    for model in models.values():
        for number in list(model.reg_image_ids()):
            if model.image(number).num_points3D < 15:
                model.deregister_frame(model.image(number).frame_id)
    good = [model for model in models.values() if model.num_reg_images() >= LEAST_PHOTOS]
    return sorted(good, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def turn_upright(model: Any, photos: Mapping[int, ListedPhoto], pycolmap: Any) -> None:
    """Rotate the world of a model so that z points up, and move its origin to the middle of the cameras."""
    rotations, centres = [], []
    for number in model.reg_image_ids():
        image = model.image(number)
        R_world_camera = image.cam_from_world().inverse().rotation.matrix()
        right, above = _upright_axes(photos[number])
        upright = np.stack([right, -above, np.cross(right, -above)], axis=1)
        rotations.append(R_world_camera @ upright)
        centres.append(image.projection_center())
    poses = SE3(torch.from_numpy(np.stack(rotations)), torch.from_numpy(np.stack(centres)))
    rotation, _ = Rotation.align_vectors([[0, 0, 1]], [up_direction(poses).direction])
    R = rotation.as_matrix()
    centre = np.mean(centres, axis=0)
    model.transform(pycolmap.Sim3d(np.concatenate([R, -(R @ centre)[:, None]], axis=1)))


def _upright_axes(photo: ListedPhoto) -> tuple[np.ndarray, np.ndarray]:
    """Return the right and up axes of the upright photo, in the camera of the photo as stored (x right, y down)."""
    turned = photo.exif.orientation
    x, y = (-1.0 if flips else 1.0 for flips in (turned.mirrors_columns, turned.mirrors_rows))
    if turned.transposes:
        return np.array([0.0, y, 0.0]), np.array([-x, 0.0, 0.0])
    return np.array([x, 0.0, 0.0]), np.array([0.0, -y, 0.0])


def full_size(model: Any, photos: Mapping[int, ListedPhoto]) -> None:
    """Scale the cameras and keypoints of a model from downscaled photos to photos as stored."""
    sizes = {photo.camera: photo for photo in photos.values()}
    for number, photo in sizes.items():
        if model.exists_camera(number):
            model.camera(number).rescale(*photo.size)
    for number in model.reg_image_ids():
        photo = photos[number]
        scale = np.array(photo.size) / np.array(photo.reduced)
        if (scale != 1).any():
            for point in model.image(number).points2D:
                point.xy = point.xy * scale


def left_out(
    found: Described, models: list[Any], overlaps: Overlaps, keypoints: Mapping[int, int]
) -> dict[str, str]:
    """Return by name why photos are in no model, or not in the largest; ``keypoints`` are their numbers of keypoints."""
    of_model = {number: model for model in reversed(models) for number in model.reg_image_ids()}
    reasons = dict(found.unusable)
    for photo in found.photos:
        model, partners = of_model.get(photo.number), overlaps.partners[photo.number]
        count = keypoints.get(photo.number, 0)
        if model is models[0]:
            continue
        reason = f"overlaps with {amount(partners, 'other photo')}, but too little with the placed ones"
        if model is not None:
            size = amount(model.num_reg_images(), "photo")
            reason = f"belongs to another model, with {size}, that has no connection to the largest"
        elif not partners and count < 100:
            reason = f"has only {amount(count, 'keypoint')}: a plain surface, blurred, or dark"
        elif not partners:
            reason = "overlaps with no other photo, judging by its keypoints"
        reasons[photo.image.name] = reason
    return reasons
