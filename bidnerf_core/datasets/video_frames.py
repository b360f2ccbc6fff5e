"""The frames of a video file by number, for recordings whose poses refer to them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

from bidnerf_core.datasets.video import opened_video, require_av, stored_pixels
from bidnerf_core.errors import InputError
from bidnerf_core.io import reason

FORWARD = 90
"""Number of frames up to which decoding continues instead of seeking; phones write a key frame about once a second."""


class VideoFrames:
    """The frames of a video in chronological order, as stored, without the rotation in the metadata.

    Raises ``InputError`` if the file is not a video, and if the extra ``video`` is missing.
    """

    def __init__(self, path: Path) -> None:
        require_av(path)
        self.path = path
        with opened_video(path) as (container, stream):
            self.size = (int(stream.codec_context.width), int(stream.codec_context.height))
            try:
                self._times = sorted(
                    packet.pts
                    for packet in container.demux(stream)
                    if packet.pts is not None and not packet.is_discard
                )
            except (OSError, ValueError) as error:
                raise self._broken(0, error) from error
        self._open: ExitStack | None = None
        self._decoded: Iterator[Any] = iter(())
        self._next = 0  # number of the next frame to decode

    def __len__(self) -> int:
        return len(self._times)

    def read(self, number: int) -> UInt8[Tensor, "h w 3"]:
        """Return the pixels of a frame. Raises ``InputError`` if the file ends before it."""
        if not 0 <= number < len(self):
            raise InputError(f"has {len(self)} frames, but frame {number} is needed", where=self.path)
        try:
            if self._open is None or not self._next <= number <= self._next + FORWARD:
                self._seek(number)
            for picture in self._decoded:
                if picture.pts is not None and picture.pts >= self._times[number]:
                    self._next = number + 1
                    return torch.from_numpy(stored_pixels(picture))
        except (OSError, ValueError, MemoryError) as error:
            self.close()
            raise self._broken(number, error) from error
        self.close()
        raise self._broken(number, ValueError("no further frame could be decoded"))

    def close(self) -> None:
        """Close the file; reading another frame reopens it."""
        if self._open is not None:
            self._open.close()
        self._open, self._next = None, 0

    def _seek(self, number: int) -> None:
        """Seek to the key frame before a frame."""
        self.close()
        self._open = ExitStack()
        container, stream = self._open.enter_context(opened_video(self.path))
        if number:
            container.seek(self._times[number], stream=stream, backward=True)
        self._decoded = container.decode(stream)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the open file, which another process cannot use."""
        return {**self.__dict__, "_open": None, "_decoded": iter(()), "_next": 0}

    def _broken(self, number: int, error: Exception) -> InputError:
        return InputError(
            f"breaks off at frame {number} ({reason(error)})",
            where=self.path,
            expected="a complete video file",
        )
