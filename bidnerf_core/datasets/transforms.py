"""Folders with ``transforms.json``: the dialects of NeRF's Blender scenes and of nerfstudio (and instant-ngp).

A folder holds some of ``transforms_train.json``, ``transforms_val.json`` and ``transforms_test.json``, or one
``transforms.json`` whose lists ``train_filenames``, ``val_filenames`` and ``test_filenames`` define the splits. Without
such lists every eighth frame (the first, the ninth ...) is held out as "test" and the others are "train", as is usual for
captures; a single frame is both.

These keys are read from a frame or, where it lacks them, from the file: ``camera_angle_x [camera_angle_y]`` or
``fl_x [fl_y]``, ``cx cy w h``, ``k1 k2 p1 p2 k3``, ``camera_model``, ``depth_unit_scale_factor`` (metres per unit, default
0.001; as in nerfstudio it applies to ``.npy`` depth as well) or instant-ngp's ``integer_depth_scale``. These are read only from
a frame: ``file_path`` (its extension may be missing, its separators may be those of Windows, its upper and lower case may differ
from the file's), ``transform_matrix``, ``depth_file_path`` or instant-ngp's ``depth_path`` (planar z of the image's aspect ratio
and of any size; each pixel has the depth of the nearest measurement; see ``depth_image`` for values that count as not measured),
``mask_path`` (an image whose black pixels are not used). Where ``dynamic_mask_NAME.png`` of instant-ngp lies beside ``NAME.png``,
its white pixels are not used.
The images of fisheye and division lenses (``camera_model`` as in COLMAP, or ``is_fisheye``, with ``k1`` to ``k4``) are undistorted
on reading; a panorama (EQUIRECTANGULAR) becomes six frames, see ``PANORAMA_FACES``. Frames whose image is missing are left out, and missing depth images too, with a remark that counts them. ``applied_transform`` and ``applied_scale`` record transformations that were already applied to the poses. They are
not undone, so the world is that of the file. A sequence is ordered by ``time`` or ``timestamp`` of the frames (seconds), or
by the number that names the file in ``source``; where a frame lacks all of them, by name. Other keys are ignored.

Images are used as they are stored: poses and intrinsics describe that raster, so the EXIF orientation is not applied.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from bidnerf_core.camera import Camera, Raster, same_aspect
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, FileNames
from bidnerf_core.datasets.incomplete import present, remark
from bidnerf_core.datasets.reader import OpenQuestion, Reader, ReadOptions
from bidnerf_core.datasets.rgbd import DepthFile, read_rgbd
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits
from bidnerf_core.datasets.transforms_json import SPLITS, FrameRecord, file_of, read_splits
from bidnerf_core.depth import DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, HiddenColour, hides_everything, read_mask
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Background, background_colour, is_file, read_header

DYNAMIC_MASK = "dynamic_mask_"
"""Prefix of instant-ngp's masks, which lie next to the images."""


class TransformsReader(Reader):
    """Reader for folders with ``transforms*.json``."""

    accepts: tuple[OpenQuestion, ...] = ("depth_unit",)
    expected = "transforms.json or transforms_train.json, transforms_val.json, transforms_test.json"

    def recognises(self, path: Path) -> bool:
        return any((path / name).is_file() for name in ("transforms.json", *map(file_of, SPLITS)))

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        return self._open(path, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        return self._open(path, options).sequence()

    def _open(self, path: Path, options: ReadOptions) -> TransformsDataset:
        return TransformsDataset(path, read_splits(path), options.background, options.depth_unit)


class TransformsDataset(SplitDataset[FrameRecord]):
    """Views of a folder with ``transforms.json``; see ``Dataset``."""

    def __init__(
        self,
        path: Path,
        frames: dict[str, list[FrameRecord]],
        background: Background | None = None,
        depth_unit: float | None = None,
    ) -> None:
        self._files = _Files(path, frames)
        super().__init__(Splits(path, self._files.splits), background)
        units = {frame.unit for group in frames.values() for frame in group}
        self.unit = units.pop() if len(units) == 1 else None
        self._read_depth = DepthReader()
        steps = {frame.depth_unit for group in frames.values() for frame in group}
        self.depth_unit = depth_unit or (steps.pop() if len(steps) == 1 else None)
        self._by_images = background is None
        self._scaled: set[tuple[int, int, int, int]] = set()  # sizes of images and cameras already reported
        self._first: tuple[str, int, int] | None = (
            None  # file, width and height of the first image whose camera has no size
        )

    @cached_property
    def background(self) -> tuple[float, float, float]:
        """The requested colour; by default white if the first image of a split has an alpha channel, else black."""
        if self._by_images and any(map(self._has_alpha, self._frames.first())):
            return background_colour("white")
        return self._background

    def image_file(self, split: str, name: str) -> Path:
        """Return the image file of a frame. Raises ``InputError`` if there is none."""
        ((_, frame),) = self._frames.select(split, [name])
        return self._files.images[frame]

    def _frame(self, frame: FrameRecord, name: str) -> Frame:
        path, depth = self._files.images[frame], None
        if frame in self._files.depth:
            unit = self.depth_unit or frame.depth_unit
            depth = DepthFile(self._files.depth[frame], unit, self._read_depth)

        def camera_of(width: int, height: int) -> Camera:
            whole = self._size_of_camera(frame, path, width, height)
            camera = frame.camera.intrinsics(*whole)
            return camera if whole == (width, height) else camera.resized(width, height)

        def hidden_of(width: int, height: int) -> Bool[Tensor, "h w"] | None:
            return self._hidden(frame, (width, height))

        return read_rgbd(name, path, camera_of, self.background, depth, hidden_of)

    def _hidden(self, frame: FrameRecord, size: tuple[int, int]) -> Bool[Tensor, "h w"] | None:
        """Return what the frame's masks hide."""
        found = [read_mask(path, Raster(*size), size, hides) for path, hides in self._masks(frame)]
        return torch.stack(found).any(0) if found else None

    def _masks(self, frame: FrameRecord) -> list[tuple[Path, HiddenColour]]:
        """Return the frame's masks and the colours that are hidden: black in nerfstudio's ``mask_path``, white in instant-ngp's."""
        masks: list[tuple[Path, HiddenColour]] = []
        if frame in self._files.masks:
            masks.append((self._files.masks[frame], "black"))
        image = self._files.images[frame]
        beside = image.with_name(f"{DYNAMIC_MASK}{image.stem}.png")
        if is_file(beside):
            masks.append((beside, "white"))
        return masks

    def wholly_hidden(self, split: str) -> list[str]:
        """Return the frames of a split of which a mask leaves nothing visible."""
        frames = self._frames.select(split)
        return [name for name, frame in frames if any(hides_everything(*mask) for mask in self._masks(frame))]

    def _pose(self, frame: FrameRecord) -> SE3:
        return frame.T_world_camera

    def _size_of_camera(self, frame: FrameRecord, path: Path, width: int, height: int) -> tuple[int, int]:
        """Return the image size that the camera describes: the file's own, or one with the same aspect ratio.

        Raises ``InputError`` for any other size. A camera without a size describes the first such image,
        taken with the same lens.
        """
        camera = frame.camera
        expected, whose = (camera.width or width, camera.height or height), "w and h say"
        if camera.width is None and camera.height is None:
            self._first = self._first or (path.name, width, height)
            expected, whose = self._first[1:], f"{self._first[0]} is"
        elif (width, height) != expected and same_aspect((width, height), expected):
            if (width, height, *expected) not in self._scaled:
                self._scaled.add((width, height, *expected))
                remark(
                    frame.record.where,
                    f"{path.name} is {width}x{height}, but w and h are {expected[0]}x{expected[1]}; cameras are"
                    " scaled to the images",
                )
            return expected
        if (width, height) != expected:
            raise frame.record.error(
                f"{path.name} is {width}x{height}", expected=f"{expected[0]}x{expected[1]} as {whose}"
            )
        return expected

    def _has_alpha(self, frame: FrameRecord) -> bool:
        try:
            return read_header(self._files.images[frame]).has_alpha
        except InputError:  # the error is raised again when that frame is read
            return False


class _Files:
    """The images, depth images and masks of the frames; missing ones are left out, and counted in a remark."""

    def __init__(self, folder: Path, splits: dict[str, list[FrameRecord]]) -> None:
        self._folder, self._names = folder, FileNames(folder)
        frames = list({id(frame): frame for group in splits.values() for frame in group}.values())
        images = {frame: self._names.find(frame.file_path, IMAGE_ENDINGS) for frame in frames}
        self.images = {frame: path for frame, path in images.items() if path is not None}
        there = set(
            present(frames, self.images.__contains__, folder, lambda frame: frame.file_path, self._no_image)
        )
        kept = {split: [frame for frame in group if frame in there] for split, group in splits.items()}
        self.splits = {split: group for split, group in kept.items() if group}
        measured = [frame for frame in frames if frame in there and frame.depth_path is not None]
        depth = {frame: self._names.find(frame.depth_path) for frame in measured if frame.depth_path}
        self.depth = {frame: path for frame, path in depth.items() if path is not None}
        present(
            measured,
            self.depth.__contains__,
            folder,
            lambda frame: frame.depth_path,
            noun="depth image",
        )
        hiding = [frame for frame in frames if frame in there and frame.mask_path is not None]
        masks = {frame: self._names.find(frame.mask_path) for frame in hiding if frame.mask_path}
        self.masks = {frame: path for frame, path in masks.items() if path is not None}
        present(hiding, self.masks.__contains__, folder, lambda frame: frame.mask_path, self._no_mask, "mask")
        self._remark_names()

    def _no_image(self, frame: FrameRecord) -> InputError:
        tried = self._folder / frame.file_path
        return frame.record.error(
            f"no image {tried}",
            expected="that file (also tried with image extensions added, in upper and lower case)",
        )

    def _no_mask(self, frame: FrameRecord) -> InputError:
        return frame.record.error(
            f"no mask {self._folder / str(frame.mask_path)}", expected="that file (mask_path)"
        )

    def _remark_names(self) -> None:
        """Report names that differ from the file names by more than an added extension."""
        for frame, path in self.images.items():
            written = frame.record.text("file_path") or ""
            if not str(path).startswith(str(self._folder / written)):
                remark(
                    self._folder,
                    f"file_path {written!r} is taken for {path.relative_to(self._folder)}, and others likewise",
                )
                return


reader = TransformsReader()
