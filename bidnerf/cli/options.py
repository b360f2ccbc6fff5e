"""Options that several commands share, as annotations and as dataclasses, and their checks."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from bidnerf.cli.output import say
from bidnerf.cli.parser import FLAG, Option, Settings
from bidnerf_core import datasets, mapping
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.registry import USUAL_FEATURES, USUAL_METHOD
from bidnerf_core.settings import LARGEST_SEED, WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.camera import CameraSource, Intrinsics
    from bidnerf_core.datasets import QuerySource
    from bidnerf_core.maps import Map

TEST_IMAGES = DatasetOptions(split="test")
"""The default options for images with which a map is tested."""

MapFolder: TypeAlias = Annotated[Path, Option("MAP", "folder of a map, as written by 'bidnerf train'", positional=True)]
Method: TypeAlias = Annotated[str, Option("NAME", "how poses are found, one of 'bidnerf plugins methods'")]
Device: TypeAlias = Annotated[str, Option("NAME", "device on which the field computes: cpu, cuda ...")]
Host: TypeAlias = Annotated[
    str | None,
    Option("ADDRESS", "address to listen on, such as 0.0.0.0; others then need a token", "this machine only"),
]
Port: TypeAlias = Annotated[int, WholeNumbers(0, 65535), Option("N", "port to listen on; 0 picks a free one")]
Seed: TypeAlias = Annotated[int, WholeNumbers(0, LARGEST_SEED), Option("N", "seed of every random choice")]
Json: TypeAlias = Annotated[bool, FLAG, Option(None, "print JSON: one value on a line")]
Names: TypeAlias = tuple[str, ...]


BakeSettings: TypeAlias = Annotated[
    Any,
    Settings(lambda *_: mapping.BakeConfig(), "settings of the surface and the landmarks"),
]
PointChoice: TypeAlias = Annotated[
    Any,
    Settings(lambda *_: datasets.SparseChoice(), "which points of a COLMAP model are used"),
]


def _method_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    from bidnerf_core.localization import find_method

    with wrong_usage():
        return find_method(values["method"]).settings(values["preset"])


@dataclass(frozen=True)
class MethodOptions:
    """How poses are found."""

    method: Method = USUAL_METHOD
    preset: Annotated[
        str | None,
        Option("NAME", "method settings to begin with, such as the paper's (default: the usual ones)"),
    ] = None
    config: Annotated[Any, Settings(_method_settings, "settings of the method")] = None


@dataclass(frozen=True)
class MapOptions:
    """The map that is written, and its landmarks."""

    overwrite: Annotated[bool, FLAG, Option(None, "replace the map in --out")] = False
    no_bake: Annotated[bool, FLAG, Option(None, "leave the surface and landmarks to 'bidnerf bake'")] = False
    landmark_features: Annotated[
        str, Option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'")
    ] = USUAL_FEATURES
    device: Device = "cpu"


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


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """Convert an ``InputError`` in the block to ``UsageError``, for arguments that are wrong whatever files contain."""
    try:
        yield
    except InputError as error:
        raise UsageError(error) from error


@dataclass(frozen=True)
class CameraOptions:
    """The camera of images whose format stores none (default: from EXIF or the map)."""

    focal: Annotated[float | None, Option("PX", "focal length in pixels of the image file")] = None
    hfov: Annotated[float | None, Option("DEG", "horizontal field of view of the upright image")] = None

    def __post_init__(self) -> None:
        require_one({"--focal": self.focal, "--hfov": self.hfov})

    def source(self, images: DatasetOptions, assumed: Sequence[Intrinsics] = ()) -> CameraSource:
        """Return the camera source for single images, where ``assumed`` are candidates for unknown cameras."""
        from bidnerf_core.camera import CameraSource

        require_one({"--camera": images.camera, "--focal": self.focal, "--hfov": self.hfov})
        assert images.camera is None or isinstance(images.camera, str | Path)
        return CameraSource(images.camera, self.focal, self.hfov, tuple(assumed))


@dataclass(frozen=True)
class QueryOptions:
    """Photos and frames."""

    camera: CameraOptions = CameraOptions()
    depth: Annotated[
        tuple[Path, ...],
        Option("FILE...", "depth images or .npy files of the photos, in the same order, or matched by name"),
    ] = ()
    depth_points: Annotated[
        Path | None,
        Option(
            "FILE",
            "points measured by a sensor, in the camera frame, metres: rows of x y z, .npy, or .npz; or the folder of a"
            " COLMAP sparse model, whose points are used where the frames observe them",
        ),
    ] = None
    frame: Annotated[
        Names,
        Option("NAME...", "frames of a dataset, together as a rig (default: each frame of the split on its own)"),
    ] = ()
    window: Annotated[
        int,
        WholeNumbers(1),
        Option("K", "combine each frame with those before it in the split, K in all, as a rig"),
    ] = 1
    model_points: PointChoice = None

    def __post_init__(self) -> None:
        twice = next((name for name in self.frame if self.frame.count(name) > 1), None)
        if twice is not None:
            raise UsageError(f"--frame names {twice} more than once", expected="each once")
        if self.window > 1 and len(self.frame) > 1:
            raise UsageError(
                f"--window {self.window} with {len(self.frame)} frames",
                expected="one: the last of the window",
            )

    def open(
        self,
        paths: Sequence[Path],
        images: DatasetOptions,
        assumed: Sequence[Intrinsics],
        scene: Map | None = None,
    ) -> QuerySource:
        """Return the queries named by the QUERY arguments: image files and folders of photos, or one dataset.

        ``scene`` is the map, or None if there are several maps. Raises ``InputError`` if the arguments hold neither
        photos nor a dataset, and ``UsageError`` for options that apply only to the other kind.
        """
        from bidnerf_core.datasets import (
            DatasetFrames,
            DepthPoints,
            Photos,
            SparsePoints,
            depth_files,
            find_reader,
            photo_files,
        )
        from bidnerf_core.io import IMAGE_SUFFIXES
        from bidnerf_core.maps import named_poses

        points = None
        if self.depth_points is not None and scene is not None:
            points = DepthPoints(self.depth_points, None)
            if self.depth_points.is_dir():
                sparse = SparsePoints(self.depth_points, named_poses(scene.info), self.model_points)
                say(sparse.summary)
                points = DepthPoints(self.depth_points, sparse)
        background = None if scene is None else scene.bounds.background
        is_dataset = (p.suffix.lower() not in IMAGE_SUFFIXES and find_reader(p) is not None for p in paths)
        if self.frame or any(is_dataset):
            if len(paths) > 1:
                raise UsageError(f"{len(paths)} queries including a dataset", expected="only the dataset")
            refuse(
                {"--depth": self.depth, "--focal": self.camera.focal, "--hfov": self.camera.hfov},
                f"is for photos, but {paths[0]} is a dataset, which has its own; to use its images as photos, name the files",
            )
            dataset = replace(images, background=background).open(paths[0])
            source: QuerySource = DatasetFrames(dataset, images.split, self.frame, self.window, points)
            kind = "frames; name one by --frame"
        else:
            if self.window > 1:
                raise UsageError(f"--window {self.window} needs known relative poses", expected="a dataset")
            files = photo_files(paths, self.depth)
            if not self.depth:
                of_depth = {
                    "--depth-unit": images.depth_unit,
                    "--register-depth": images.registration or None,
                }
                refuse(of_depth, "was given without --depth", expected="the depth image that it belongs to")
            options = replace(images, camera=self.camera.source(images, assumed), background=background)
            source = Photos(files, options, depth_files(files, self.depth), points)
            kind = "photos; expected one photo"
        if points is not None and points.sparse is None and len(source.names) > 1:
            raise UsageError(f"points of a single camera, but {len(source.names)} {kind}", where=points.path)
        return source
