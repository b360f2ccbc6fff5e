"""``bidnerf import``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.cli.camera_options import DatasetCamera
from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import Device, FeaturesName, Flag, option, parse, require, value_of, wrong_usage
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.datasets import DatasetOptions, open_dataset
from bidnerf_core.devices import working_device
from bidnerf_core.errors import InputError
from bidnerf_core.mapping import USUAL_FEATURES
from bidnerf_core.maps import IMPORTERS, ImportOptions, import_map, importer_of
from bidnerf_core.results import read_pose

LEAST_SCALE = 1e-9


@dataclass(frozen=True)
class NoSettings:
    """Placeholder for an importer's settings if the arguments do not determine the importer."""


def run(arguments: list[str]) -> None:
    """Parse with the options of the importer that is named, or that recognizes the file, and import."""
    default = _settings(arguments)

    def import_file(
        file: Annotated[Path, tyro.conf.Positional, option("FILE", "file or folder of a trained field")],
        out: Annotated[Path, option("MAP", "folder for the map")],
        as_: Annotated[
            str | None,
            tyro.conf.arg(
                name="as",
                metavar="NAME",
                help="one of 'bidnerf plugins importers'",
                help_behavior_hint="(default: the one that recognizes the file)",
            ),
        ] = None,
        scale: Annotated[float, option("FACTOR", "metres per unit of length in the file")] = 1.0,
        T_world_file: Annotated[
            Path | None,
            tyro.conf.arg(
                name="T-world-file",
                metavar="POSE",
                help_behavior_hint="",
                help="file of a pose (JSON, 4x4) that takes the scaled coordinates of the file to the world",
            ),
        ] = None,
        photos: Annotated[
            Path | None,
            option(
                "DATA",
                "dataset whose photos, with poses in the world, provide the landmarks",
                "rendered images",
            ),
        ] = None,
        split: Annotated[str, option("NAME", "split of the dataset")] = "train",
        camera: DatasetCamera = None,
        landmark_features: FeaturesName = USUAL_FEATURES,
        overwrite: Annotated[Flag, option(None, "replace the map in --out", "")] = False,
        no_bake: Annotated[
            Flag, option(None, "leave the surface and landmarks to 'bidnerf bake'", "")
        ] = False,
        device: Device = "cpu",
        config: Any = None,
    ) -> None:
        """Build a map from a field that was trained elsewhere.

        The installed importer that recognizes the file reads it. The command reports what it found: counts,
        what was left out, and the extent, since most files store no unit. With --photos, landmarks are built
        from photos, as in 'train'; otherwise from images rendered by the field, which match photos less well.
        """
        require("--scale", scale, LEAST_SCALE)
        check_folder(out, (file, photos), may_be_map=True)
        working_device(device)
        if T_world_file is not None:
            with wrong_usage():
                pose = read_pose(T_world_file)
        dataset = None if photos is None else open_dataset(photos, camera=camera)
        with stopped_by_ctrl_c() as cancel, Display() as progress:
            import_map(
                file,
                out,
                None if isinstance(config, NoSettings) else config,
                photos=dataset,
                bake=not no_bake,
                options=ImportOptions(
                    DatasetOptions(split=split),
                    landmark_features,
                    device,
                    overwrite,
                    as_,
                    scale,
                    None if T_world_file is None else pose,
                ),
                progress=progress,
                cancel=cancel,
            )

    parse("import", import_file, arguments, default)


def _settings(arguments: list[str]) -> Any:
    """Return the default settings of the importer, if the arguments determine it."""
    name = value_of("--as", arguments)
    if name is not None:
        with wrong_usage():
            return IMPORTERS.load(name).config_type()
    for word in arguments:
        try:
            if not word.startswith("-"):
                return importer_of(Path(word))[1].config_type()
        except InputError:  # not the file; or an invalid one, which is reported later
            continue
    return NoSettings()
