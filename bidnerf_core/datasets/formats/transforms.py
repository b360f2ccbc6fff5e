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

from functools import partial
from pathlib import Path, PurePosixPath

from bidnerf_core.camera import Camera, CameraSource, PanoramaFace, same_aspect
from bidnerf_core.datasets.capture import SPLITS, Capture, DepthFile, MaskFile, Shot, present, remark
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, FileNames
from bidnerf_core.datasets.formats.transforms_json import FrameRecord, file_of, read_splits
from bidnerf_core.datasets.reader import DatasetOptions, OpenQuestion, Reader
from bidnerf_core.depth import DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.io import background_colour, is_file, read_header

DYNAMIC_MASK = "dynamic_mask_"
"""Prefix of instant-ngp's masks, which lie next to the images."""


class TransformsReader(Reader):
    """Reader for folders with ``transforms*.json``."""

    accepts: tuple[OpenQuestion, ...] = ("depth_unit",)
    expected = "transforms.json or transforms_train.json, transforms_val.json, transforms_test.json"

    def recognises(self, path: Path) -> bool:
        return any((path / name).is_file() for name in ("transforms.json", *map(file_of, SPLITS)))

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the frames, and find their files. Raises ``InputError`` if no image is found."""
        listed, names = read_splits(path), FileNames(path)
        frames = [frame for frame, _ in listed]
        images = _files(names, path, {frame: frame.file_path for frame in frames}, "image", IMAGE_ENDINGS)
        depths = _files(names, path, {f: f.depth_path for f in images if f.depth_path}, "depth image")
        masks = _files(names, path, {f: f.mask_path for f in images if f.mask_path}, "mask")
        _remark_names(path, images)
        steps, units = {frame.depth_unit for frame in frames}, {frame.unit for frame in frames}
        read_depth, size = DepthReader(), _first_size(images)
        shots = list[Shot]()
        for frame, splits in ((frame, splits) for frame, splits in listed if frame in images):
            image, depth, mask = images[frame], depths.get(frame), masks.get(frame)
            camera = _camera(frame, size)
            if isinstance(camera, PanoramaFace) and frame.depth_path is not None:
                expected = "none, or pinhole images with depth"
                raise frame.record.error("an equirectangular image has depth", expected=expected)
            dynamic = image.with_name(f"{DYNAMIC_MASK}{image.stem}.png")
            unit = options.depth_unit or frame.depth_unit
            shots.append(
                Shot(
                    image=image,
                    camera=camera,
                    T_world_camera=frame.T_world_camera,
                    time=frame.time,
                    depth=None if depth is None else DepthFile(depth, partial(read_depth, depth, unit)),
                    masks=(
                        *([] if mask is None else [MaskFile(mask)]),
                        *([MaskFile(dynamic, "white")] if is_file(dynamic) else []),
                    ),
                    splits=splits,
                    stem=frame.stem,
                    folders=frame.parts[:-1],
                )
            )
        first = {splits[:1]: images[frame] for frame, splits in reversed(listed) if frame in images}
        white = options.background is None and any(map(_has_alpha, first.values()))
        return Capture(
            path, shots, background_colour("white") if white else options.colour,
            unit=units.pop() if len(units) == 1 else None,
            depth_unit=options.depth_unit or (steps.pop() if len(steps) == 1 else None),
        )  # fmt: skip


def _files(
    names: FileNames,
    folder: Path,
    listed: dict[FrameRecord, PurePosixPath],
    noun: str,
    endings: tuple[str, ...] = ("",),
) -> dict[FrameRecord, Path]:
    """Return the files of the frames that have them; a remark counts the others. Raises ``InputError`` if no image is left."""
    found = {
        frame: file
        for frame, name in listed.items()
        if (file := names.find(name, endings, moved=True)) is not None
    }
    owner: dict[Path, PurePosixPath] = {}
    for frame, file in found.items():  # parts of several names may fit one file
        if owner.setdefault(file, listed[frame]) != listed[frame] and noun == "image":
            expected = f"different images, though {owner[file]} and {listed[frame]} may both be {file}"
            raise frame.record.error("has the image of another frame", expected=expected)

    def missing(frame: FrameRecord) -> InputError:
        tried = (
            " (also tried with image extensions added, in upper and lower case)"
            if noun == "image"
            else " (mask_path)"
        )
        return frame.record.error(f"no {noun} {folder / listed[frame]}", expected=f"that file{tried}")

    present(
        list(listed),
        found.__contains__,
        folder,
        listed.__getitem__,
        None if noun == "depth image" else missing,
        noun,
    )
    return found


def _camera(frame: FrameRecord, size: tuple[int, int] | None) -> Camera | CameraSource:
    """Return the camera of a frame; one without a size describes the first image, since all have the same lens."""
    width, height = frame.camera.width or (size and size[0]), frame.camera.height or (size and size[1])
    if width is None or height is None:  # no image is readable, which is an error when one is read
        return CameraSource()
    return frame.camera.intrinsics(width, height)


def _first_size(images: dict[FrameRecord, Path]) -> tuple[int, int] | None:
    """Return the size of the first readable image. A remark says that cameras are scaled if its camera has another size."""
    for frame, image in images.items():
        try:
            header = read_header(image)
        except InputError:  # raised again when that frame is read
            continue
        size = header.width, header.height
        given = frame.camera.width or size[0], frame.camera.height or size[1]
        if given != size and same_aspect(given, size):
            expected = f"w and h are {given[0]}x{given[1]}; cameras are scaled to the images"
            remark(frame.record.where, f"{image.name} is {size[0]}x{size[1]}, but {expected}")
        return size
    return None


def _has_alpha(image: Path) -> bool:
    try:
        return read_header(image).has_alpha
    except InputError:  # the error is raised again when that frame is read
        return False


def _remark_names(folder: Path, images: dict[FrameRecord, Path]) -> None:
    """Report names that differ from the file names by more than an added extension."""
    for frame, path in images.items():
        written = frame.record.text("file_path") or ""
        if not str(path).startswith(str(folder / written)):
            text = f"file_path {written!r} is taken for {path.relative_to(folder)}, and others likewise"
            return remark(folder, text)


reader = TransformsReader()
