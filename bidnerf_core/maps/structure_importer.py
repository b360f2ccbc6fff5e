"""Importing an existing COLMAP model: its images, poses, points and tracks become a map of landmarks.

The files of the model are only read. The map keeps the cameras and image names of the model, and its world unless the user moves or scales
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Capture,
    colmap_models,
    colmap_project,
    read_model,
    shot_of,
    stored_keypoints,
    unique_names,
)
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import Similarity
from bidnerf_core.mapping import Keypoints
from bidnerf_core.maps.importers import ImportedField, Structure, bounds_about
from bidnerf_core.settings import Settings


@dataclass(frozen=True)
class StructureSettings(Settings):
    """Where the keypoints are from."""

    # COLMAP database (.db) or hloc features (.h5, with `landmark_features` and h5py) that hold the model's keypoints; 'photos' detects
    # them anew (default: database.db beside the model, else the photos)
    keypoints: Annotated[str, "FILE"] = ""


class StructureImporter:
    """Reads COLMAP models, with keypoints from a COLMAP database, from hloc's feature file, or detected in the photos."""

    summary = "COLMAP models with their database or photos, as landmarks ('train' adds a field)"
    config_type = StructureSettings

    def recognises(self, path: Path) -> bool:
        """Return whether a folder is a COLMAP project or contains a COLMAP model."""
        return path.is_dir() and bool(colmap_models(path))

    def read(
        self, path: Path, config: StructureSettings, placement: Similarity, image_folder: Path | None = None
    ) -> ImportedField:
        """Read the COLMAP model in a folder; see ``Importer.read``."""
        model, folder, images, cameras, files = colmap_project(path, image_folder)
        _, points = read_model(model)
        found = [f"{model}: {amount(len(images), 'image')}, {amount(len(points.ids), 'point')}"]
        shots = [shot_of(model, image, files.get(image.name), cameras) for image in images]
        sound, positions = points.positions.isfinite().all(-1), placement.apply(points.positions)
        observed = [points.rows(image.observed, sound) for image in images]
        known: Mapping[str, Keypoints] = {}
        given = None if config.keypoints in ("", "photos") else Path(config.keypoints)
        beside = (folder / "database.db" for folder in (model, model.parent, model.parent.parent))
        source = given or next((file for file in beside if file.is_file()), None)
        if source is not None and config.keypoints != "photos":
            counts = {image.name: len(image.observed) for image in images}
            stored = stored_keypoints(source, counts)
            why = _misfit(stored, counts, [s.camera for s in shots], source.suffix != ".h5")
            if why is None:
                known = stored
            elif given is not None:
                raise InputError(why, where=given, expected=f"the keypoints of {model}")
            used = "the keypoints and their descriptors" if why is None else f"not used: {why}"
            found.append(f"{source}: {used}")
        left_out, usable = list[str](), list[int]()
        for number, image in enumerate(images):
            if known and image.name not in known:
                left_out.append(f"{image.name}: it has no keypoints in the file of them")
            elif not known and image.name not in files:
                left_out.append(f"{image.name}: no such photo in {folder} (`images` names another folder)")
            elif int((observed[number] >= 0).sum()) < 6:  # too few to determine even its own pose by RANSAC
                left_out.append(f"{image.name}: it observes fewer than 6 points")
            else:
                usable.append(number)
        if not usable:
            raise InputError(
                f"none of its {amount(len(images), 'image')} can be used, such as {left_out[0]}", where=model
            )
        found += [f"left out: {line}" for line in left_out]
        poses = [placement.move(images[number].T_camera_model.inverse()) for number in usable]
        names = unique_names([shots[number].parts for number in usable])
        structure = Structure(
            Capture(
                path,
                [
                    replace(shots[number], name=name, T_world_camera=T, splits=("train",))
                    for number, name, T in zip(usable, names, poses, strict=True)
                ],
            ),
            positions,
            tuple(observed[number] for number in usable),
            tuple(known[images[number].name] for number in usable) if known else (),
        )
        return ImportedField(
            "", None, {}, bounds_about(positions[sound]), found=tuple(found), steps=0, structure=structure
        )


def _misfit(
    known: Mapping[str, Keypoints], counts: Mapping[str, int], cameras: list[object], is_database: bool
) -> str | None:
    """Return why stored keypoints cannot be used for images with these ``counts`` of keypoints; None if they can."""
    named = [name for name in counts if name in known]
    if not named:
        return "it has no keypoints of any image of the model"
    for name in named:
        if counts[name] != len(known[name]):
            return f"it has {len(known[name])} keypoints of {name}, the model {counts[name]}"
        if is_database and (width := known[name].descriptors.shape[1]) != 128:
            return f"its descriptors have {width} bytes, those of SIFT 128"
    if not all(isinstance(camera, Intrinsics) for camera in cameras):
        return "its keypoints are those of lenses whose images are undistorted"
    return None


importer = StructureImporter()
