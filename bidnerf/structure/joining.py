"""Models of parts of the photos: those that show enough of the same points are joined by a similarity and a bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from bidnerf.structure.colmap import to_sim3d
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import fit_most
from bidnerf_core.progress import log

LEAST_SHARED = 30
"""Smallest number of points that two models share, as many as COLMAP requires to place a photo."""
SHARED_DISTANCE = 0.02
"""Largest distance between the positions of a shared point in two models, relative to the points' median distance from the cameras.
Of the points that parts of a drone's flight share, 98 % are within a hundredth and no more within a tenth."""

PhotoMatches: TypeAlias = list[tuple[int, int, np.ndarray]]
"""The numbers of two photos, and the numbers (n, 2) of the keypoints that both show."""


def join(models: Sequence[Any], database: Path, folder: Path, options: Any, pycolmap: Any) -> None:
    """Write the models, given the largest first, to a folder, those that show enough of the same points as one.

    Two models share a point if a photo of both shows it, or if photos of both have a match there. A last bundle adjustment, with the
    options of the incremental mapper, merges the tracks of joined models.
    """
    with pycolmap.Database.open(database) as opened:
        needed = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(opened, needed)
        geometries = list(zip(*opened.read_two_view_geometries(), strict=True))
    matches = [(*pycolmap.pair_id_to_image_pair(pair), seen.inlier_matches.astype(int)) for pair, seen in geometries]
    left, seen_by = dict(enumerate(models)), [_points_by_keypoint(model) for model in models]

    def next_part(model: Any) -> tuple[Any, Any, dict[int, int]] | None:
        """Return one of the models left that shows enough of the points of ``model``, their similarity and their shared points."""
        own = _points_by_keypoint(model)
        for number, other in left.items():
            fit = _align(model, other, _shared_points(own, seen_by[number], matches), pycolmap)
            if fit is not None:
                return left.pop(number), *fit
        return None

    while left:
        first = min(left)
        model, is_joined = left.pop(first), False
        while (part := next_part(model)) is not None:
            other, similarity, same = part
            sizes = f"{model.num_reg_images()} and {other.num_reg_images()} photos"
            log.info(f"models of {sizes} share {len(same)} points and are joined")
            _merge(model, other, similarity, same, pycolmap)
            is_joined = True
        if is_joined:
            mapper = pycolmap.IncrementalMapper(cache)
            mapper.begin_reconstruction(model)
            adjustment = options.get_mapper(), options.get_global_bundle_adjustment(), options.get_triangulation()
            rounds = options.ba_global_max_refinements, options.ba_global_max_refinement_change
            mapper.iterative_global_refinement(*rounds, *adjustment)
            mapper.end_reconstruction(False)
        (folder / f"{first}").mkdir()
        model.write_binary(folder / f"{first}")


def _align(model: Any, other: Any, pairs: np.ndarray, pycolmap: Any) -> tuple[Any, dict[int, int]] | None:
    """Return the similarity from ``other`` to ``model``, and the shared points' numbers in ``model`` by those in ``other``.

    It is None unless it brings together most of the ``pairs`` of points that matches call the same: a wrong one leaves them scattered.
    """
    if len(pairs) < LEAST_SHARED:
        return None
    points = [model.point3D(number) for number in pairs[:, 0]]
    target, source = np.array([p.xyz for p in points]), np.array([other.point3D(n).xyz for n in pairs[:, 1]])
    centres = [model.image(point.track.elements[0].image_id).projection_center() for point in points]
    try:
        similarity, away, _ = fit_most(torch.from_numpy(source), torch.from_numpy(target))
    except InputError:  # no similarity fits
        return None
    near = away.numpy() <= SHARED_DISTANCE * np.median(np.linalg.norm(target - centres, axis=1))
    if near.sum() < max(LEAST_SHARED, len(pairs) / 2):
        return None
    return to_sim3d(similarity, pycolmap), dict(pairs[near, ::-1].tolist())


def _points_by_keypoint(model: Any) -> dict[int, np.ndarray]:
    """Return, by number of the photo, the number of the point that each keypoint shows, or -1."""
    return {
        number: np.array(
            [p.point3D_id if p.has_point3D() else -1 for p in model.image(number).points2D], dtype=np.int64
        )
        for number in model.reg_image_ids()
    }


def _shared_points(a: dict[int, np.ndarray], b: dict[int, np.ndarray], matches: PhotoMatches) -> np.ndarray:
    """Return the numbers (n, 2) of the points in two models that matches, or a keypoint of a photo in both, call the same."""
    there = matches + [(j, i, keypoints[:, ::-1]) for i, j, keypoints in matches]
    there += [(i, i, np.arange(len(a[i]))[:, None].repeat(2, axis=1)) for i in a.keys() & b.keys()]
    rows = [np.stack([a[i][ends[:, 0]], b[j][ends[:, 1]]], axis=1) for i, j, ends in there if i in a and j in b]
    pairs = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *rows]), axis=0)
    return pairs[(pairs >= 0).all(1)]


def _merge(model: Any, other: Any, similarity: Any, same: dict[int, int], pycolmap: Any) -> None:
    """Move ``other`` by a similarity and add its photos and points to ``model``; points that are the ``same`` become one."""
    other.transform(similarity)
    new = {*other.reg_image_ids()} - {*model.reg_image_ids()}
    for number in sorted(new):
        image, frame = other.image(number), other.frame(other.image(number).frame_id)
        if not model.exists_camera(image.camera_id):
            model.add_camera(other.camera(image.camera_id))
            model.add_rig(other.rig(frame.rig_id))
        if not model.exists_frame(frame.frame_id):
            added = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id)
            added.add_data_id(image.data_id)
            model.add_frame(added)
            pixels = np.array([point.xy for point in image.points2D])
            copy = pycolmap.Image(name=image.name, keypoints=pixels, camera_id=image.camera_id, image_id=number)
            copy.frame_id = frame.frame_id
            model.add_image(copy)
        model.frame(frame.frame_id).rig_from_world = frame.rig_from_world
        model.register_frame(frame.frame_id)
    for number, point in other.points3D.items():
        elements = [element for element in point.track.elements if element.image_id in new]
        if number in same:
            for element in elements:
                model.add_observation(same[number], element)
        elif len(elements) > 1:
            model.add_point3D(point.xyz, pycolmap.Track(elements))
