"""Video files as sequences; needs the extra ``video`` (imageio-ffmpeg, which brings ffmpeg along).

Frames are decoded one after another, each with its time stamp from the file, in seconds from the start: phones record at a
varying rate. A rotation in the file's metadata is applied, so the camera is that of the upright image. A video does not record
its focal length, so the camera has to be given, or assumed.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import UInt8

from bidnerf_core.camera.source import CameraSource, Raster
from bidnerf_core.datasets.sequence import TimedFrame
from bidnerf_core.errors import InputError
from bidnerf_core.frames.frame import Frame
from bidnerf_core.io.files import open_binary
from bidnerf_core.io.images import LARGEST_IMAGE

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".3gp", ".ts", ".mts")
INPUT = ("-hide_banner", "-nostdin", "-nostats", "-protocol_whitelist", "file,pipe", "-i")
AS_PICTURES = (
    "-map",
    "0:v:0",
    "-vf",
    "showinfo=checksum=0",
    "-fps_mode",
    "passthrough",
    "-f",
    "image2pipe",
    "-c:v",
    "ppm",
    "-",
)
AS_LIST = ("-map", "0:v:0", "-c", "copy", "-f", "framecrc", "-")
PICTURE_TIME = re.compile(rb"showinfo.* pts_time: *(-?\d[\d.e+-]*)")
LONGEST_LISTING = 60.0
"""Seconds that ffmpeg may take to list the frames of a file, without decoding any."""


@dataclass(frozen=True)
class Video:
    """The frames of a video file in chronological order; see ``FrameSequence``.

    Its length is the number of frames in the file; a trimmed video shows fewer. Iteration raises ``InputError`` where the
    file breaks off.
    """

    path: Path
    camera: CameraSource
    ffmpeg: str
    count: int

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[TimedFrame]:
        with _decoding(self.ffmpeg, self.path) as decoder:
            for number, (time, pixels) in enumerate(decoder):
                yield TimedFrame(time, self._frame(pixels, number))

    def _frame(self, pixels: UInt8[np.ndarray, "h w 3"], number: int) -> Frame:
        rgb = torch.from_numpy(pixels.astype(np.float32) / 255)
        found = self.camera.find(self.path, Raster(pixels.shape[1], pixels.shape[0]))
        return Frame(
            f"{number:06d}", rgb, found.intrinsics, camera_source=found.description,
            focal_is_approximate=found.approximate,
        )  # fmt: skip


def open_video(path: Path, camera: CameraSource) -> Video:
    """Open a video file. Raises ``InputError`` if it is not one, if there is no camera, and if the extra is missing."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise InputError(
            f"{path}: reading a video needs the extra 'video' (pip install 'bidnerf[video]'); or extract its frames to a folder"
        ) from error
    camera.require(path, "a video does not record its focal length")
    with open_binary(path, "a video file"):
        pass
    ffmpeg = get_ffmpeg_exe()
    return Video(path, camera, ffmpeg, _count(ffmpeg, path))


def _count(ffmpeg: str, path: Path) -> int:
    """Return the number of frames of a file, except those before time 0, which were trimmed."""
    try:
        listed = subprocess.run(
            [ffmpeg, "-loglevel", "error", *INPUT, str(path.resolve()), *AS_LIST],
            capture_output=True,
            timeout=LONGEST_LISTING,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{path}: not listed within {LONGEST_LISTING:g} s, expected a video file") from error
    rows = [line.split(b",") for line in listed.stdout.splitlines() if not line.startswith(b"#")]
    count = sum(int(row[2]) >= 0 for row in rows if len(row) > 2)
    if not count:
        raise InputError(
            f"{path}: not readable as a video ({_last_line(listed.stderr)}), expected a video file"
        )
    return count


class _Decoder:
    """Iterates over (time in seconds, pixels) of the frames that a running ffmpeg writes."""

    def __init__(self, path: Path, process: subprocess.Popen[bytes], log: IO[bytes]) -> None:
        assert process.stdout is not None
        self._path, self._process, self._log, self._pictures = path, process, log, process.stdout
        self._times, self._partial, self._last = deque[float](), b"", "ffmpeg gives no reason"

    def __iter__(self) -> Iterator[tuple[float, np.ndarray]]:
        number = 0
        while (pixels := self._picture(number)) is not None:
            self._read_log()
            if not self._times:
                raise self._broken(number, "a frame without a time stamp")
            yield self._times.popleft(), pixels
            number += 1
        failed = self._process.wait() != 0
        self._read_log()
        if failed or number == 0:
            raise self._broken(number, self._last)

    def _picture(self, number: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """Read a PPM image, or return None at the end."""
        if not (magic := self._pictures.readline()):
            return None
        size = self._pictures.readline().split()
        if magic != b"P6\n" or len(size) != 2 or self._pictures.readline() != b"255\n":
            raise self._broken(number, "a picture that is not RGB of 8 bit")
        width, height = map(int, size)
        if width * height > LARGEST_IMAGE:
            raise self._broken(
                number, f"{width}x{height} pixels, expected at most {LARGEST_IMAGE // 10**6} megapixels"
            )
        content = self._pictures.read(3 * width * height)
        if len(content) < 3 * width * height:
            raise self._broken(number, "the picture is cut off")
        return np.frombuffer(content, np.uint8).reshape(height, width, 3)

    def _read_log(self) -> None:
        """Collect the time stamps that ffmpeg has logged; it logs each frame before writing it."""
        *lines, self._partial = (self._partial + self._log.read()).split(b"\n")
        self._times += [float(found[1]) for line in lines if (found := PICTURE_TIME.search(line))]
        self._last = _last_line(b"\n".join(line for line in lines if b"showinfo" not in line)) or self._last

    def _broken(self, number: int, reason: str) -> InputError:
        return InputError(
            f"{self._path}: breaks off at frame {number} ({reason}), expected a whole video file"
        )


@contextmanager
def _decoding(ffmpeg: str, path: Path) -> Iterator[_Decoder]:
    """Run ffmpeg until the context ends."""
    with tempfile.NamedTemporaryFile() as log, Path(log.name).open("rb") as written:
        command = [ffmpeg, "-xerror", *INPUT, str(path.resolve()), *AS_PICTURES]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log)
        try:
            yield _Decoder(path, process, written)
        finally:
            process.kill()
            process.communicate()


def _last_line(log: bytes) -> str:
    lines = [line.strip() for line in log.decode("utf-8", "replace").splitlines() if line.strip()]
    return lines[-1][:120] if lines else ""
