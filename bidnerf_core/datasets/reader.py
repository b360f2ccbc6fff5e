"""The interface of a reader for one dataset format, and the options with which it opens a folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias, TypeVar, runtime_checkable

from bidnerf_core.camera import Camera
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.sequence import FrameSequence, sequence_of
from bidnerf_core.depth import FARTHEST
from bidnerf_core.depth import DepthCamera as DepthCamera  # for authors of readers
from bidnerf_core.errors import InputError, InputWarning, enumeration
from bidnerf_core.io import IMAGE_SUFFIXES
from bidnerf_core.io import Background as Background  # for authors of readers
from bidnerf_core.registry import PluginError, Plugins, interface_defects

DepthRegistration: TypeAlias = bool | DepthCamera | str | Path
"""How depth is registered to colour images: from a given sensor or its file, from the format's own sensor
(True), or not at all (False)."""
Answer = TypeVar("Answer")
OpenQuestion = Literal["camera", "register_depth", "depth_unit"]
"""An option of ``ReadOptions`` that a format may leave open."""


@dataclass(frozen=True)
class ReadOptions:
    """The options with which a reader opens a folder.

    ``background`` ("white", "black" or an rgb triple in [0, 1]) lies behind images with an alpha channel;
    None is the format's own. ``camera`` (intrinsics or a file of them), ``register_depth`` and ``depth_unit``
    (metres per step of depth images, instead of the format's) are passed only to readers that accept them.
    """

    background: Background | None = None
    camera: Camera | Path | None = None
    register_depth: DepthRegistration | None = None
    depth_unit: float | None = None

    def sensor(self, folder: Path | str, own: DepthCamera | None = None) -> DepthCamera | None:
        """Return the sensor from which depth is registered, or None if depth is used as it is; ``own`` is the
        format's.

        Raises ``InputError``, whose message begins with ``folder``, for True if the format has no sensor, and
        as ``DepthCamera.read`` does.
        """
        register = self.register_depth
        if register is None:
            return own
        if register is False:
            return None
        if register is True and own is None:
            raise InputError(
                "its depth sensor is not known", where=folder, expected="the file of one (register_depth=)"
            )
        if register is True or isinstance(register, DepthCamera):
            return own if register is True else register
        return DepthCamera.read(Path(register))


def checked_unit(depth_unit: float | None) -> float | None:
    """Return a depth unit as given. Raises ``InputError`` unless it is a positive number of metres per step."""
    if depth_unit is not None and not 0 < depth_unit <= FARTHEST:
        raise InputError(
            f"depth_unit is {depth_unit:g}", expected="a positive number of metres per step, such as 0.001"
        )
    return depth_unit


@runtime_checkable
class Reader(Protocol):
    """A reader for one dataset format. Subclasses inherit the attributes and methods that have a default here."""

    accepts: Collection[OpenQuestion] = ()
    """The options that the format accepts: "camera" if its files have none, "register_depth" if its depth may
    not be registered to its images, "depth_unit" if its depth images may be in another unit. Others are
    rejected before the reader is called."""

    suffixes: Collection[str] = ()
    """The extensions (".r3d") of single files that hold a whole dataset; the paths of such files are passed
    to the reader."""

    @property
    def expected(self) -> str:
        """The files in a folder of this format, for error messages."""
        ...

    def recognises(self, path: Path) -> bool:
        """Return whether a folder has this format; no image is opened."""
        ...

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Return the dataset in a folder. Raises ``InputError`` if it cannot be used."""
        ...

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        """Return the frames in chronological order, including those in no split; by default, all frames in name order."""
        return sequence_of(self.open(path, options))


def _defects(reader: Any) -> Iterator[str]:
    options = ("path", "options")
    methods = {"recognises": ("path",), "open": options, "open_sequence": options}
    yield from interface_defects(reader, ("accepts", "expected"), methods)


ORDER = (
    "transforms", "tum", "twelve-scenes", "seven-scenes", "record3d", "polycam", "stray-scanner", "euroc", "kitti",
    "reality-capture", "colmap",
)  # fmt: skip
"""The bundled readers in the order in which they are tried; a folder may hold files of several formats."""

READERS: Plugins[Reader] = Plugins("readers", _defects, first=ORDER)
"""The readers by name."""


def find_reader(folder: Path) -> Reader | None:
    """Return the reader that recognizes a folder, or None: the first bundled one, or else the only other one.

    A reader that cannot be loaded or fails is reported by an ``InputWarning``. Raises ``InputError`` if
    several third-party readers recognize the folder.
    """
    for name in ORDER:
        if may_hold(READERS[name], folder) and READERS[name].recognises(folder):
            return READERS[name]
    claims = {
        name: reader
        for name, reader in _others()
        if may_hold(reader, folder) and _claims(name, reader, folder)
    }
    if len(claims) > 1:
        raise InputError(
            f"is recognized by the readers {enumeration(list(claims))}",
            where=folder,
            expected="one; uninstall the others",
        )
    return next(iter(claims.values()), None)


def may_hold(reader: Reader, path: Path) -> bool:
    """Return whether ``path`` is a folder, or a file with one of the reader's extensions."""
    return path.is_dir() or path.suffix.lower() in getattr(reader, "suffixes", ())


def opened(reader: Reader, folder: Path, options: ReadOptions) -> Dataset:
    """Return what a reader opens. Raises ``InputError`` if a third-party reader fails, or does not return a dataset."""
    return _answer(reader, folder, Dataset, lambda: reader.open(folder, options))


def opened_sequence(reader: Reader, folder: Path, options: ReadOptions) -> FrameSequence:
    """Return the sequence that a reader opens. Raises ``InputError`` as ``opened`` does."""
    return _answer(reader, folder, FrameSequence, lambda: reader.open_sequence(folder, options))


def _answer(reader: Reader, folder: Path, expected: type, ask: Callable[[], Answer]) -> Answer:
    if any(reader is READERS[name] for name in ORDER):
        return ask()
    who = f"reader {type(reader).__name__}"
    try:
        answer = ask()
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{who} failed to open it: {type(error).__name__}: {error}", where=folder) from error
    if not isinstance(answer, expected):
        raise InputError(
            f"{who} returned a {type(answer).__name__}", where=folder, expected=f"a {expected.__name__}"
        )
    return answer


def file_of_dataset(path: Path) -> str | None:
    """Return a clause that names the folder to give instead of a file in it that describes a dataset, or None."""
    is_photo = path.suffix.lower() in IMAGE_SUFFIXES or not path.is_file()
    return (
        None
        if is_photo or find_reader(path.parent) is None
        else f"is a file of a dataset; give its folder, {path.parent}"
    )


def no_dataset(folder: Path) -> InputError:
    """Return the error for a folder with neither photos nor a dataset, which refers to the list of formats."""
    found = "contains no photos and is no dataset" if any(folder.iterdir()) else "the folder is empty"
    return InputError(f"{found};", where=folder, expected=expected_formats())


def expected_formats(readers: Sequence[Reader] | None = None) -> str:
    """Return the formats that can be read, for messages: all by name, or the files that some readers expect."""
    if readers is not None:
        return "; or ".join(reader.expected for reader in readers)
    return f"photos or a dataset in one of the formats of docs/datasets.md: {', '.join(READERS)}"


def _others() -> Iterator[tuple[str, Reader]]:
    """Yield the readers that are not bundled, except those that cannot be loaded."""
    for name in READERS:
        if name not in ORDER:
            try:
                yield name, READERS.load(name)
            except PluginError as error:
                warnings.warn(str(error), InputWarning, stacklevel=2)


def _claims(name: str, reader: Reader, folder: Path) -> bool:
    try:
        return bool(reader.recognises(folder))
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
        warnings.warn(f"{folder}: reader {name!r} failed to examine it: {why}", InputWarning, stacklevel=2)
        return False
