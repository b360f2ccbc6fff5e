"""``bidnerf render``."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from rich.text import Text

from bidnerf_core.cli.camera_options import (
    DatasetCamera,
    DatasetDepthUnit,
    RegisterDepth,
    depth_registration,
)
from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import DataFolder, Flag, MapFolder, Names, option, parse
from bidnerf_core.cli.output import console, read_views, say, show
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError, printable
from bidnerf_core.fields import RenderedImage
from bidnerf_core.frames import View
from bidnerf_core.geometry import symbol
from bidnerf_core.io import output_folder, png_bytes, write_file
from bidnerf_core.maps import Map, RenderingScores, load_map, rendering_scores

DEEPEST = 65.535  # largest depth in metres that a 16-bit image in millimetres can hold


def run(arguments: list[str]) -> None:
    parse("render", _render, arguments)


def _render(
    map: MapFolder,
    data: DataFolder,
    out: Annotated[Path, option("DIR", "folder for the images")],
    split: Annotated[str, option("NAME", "split of the dataset; all: every image")] = "test",
    frame: Annotated[Names, option("NAME...", "render only these frames", "all of the split")] = (),
    camera: DatasetCamera = None,
    register_depth: RegisterDepth = None,
    depth_unit: DatasetDepthUnit = None,
    level: Annotated[
        int | None, option("N", "level of detail, 0 the coarsest", "the field itself, the finest")
    ] = None,
    overwrite: Annotated[Flag, option(None, "replace images in --out", "")] = False,
) -> None:
    """Render a map from the poses of a dataset.

    Writes NAME.png (8-bit RGB) and NAME.depth.png (16-bit, planar z in mm, 0 where rays hit nothing) per
    frame into --out, and prints PSNR and depth error against the dataset's images.
    """
    check_folder(out, (map, data))
    with output_folder(out, overwrite):
        scene = load_map(map)
        names = [name for group in frame for name in group]
        registration = depth_registration(register_depth)
        dataset = open_dataset(
            data, scene.bounds.background, camera=camera, register_depth=registration, depth_unit=depth_unit
        )
        views = read_views(dataset, split, names or None)
        _check_file_names([view.frame.name for view in views])
        _render_views(scene, level, views, out)


def _check_file_names(names: Sequence[str]) -> None:
    """Raise ``InputError`` if one frame's colour image would have the same name as another's depth image."""
    for name in {f"{name}.depth" for name in names} & set(names):
        raise InputError(
            f"frame {name!r} would overwrite the depth of {name.removesuffix('.depth')!r}; render them one"
            " by one with --frame, into different folders"
        )


def _render_views(scene: Map, level: int | None, views: Sequence[View], out: Path) -> None:
    scores = []
    with console.status("") as status:
        for number, view in enumerate(views):
            status.update(Text(printable(f"rendering {number + 1}/{len(views)}: {view.frame.name}")))
            image = scene.render(view, level)
            write_images(out, view.frame.name, image)
            scores.append(rendering_scores(image, view.frame, scene.unit))
            show(f"{view.frame.name}  {scores[-1]}")
    errors = torch.cat([score.depth_errors for score in scores])
    mean = RenderingScores(statistics.fmean(score.psnr for score in scores), errors)
    error = "-" if mean.depth_error is None else f"{mean.depth_error:.4f}"
    show(
        f"mean of {len(scores)}: PSNR {mean.psnr:.2f} dB; median depth error over all pixels {error} {symbol(scene.unit)}"
    )


def write_images(out: Path, name: str, image: RenderedImage) -> None:
    """Write ``NAME.png`` and ``NAME.depth.png``."""
    write_file(out / f"{name}.png", png_bytes((image.rgb * 255).round().to(torch.uint8).numpy()))
    if float(image.depth.max()) > DEEPEST:
        say(
            f"{name}: depth beyond {DEEPEST} units does not fit a 16-bit image in steps of 0.001 and is"
            " clipped"
        )
    millimetres = (image.depth.clamp(0, DEEPEST) * 1000).round().numpy().astype(np.uint16)
    write_file(out / f"{name}.depth.png", png_bytes(millimetres))
