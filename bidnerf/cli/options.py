"""Options that several commands share, as annotations and as dataclasses, and their checks."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from bidnerf import results
from bidnerf.cli.parameters import FLAG, Check, Group, Option, SettingsGroup, Without
from bidnerf.cli.parser import as_usage_error
from bidnerf_core import datasets, mapping
from bidnerf_core.datasets import TEST_IMAGES as TEST_IMAGES
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.installation import import_extra
from bidnerf_core.io import require_existing
from bidnerf_core.registry import USUAL_FEATURES, USUAL_METHOD, Plugins
from bidnerf_core.settings import EXPERT, LARGEST_SEED, Above, OneOf, WholeNumbers, check_hfov

if TYPE_CHECKING:
    from bidnerf_core.camera import CameraSource, Intrinsics
    from bidnerf_core.datasets import DatasetFrames, Photos
    from bidnerf_core.io import Background


def existing(expected: str) -> Check:
    """Return the check that a path exists, or is a scene in memory, such as demo:blobs; the error says what was ``expected``.

    Of several paths, one has to exist: a single one that is missing does not stop the others.
    """

    def check(given: Path | str | tuple[Path, ...]) -> None:
        paths = given if isinstance(given, tuple) else (given,)
        if not any(str(path).startswith("demo:") or os.path.exists(path) for path in paths):
            require_existing(*paths, expected=expected)

    return Check(check)


def require_map(folder: Path | str) -> None:
    """Raise ``InputError`` unless a folder holds the description of a map."""
    from bidnerf_core.maps import read_description

    if not str(folder).startswith("demo:"):
        read_description(Path(folder))


ImageOptions: TypeAlias = Annotated[
    DatasetOptions, Group("images", "How the images and their depth are read."), Check(DatasetOptions.require_files)
]
MappedImages: TypeAlias = Annotated[ImageOptions, Without("background")]  # in the map, which has a background
SeenImages: TypeAlias = Annotated[MappedImages, Without("largest")]  # localized at the size that the method chooses
QueryImages: TypeAlias = Annotated[SeenImages, Without("split")]  # photos may be queries, which have no splits
WholeImages: TypeAlias = Annotated[SeenImages, Without("masks", "mask_hides")]  # of which every pixel counts
ColourImages: TypeAlias = Annotated[  # whose depth is not used
    WholeImages, Without("register_depth", "depth_unit"), Group("images", "How the images are read.")
]

MapFolder: TypeAlias = Annotated[
    Path, Option("MAP", "folder of a map, as written by 'bidnerf train'", positional=True), Check(require_map)
]
Device: TypeAlias = Annotated[str, Option("NAME", "device to compute on, such as cpu, cuda or cuda:1")]
Host: TypeAlias = Annotated[
    str | None,
    Option("ADDRESS", "address to listen on, such as 0.0.0.0; clients then need a token", "this machine only"),
]
Port: TypeAlias = Annotated[int, WholeNumbers(0, 65535), Option("N", "port to listen on; 0 picks a free one")]
Seed: TypeAlias = Annotated[int, WholeNumbers(0, LARGEST_SEED), Option("N", "seed of every random choice")]
Json: TypeAlias = Annotated[bool, FLAG, Option(None, "print JSON, one value per line")]
First: TypeAlias = Annotated[int | None, WholeNumbers(1), Option("N", "use only the first N images", "all")]
NoDepth: TypeAlias = Annotated[bool, FLAG, EXPERT, Option(None, "leave out measured depth")]
POSE_FILE = Option(
    "POSES",
    lambda: (
        "write the poses to this file, in the format of its ending:"
        f" {', '.join(installed('writers').table)}; .json has all details"
    ),
)
NEW_POSES = Check(lambda path: results.check_pose_file(path))
"""Checks that poses can be written to a file of this name."""
StartFile: TypeAlias = Annotated[Path | None, existing("a pose file")]
Names: TypeAlias = tuple[str, ...]
FrameNames: TypeAlias = Annotated[Names, Option("NAME...", "use only these frames of the dataset", "all of the split")]


BakeSettings: TypeAlias = Annotated[
    Any,
    SettingsGroup(
        "settings of the surface and the landmarks",
        "How the surface and the landmarks of the map are made.",
        lambda *_: mapping.BakeConfig(),
    ),
]
PointChoice: TypeAlias = Annotated[
    Any,
    SettingsGroup(
        "choice of points",
        "Which points of the COLMAP model named by --depth-points are used.",
        lambda *_: datasets.SparseChoice(),
    ),
]


def installed(group: str) -> OneOf:
    """Return the names of the plugins of a group as the values of an option; nothing is imported."""
    return OneOf(Plugins(group, lambda _: iter(())))


MethodName: TypeAlias = Annotated[
    str, installed("methods"), Option("NAME", "method that finds poses, one of 'bidnerf plugins methods'")
]
DaskAddress: TypeAlias = Annotated[
    str | None,
    EXPERT,
    Option("ADDRESS", "address of a dask scheduler whose workers detect and match keypoints, and train cells"),
]
Overwrite: TypeAlias = Annotated[bool, FLAG, Option(None, "replace output that exists")]


def _method_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    from bidnerf_core.localization import find_method

    with wrong_usage():
        return find_method(values["method"]).settings(values["preset"])


@dataclass(frozen=True)
class RunOptions:
    """Where a command computes, what it prints, and whether it replaces its output."""

    device: Device = "cpu"
    json: Json = False
    overwrite: Overwrite = False


@dataclass(frozen=True)
class MethodOptions:
    """How poses are found."""

    method: MethodName = USUAL_METHOD
    preset: Annotated[
        str | None,
        EXPERT,
        Option("NAME", "settings to begin with; bid: paper, paper-scene; inerf: paper", "the usual ones"),
    ] = None
    config: Annotated[
        Any,
        SettingsGroup("settings of the method", "How the method named by --method works.", _method_settings, "methods"),
    ] = None


MethodGroup: TypeAlias = Annotated[MethodOptions, Group("localization", "How poses are found.")]


@dataclass(frozen=True)
class MapOutput(RunOptions):
    """The map that is written, and its landmarks."""

    no_bake: Annotated[bool, FLAG, EXPERT, Option(None, "leave the surface and landmarks to 'bidnerf bake'")] = False
    landmark_features: Annotated[
        str,
        EXPERT,
        installed("features"),
        Option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'"),
    ] = USUAL_FEATURES


NewMap: TypeAlias = Annotated[MapOutput, Group("map", "How the map is made and written.")]


def require_one(values: Mapping[str, object], required: bool = False) -> None:
    """Raise ``UsageError`` if more than one option has a value, or if ``required`` is set and none has."""
    given = [option for option, value in values.items() if value is not None]
    if len(given) > 1:
        raise UsageError(f"{given[0]} and {given[1]} exclude each other", expected="only one of them")
    if required and not given:
        raise UsageError(f"one of {', '.join(values)} is missing")


def refuse(options: Mapping[str, object], reason: str, expected: str | None = None) -> None:
    """Raise ``UsageError`` if one of ``options`` has a value; the message begins with that option and ``reason``."""
    for option, value in options.items():
        if value is not None and value != ():
            raise UsageError(f"{option} {reason}", expected=expected)


def require_device(device: str) -> None:
    """Raise ``UsageError`` if a device does not work here."""
    if device != "cpu":  # which works without a question to torch
        from bidnerf_core.devices import working_device

        with wrong_usage():
            working_device(device)


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """Convert an ``InputError`` in the block to ``UsageError``, for arguments that are wrong whatever files contain."""
    try:
        yield
    except InputError as error:
        raise as_usage_error(error) from error


@dataclass(frozen=True)
class CameraOptions:
    """The camera of images whose format stores none."""

    focal: Annotated[float | None, Above(0.0), Option("PX", "focal length in pixels of the image file")] = None
    hfov: Annotated[float | None, Option("DEG", "horizontal field of view of the upright image")] = None

    def __post_init__(self) -> None:
        if self.hfov is not None:
            check_hfov(self.hfov)
        require_one({"--focal": self.focal, "--hfov": self.hfov})

    def source(self, camera: Any, assumed: Sequence[Intrinsics] = ()) -> CameraSource:
        """Return the camera source for single images: ``camera``, these options or, if unknown, the ``assumed`` cameras."""
        from bidnerf_core.camera import CameraSource

        require_one({"--camera": camera, "--focal": self.focal, "--hfov": self.hfov})
        return CameraSource(camera, self.focal, self.hfov, tuple(assumed))


PhotoCamera: TypeAlias = Annotated[
    CameraOptions,
    Group("camera", "The camera of photos without one of their own. By default, it comes from EXIF or from the map."),
]
NewPhotoCamera: TypeAlias = Annotated[
    CameraOptions,
    Group("camera", "The camera of photos without poses. By default, it is estimated from EXIF and the photos."),
]


@dataclass(frozen=True)
class QueryOptions:
    """Photos and frames."""

    depth: Annotated[
        tuple[Path, ...],
        Option("FILE...", "depth images or .npy files of the photos, in the same order, or matched by name"),
        existing("a depth image"),
    ] = ()
    frame: FrameNames = ()
    first: Annotated[First, EXPERT] = None
    split: Annotated[
        str | None, Option("NAME", "split of the dataset; all: every image with a pose", TEST_IMAGES.split)
    ] = None
    rig: Annotated[bool, FLAG, Option(None, "find one pose for the frames in --frame, together as a rig")] = False
    window: Annotated[
        int,
        EXPERT,
        WholeNumbers(1),
        Option("K", "combine each frame with those before it in the split, K in all, as a rig"),
    ] = 1
    camera: PhotoCamera = CameraOptions()

    def __post_init__(self) -> None:
        twice = next((name for name in self.frame if self.frame.count(name) > 1), None)
        if twice is not None:
            raise UsageError(f"--frame names {twice} more than once", expected="each once")
        if self.rig and not self.frame:
            raise UsageError("--rig was given without --frame", expected="the frames of the rig")
        if self.rig and self.window > 1:
            raise UsageError("--rig and --window exclude each other", expected="only one of them")

    def is_dataset(self, paths: Sequence[Path]) -> bool:
        """Return whether the QUERY arguments are a dataset, rather than photos."""
        from bidnerf_core.io import IMAGE_SUFFIXES

        others = [path for path in paths if path.suffix.lower() not in IMAGE_SUFFIXES]
        if self.frame or not others:  # which is known without the readers
            return bool(others)

        from bidnerf_core.datasets import find_reader

        return any(map(find_reader, others))

    def opener(self, paths: Sequence[Path], images: DatasetOptions) -> QueryOpener:
        """Check the QUERY arguments before a map is loaded, and return a function that opens them.

        The arguments are image files and folders of photos, or one dataset. Raises ``InputError`` if they hold neither,
        and ``UsageError`` for options that apply only to the other kind.
        """
        if self.is_dataset(paths):
            from bidnerf_core.datasets import DatasetFrames

            if len(paths) > 1:
                raise UsageError(f"{len(paths)} queries, one of which is a dataset", expected="the dataset alone")
            refuse(
                {"--depth": self.depth},
                f"is for photos, but {paths[0]} is a dataset, which has its own; leave it out, or name its images as photos",
            )
            camera = images.camera if self.camera == CameraOptions() else self.camera.source(images.camera)

            def frames(_: Sequence[Intrinsics], background: Background | None) -> DatasetFrames:
                dataset = replace(images, camera=camera, background=background).open(paths[0])
                queries = DatasetFrames(dataset, self.split or TEST_IMAGES.split, self.frame, self.window, self.rig)
                return queries.select(range(len(queries.names))[: self.first])

            return frames
        of_dataset = {"--split": self.split, "--frame": self.frame}
        refuse(of_dataset, f"is for a dataset, but {paths[0]} is none; leave it out")
        if self.window > 1:
            raise UsageError(f"--window {self.window} needs known relative poses", expected="a dataset")
        if not self.depth:
            of_depth = {"--depth-unit": images.depth_unit, "--register-depth": images.registration or None}
            refuse(of_depth, "was given without --depth", expected="the depth image that it belongs to")
        require_one({"--camera": images.camera, "--focal": self.camera.focal, "--hfov": self.camera.hfov})

        from bidnerf_core.datasets import Photos, depth_files, photo_files
        from bidnerf_core.io import is_heif, open_binary

        files = photo_files(paths, self.depth)
        for file in filter(Path.is_file, files):
            head = b""
            with contextlib.suppress(InputError), open_binary(file, "an image file") as opened:
                head = opened.read(12)
            if is_heif(head):
                import_extra("pillow_heif", "heif", "reading HEIC", file, "; or convert the photo to JPEG")
        depth = depth_files(files, self.depth)
        return lambda assumed, background: Photos(
            files[: self.first],
            replace(images, camera=self.camera.source(images.camera, assumed), background=background),
            depth,
        )


QueryOpener: TypeAlias = "Callable[[Sequence[Intrinsics], Background | None], Photos | DatasetFrames]"
"""Opens queries, given the cameras assumed for photos without any and the background of the map, if there is one map."""
Queries: TypeAlias = Annotated[QueryOptions, Group("queries", "What is localized, and which depth was measured.")]
