"""Registration of photos by COLMAP's incremental mapper, and the choice of the model that is kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bidnerf_core.captures import up_direction
from bidnerf_core.errors import amount
from bidnerf_core.geometry import SE3
from bidnerf_core.progress import counter
from bidnerf_core.structure.keypoints import Described, ListedPhoto
from bidnerf_core.structure.matching import Overlaps

LEAST_PHOTOS = 3
"""Photos in the smallest model: two have a single baseline, which allows no check."""
LEAST_POINTS = 15
"""Minimum number of triangulated points that a registered photo observes. COLMAP also registers photos by matches without
depth, which occur between photos from one place.
"""
FEW_KEYPOINTS = 100
"""Number of keypoints below which an unregistered photo is reported as showing too little."""
MOST_MODELS = 20


@dataclass(frozen=True, eq=False)
class Models:
    """The reconstructions of the photos, largest first; parts without overlap have one each."""

    all: list[Any]

    @property
    def largest(self) -> Any:
        return self.all[0]

    @property
    def sizes(self) -> list[int]:
        """Numbers of photos."""
        return [model.num_reg_images() for model in self.all]


def reconstructed(
    database: Path, folder: Path, found: Described, fixed: bool, threads: int, pycolmap: Any
) -> Models:
    """Reconstruct the photos of a database, keeping their cameras if ``fixed``; models are written to
    ``folder``.

    There may be no model at all.
    """
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads,
        random_seed=0,
        extract_colors=False,
        min_model_size=LEAST_PHOTOS,
        max_num_models=MOST_MODELS,
    )
    if fixed:
        options.constant_cameras = set(found.cameras)
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    total, placed, count = len(found.photos), 0, counter("placing photos", "photos")

    def begin() -> None:
        nonlocal placed
        placed = 2
        count(placed, total)

    def place() -> None:
        nonlocal placed
        placed = min(placed + 1, total)
        count(placed, total)

    folder.mkdir(parents=True, exist_ok=True)
    models = pycolmap.incremental_mapping(
        database, folder, folder, options, initial_image_pair_callback=begin, next_image_callback=place
    )
    for model in models.values():
        for number in list(model.reg_image_ids()):
            if model.image(number).num_points3D < LEAST_POINTS:
                model.deregister_frame(model.image(number).frame_id)
    good = [model for model in models.values() if model.num_reg_images() >= LEAST_PHOTOS]
    return Models(sorted(good, key=lambda model: (-model.num_reg_images(), -model.num_points3D())))


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
    R = _rotation_to_z(np.array(up_direction(poses).direction))
    centre = np.mean(centres, axis=0)
    model.transform(pycolmap.Sim3d(np.concatenate([R, -(R @ centre)[:, None]], axis=1)))


def _upright_axes(photo: ListedPhoto) -> tuple[np.ndarray, np.ndarray]:
    """Return the right and up axes of the upright photo, in the camera of the photo as stored (x right, y down)."""
    turned = photo.orientation
    x, y = (-1.0 if flips else 1.0 for flips in (turned.mirrors_columns, turned.mirrors_rows))
    if turned.transposes:
        return np.array([0.0, y, 0.0]), np.array([-x, 0.0, 0.0])
    return np.array([x, 0.0, 0.0]), np.array([0.0, -y, 0.0])


def _rotation_to_z(direction: np.ndarray) -> np.ndarray:
    """Return the smallest rotation that maps a unit vector to the z axis."""
    x, y, z = direction
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0.0]])  # of direction x (0, 0, 1)
    found: np.ndarray = np.eye(3) + cross + cross @ cross / (1 + z)
    return found


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
    found: Described, models: Models, overlaps: Overlaps, keypoints: Mapping[int, int]
) -> dict[str, str]:
    """Return by name why photos are in no model, or not in the largest; ``keypoints`` are their numbers of keypoints."""
    of_model = {
        number: place
        for place, model in reversed(list(enumerate(models.all)))
        for number in model.reg_image_ids()
    }
    reasons = dict(found.unusable)
    for photo in found.photos:
        place = of_model.get(photo.number)
        if place != 0:
            reasons[photo.image.name] = _reason(
                photo, None if place is None else models.sizes[place], overlaps, keypoints
            )
    return reasons


def _reason(photo: ListedPhoto, model: int | None, overlaps: Overlaps, keypoints: Mapping[int, int]) -> str:
    count, partners = keypoints.get(photo.number, 0), overlaps.partners[photo.number]
    if model is not None:
        return (
            f"belongs to another model, with {amount(model, 'photo')}, that has no connection to the largest"
        )
    if not partners and count < FEW_KEYPOINTS:
        return f"has only {amount(count, 'keypoint')}: a plain surface, blurred, or dark"
    if not partners:
        return "overlaps with no other photo, judging by its keypoints"
    return f"overlaps with {amount(partners, 'other photo')}, but too little with the placed ones"
