"""The video of a tracked sequence: the camera's images next to the map rendered from the poses found."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.localization import SceneMap
from bidnerf_core.results.answers import Answer
from bidnerf_core.results.overlays import Painter, tile

WRITTEN_SUFFIXES = (".mp4", ".mkv", ".webm")
USUAL_RATE = 30.0
"""Frames per second of sequences without time stamps."""


def check_video(file: Path) -> None:
    """Raise ``InputError``, before any work is done, if a video cannot be written."""
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise InputError(
            "writing a video needs the extra 'video' (pip install 'bidnerf[video]')", where=file
        ) from error
    if file.suffix.lower() not in WRITTEN_SUFFIXES or not file.parent.is_dir():
        endings = ", ".join(WRITTEN_SUFFIXES)
        raise InputError(where=file, expected=f"a name that ends with {endings}, in an existing folder")


class TrackingVideo:
    """Writes a picture for each tracked frame, at the frame rate of the first two."""

    def __init__(self, file: Path, scene: SceneMap) -> None:
        self._file, self._scene = file, scene
        self._partial = file.with_name(f".{file.stem}.partial{file.suffix}")
        self._file_out: Any = None
        self._stream: Any = None
        self._first: tuple[UInt8[np.ndarray, "h w 3"], float | None] | None = None

    def __enter__(self) -> TrackingVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file, which gets its final name only then."""
        if self._stream is None and self._first is not None:
            self._open(self._first[0], USUAL_RATE)
        if self._stream is not None:
            self._file_out.mux(self._stream.encode())
            self._file_out.close()
            self._partial.replace(self._file)

    def add(self, frame: Frame, answer: Answer) -> None:
        """Draw a frame beside the map: its colours or, if none were recorded, its depth as grey values up to 5 m."""
        found, time = answer.found, answer.time
        painter = Painter(self._scene, found.frame_as_taken(frame))
        observed = painter.observed
        if frame.depth is not None and not frame.has_colour:
            grey = (frame.depth.cpu() / 5.0).clamp(0, 1)
            rows, columns = (
                torch.linspace(0, old - 1, new).round().long()
                for old, new in zip(grey.shape, observed.shape[:2], strict=True)
            )
            observed = grey[rows][:, columns][..., None].expand(-1, -1, 3)
        caption = "rendered at the pose found" if found.converged else f"not accepted: {found.outcome}"
        rendered = tile(painter.rendered(found.T_world_camera), caption)
        picture = np.concatenate([tile(observed, f"observed: {frame.name}"), rendered], axis=1)
        picture = np.ascontiguousarray(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])
        if self._first is None:
            self._first = picture, time
            return
        first, began = self._first
        if self._stream is None:
            apart = 0.0 if time is None or began is None else abs(time - began)
            rate = min(60.0, max(1.0, 1 / apart)) if apart else USUAL_RATE
            self._open(first, rate)
        if picture.shape != first.shape:
            size = (first.shape[1], first.shape[0])
            picture = np.asarray(Image.fromarray(picture).resize(size))
        self._write(picture)

    def _open(self, first: UInt8[np.ndarray, "h w 3"], rate: float) -> None:
        """Open the file for pictures of the size of the first one, and write that."""
        import av

        codec = "libvpx-vp9" if self._file.suffix.lower() == ".webm" else "libx264"
        self._file_out = av.open(str(self._partial), "w")
        self._stream = self._file_out.add_stream(
            codec,
            rate=Fraction(rate).limit_denominator(1000),
            options={"crf": "20"},  # almost without visible loss
        )
        self._stream.height, self._stream.width = first.shape[:2]
        self._stream.pix_fmt = "yuv420p"
        self._write(first)

    def _write(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        from av import VideoFrame

        self._file_out.mux(self._stream.encode(VideoFrame.from_ndarray(picture, format="rgb24")))
