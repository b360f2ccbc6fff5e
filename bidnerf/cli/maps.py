"""The commands that create, read or change a map: ``bidnerf info``, ``render``, ``export``, ``scale``, ``bake`` and others."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bidnerf.cli.options import (
    TEST_IMAGES,
    BakeSettings,
    CameraOptions,
    ColourImages,
    Device,
    First,
    FrameNames,
    Json,
    MapFolder,
    MappedImages,
    NewMap,
    Overwrite,
    PhotoCamera,
    RunOptions,
    WholeImages,
    existing,
    installed,
    refuse,
    require_device,
    require_one,
)
from bidnerf.cli.output import check_folder, check_output, print_result, say
from bidnerf.cli.parameters import Flag, Group, Option, SettingsGroup, Without
from bidnerf.cli.running import display_progress, interruptible_work
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.progress import report_each
from bidnerf_core.settings import EXPERT, Above, WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.datasets import Capture
    from bidnerf_core.fields import RenderedImage
    from bidnerf_core.frames import View
    from bidnerf_core.maps import Map


def run_info(
    map: MapFolder,
    json: Json = False,
    plot: Annotated[Path | None, Option("FILE", "draw the capture from above to this .png file")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Describe a map and the photos it was built from.

    The whole map is loaded, so that damage is detected.
    """
    if plot is not None:
        check_output(plot, (), overwrite, (".png",))
    from bidnerf.results import draw_capture, require_matplotlib
    from bidnerf_core.maps import load_map

    if plot is not None:
        require_matplotlib()

    scene = load_map(map)
    if plot is not None:
        if scene.capture is None:
            raise InputError(
                "has no record of its photos to draw; 'bidnerf bake MAP --data DATA' creates one", where=map
            )
        draw_capture(scene.capture, scene.landmarks, plot, scene.unit)
        say(f"{plot}: written")
    summary = scene.describe()
    print_result(summary.plain(), str(summary).splitlines(), json)


def run_export(
    map: MapFolder,
    to: Annotated[
        str,
        installed("exporters"),
        Option(
            "FORMAT",
            lambda: (
                "format of the files, one of 'bidnerf plugins exporters': " + ", ".join(installed("exporters").table)
            ),
        ),
    ],
    out: Annotated[Path, Option("DIR", "folder for the files")],
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Export a map's surface, landmarks and cameras for other software.

    The files are in the map's frame and unit.
    """
    check_folder(out, (map,))

    from bidnerf.results import export_map

    files = export_map(map, out, to, overwrite)
    sizes = {str(file): file.stat().st_size for file in files}
    print_result(sizes, [f"{file}: {size / 1e3:,.1f} kB" for file, size in sizes.items()], json)


def run_scale(
    map: MapFolder,
    distance: Annotated[
        tuple[str, str, str] | None,
        Option(
            "A B METRES",
            "true distance between two places: camera names, NAME@U,V for what a camera shows at a pixel, or X,Y,Z",
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        Option(
            "POSES.json",
            "file with the true positions of three or more of the map's cameras in metres, in any world:"
            " {NAME: [x, y, z], ...}, or poses as localize --out POSES.json writes them",
        ),
        existing("the positions of cameras"),
    ] = None,
    factor: Annotated[
        float | None, Above(0.0), Option("F", "metres per unit of the map; 1 states that its unit is the metre")
    ] = None,
    out: Annotated[
        Path | None, Option("MAP2", "leave the map unchanged and write a new one", "MAP is replaced")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Convert a map to metres.

    All of it is converted: field, bounds, surface, landmarks, capture record and anchor. Poses, covariances and errors are then in metres, so measured depth can be used. Exactly one of
    --distance, --poses and --factor is required: it gives the length of a unit.
    """
    require_one({"--distance": distance, "--poses": poses, "--factor": factor}, required=True)
    first, second, length = distance or ("", "", "1")
    try:
        metres = float(length)
    except ValueError:
        metres = math.nan
    if not 0 < metres < math.inf:
        raise UsageError(f"METRES is {length!r}", where="--distance", expected="a number, more than 0")
    if out is not None:
        check_folder(out, (map,), may_be_map=True)

    from bidnerf.results import read_positions
    from bidnerf_core.maps import factor_of_distance, factor_of_poses, load_map, map_folder

    # The map is locked before it is read, so that no other program changes it meanwhile.
    with map_folder(out or map, overwrite or out is None):
        scene = load_map(map)
        if poses is not None:
            fit = factor_of_poses(scene, read_positions(poses))
            say(f"{poses}: {fit}")
            factor = fit.factor
        elif distance is not None:
            factor = factor_of_distance(scene, first, second, metres)
        assert factor is not None
        by_its_data = scene.info.unit == "metres" and scene.info.field_frame is None
        if by_its_data and factor != 1 and out is None and not overwrite:
            raise InputError(
                f"is in metres by its data, and all its lengths would be multiplied by {factor:.6g}; write another map (`out`),"
                " or replace this one all the same (`overwrite`)",
                where=map,
            )
        stored = scene.scaled(factor).write_to(out or map)
    sides = " x ".join(f"{side:.3g}" for side in stored.bounds.size)
    text = f"{out or map}: all lengths multiplied by {factor:.6g}; the scene is now in metres, in a box of {sides}"
    print_result(stored.describe().plain(), [text], json)


def run_render(
    map: MapFolder,
    data: Annotated[Path, Option("DATA", "folder of a dataset", positional=True), existing("a dataset")],
    out: Annotated[Path, Option("DIR", "folder for the images")],
    frame: FrameNames = (),
    first: Annotated[First, EXPERT] = None,
    level: Annotated[
        int | None,
        WholeNumbers(0),
        EXPERT,
        Option("N", "level of detail, 0 the coarsest", "the field itself, the finest"),
    ] = None,
    *,
    run: RunOptions,
    images: WholeImages = TEST_IMAGES,
) -> None:
    """Render a map from the poses of a dataset.

    For each frame, NAME.png (8-bit RGB) and NAME.depth.png (16-bit, planar z in mm, 0 where rays hit nothing) are written to
    --out, and PSNR and depth error against the dataset's images are printed.
    """
    check_folder(out, (map, data))
    require_device(run.device)

    from bidnerf_core.io import output_folder
    from bidnerf_core.maps import load_info, load_map

    with output_folder(out, run.overwrite), display_progress():
        dataset = replace(images, background=load_info(map).bounds.background).open(data)
        names = list(frame) or None
        if first is not None:
            names = (names or dataset.frame_names(images.split))[:first]
        views = dataset.views(images.split, names)
        if not views:
            raise InputError(f"split {images.split!r} has no frames", where=data)
        scene, rendered = load_map(map, run.device), {view.frame.name for view in views}
        for name in {f"{name}.depth" for name in rendered} & rendered:
            raise InputError(
                f"frame {name!r} would overwrite the depth of {name.removesuffix('.depth')!r}; render them one by one"
                " with --frame, into different folders"
            )
        _render_views(scene, level, views, out, run.json)


def _render_views(scene: Map, level: int | None, views: Sequence[View], out: Path, json: bool) -> None:
    import torch

    from bidnerf_core.geometry import symbol
    from bidnerf_core.maps import RenderingScores, rendering_scores

    scores = []
    for view in report_each(views, "rendering", "images"):
        image = scene.render(view, level)
        write_images(out, view.frame.name, image)
        scores.append(rendering_scores(image, view.frame, scene.unit))
        row = {"frame": view.frame.name, "psnr": scores[-1].psnr, "depth_error": scores[-1].depth_error}
        print_result(row, [f"{view.frame.name}  {scores[-1]}"], json)
    errors = torch.cat([score.depth_errors for score in scores])
    mean = RenderingScores(statistics.fmean(score.psnr for score in scores), errors, scene.unit)
    error = "-" if mean.depth_error is None else f"{mean.depth_error:.4f}"
    text = f"mean of {len(scores)}: PSNR {mean.psnr:.2f} dB; median depth error over all pixels {error} {symbol(scene.unit)}"
    print_result({"psnr": mean.psnr, "depth_error": mean.depth_error}, [text], json)


def write_images(out: Path, name: str, image: RenderedImage) -> None:
    """Write ``NAME.png`` (8-bit RGB) and ``NAME.depth.png`` (16-bit planar z in steps of 0.001 map units) to ``out``."""
    import numpy as np
    import torch

    from bidnerf_core.io import png_bytes, write_file

    write_file(out / f"{name}.png", png_bytes((image.rgb * 255).round().to(torch.uint8).numpy()))
    millimetres = (image.depth * 1000).round().numpy()
    deepest = np.iinfo(np.uint16).max
    if millimetres.max() > deepest:
        say(f"{name}: depth beyond {deepest / 1000} units does not fit a 16-bit image in steps of 0.001 and is clipped")
    write_file(out / f"{name}.depth.png", png_bytes(millimetres.clip(0, deepest).astype(np.uint16)))


def run_bake(
    map: MapFolder,
    data: Annotated[
        Path | None,
        Option(
            "DATA",
            "dataset whose photos give landmarks and whose measured depth gives the surface",
            "rendered images only",
        ),
        existing("a dataset"),
    ] = None,
    rendered_landmarks: Annotated[
        Flag, EXPERT, Option(None, "replace landmarks of photos by landmarks of rendered images")
    ] = False,
    landmark_features: Annotated[
        str | None,
        EXPERT,
        installed("features"),
        Option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'", "the map's"),
    ] = None,
    device: Device = "cpu",
    json: Json = False,
    *,
    images: MappedImages,
    config: BakeSettings = None,
) -> None:
    """Find the surface and the landmarks of a map, and store them in it.

    Depth is rendered from the poses of the training images; what several of these views agree on is kept. With --data,
    measured depth is used directly where views have it, and landmarks are built from the photos; without --data they are built
    from images rendered by the field, which are only as sharp as the field. Landmarks from photos are kept unless --data gives
    new photos or --rendered-landmarks is set.
    """
    if rendered_landmarks:
        refuse({"--data": data}, "gives photos, but --rendered-landmarks uses none;", expected="only one of them")
    if data is None:
        refuse({"--masks": images.masks}, "was given without --data", expected="the dataset that they belong to")
    require_device(device)

    from bidnerf_core.maps import load_map

    # The baked parts may be damaged, so they are not loaded here.
    scene = load_map(map, device, baked=False)
    with interruptible_work(kept=f"stopped; {map} keeps the parts that were finished"):
        scene = scene.bake(
            data, config(), images=images, rendered_landmarks=rendered_landmarks, features=landmark_features
        )
    print_result(scene.describe().plain(), (), json)


def run_extend(
    map: MapFolder,
    new: Annotated[
        Path,
        Option("NEW", "photo, folder of photos, or dataset (whose own poses are ignored)", positional=True),
        existing("photos or a dataset"),
    ],
    data: Annotated[
        Path | None,
        Option("DATA", "dataset that the map was built from", "none: images rendered by the field replace it"),
        existing("a dataset"),
    ] = None,
    steps: Annotated[
        int | None,
        WholeNumbers(1),
        EXPERT,
        Option("N", "training steps", "in proportion to the new photos, at least a quarter of the usual number"),
    ] = None,
    *,
    run: Annotated[RunOptions, Without("overwrite")],
    camera: PhotoCamera,
    images: WholeImages,
    config: BakeSettings = None,
) -> None:
    """Add photos of the same scene to a map.

    The photos are localized, training of the field continues with them, and the landmarks and the surface are updated. Photos are left out if they cannot be read, if they are not localized in the map, or if the map was built from them. The map
    is replaced only when everything is done: after Ctrl-C, or a kill, it is unchanged, and localizers may keep reading it
    meanwhile.
    """
    from bidnerf_core.datasets import Photos, find_reader, photo_files
    from bidnerf_core.maps import extend, load_info

    require_device(run.device)
    info = load_info(map)
    if camera != CameraOptions():
        images = replace(images, camera=camera.source(images.camera))
    of_depth = {"--register-depth": images.register_depth, "--depth-unit": images.depth_unit}
    is_stated = any(value is not None for value in (images.camera, *of_depth.values()))
    paths = [new] if data is None else [new, data]
    datasets = [path for path in paths if is_stated and find_reader(path) is not None]
    if not datasets:
        refuse(of_depth, f"is for a dataset, but {new} is none; leave it out")
    options = replace(images, background=info.bounds.background)
    of_map = options if new in datasets else replace(options, camera=None)  # which is then that of the photos
    opened: dict[Path, Path | Capture] = {path: (of_map if path == data else options).open(path) for path in datasets}
    if images.camera is not None and new not in datasets:
        opened[new] = Photos(photo_files([new]), options).capture
    known = None if data is None else opened.get(data, data)
    with interruptible_work(kept=f"stopped; {map} is unchanged"):
        scene = extend(
            map, opened.get(new, new), known, split=images.split, steps=steps, config=config(), device=run.device
        )
    added, total = len(scene.info.cameras) - len(info.cameras), len(scene.info.cameras)
    text = f"{map}: {amount(added, 'photo')} added, {amount(total, 'image')} in all"
    print_result(scene.describe().plain(), [text], run.json)


def _importer_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    """Return the default settings of the importer that the arguments select, or None if they select none."""
    from bidnerf_core.maps import IMPORTERS, importer_of

    if values["importer"] is not None:
        return IMPORTERS.load(values["importer"]).config_type()
    for word in words:
        try:
            if not word.startswith("-"):
                return importer_of(Path(word))[1].config_type()
        except InputError:  # not the file to import, or an invalid file, which is reported later
            continue
    return None


@dataclass(frozen=True)
class WorldOptions:
    """How the coordinates of the file are taken to the world."""

    scale: Annotated[float, Above(0.0), Option("FACTOR", "metres per unit of length in the file")] = 1.0
    T_world_file: Annotated[
        Path | None,
        EXPERT,
        existing("a pose file"),
        Option("POSE.json", "file of a pose (JSON, 4x4) that takes the scaled coordinates of the file to the world"),
    ] = None


def run_import(
    file: Annotated[
        Path,
        Option("FILE", "file or folder of a trained field, or folder of a COLMAP project", positional=True),
        existing("a trained field or a COLMAP model"),
    ],
    out: Annotated[Path, Option("MAP", "folder for the map")],
    importer: Annotated[
        str | None,
        installed("importers"),
        Option("NAME", "importer to use, one of 'bidnerf plugins importers'", "the one that recognizes the file"),
    ] = None,
    *,
    world: Annotated[WorldOptions, Group("world", "How the coordinates of the file become those of the map.")],
    photos: Annotated[
        Path | None,
        Option("DATA", "dataset whose photos, with poses in the world, provide the landmarks", "rendered images"),
        existing("a dataset"),
    ] = None,
    target: NewMap,
    images: ColourImages,
    config: Annotated[
        Any,
        SettingsGroup(
            "settings of the importer named by --importer",
            "What the importer cannot find in the file.",
            _importer_settings,
            "importers",
        ),
    ] = None,
) -> None:
    """Build a map from a COLMAP model, or a field trained elsewhere.

    The installed importer that recognizes the file reads it. The command reports what it found: counts, what was left out, and
    the extent, since most files store no unit. With --photos, landmarks are built from photos, as in 'train'; otherwise from
    images rendered by the field, which match photos less well.

    The points and tracks of a COLMAP model (a project folder or the model in it) become the landmarks, and answers are in its
    world; its files are not changed. Such a map localizes photos without a field, which 'bidnerf train FILE --out MAP' adds.
    """
    check_folder(out, (file, photos), may_be_map=True)
    require_device(target.device)

    from bidnerf.results import read_pose
    from bidnerf_core.maps import ImportOptions, import_map

    pose = None if world.T_world_file is None else read_pose(world.T_world_file)
    options = ImportOptions(
        images, target.landmark_features, target.device, target.overwrite, importer, world.scale, pose
    )
    with interruptible_work(kept=f"stopped; {out} was not written"):
        scene = import_map(file, out, config(), photos=photos, bake=not target.no_bake, options=options)
    print_result(scene.describe().plain(), (), target.json)
