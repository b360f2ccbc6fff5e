"""Folders of images, and videos, without poses.

Images are ordered by time if every name is a timestamp (``12.345.png``), else in natural name order. The depth of ``NAME.png``,
if any, is ``NAME.depth.png``, as written by ``bidnerf render``. Unlike the images of datasets, photos are turned upright
according to their EXIF orientation, and their camera is read from EXIF unless the user gives one, as in ``Frame.open``.

A video is turned by the rotation in its metadata, so its camera describes the upright image. Videos do not record a focal
length, so the camera has to be given or assumed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.camera import WAYS
from bidnerf_core.datasets.capture import Capture, Colour, Shot
from bidnerf_core.datasets.frame_cameras import photo_camera
from bidnerf_core.datasets.reader import DatasetOptions, Format
from bidnerf_core.datasets.video import VIDEO_SUFFIXES, Video, VideoPicture, is_video
from bidnerf_core.depth import MILLIMETRE, DepthCamera
from bidnerf_core.errors import InputError
from bidnerf_core.frames import BLACK, DEPTH_STEM, Frame, photos_in


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoShot(Shot):
    """A photo, optionally with a depth image in steps of ``depth_unit`` metres that is registered from ``sensor``.

    If it ``awaits_background``, transparent pixels get the background of the map in which the photo is localized.
    """

    image: Path
    depth_image: Path | None = None
    depth_unit: float | None = None
    sensor: DepthCamera | None = None
    awaits_background: bool = False

    def frame(self, background: Colour = BLACK, side: int | None = None) -> Frame:
        """Read the photo as ``Frame.read`` does."""
        return Frame.read(
            self.image,
            photo_camera(self.camera, self.image, self.stem),
            depth=self.depth_image,
            depth_unit=self.depth_unit,
            sensor=self.sensor,
            background=None if self.awaits_background else background,
            largest=side,
        ).replace(name=self.name)


def _read(path: Path, photos: list[Path], options: DatasetOptions) -> Capture:
    """List the images. Raises ``InputError`` for a depth sensor that cannot be read."""
    sensor, shots = options.sensor(path), list[Shot]()
    for photo in photos:
        depth = photo.with_name(f"{photo.stem}{DEPTH_STEM}.png")
        shots.append(
            PhotoShot(
                image=photo,
                camera=options.camera_source,
                time=timestamp(photo.stem),
                depth_image=depth if depth.is_file() else None,
                depth_unit=options.depth_unit or MILLIMETRE,
                sensor=sensor,
            )
        )
    return Capture(path, shots, options.colour)


def timestamp(stem: str) -> float | None:
    """Return the time (seconds) in a file name such as ``1305031102.175304.png``; None for names without a fraction."""
    return float(stem) if re.fullmatch(r"\d+\.\d+", stem) else None


def _read_video(path: Path, is_video: bool, options: DatasetOptions) -> Capture:
    """List the frames of a video. Raises ``InputError`` if the file is not a video, and if there is no camera."""
    source, video = options.camera_source, Video(path)
    if not source.is_given and not source.assumed:
        raise InputError("a video does not record its focal length", where=path, expected=f"a camera: {WAYS}")
    return Capture(
        path,
        [
            Shot(
                image=VideoPicture(video, number, is_upright=True),
                camera=source,
                time=time,
                stem=f"{number:06d}",
                tells_camera=True,
            )
            for number, time in enumerate(video.times)
        ],
    )


reader = Format(
    "images without poses; the depth of NAME.png is NAME.depth.png, in millimetres",
    "image files",
    lambda path: photos_in(path)[0] if path.is_dir() else [],
    _read,
    ("camera", "focal", "register_depth", "depth_unit"),
)
video_reader = Format(
    "videos without poses, whose camera is given (extra 'video')",
    f"a video ({', '.join(VIDEO_SUFFIXES)})",
    is_video,
    _read_video,
    ("camera", "focal"),
    VIDEO_SUFFIXES,
)
