"""Folders of a COLMAP project: images and a sparse model, with no other file.

Models are looked for in ``sparse``, ``colmap/sparse`` (nerfstudio), the folder itself, ``dense`` and the
like, as .bin or .txt (``cameras`` and ``images``; ``points3D``, ``rigs`` and ``frames`` are not read). If the
mapper wrote several (``sparse/0``, ``sparse/1`` ...), the one with the most images is used, with a remark.
Among the usual image folders, the one that holds most of the model's images is used. Missing images and
photos that are not registered are left out and counted. Every eighth registered image in natural name order
(the first, the ninth ...) is held out as "test" and the others are "train", as is usual for captures.

In a dense workspace (``images``, ``sparse``, ``stereo/depth_maps``) the depth maps provide the images' depth:
the geometrically filtered ones, or else the photometric ones.

The world is that of the model, whose unit of length is arbitrary: poses and maps use that unit, not metres.
Images are used as stored, as in COLMAP, whose pixel centres are at +0.5 like ours. The camera of an image
that was resized after the reconstruction is scaled. COLMAP records no times: a sequence is in name order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

from bidnerf_core.camera import Camera, CameraSource, PanoramaFace
from bidnerf_core.datasets.colmap_depth import depth_map_of, read_colmap_depth
from bidnerf_core.datasets.colmap_files import (
    ModelImage,
    count_posed_images,
    has_posed_images,
    read_posed_images,
)
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.file_names import FileNames, posix_name
from bidnerf_core.datasets.incomplete import present, remark
from bidnerf_core.datasets.panoramas import faces_of
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.rgbd import DepthFile, read_rgbd
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits, hold_out
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import HEIF_SUFFIXES, IMAGE_SUFFIXES

MODELS = (
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
IMAGES = (
    "images", "colmap/images", "dense/images", "dense/0/images", "undistorted/images", "input", "image", "photos", "rgb", ".",
    "../images", "../../images",
)  # fmt: skip
"""Where to look for the images, relative to the folder; those next to the model come first."""


@dataclass(frozen=True, eq=False)
class ColmapFrame:
    """A registered image."""

    name: PurePosixPath  # below the folder of images
    image: Path
    camera: Camera
    T_world_camera: SE3  # in units of the model
    depth: Path | None  # of a dense reconstruction

    time = None

    @property
    def stem(self) -> str:
        face = f"_{self.camera.face}" if isinstance(self.camera, PanoramaFace) else ""
        return f"{self.name.stem}{face}"

    def faces(self) -> list[ColmapFrame]:
        """Return the pinhole views of a panorama; the frame itself if it is not one."""
        if not isinstance(self.camera, PanoramaFace):
            return [self]
        return [
            replace(self, camera=replace(self.camera, face=face), T_world_camera=T)
            for face, T in faces_of(self.T_world_camera)
        ]

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.name.parts[:-1], self.stem)


class ColmapReader(Reader):
    """Reader for COLMAP project folders."""

    expected = "images with a sparse model in sparse/0 (COLMAP)"

    def recognises(self, path: Path) -> bool:
        return bool(_models(path))

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the model. Raises ``InputError`` if it is damaged or has no registered image."""
        return self._open(path, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        return self._open(path, options).sequence()

    def _open(self, path: Path, options: ReadOptions) -> ColmapDataset:
        model = _largest(path, _models(path))
        splits = hold_out(_frames(path, model))
        views = {id(frame): frame.faces() for group in splits.values() for frame in group}
        cut = {
            split: [view for frame in group for view in views[id(frame)]] for split, group in splits.items()
        }
        return ColmapDataset(Splits(path, cut), options.background)


class ColmapDataset(SplitDataset[ColmapFrame]):
    """Views of a COLMAP project; see ``Dataset``."""

    def _frame(self, frame: ColmapFrame, name: str) -> Frame:
        depth = None if frame.depth is None else DepthFile(frame.depth, 1.0, read_colmap_depth)
        camera = CameraSource(frame.camera).at(frame.image)
        return read_rgbd(name, frame.image, camera, self._background, depth)

    def _pose(self, frame: ColmapFrame) -> SE3:
        return frame.T_world_camera


def _models(path: Path) -> list[Path]:
    """Return the models at the first location that has any: the location itself, or numbered folders in it."""
    for place in MODELS:
        folder = path / place
        inside = [child for child in folder.glob("*") if child.name.isdecimal() and has_posed_images(child)]
        if inside or has_posed_images(folder):
            own = [folder] if has_posed_images(folder) else []
            return [*own, *sorted(inside, key=lambda child: natural_order(child.name))]
    return []


def _largest(path: Path, models: Sequence[Path]) -> Path:
    """Return the model with the most images; a remark names the others."""
    if len(models) == 1:
        return models[0]
    sizes = {model: count_posed_images(model) for model in models}
    chosen = max(models, key=lambda model: sizes[model])
    others = ", ".join(f"{model.relative_to(path)} ({sizes[model]})" for model in models if model != chosen)
    remark(
        path,
        f"has {len(models)} models, of which {chosen.relative_to(path)} with"
        f" {amount(sizes[chosen], 'image')} is used, not {others}; each model has its own world frame",
    )
    return chosen


def _frames(path: Path, model: Path) -> list[ColmapFrame]:
    images, cameras = read_posed_images(model)
    if not images:
        raise InputError("has no registered image", where=model, expected="at least one")
    folder, files = _image_folder(path, model, images)
    there = present(
        images,
        lambda image: image.name in files,
        folder,
        lambda image: image.name,
        lambda image: InputError(
            f"no such file, although {model} lists that image", where=folder / image.name
        ),
    )
    _remark_unregistered(path, folder, files)
    frames = [_frame(model, image, files[image.name], cameras) for image in there]
    frames.sort(key=lambda frame: natural_order(str(frame.name)))
    for frame, following in pairwise(frames):
        if frame.name == following.name:
            raise InputError(f"image {frame.name} is registered twice", where=model, expected="once")
    return frames


def _image_folder(path: Path, model: Path, images: Sequence[ModelImage]) -> tuple[Path, dict[str, Path]]:
    """Return the folder that holds most of the images, and the image files by their names in the model."""
    beside = [model.parent / "images", model.parent.parent / "images"]
    places = list(dict.fromkeys([*beside, *(path / place for place in IMAGES)]))
    best: tuple[Path, dict[str, Path]] = (path / IMAGES[0], {})
    for folder in filter(Path.is_dir, places):
        names = FileNames(folder)
        found = {image.name: names.find(posix_name(image.name)) for image in images}
        files = {name: file for name, file in found.items() if file is not None}
        if len(files) > len(best[1]):
            best = folder, files
        if len(files) == len(images):
            break
    return best


def _remark_unregistered(path: Path, folder: Path, files: dict[str, Path]) -> None:
    """Count the photos in an image folder that the model lacks."""
    if folder == path:
        return
    photos = [file for file in folder.rglob("*") if file.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)]
    others = sorted(set(photos) - set(files.values()), key=lambda file: natural_order(str(file)))
    if others:
        text = f"{len(others)} of {amount(len(photos), 'photo')} are not registered in the model and are left out"
        remark(folder, f"{text}, first: {others[0].relative_to(folder)}")


def _frame(model: Path, image: ModelImage, file: Path, cameras: dict[int, Camera]) -> ColmapFrame:
    if image.camera not in cameras:
        raise InputError(
            f"image {image.name!r} has the camera {image.camera}, which is missing from cameras", where=model
        )
    name = PurePosixPath(posix_name(image.name))
    return ColmapFrame(
        name, file, cameras[image.camera], image.T_camera_model.inverse(), depth_map_of(model, image.name)
    )


reader = ColmapReader()
