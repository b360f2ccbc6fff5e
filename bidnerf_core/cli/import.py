"""``bidnerf import``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import Device, FeaturesName, require, wrong_usage
from bidnerf_core.cli.parser import Flag, Option, Settings, Without, parse
from bidnerf_core.cli.progress import working
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError

LEAST_SCALE = 1e-9


def _importer_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    """Return the default settings of the importer, if the arguments determine it."""
    from bidnerf_core.maps import IMPORTERS, importer_of

    if values["as_"] is not None:
        with wrong_usage():
            return IMPORTERS.load(values["as_"]).config_type()
    for word in words:
        try:
            if not word.startswith("-"):
                return importer_of(Path(word))[1].config_type()
        except InputError:  # not the file; or an invalid one, which is reported later
            continue
    return None


@dataclass(frozen=True)
class Import:
    """Build a map from a field that was trained elsewhere, or from an existing COLMAP model.

    The installed importer that recognizes the file reads it. The command reports what it found: counts, what was left out, and
    the extent, since most files store no unit. With --photos, landmarks are built from photos, as in 'train'; otherwise from
    images rendered by the field, which match photos less well.

    The points and tracks of a COLMAP model (a project folder or the model in it) become the landmarks, and answers are in its
    world; its files are not changed. Such a map localizes photos without a field, which 'bidnerf train FILE --out MAP' adds.
    """

    file: Annotated[
        Path,
        Option("FILE", "file or folder of a trained field, or folder of a COLMAP project", positional=True),
    ]
    out: Annotated[Path, Option("MAP", "folder for the map")]
    as_: Annotated[
        str | None, Option("NAME", "one of 'bidnerf plugins importers'", "the one that recognizes the file")
    ] = None
    scale: Annotated[float, Option("FACTOR", "metres per unit of length in the file")] = 1.0
    T_world_file: Annotated[
        Path | None,
        Option(
            "POSE", "file of a pose (JSON, 4x4) that takes the scaled coordinates of the file to the world"
        ),
    ] = None
    photos: Annotated[
        Path | None,
        Option(
            "DATA", "dataset whose photos, with poses in the world, provide the landmarks", "rendered images"
        ),
    ] = None
    landmark_features: FeaturesName = "sift"
    overwrite: Annotated[Flag, Option(None, "replace the map in --out")] = False
    no_bake: Annotated[Flag, Option(None, "leave the surface and landmarks to 'bidnerf bake'")] = False
    device: Device = "cpu"
    images: Annotated[
        DatasetOptions,
        Without("register_depth", "depth_unit", "masks", "mask_hides", "largest", "background"),
    ] = DatasetOptions()
    config: Annotated[Any, Settings(_importer_settings)] = None
    """settings of the importer"""

    def run(self) -> None:
        from bidnerf_core.devices import working_device
        from bidnerf_core.maps import ImportOptions, import_map
        from bidnerf_core.results import read_pose

        require("--scale", self.scale, LEAST_SCALE)
        check_folder(self.out, (self.file, self.photos), may_be_map=True)
        working_device(self.device)
        pose = None
        if self.T_world_file is not None:
            with wrong_usage():
                pose = read_pose(self.T_world_file)
        options = ImportOptions(
            self.images, self.landmark_features, self.device, self.overwrite, self.as_, self.scale, pose
        )
        with working():
            import_map(
                self.file,
                self.out,
                self.config,
                photos=self.photos,
                bake=not self.no_bake,
                options=options,
            )


def run(arguments: list[str]) -> None:
    parse("import", Import, arguments).run()
