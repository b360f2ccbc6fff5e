"""Video files as sequences; needs the extra ``video`` (PyAV, whose wheels include FFmpeg's libraries).

Frames are decoded one after another, each with its time stamp from the file, in seconds from the start:
phones record at a varying rate. A rotation in the file's metadata is applied, so the camera is that of the
upright image. A video does not record its focal length, so the camera has to be given or assumed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from bidnerf_core.camera import CameraSource, Raster
from bidnerf_core.datasets.sequence import TimedFrame
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.io import LARGEST_IMAGE, looks_like_image, open_binary, reason

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".3gp", ".ts", ".mts")
MICROSECONDS = 1_000_000
"""The unit of a file's start time, per second."""
MATROSKA = b"\x1aE\xdf\xa3"
"""First bytes of Matroska and WebM."""
BT_2020 = 9
"""The YCbCr-to-RGB matrix (ITU-T H.273) used in place of those that FFmpeg lacks."""
OPTIONS = {"protocol_whitelist": "file"}
"""A playlist disguised as a video must not open connections."""


@dataclass(frozen=True)
class Video:
    """The frames of a video file in chronological order; see ``FrameSequence``.

    Its length is the number of frames in the file. Iteration raises ``InputError`` if the file is truncated.
    """

    path: Path
    camera: CameraSource
    count: int

    def __len__(self) -> int:
        return self.count

    @property
    def names(self) -> list[str]:
        """The names of the frames, which are their numbers."""
        return [_name(number) for number in range(self.count)]

    def __iter__(self) -> Iterator[TimedFrame]:
        for number, (time, pixels) in enumerate(pictures(self.path)):
            yield TimedFrame(time, self._frame(pixels, number))

    def _frame(self, pixels: UInt8[np.ndarray, "h w 3"], number: int) -> Frame:
        found = self.camera.find(self.path, Raster(pixels.shape[1], pixels.shape[0]))
        return Frame.taken(
            _name(number), found.camera, torch.from_numpy(pixels), camera_source=found.description,
            focal_is_approximate=found.approximate,
        )  # fmt: skip


def _name(number: int) -> str:
    return f"{number:06d}"


def pictures(path: Path) -> Iterator[tuple[float, UInt8[np.ndarray, "h w 3"]]]:
    """Yield the time (seconds) and the upright pixels of each frame of a video that ``open_video`` has
    accepted.

    Raises ``InputError`` if the file is truncated.
    """
    number = 0
    with opened_video(path) as (container, stream):
        decoded = container.decode(stream)
        while True:
            try:
                if (picture := next(decoded, None)) is None:
                    break
                time, pixels = _time(container, picture), _upright(picture)
            except (OSError, ValueError, MemoryError) as error:
                raise _broken(path, number, error) from error
            if time < 0:  # trimmed, but needed to decode what follows
                continue
            yield time, pixels
            number += 1
    if number == 0:
        raise _broken(path, 0, ValueError("no frame could be decoded"))


def _broken(path: Path, number: int, error: Exception) -> InputError:
    return InputError(
        f"breaks off at frame {number} ({reason(error)})", where=path, expected="a complete video file"
    )


def is_video(path: Path) -> bool:
    """Return whether a file is a video, judging by its name or first bytes; it is not decoded."""
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return True
    try:
        with open_binary(path, "a video file") as file:
            head = file.read(12)
    except InputError:
        return False
    mp4 = head[4:8] == b"ftyp" and not looks_like_image(path)
    return mp4 or head[:4] == MATROSKA or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")


def open_video(path: Path, camera: CameraSource) -> Video:
    """Open a video file. Raises ``InputError`` if it is not one, if there is no camera, and if the extra is missing."""
    require_av(path)
    camera.require(path, "a video does not record its focal length")
    return Video(path, camera, frame_count(path))


def frame_count(path: Path) -> int:
    """Return the number of frames in a video file without decoding any. Raises ``InputError`` as ``open_video`` does."""
    require_av(path)
    with open_binary(path, "a video file"):
        pass
    with opened_video(path) as (container, stream):
        try:
            shown = [
                packet
                for packet in container.demux(stream)
                if packet.pts is not None and not packet.is_discard
            ]
        except (OSError, ValueError) as error:
            raise _no_video(path, reason(error)) from error
    if not shown:
        raise _no_video(path, "it has no frames")
    return len(shown)


def require_av(path: Path) -> None:
    """Raise ``InputError``, which states what to install, if the extra ``video`` is missing."""
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise InputError(
            "reading a video needs the extra 'video' (pip install 'bidnerf[video]'); or extract its frames"
            " to a folder",
            where=path,
        ) from error


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video file; only its first video stream is read. Raises ``InputError`` if it is not a video."""
    import av

    try:
        container = av.open(str(path.resolve()), options=OPTIONS)
    except (OSError, ValueError) as error:
        raise _no_video(path, reason(error)) from error
    with container:
        if not container.streams.video:
            raise _no_video(path, "it has no video stream")
        stream = container.streams.video[0]
        stream.codec_context.options = {"max_pixels": str(LARGEST_IMAGE)}
        yield container, stream


def _no_video(path: Path, why: str) -> InputError:
    return InputError(f"not readable as a video ({why})", where=path, expected="a video file")


def _time(container: Any, picture: Any) -> float:
    """Return the time (seconds) of a picture since the start of the file."""
    if picture.pts is None:
        raise ValueError("a frame without a time stamp")
    return float(picture.pts * picture.time_base) - (container.start_time or 0) / MICROSECONDS


def _upright(picture: Any) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray(np.rot90(stored_pixels(picture), round(picture.rotation / 90)))


def stored_pixels(picture: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Return the pixels of a picture of any bit depth; HDR colours are kept as coded, without tone mapping."""
    try:
        pixels: np.ndarray = picture.to_ndarray(format="rgb24")
    except OSError:  # FFmpeg does not support the colour space that the file names, such as BT.2020 with constant luminance
        picture.colorspace = BT_2020
        pixels = picture.to_ndarray(format="rgb24")
    return pixels
