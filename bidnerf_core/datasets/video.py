"""Frames of video files; reading them needs the extra ``video`` (PyAV, whose wheels include FFmpeg's libraries).

Frame timestamps are read from the file, in seconds from the start, because phones record at a varying rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from bidnerf_core.datasets.capture import BreaksOff
from bidnerf_core.errors import InputError
from bidnerf_core.installation import import_extra
from bidnerf_core.io import LARGEST_IMAGE, library_errors, looks_like_image, open_binary, reason

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".3gp", ".ts", ".mts")
OPTIONS = {
    "protocol_whitelist": "file",  # a playlist disguised as a video must not open connections ...
    "format_whitelist": "mov,matroska,avi,mpeg,mpegts,mpegvideo",  # ... nor other files
}


class Video:
    """The frames of a video file by number, in chronological order, and their ``times`` (seconds).

    Raises ``InputError`` if the file is not a video, and if the extra ``video`` is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        open_binary(path, "a video file").close()
        with _open_stream(path) as (container, stream):
            self.size = int(stream.codec_context.width), int(stream.codec_context.height)
            found = [packet for packet in container.demux(stream) if packet.pts is not None]
            start = (container.start_time or 0) / 1e6  # microseconds
            shown = [(p.pts, float(p.pts * stream.time_base) - start) for p in found if not p.is_discard]
            # Frames before the start are only needed to decode what follows.
            shown = sorted(frame for frame in shown if frame[1] >= 0)
            if not shown:
                raise ValueError("it has no frames")
        self._stamps, self.times = [stamp for stamp, _ in shown], [time for _, time in shown]
        self._open: ExitStack | None = None
        self._decoded: Iterator[Any] = iter(())
        self._next = 0  # number of the next frame to decode

    def __len__(self) -> int:
        return len(self.times)

    def pixels(self, number: int, is_upright: bool = False) -> UInt8[np.ndarray, "h w 3"]:
        """Return the pixels of a frame, as stored or rotated upright according to the metadata.

        HDR colours are kept as coded, without tone mapping. Raises ``InputError`` if the file ends before the frame.
        """
        picture = self._picture(number)
        try:
            pixels: np.ndarray = picture.to_ndarray(format="rgb24")
        except OSError:
            # FFmpeg lacks the colour space that the file names, such as BT.2020 with constant luminance.
            picture.colorspace = 9  # BT.2020's YCbCr-to-RGB matrix (ITU-T H.273)
            pixels = picture.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(pixels, round(picture.rotation / 90))) if is_upright else pixels

    def close(self) -> None:
        """Close the file; reading another frame reopens it."""
        if self._open is not None:
            self._open.close()
        self._open, self._next = None, 0

    def _picture(self, number: int) -> Any:
        if not 0 <= number < len(self):
            raise InputError(f"has {len(self)} frames, but frame {number} is needed", where=self.path)
        why: Exception = ValueError("no further frame could be decoded")
        try:
            # Phones write a key frame about once a second: decoding on is as fast as seeking up to about 90 frames.
            if self._open is None or not self._next <= number <= self._next + 90:
                self.close()
                self._open = ExitStack()
                container, stream = self._open.enter_context(_open_stream(self.path))
                if number:
                    container.seek(self._stamps[number], stream=stream, backward=True)  # to the key frame before it
                self._decoded = container.decode(stream)
            for picture in self._decoded:
                if picture.pts is not None and picture.pts >= self._stamps[number]:
                    self._next = number + 1
                    return picture
        except (OSError, ValueError, MemoryError) as error:
            why = error
        self.close()
        raise BreaksOff(
            f"breaks off at frame {number} ({reason(why)})", where=self.path, expected="a complete video file"
        ) from why

    def __getstate__(self) -> dict[str, Any]:
        """Exclude the open file, which another process cannot use, from the pickled state."""
        return {**self.__dict__, "_open": None, "_decoded": iter(()), "_next": 0}


@dataclass(frozen=True)
class VideoPicture:
    """A video frame used as the image of a shot, as stored or rotated upright according to the metadata."""

    video: Video
    number: int
    is_upright: bool = False

    def pixels(self) -> UInt8[Tensor, "h w 3"]:
        """Decode this frame. Raises ``InputError`` if the file ends before the frame."""
        return torch.from_numpy(self.video.pixels(self.number, self.is_upright))

    def __str__(self) -> str:
        return f"{self.video.path}: frame {self.number}"


def is_video(path: Path) -> bool:
    """Return whether a file is a video, judging by its name or first bytes, without decoding it."""
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return not path.is_dir()
    head = b""
    with suppress(InputError), open_binary(path, "a video file") as file:
        head = file.read(12)
    mp4 = head[4:8] == b"ftyp" and not looks_like_image(path)
    # The second is the beginning of Matroska and WebM.
    return mp4 or head[:4] == b"\x1aE\xdf\xa3" or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")


@contextmanager
def _open_stream(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video file; only its first video stream is read.

    Raises ``InputError`` if it is not a video, and, with what to install, if the extra ``video`` is missing.
    """
    av = import_extra("av", "video", "reading a video", path, "; or extract its frames to a folder")
    with (
        library_errors(path, "not readable as a video", "a video file", OSError, ValueError),
        av.open(str(path.resolve()), options=OPTIONS) as container,
    ):
        if not container.streams.video:
            raise ValueError("it has no video stream")
        stream = container.streams.video[0]
        stream.codec_context.options = {"max_pixels": str(LARGEST_IMAGE)}
        yield container, stream
