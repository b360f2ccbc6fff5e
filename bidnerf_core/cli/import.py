"""``bidnerf import``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from bidnerf_core.cli.options import MapOptions, wrong_usage
from bidnerf_core.cli.output import check_folder
from bidnerf_core.cli.parser import Option, Settings, Without
from bidnerf_core.cli.progress import working
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError
from bidnerf_core.settings import Above


def _importer_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    """Return the default settings of the importer that the arguments select, or None if they select none."""
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
class WorldOptions:
    """How the coordinates of the file are taken to the world."""

    scale: Annotated[float, Above(0.0), Option("FACTOR", "metres per unit of length in the file")] = 1.0
    T_world_file: Annotated[
        Path | None,
        Option(
            "POSE", "file of a pose (JSON, 4x4) that takes the scaled coordinates of the file to the world"
        ),
    ] = None


def run(
    file: Annotated[
        Path,
        Option("FILE", "file or folder of a trained field, or folder of a COLMAP project", positional=True),
    ],
    out: Annotated[Path, Option("MAP", "folder for the map")],
    as_: Annotated[
        str | None, Option("NAME", "one of 'bidnerf plugins importers'", "the one that recognizes the file")
    ] = None,
    *,
    world: WorldOptions,
    photos: Annotated[
        Path | None,
        Option(
            "DATA", "dataset whose photos, with poses in the world, provide the landmarks", "rendered images"
        ),
    ] = None,
    target: MapOptions,
    images: Annotated[
        DatasetOptions,
        Without("register_depth", "depth_unit", "masks", "mask_hides", "largest", "background"),
    ],
    config: Annotated[Any, Settings(_importer_settings, "settings of the importer")] = None,
) -> None:
    """Build a map from a field that was trained elsewhere, or from an existing COLMAP model.

    The installed importer that recognizes the file reads it. The command reports what it found: counts, what was left out, and
    the extent, since most files store no unit. With --photos, landmarks are built from photos, as in 'train'; otherwise from
    images rendered by the field, which match photos less well.

    The points and tracks of a COLMAP model (a project folder or the model in it) become the landmarks, and answers are in its
    world; its files are not changed. Such a map localizes photos without a field, which 'bidnerf train FILE --out MAP' adds.
    """
    from bidnerf_core.devices import working_device
    from bidnerf_core.maps import ImportOptions, import_map
    from bidnerf_core.results import read_pose

    check_folder(out, (file, photos), may_be_map=True)
    working_device(target.device)
    pose = None
    if world.T_world_file is not None:
        with wrong_usage():
            pose = read_pose(world.T_world_file)
    options = ImportOptions(
        images, target.landmark_features, target.device, target.overwrite, as_, world.scale, pose
    )
    with working():
        import_map(file, out, config, photos=photos, bake=not target.no_bake, options=options)
