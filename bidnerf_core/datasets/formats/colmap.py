"""Folders of a COLMAP project, consisting only of images and a sparse model.

Models are looked for in ``sparse``, ``colmap/sparse`` (nerfstudio), the folder itself, ``dense`` and the
like, as .bin or .txt (``cameras`` and ``images``; ``points3D``, ``rigs`` and ``frames`` are not read). If
the mapper wrote several (``sparse/0``, ``sparse/1`` ...), the one with the most images is used, with a
remark. Among the usual image folders, the one that holds most of the model's images is used, or else any folder in which they
are found by name. Missing images
and photos that are not registered are left out and counted.

In a dense workspace (``images``, ``sparse``, ``stereo/depth_maps``) the depth maps provide the images' depth:
the geometrically filtered ones, or else the photometric ones.

The world frame is the model's, and its unit of length is arbitrary: poses and maps use that unit, not metres.
Images are used as stored, as in COLMAP, whose pixel centres are at +0.5 like ours. The camera of an image
that was resized after the reconstruction is scaled. COLMAP records no times: a sequence is in name order.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

from bidnerf_core.camera import Camera
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot, warn_about
from bidnerf_core.datasets.colmap_files import (
    ModelImage,
    depth_map_of,
    files_of,
    read_colmap_depth,
    read_posed_images,
)
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, FileNames, posix_name
from bidnerf_core.datasets.reader import DatasetOptions, Format
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import natural_order
from bidnerf_core.io import is_file

MODEL_FOLDERS = (
    "sparse",
    "colmap/sparse",
    ".",
    "colmap",
    "dense/sparse",
    "dense/0/sparse",
    "undistorted/sparse",
    "model",
)
"""Where to look for a model, or numbered folders of models, in order of preference."""
IMAGE_FOLDERS = (
    "images",
    "images_2",
    "images_4",
    "images_8",
    "colmap/images",
    "dense/images",
    "dense/0/images",
    "undistorted/images",
    "input",
    "image",
    "photos",
    "rgb",
    ".",
    "../images",
    "../../images",
)
"""Where to look for the images, relative to the folder; those next to the model come first."""


def _read(path: Path, models: list[Path], options: DatasetOptions) -> Capture:
    """Read the project. Raises ``InputError`` if its model is damaged or has no registered image."""
    model, folder, images, cameras, files = colmap_project(path, options.image_folder)
    if options.masks is None and any((each / "masks").is_dir() for each in (path, folder.parent)):
        warn_about(path, "masks lies beside the images and is not used; name it (`masks`) to use it")
    if folder != path:
        photos = [file for file in folder.rglob("[!.]*") if file.suffix.lower() in IMAGE_ENDINGS[1:]]
        others = sorted(set(photos) - set(files.values()), key=lambda file: natural_order(str(file)))
        if others:
            warn_about(
                folder,
                f"{len(others)} of {amount(len(photos), 'photo')} are not registered in the model and are left out, first:"
                f" {others[0].relative_to(folder)}",
            )
    return Capture(
        path,
        [shot_of(model, i, files.get(i.name, folder / posix_name(i.name)), cameras) for i in images],
        options.colour,
        pose_file=model,
    )


def colmap_project(
    path: Path, given: Path | None = None
) -> tuple[Path, Path, list[ModelImage], dict[int, Camera], dict[str, Path]]:
    """Return the selected model, its image folder (``given`` by the user or not), and its images, cameras and image files.

    Images are in natural name order, cameras are keyed by id, and existing files are keyed by image name.
    Raises ``InputError`` if the model is damaged or has no registered image.
    """
    models = colmap_models(path)
    if not models:
        raise InputError("no COLMAP model in it", where=path, expected="the folder of a COLMAP project or model")
    model, images, cameras = _largest(path, models)
    folder, files = _image_folder(path, model, images, given)
    others = _models_at(folder.parent / "sparse") if files and given is None else []
    if others and model.resolve() not in [each.resolve() for each in others]:
        # For example, the images of dense/0 are undistorted, while those of sparse/0 lie elsewhere.
        warn_about(
            path,
            f"{folder.relative_to(path)} has a model of its own, which is used instead of {model.relative_to(path)}",
        )
        model, images, cameras = _largest(path, others)
        folder, files = _image_folder(path, model, images, given)
    if not images:
        raise InputError("has no registered image", where=model, expected="at least one")
    images.sort(key=lambda image: natural_order(str(posix_name(image.name))))
    for image, following in pairwise(images):
        if posix_name(image.name) == posix_name(following.name):
            raise InputError(f"image {image.name} is registered twice", where=model, expected="once")
    return model, folder, images, cameras, files


def colmap_models(path: Path) -> list[Path]:
    """Return the models at the first location that contains any."""
    return next((models for name in MODEL_FOLDERS if (models := _models_at(path / name))), [])


def _models_at(folder: Path) -> list[Path]:
    """Return the models at a location (the folder itself or its numbered subfolders), or an incomplete one if there are no others.

    A model without its ``images`` file is reported as damaged, rather than taken for photos that still need poses.
    """
    inside = [child for child in folder.glob("*") if child.name.isdecimal()]
    folders = [folder, *sorted(inside, key=lambda child: natural_order(child.name))]
    complete = [each for each in folders if files_of(each, "cameras", "images")]
    return complete or [each for each in folders if files_of(each, "cameras", "points3D")][:1]


def _largest(path: Path, models: Sequence[Path]) -> tuple[Path, list[ModelImage], dict[int, Camera]]:
    """Return the model with the most images, its images and its cameras; a remark names the other models."""
    read = {model: read_posed_images(model) for model in models}
    chosen = max(models, key=lambda model: len(read[model][0]))
    if len(models) > 1:
        sizes = {
            model: f"{model.relative_to(path)} with {amount(len(images), 'image')}"
            for model, (images, _) in read.items()
        }
        used = sizes.pop(chosen)
        warn_about(
            path,
            f"has {len(models)} models, of which {used} is used, not {', '.join(sizes.values())}; each model has its own"
            " world frame",
        )
    return chosen, *read[chosen]


def _image_folder(
    path: Path, model: Path, images: Sequence[ModelImage], given: Path | None
) -> tuple[Path, dict[str, Path]]:
    """Return the folder that holds most of the images, and the image files by their names in the model.

    If none of the usual folders holds half of the images, they are looked for below ``path``, or in the ``given`` folder alone.
    """
    usual = (model.parent / "images", model.parent.parent / "images", *map(path.joinpath, IMAGE_FOLDERS))
    best: tuple[Path, dict[str, Path]] = (given or path / IMAGE_FOLDERS[0], {})
    for folder in filter(Path.is_dir, dict.fromkeys(usual) if given is None else ()):
        names = FileNames(folder)
        files = {image.name: file for image in images if (file := names.find(posix_name(image.name))) is not None}
        if len(files) > len(best[1]):
            best = folder, files
        if len(files) == len(images):
            break
    if 2 * len(best[1]) < len(images):
        names = FileNames(path, images=given)
        files = {image.name: file for image in images if is_file(file := names.image(image.name))}
        if len(files) > len(best[1]):
            best = Path(os.path.commonpath([file.parent for file in files.values()])), files
    return best


def shot_of(model: Path, image: ModelImage, file: Path | None, cameras: dict[int, Camera]) -> Shot:
    """Return a model image as a shot, without pixels if the image file is missing.

    Raises ``InputError`` if its camera is missing.
    """
    if image.camera not in cameras:
        raise InputError(
            f"image {image.name!r} has the camera {image.camera}, which is missing from cameras", where=model
        )
    name, depth = posix_name(image.name), depth_map_of(model, image.name)
    return Shot(
        image=file,
        camera=cameras[image.camera],
        T_world_camera=image.T_camera_model.inverse(),
        depth=None if depth is None else DepthFile(depth, partial(read_colmap_depth, depth)),
        stem=name.stem,
        folders=name.parts[:-1],
    )


reader = Format(
    "COLMAP projects: the largest model, in its own unit, with the depth of stereo/depth_maps",
    "images with a sparse model in sparse/0 (COLMAP)",
    colmap_models,
    _read,
    ["images"],
    precedence=20,  # other programs' reconstructions are often made from this one, or lack its lenses
)
