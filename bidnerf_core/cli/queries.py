"""The images that ``localize`` and ``view`` look for: the user's own photos, or frames of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.options import Names, PointChoice, require_one
from bidnerf_core.cli.output import say
from bidnerf_core.cli.parser import Option
from bidnerf_core.errors import UsageError
from bidnerf_core.settings import WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.camera import CameraSource, Intrinsics
    from bidnerf_core.datasets import DatasetOptions, QuerySource
    from bidnerf_core.maps import Map


@dataclass(frozen=True)
class CameraOptions:
    """The camera of images whose format stores none (default: from EXIF or the map)."""

    focal: Annotated[float | None, Option("PX", "focal length in pixels of the image file")] = None
    hfov: Annotated[float | None, Option("DEG", "horizontal field of view of the upright image")] = None

    def __post_init__(self) -> None:
        require_one({"--focal": self.focal, "--hfov": self.hfov})

    def source(self, images: DatasetOptions, assumed: Sequence[Intrinsics] = ()) -> CameraSource:
        """Return the source of the cameras of single images."""
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
        Option(
            "NAME...", "frames of a dataset, together as a rig (default: each frame of the split on its own)"
        ),
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
        """Return the queries for the QUERY arguments: image files and folders of them, or one dataset.

        ``scene`` is the map, or None if there are several. Raises ``InputError`` if there is nothing of either kind, and
        ``UsageError`` for options that belong to the other kind.
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
        from bidnerf_core.evaluation import places_of
        from bidnerf_core.io import IMAGE_SUFFIXES

        points = None
        if self.depth_points is not None and scene is not None:
            points = DepthPoints(self.depth_points, None)
            if self.depth_points.is_dir():
                sparse = SparsePoints(self.depth_points, places_of(scene.info), self.model_points)
                say(sparse.summary)
                points = DepthPoints(self.depth_points, sparse)
        background = None if scene is None else scene.bounds.background
        is_dataset = (p.suffix.lower() not in IMAGE_SUFFIXES and find_reader(p) is not None for p in paths)
        if self.frame or any(is_dataset):
            if len(paths) > 1:
                raise UsageError(f"{len(paths)} queries including a dataset", expected="only the dataset")
            given = {
                "--depth": self.depth or None, "--focal": self.camera.focal, "--hfov": self.camera.hfov
            }  # fmt: skip
            for option, value in given.items():
                if value is not None:
                    raise UsageError(
                        f"{option} is for photos, but {paths[0]} is a dataset, which has its own; to use its images as"
                        " photos, name the files"
                    )
            dataset = replace(images, background=background).open(paths[0])
            source: QuerySource = DatasetFrames(dataset, images.split, self.frame, self.window, points)
            kind = "frames; name one by --frame"
        else:
            if self.window > 1:
                raise UsageError(f"--window {self.window} needs known relative poses", expected="a dataset")
            files = photo_files(paths, self.depth)
            of_depth = {"--depth-unit": images.depth_unit, "--register-depth": images.registration}
            for option, setting in of_depth.items():
                if setting and not self.depth:
                    raise UsageError(
                        f"{option} was given without --depth", expected="the depth image that it belongs to"
                    )
            options = replace(images, camera=self.camera.source(images, assumed), background=background)
            source = Photos(files, options, depth_files(files, self.depth), points)
            kind = "photos; expected one photo"
        if points is not None and points.sparse is None and len(source.names) > 1:
            raise UsageError(f"points of a single camera, but {len(source.names)} {kind}", where=points.path)
        return source
