"""Folders with ``transforms.json``: the dialects of NeRF's Blender scenes and of nerfstudio (and instant-ngp).

A folder holds some of ``transforms_train.json``, ``transforms_val.json`` and ``transforms_test.json``, or
one ``transforms.json`` whose lists ``train_filenames``, ``val_filenames`` and ``test_filenames`` define the
splits.

These keys are read from a frame or, where it lacks them, from the file: ``camera_angle_x [camera_angle_y]`` or
``fl_x [fl_y]``, ``cx cy w h``, ``k1 k2 p1 p2 k3``, ``camera_model``, ``depth_unit_scale_factor`` (metres per unit, default
0.001; as in nerfstudio it applies to ``.npy`` depth as well) or instant-ngp's ``integer_depth_scale``. These are read only from
a frame: ``file_path`` (its extension may be missing, its separators may be those of Windows, its upper and lower case may differ
from the file's), ``transform_matrix``, ``depth_file_path`` or instant-ngp's ``depth_path`` (planar z of the image's aspect ratio
and of any size; each pixel has the depth of the nearest measurement; see ``depth_image`` for values that count as not measured),
``mask_path`` (an image whose black pixels are not used). If instant-ngp's ``dynamic_mask_NAME.png`` lies beside ``NAME.png``,
its white pixels are not used.
A scene of ScanNet++ has ``dslr/nerfstudio/transforms.json``, with the images in ``dslr/resized_images`` and a split "test" in
``test_frames``.
The images of fisheye and division lenses (``camera_model`` as in COLMAP, or ``is_fisheye``, with ``k1`` to ``k4``) are undistorted
on reading; a panorama (EQUIRECTANGULAR) becomes six frames, see ``PANORAMA_FACES``. Frames whose image is missing are left out,
and so are missing depth images, with a remark that counts them. ``applied_transform`` and ``applied_scale`` record
transformations that were already applied to the poses. They are not undone, so the world frame is the file's. A sequence is
ordered by ``time`` or ``timestamp`` of the frames (seconds), or by the number that names the file in ``source``; if a frame
lacks all of them, by name. Other keys are ignored.

Images are used as they are stored: poses and intrinsics describe that raster, so the EXIF orientation is not applied.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import get_args

from bidnerf_core.camera import Camera, CameraSource, PanoramaFace, camera_of_record, same_aspect
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot, warn_about
from bidnerf_core.datasets.file_names import FileNames
from bidnerf_core.datasets.formats.transforms_json import SPLIT_FILES, FrameRecord, read_splits
from bidnerf_core.datasets.reader import DatasetOptions, Format, first_file
from bidnerf_core.depth import DepthReader
from bidnerf_core.frames import MaskFile
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.io import background_colour, find_header, is_file


def _read(path: Path, folder: Path, options: DatasetOptions) -> Capture:
    """Read the frames and find their files. Raises ``InputError`` if a file is invalid."""
    others = [] if folder == path else [folder.parent / "resized_images", folder.parent / "resized_anon_masks"]
    listed, names = read_splits(folder), FileNames(folder, *others)
    named = FileNames(folder, *others, images=options.image_folder)
    images, owner = (
        [named.image(frame.record.text("file_path") or "") for frame, _ in listed],
        dict[Path, FrameRecord](),
    )
    for (frame, _), image in zip(listed, images, strict=True):
        if (other := owner.setdefault(image, frame)).file_path != frame.file_path:
            raise frame.record.error(
                "has the image of another frame",
                expected=f"different images, though {other.file_path} and {frame.file_path} may both be {image}",
            )
    steps = {frame.depth_unit for frame, _ in listed if frame.depth_path}
    units = {str(frame.record.value("unit")) for frame, _ in listed}  # which bidnerf's own files state
    read_depth, size = DepthReader(), _first_size([frame for frame, _ in listed], images)
    shots, first = list[Shot](), dict[tuple[str, ...], Path]()
    for (frame, splits), image in zip(listed, images, strict=True):
        camera: Camera | CameraSource = CameraSource()  # if no image is readable, which is an error when one is read
        if size is not None or None not in (frame.record.size("w"), frame.record.size("h")):
            # Without a size in the file, the first image's size is used, since all images share the lens.
            camera = camera_of_record(frame.record, size or (0, 0))
        if isinstance(camera, PanoramaFace) and frame.depth_path is not None:
            raise frame.record.error(
                "an equirectangular image has depth", expected="none, or pinhole images with depth"
            )
        depth = frame.depth_path and names.path(frame.depth_path, moved=True)
        unit = options.depth_unit or frame.depth_unit
        masks = [MaskFile(names.path(frame.mask_path, moved=True))] if frame.mask_path else []
        dynamic = image.with_name(f"dynamic_mask_{image.stem}.png")  # where instant-ngp looks for a mask
        masks += [MaskFile(dynamic, "white")] if is_file(dynamic) else []
        shots.append(
            Shot(
                image=image,
                camera=camera,
                T_world_camera=frame.T_world_camera,
                time=frame.time,
                depth=DepthFile(depth, partial(read_depth, depth, unit)) if depth else None,
                masks=tuple(masks),
                splits=splits,
                stem=frame.stem,
                folders=frame.parts[:-1],
            )
        )
        if is_file(image):
            first.setdefault(splits[:1], image)
    headers = map(find_header, first.values()) if options.background is None else ()
    white = any(header is not None and header.has_alpha for header in headers)
    return Capture(
        path,
        shots,
        background_colour("white") if white else options.colour,
        unit=next((unit for unit in get_args(LengthUnit) if units == {unit}), None),
        depth_unit=options.depth_unit or (steps.pop() if len(steps) == 1 else None),
    )


def _find(path: Path) -> Path | None:
    """Return the folder of the files: the given one, or that of ScanNet++."""
    return next(
        (
            folder
            for folder in (path, path / "nerfstudio", path / "dslr/nerfstudio")
            if first_file(folder, "transforms.json", *SPLIT_FILES.values())
        ),
        None,
    )


def _first_size(frames: Sequence[FrameRecord], images: Sequence[Path]) -> tuple[int, int] | None:
    """Return the size of the first readable image. If its camera has another size, a remark states that cameras are scaled."""
    sized = (
        (frame, image, header.size)
        for frame, image in zip(frames, images, strict=True)
        if (header := find_header(image)) is not None
    )
    if (found := next(sized, None)) is None:
        return None
    frame, image, size = found
    given = frame.record.size("w") or size[0], frame.record.size("h") or size[1]
    if given != size and same_aspect(given, size):
        warn_about(
            frame.record.where,
            f"{image.name} is {size[0]}x{size[1]}, but w and h are {given[0]}x{given[1]}; cameras are scaled to the"
            " images",
        )
    return size


reader = Format(
    "NeRF-Synthetic, nerfstudio, instant-ngp, ScanNet++, NeRFCapture, KIRI Engine, and datasets that bidnerf writes",
    "transforms.json or transforms_train.json, transforms_val.json, transforms_test.json",
    _find,
    _read,
    ["depth_unit", "images"],
    precedence=50,  # datasets of other formats are converted to this one in place
)
