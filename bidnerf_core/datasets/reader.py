"""The interface of a reader of one dataset format, and the options with which it opens a folder."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, TypeAlias, runtime_checkable

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.sequence import FrameSequence, sequence_of
from bidnerf_core.depth.registration import DepthCamera
from bidnerf_core.errors import InputError
from bidnerf_core.io.images import Background

DepthRegistration: TypeAlias = bool | DepthCamera | str | Path
"""The registration of depth to colour images: from a sensor or a file of one, from the format's own (True), or none (False)."""
OpenQuestion = Literal["camera", "register_depth"]
"""An option of ``ReadOptions`` that a format may leave open."""


@dataclass(frozen=True)
class ReadOptions:
    """The options with which a reader opens a folder.

    ``background`` ("white", "black" or an rgb triple in [0, 1]) lies behind images with an alpha channel; None is the format's
    own. ``camera`` (intrinsics or a file of them) and ``register_depth`` reach only the readers that accept them.
    """

    background: Background | None = None
    camera: Intrinsics | Path | None = None
    register_depth: DepthRegistration | None = None

    def sensor(self, folder: Path | str, own: DepthCamera | None = None) -> DepthCamera | None:
        """Return the sensor from which depth is registered, or None where depth is used as it is; ``own`` is the format's.

        Raises ``InputError``, which begins with ``folder``, for True where the format has none, and as ``DepthCamera.read``.
        """
        register = self.register_depth
        if register is None:
            return own
        if register is False:
            return None
        if register is True and own is None:
            raise InputError(
                f"{folder}: has no depth sensor that is known, expected a file of one (register_depth=)"
            )
        if register is True or isinstance(register, DepthCamera):
            return own if register is True else register
        return DepthCamera.read(Path(register))


@runtime_checkable
class Reader(Protocol):
    """A reader of one dataset format. Subclasses inherit the attributes and methods that have a default here."""

    accepts: Collection[OpenQuestion] = ()
    """The options that the format leaves open: "camera" where its files have none, "register_depth" where its depth may not be
    registered to its images. Others are refused before the reader is called."""

    @property
    def expected(self) -> str:
        """The files that a folder of this format holds, for error messages."""
        ...

    def recognises(self, path: Path) -> bool:
        """Return whether a folder has this format; no image is opened."""
        ...

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Return the dataset in a folder. Raises ``InputError`` if it cannot be used."""
        ...

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        """Return the frames in chronological order, also those that no split has; by default, all frames in order of names."""
        return sequence_of(self.open(path, options))
