"""The camera of a photo, also from the ``transforms*.json`` of a dataset whose frames state theirs."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from bidnerf_core.camera import Camera, CameraSource, camera_of_record
from bidnerf_core.errors import InputError
from bidnerf_core.io import IMAGE_SUFFIXES, ImageSource, Record, parse_record, read_file, read_header


def photo_camera(given: Camera | CameraSource | str | Path | None, image: object, name: str) -> CameraSource:
    """Return the camera source of an image called ``name``, with its own camera if the ``given`` file states one for each frame.

    Of a file whose frames state cameras, that of the frame with this name is taken or, without one, the only camera. Raises
    ``InputError`` if there are several.
    """
    source = given if isinstance(given, CameraSource) else CameraSource(given)
    if not isinstance(source.camera, str | Path):
        return source
    path = Path(source.camera)
    content = read_file(path, "a camera") if path.is_file() else b""
    if not content.lstrip().startswith(b"{") or b'"frames"' not in content:
        return source
    size = read_header(image).size if isinstance(image, ImageSource) else (0, 0)
    cameras = _frame_cameras(str(path), content, size)
    wanted = {cameras[name]} if name in cameras else {*cameras.values()}
    if len(wanted) > 1:
        expected = f"one, or one of a frame named {name!r}"
        raise InputError(f"holds {len(wanted)} cameras", where=path, expected=expected)
    return replace(source, camera=wanted.pop()) if wanted else source


@lru_cache(maxsize=4)
def _frame_cameras(where: str, content: bytes, size: tuple[int, int]) -> dict[str, Camera]:
    """Return the cameras of frames by the stems of their images; none if the file itself states the camera, or no frame does."""
    file, cameras = parse_record(where, content), dict[str, Camera]()
    stating = ("fl_x", "camera_angle_x", "camera_model")
    for number, entry in enumerate(file.items("frames") or ()):
        if isinstance(entry, dict) and any(key in entry for key in stating):
            record = Record(f"{where}: frame {number}", entry, file)
            image = PureWindowsPath(record.text("file_path") or "")  # which also splits at the separators of others
            stem = image.stem if image.suffix.lower() in IMAGE_SUFFIXES else image.name
            cameras[stem] = camera_of_record(record, size)
    return cameras
