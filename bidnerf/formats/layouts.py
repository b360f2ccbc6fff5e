"""Data sets in which each image has files of its own, such as a pose and a depth image: where they lie, as a table."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from glob import glob
from pathlib import Path
from types import MappingProxyType

from bidnerf_core.camera import Camera, CameraSource
from bidnerf_core.datasets import IMAGE_ENDINGS, DepthFile, Shot, read_pose_matrix
from bidnerf_core.depth import MILLIMETRE, DepthCamera, DepthReader
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, read_header

NO_FILE = ("",)


@dataclass(frozen=True)
class Layout:
    """Where the images of a format lie, and the files that belong to each image: of each kind, the first that exists.

    Names of files are relative to the folder of the image. In them, ``{name}`` stands for the first group of ``image``,
    ``{number}`` for the digits at its end, and ``{prefix}`` for what precedes "rgb" in the name of the folder.
    """

    folders: tuple[tuple[str, ...], ...]  # globs of the folders of images; the first group that has images is used
    image: str = r"([^.]+)\..+"  # names of images; the first group is the name of the frame
    pose: tuple[str, ...] = NO_FILE
    camera: tuple[str, ...] = NO_FILE
    depth: tuple[str, ...] = NO_FILE
    unmeasured: tuple[str, ...] = ("65535",)  # values of depth that cause no remark, see ``DepthReader``

    def images(self, path: Path) -> list[Path]:
        """Return the images, in the order of their numbers, of the folders that also have the poses and cameras of the layout."""
        for globs in self.folders:
            names = sorted((name for each in globs for name in glob(each, root_dir=path)), key=natural_order)
            images = [
                folder / name
                for folder in map(path.joinpath, names)
                if folder.is_dir() and self._is_complete(folder)
                for name in sorted(os.listdir(folder), key=natural_order)
                if Path(name).suffix.lower() in IMAGE_ENDINGS[1:] and re.fullmatch(self.image, name, re.IGNORECASE)
            ]
            if images:
                return images
        return []

    def file(self, names: Sequence[str], image: Path) -> Path:
        """Return the first of the files with these ``names`` that exists for an image, or else where the first would be."""
        files = [self._path(name, image) for name in names]
        return next(filter(is_file, files), files[0])

    def shots(
        self,
        images: Sequence[Path],
        camera: Camera | CameraSource | Callable[[Path, tuple[int, int]], Camera],
        unit: float = MILLIMETRE,
        sensor: DepthCamera | None = None,
        poses: Mapping[str, SE3 | None] | None = None,
        times: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Shot]:
        """Return the images with their poses, and depth in steps of ``unit`` metres, which is registered if there is a ``sensor``.

        The ``camera`` may be a function that reads it from the file of each image, given its size. ``poses`` by name take the
        place of files with a 4x4 matrix each; ``times`` are seconds by name. Raises ``InputError`` for an invalid pose, and as the function does.
        """
        read_depth, shots = DepthReader(self.unmeasured), list[Shot]()
        for image in images:
            name = self._name(image)
            pose, file, depth = (self.file(names, image) for names in (self.pose, self.camera, self.depth))
            shots.append(
                Shot(
                    image=image,
                    stem=name,
                    camera=camera
                    if isinstance(camera, Camera | CameraSource)
                    else camera(file, read_header(image).size),
                    T_world_camera=read_pose_matrix(pose) if poses is None else poses.get(name),
                    time=times.get(name),
                    depth=DepthFile(depth, partial(read_depth, depth, unit), sensor) if is_file(depth) else None,
                )
            )
        return shots

    def _is_complete(self, folder: Path) -> bool:
        files = [[(name, self._path(name, folder / "0.png")) for name in names] for names in (self.pose, self.camera)]
        return all(any(f.parent.is_dir() if "{name}" in name else f.exists() for name, f in kind) for kind in files)

    def _name(self, image: Path) -> str:
        match = re.fullmatch(self.image, image.name, re.IGNORECASE)
        return match[1] if match else image.stem

    def _path(self, name: str, image: Path) -> Path:
        own, prefix = self._name(image), image.parent.name.removesuffix("rgb")
        number = own[len(own.rstrip("0123456789")) :]
        return Path(os.path.normpath(image.parent / name.format(name=own, number=number, prefix=prefix)))
