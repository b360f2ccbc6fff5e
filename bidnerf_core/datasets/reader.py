"""Readers of capture formats, and functions that open datasets, folders of images and videos."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar, cast, runtime_checkable

from bidnerf_core.camera import Camera, CameraSource, Intrinsics
from bidnerf_core.datasets.capture import Capture, drop_missing_files, hold_out, warn_about
from bidnerf_core.datasets.options import DatasetOptions as DatasetOptions
from bidnerf_core.datasets.options import DepthRegistration
from bidnerf_core.depth import DepthCamera as DepthCamera  # for authors of readers
from bidnerf_core.errors import InputError, InputWarning, UsageError, amount, enumeration
from bidnerf_core.frames import MaskFolder, photos_in
from bidnerf_core.io import IMAGE_SUFFIXES, is_file, looks_like_image, require_existing
from bidnerf_core.io import Background as Background  # for authors of readers
from bidnerf_core.registry import PluginError, Plugins, interface_defects

UNREAD_VIDEOS = (
    ".h264",
    ".h265",
    ".264",
    ".265",
    ".hevc",
    ".wmv",
    ".flv",
    ".y4m",
    ".ogv",
    ".vob",
    ".insv",
    ".360",
    ".mjpeg",
)
"""The extensions of videos without times or in containers that are not opened."""
Match = TypeVar("Match")
OpenQuestion = Literal["camera", "focal", "register_depth", "depth_unit", "images"]
"""An option of ``DatasetOptions`` that a format may leave open."""


def read_capture(
    options: DatasetOptions, path: str | Path, readers: Sequence[Reader] | None = None, in_time_order: bool = False
) -> Capture:
    """Read a dataset, or frames in chronological order; see ``DatasetOptions.open`` and ``DatasetOptions.open_sequence``.

    Raises ``InputError`` for options that the format does not accept, and if a third-party reader fails.
    """
    path, or_else = Path(path), ""
    require_existing(path, expected="a dataset, images or a video" if in_time_order else "a dataset")
    options.require_files()
    reader = find_reader(path, readers)
    if reader is None and in_time_order:
        # The readers of photos and videos are not registered: they find no poses.
        from bidnerf_core.datasets.formats.photos import reader as photos
        from bidnerf_core.datasets.formats.photos import video_reader as video

        reader, or_else = next((r for r in (photos, video) if r.recognises(path)), None), f", or {video.expected}"
        if reader is None and path.is_dir():
            raise InputError("no images in it", where=path, expected="image files or a dataset")
    if reader is None:
        raise no_dataset(path, readers, or_else)
    source = options.camera_source
    given: list[tuple[OpenQuestion, bool, str]] = [
        ("camera", source.is_given, "is a dataset with its own cameras; leave out `camera`, `focal` and `hfov`"),
        (
            "register_depth",
            options.registration not in (None, False),
            "has no depth, or its depth is already registered to its images; leave out `register_depth`",
        ),
        (
            "depth_unit",
            options.depth_unit is not None,
            "has no depth images, or depth in a fixed unit; leave out `depth_unit`",
        ),
        (
            "focal",
            source.is_given and source.camera is None,
            "is a dataset; give a camera with all intrinsics (`camera`)",
        ),
        ("images", options.images is not None, "has its images where its format says; leave out images"),
    ]
    for option, is_given, problem in given:
        if is_given and option not in reader.accepts:
            raise UsageError(problem, where=path)
    try:
        capture: Any = reader.read(path, options)
    except Exception as error:
        if isinstance(error, InputError | OSError | MemoryError) or isinstance(reader, Format):
            raise
        raise InputError(
            f"reader {type(reader).__name__} failed to open it: {type(error).__name__}: {error}", where=path
        ) from error
    if not isinstance(capture, Capture):
        raise InputError(
            f"reader {type(reader).__name__} returned a {type(capture).__name__}", where=path, expected="a Capture"
        )
    shots = drop_missing_files(capture)
    farthest = 1e10  # even in millimetres from the centre of the Earth, its surface is at 6.4e9
    positions = {shot.name: shot.T_world_camera.translation for shot in shots if shot.T_world_camera is not None}
    if far := [(name, x) for name, x in positions.items() if not x.abs().max() < farthest]:
        raise InputError(
            f"{far[0][0]} is at {', '.join(f'{x:.3g}' for x in far[0][1].tolist())}",
            where=capture.pose_file or path,
            expected=f"coordinates below {farthest:g}",
        )
    if not capture.splits:
        shots = hold_out(shots, rate=capture.rate)
        posed = [bool(shot.splits) for shot in shots if shot.T_world_camera is not None]
        if not all(posed):
            warn_about(
                path,
                f"the dataset has {sum(posed)} of {amount(len(posed), 'frame')}, {capture.rate:g} per second; the"
                " sequence has all",
            )
    capture = replace(
        capture, shots=[replace(face, name="") for shot in shots for face in shot.faces()], largest=options.largest
    )
    masks = options.mask_folder
    capture = capture if masks is None else capture.with_masks(masks)
    return capture.in_time_order() if in_time_order else capture.require_poses()


def open_dataset(
    path: str | Path,
    background: Background | None = None,
    readers: Sequence[Reader] | None = None,
    camera: Camera | str | Path | None = None,
    register_depth: DepthRegistration | None = None,
    depth_unit: float | None = None,
    masks: str | Path | MaskFolder | None = None,
    images: str | Path | None = None,
) -> Capture:
    """Open the dataset in the folder ``path``, see ``DatasetOptions.open``.

    ``background`` ("white", "black" or an rgb triple in [0, 1]) lies behind images with an alpha channel. It
    defaults to white if the images have one, following NeRF-Synthetic, and to black otherwise. ``camera``
    (intrinsics or a file of them) is for formats that store no camera, such as TUM RGB-D. ``register_depth``
    determines whether depth is registered to the colour camera, and from which sensor; the default depends on
    the format. ``depth_unit`` (metres per step of depth images) overrides the unit of the format. ``masks``
    is a folder of images whose black pixels are ignored (see ``MaskFolder``), ``images`` the folder of the images that
    the files of a dataset list, if they lie elsewhere.
    """
    return DatasetOptions(
        camera, images=images, register_depth=register_depth, depth_unit=depth_unit, masks=masks, background=background
    ).open(path, readers)


def open_sequence(
    path: str | Path,
    *,
    camera: Camera | str | Path | None = None,
    focal: float | None = None,
    hfov: float | None = None,
    assumed: Sequence[Intrinsics] = (),
    readers: Sequence[Reader] | None = None,
    **options: Any,
) -> Capture:
    """Open the frames of ``path`` in chronological order: a dataset, a folder of images, or a video.

    Nothing is decoded yet. The camera of images and videos is ``camera`` (intrinsics or a file), ``focal``
    (pixels) or ``hfov`` (degrees), as in ``Frame.open``. Without these, images use their EXIF; images without a
    focal length, and videos, use one of the ``assumed`` cameras. Datasets have their own cameras, except those
    for which ``open_dataset`` accepts one. Further ``options`` are those of ``DatasetOptions``; depth in a folder
    of images is registered if a sensor is given, and in millimetres unless a unit is given. Raises ``InputError``
    as ``DatasetOptions.open_sequence`` does.
    """
    return DatasetOptions(CameraSource(camera, focal, hfov, tuple(assumed)), **options).open_sequence(path, readers)


@runtime_checkable
class Reader(Protocol):
    """A reader for one dataset format. Subclasses inherit the attributes and methods that have defaults here."""

    accepts: Collection[OpenQuestion] = ()
    """The options that the format accepts: "camera" if its files have none, "focal" if a focal length suffices for it,
    "register_depth" if its depth may not be registered to its images, "depth_unit" if its depth images may be in another
    unit, "images" if its files list images that may lie elsewhere. Others are rejected before the reader is called."""

    may_lack_poses: bool = False
    """Whether the format is that of recordings, whose poses may be missing: they are then photos with cameras and times."""

    suffixes: Collection[str] = ()
    """The extensions (".r3d") of single files that hold a whole dataset; the paths of such files are passed
    to the reader."""

    precedence: int = 0
    """If several readers recognize a folder, the one of highest precedence reads it; a tie is an error. Bundled readers
    state 10 to 50: first the formats into which others are converted, then those of recordings, whose poses are metric,
    and last those of reconstructions from their photos."""

    @property
    def expected(self) -> str:
        """The files in a folder of this format, for error messages."""
        ...

    @property
    def summary(self) -> str:
        """One line about the format, for lists of plugins; by default ``expected``."""
        return self.expected

    def recognises(self, path: Path) -> bool:
        """Return whether a folder has this format; no image is opened."""
        ...

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Return the images in a folder. Raises ``InputError`` if the folder cannot be used.

        The capture includes images without a pose. If it has no splits, every eighth image with a pose is held out.
        """
        ...


@dataclass(eq=False)
class Format(Generic[Match]):
    """A bundled reader, made of a function that recognizes a folder and a function that reads it."""

    summary: str
    expected: str
    find: Callable[[Path], Match | None]
    """Returns what identifies the format in a folder, such as its metadata file, or a false value."""
    load: Callable[[Path, Match, DatasetOptions], Capture]
    """Reads a folder, given what ``find`` returned for it."""
    accepts: Collection[OpenQuestion] = ()
    suffixes: Collection[str] = ()
    precedence: int = 0
    may_lack_poses: bool = False

    def recognises(self, path: Path) -> bool:
        return bool(self.find(path))

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        return self.load(path, cast(Match, self.find(path)), options)  # which recognises ensured


def first_file(path: Path, *names: str) -> Path | None:
    """Return the first of the files that exists in a folder, such as the metadata file that identifies its format."""
    return next((file for name in names if is_file(file := path / name)), None)


READERS: Plugins[Reader] = Plugins(
    "readers",
    lambda reader: interface_defects(
        reader, ("accepts", "expected"), {"recognises": ("path",), "read": ("path", "options")}
    ),
)
"""The readers by name."""


def find_reader(folder: Path, given: Sequence[Reader] | None = None) -> Reader | None:
    """Return the reader of highest precedence that recognizes a folder, or the first of those ``given``; None if none does.

    A third-party reader that cannot be loaded or fails is reported by an ``InputWarning`` when its turn comes. Raises
    ``InputError`` if several readers of the same precedence recognize the folder.
    """
    if given is not None:
        return next((each for each in given if may_hold(each, folder) and each.recognises(folder)), None)
    readers = dict[str, Reader | PluginError]()
    for name in READERS:
        try:
            readers[name] = READERS.load(name)
        except PluginError as error:
            readers[name] = error

    def precedence(name: str) -> int:
        return getattr(readers[name], "precedence", Reader.precedence)

    for _, names in groupby(sorted(readers, key=precedence, reverse=True), precedence):
        claims = {name: reader for name in names if (reader := _if_recognised(name, readers[name], folder))}
        if len(claims) > 1:
            raise InputError(
                f"is recognized by the readers {enumeration(list(claims))}",
                where=folder,
                expected="one format, or one reader installed for it",
            )
        if claims:
            return next(iter(claims.values()))
    return None


def _if_recognised(name: str, reader: Reader | PluginError, path: Path) -> Reader | None:
    """Return the reader if it recognizes a path; a third-party reader that fails does not, and is reported."""
    if isinstance(reader, PluginError):
        warnings.warn(str(reader), InputWarning, stacklevel=3)
        return None
    try:
        return reader if may_hold(reader, path) and reader.recognises(path) else None
    except Exception as error:
        if isinstance(reader, Format):
            raise
        warn_about(path, f"reader {name!r} failed to examine it: {type(error).__name__}: {error}")
        return None


def may_hold(reader: Reader, path: Path) -> bool:
    """Return whether ``path`` is a folder, or a file with one of the reader's extensions."""
    return path.is_dir() or path.suffix.lower() in getattr(reader, "suffixes", ())


def file_of_dataset(path: Path) -> str | None:
    """If ``path`` is a file of a dataset, return an error clause asking for its folder instead; otherwise return None."""
    if path.suffix.lower() in IMAGE_SUFFIXES or not path.is_file() or find_reader(path.parent) is None:
        return None
    return f"is a file of a dataset; give its folder, {path.parent}"


def no_dataset(path: Path, readers: Sequence[Reader] | None = None, or_else: str = "") -> InputError:
    """Return the error, with a remedy, for a folder that is not a dataset or a file given instead of a folder.

    ``or_else`` names the alternatives to a dataset folder that are accepted.
    """
    if not path.is_dir():
        if (instead := file_of_dataset(path)) is not None:
            return InputError(f"{instead}{or_else}", where=path)
        if path.suffix.lower() in UNREAD_VIDEOS:
            return InputError(
                "is a video in a container that is not read", where=path, expected="MP4: convert it first"
            )
        if looks_like_image(path):
            several = "a folder of photos of the scene from several places, a video, or "
            return InputError(
                "is a single photo", where=path, expected=f"{several if or_else else ''}the folder of a dataset"
            )
        is_archive = path.suffix.lower() in (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
        return InputError(
            "is an archive" if is_archive else "is a file",
            where=path,
            expected=f"the folder of a dataset{or_else}{'; unpack the archive first' if is_archive else ''}",
        )
    if (path / "cameras.json").is_file() and (path / "point_cloud").is_dir():
        return InputError(
            "is the output of 3D Gaussian Splatting",
            where=path,
            expected="'bidnerf import' with its point_cloud.ply, or the capture that it was trained on",
        )
    if (path / "map.json").is_file():
        return InputError("is a map already, as bidnerf writes them", where=path, expected="photos or a dataset")
    children = (child for child in sorted(path.iterdir()) if child.is_dir())
    if (inside := next((child for child in children if find_reader(child, readers)), None)) is not None:
        return InputError("no dataset found", where=path, expected=f"one of the folders in it, such as {inside.name}")
    found = "contains no photos and is no dataset;" if any(path.iterdir()) else "the folder is empty;"
    if photos := photos_in(path)[0]:
        found = (
            f"no dataset found: {amount(len(photos), 'photo')} without poses; 'bidnerf poses' finds them, or give"
            " those of an AR framework or a robot;"
        )
    return InputError(
        found,
        where=path,
        expected=f"photos or a dataset in one of the formats of docs/datasets.md: {', '.join(READERS)}"
        if readers is None
        else "; or ".join(reader.expected for reader in readers),
    )
