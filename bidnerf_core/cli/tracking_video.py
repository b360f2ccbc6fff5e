"""``bidnerf track --video``: what the camera saw beside what the map shows from the poses found."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from types import TracebackType

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.localization import Localization
from bidnerf_core.rendering import render_image
from bidnerf_core.storage import Map

PANEL_HEIGHT = 240
"""Pixels; the width follows from the first image."""
RENDERED_SIDE = 160
"""Largest side (pixels) of a rendered image before it is enlarged: rendering takes longer than tracking."""
STRIP = 6
"""Pixels of the strip below the images, whose colour says whether the pose was accepted."""
ACCEPTED, LOST = (0.0, 0.62, 0.45), (0.84, 0.37, 0.0)
RATES = 1.0, 60.0
"""Least and largest number of frames a second; without time stamps it is ``USUAL_RATE``."""
USUAL_RATE = 30.0
DEEPEST = 5.0
"""Metres of depth that are drawn white, where only depth was recorded."""


def check_video(file: Path) -> None:
    """Raise ``InputError`` before any work where a video cannot be written."""
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"{file}: writing a video needs the extra 'video' (pip install 'bidnerf[video]')"
        ) from error
    if file.suffix.lower() not in (".mp4", ".mkv", ".webm") or not file.parent.is_dir():
        raise InputError(
            f"{file}: expected a name that ends with .mp4, .mkv or .webm in a folder that exists"
        )


class TrackingVideo:
    """Writes a frame of the video for each frame that is tracked; whole or not at all."""

    def __init__(self, file: Path, scene: Map) -> None:
        self._file, self._scene = file, scene
        self._partial = file.with_name(f".{file.stem}.partial{file.suffix}")
        self._writer: Generator[None, bytes, None] | None = None
        self._size: tuple[int, int] | None = None
        self._waiting: tuple[bytes, float | None] | None = None

    def __enter__(self) -> TrackingVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._waiting is not None:
            self._begin(USUAL_RATE)
        if self._writer is not None:
            self._writer.close()
            os.replace(self._partial, self._file)

    def add(self, frame: Frame, time: float | None, found: Localization) -> None:
        """Draw a frame; the rate is that of the first two."""
        if self._size is None:
            camera = frame.intrinsics
            self._size = (PANEL_HEIGHT, 2 * round(PANEL_HEIGHT * camera.width / camera.height / 2))
        picture = self._drawn(frame, found, self._size)
        if self._writer is not None:
            self._writer.send(picture)
        elif self._waiting is None:
            self._waiting = picture, time
        else:
            before = self._waiting[1]
            apart = None if time is None or before is None else abs(time - before)
            self._begin(min(RATES[1], max(RATES[0], 1 / apart)) if apart else USUAL_RATE)
            assert self._writer is not None
            self._writer.send(picture)

    def _begin(self, rate: float) -> None:
        from imageio_ffmpeg import write_frames

        assert self._size is not None
        assert self._waiting is not None
        height, width = self._size
        self._writer = write_frames(
            str(self._partial), (2 * width, height + STRIP), fps=rate, macro_block_size=2, quality=7
        )
        self._writer.send(None)
        self._writer.send(self._waiting[0])
        self._waiting = None

    def _drawn(self, frame: Frame, found: Localization, size: tuple[int, int]) -> bytes:
        camera = frame.intrinsics
        small = camera.scaled(min(1.0, RENDERED_SIDE / max(camera.width, camera.height)))
        rendered = render_image(self._scene.field, small, found.T_world_camera, self._scene.bounds).rgb
        panels = torch.cat([_resized(_observed(frame), size), _resized(rendered, size)], dim=1)
        strip = torch.tensor(ACCEPTED if found.converged else LOST).expand(STRIP, panels.shape[1], 3)
        picture = (255 * torch.cat([panels, strip]).clamp(0, 1)).round().byte()
        return bytes(picture.contiguous().numpy().tobytes())


def _observed(frame: Frame) -> Float[Tensor, "h w 3"]:
    """Return a frame's colours, or its depth in grey where no colours were recorded."""
    if frame.has_colour or frame.depth is None:
        return frame.rgb.cpu()
    return (frame.depth.cpu() / DEEPEST).clamp(0, 1)[..., None].expand(-1, -1, 3)


def _resized(image: Float[Tensor, "h w 3"], size: tuple[int, int]) -> Float[Tensor, "ph pw 3"]:
    planes = image.float().permute(2, 0, 1)[None]
    return F.interpolate(planes, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
