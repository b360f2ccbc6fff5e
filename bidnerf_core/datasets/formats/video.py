"""Video files without poses, see ``bidnerf_core.datasets.video``.

A rotation in the file's metadata is applied, so the camera is that of the upright image. A video does not record its focal
length, so the camera has to be given or assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from bidnerf_core.camera import CameraSource, Raster
from bidnerf_core.datasets.capture import Capture, Colour, Shot
from bidnerf_core.datasets.reader import DatasetOptions, Format
from bidnerf_core.datasets.video import VIDEO_SUFFIXES, Video, is_video, require_av
from bidnerf_core.frames import BLACK, Frame
from bidnerf_core.io import reduced


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoShot(Shot):
    """A frame of a video without poses."""

    video: Video
    number: int

    def frame(self, background: Colour = BLACK, side: int | None = None) -> Frame:
        """Decode the frame; its camera is that of the upright image."""
        pixels = torch.from_numpy(self.video.upright(self.number))
        source = self.camera if isinstance(self.camera, CameraSource) else CameraSource(self.camera)
        whole = source.find(self.video.path, Raster(pixels.shape[1], pixels.shape[0]))
        found = whole.at_most(side)
        if found is not whole:
            pixels = reduced(pixels, found.camera.width, found.camera.height)
        return Frame.taken(
            self.name,
            found.camera,
            pixels,
            camera_source=found.description,
            focal_is_approximate=found.approximate,
        )


def _read(path: Path, found: bool, options: DatasetOptions) -> Capture:
    """List the frames. Raises ``InputError`` if it is not a video, and if there is no camera."""
    require_av(path)
    source = options.camera_source
    source.require(path, "a video does not record its focal length")
    video = Video(path)
    shots = [
        VideoShot(video=video, number=number, camera=source, time=time, stem=f"{number:06d}")
        for number, time in enumerate(video.times)
    ]
    return Capture(path, shots)


reader = Format(
    f"a video ({', '.join(VIDEO_SUFFIXES)})", is_video, _read, ("camera", "focal"), VIDEO_SUFFIXES
)
