"""``bidnerf render``."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.options import TEST_IMAGES, MapFolder, Names
from bidnerf_core.cli.output import check_folder, say, show
from bidnerf_core.cli.parser import Flag, Option, Without
from bidnerf_core.cli.progress import displayed
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError
from bidnerf_core.progress import counter

if TYPE_CHECKING:
    from bidnerf_core.fields import RenderedImage
    from bidnerf_core.frames import View
    from bidnerf_core.maps import Map


def run(
    map: MapFolder,
    data: Annotated[Path, Option("DATA", "folder of a dataset, or a .r3d file", positional=True)],
    out: Annotated[Path, Option("DIR", "folder for the images")],
    frame: Annotated[Names, Option("NAME...", "render only these frames", "all of the split")] = (),
    level: Annotated[
        int | None, Option("N", "level of detail, 0 the coarsest", "the field itself, the finest")
    ] = None,
    overwrite: Annotated[Flag, Option(None, "replace images in --out")] = False,
    images: Annotated[DatasetOptions, Without("masks", "mask_hides", "largest", "background")] = TEST_IMAGES,
) -> None:
    """Render a map from the poses of a dataset.

    Writes NAME.png (8-bit RGB) and NAME.depth.png (16-bit, planar z in mm, 0 where rays hit nothing) per frame into --out, and
    prints PSNR and depth error against the dataset's images.
    """
    from bidnerf_core.io import output_folder
    from bidnerf_core.maps import load_info, load_map

    check_folder(out, (map, data))
    with output_folder(out, overwrite), displayed():
        dataset = replace(images, background=load_info(map).bounds.background).open(data)
        names = list(frame) or dataset.frame_names(images.split)
        if not names:
            raise InputError(f"split {images.split!r} has no frames", where=data)
        scene = load_map(map)
        views = dataset.views(images.split, names)
        names = [view.frame.name for view in views]
        for name in {f"{name}.depth" for name in names} & set(names):
            raise InputError(
                f"frame {name!r} would overwrite the depth of {name.removesuffix('.depth')!r}; render them one by one"
                " with --frame, into different folders"
            )
        _render_views(scene, level, views, out)


def _render_views(scene: Map, level: int | None, views: Sequence[View], out: Path) -> None:
    import torch

    from bidnerf_core.geometry import symbol
    from bidnerf_core.maps import RenderingScores, rendering_scores

    scores, count = [], counter("rendering", "images")
    for number, view in enumerate(views):
        image = scene.render(view, level)
        write_images(out, view.frame.name, image)
        scores.append(rendering_scores(image, view.frame, scene.unit))
        show(f"{view.frame.name}  {scores[-1]}")
        count(number + 1, len(views))
    errors = torch.cat([score.depth_errors for score in scores])
    mean = RenderingScores(statistics.fmean(score.psnr for score in scores), errors, scene.unit)
    error = "-" if mean.depth_error is None else f"{mean.depth_error:.4f}"
    show(
        f"mean of {len(scores)}: PSNR {mean.psnr:.2f} dB; median depth error over all pixels {error} {symbol(scene.unit)}"
    )


def write_images(out: Path, name: str, image: RenderedImage) -> None:
    """Write ``NAME.png`` and ``NAME.depth.png``."""
    import numpy as np
    import torch

    from bidnerf_core.io import png_bytes, write_file

    write_file(out / f"{name}.png", png_bytes((image.rgb * 255).round().to(torch.uint8).numpy()))
    millimetres = (image.depth * 1000).round().numpy()
    deepest = np.iinfo(np.uint16).max
    if millimetres.max() > deepest:
        say(
            f"{name}: depth beyond {deepest / 1000} units does not fit a 16-bit image in steps of 0.001 and is clipped"
        )
    depth = millimetres.clip(0, deepest).astype(np.uint16)
    write_file(out / f"{name}.depth.png", png_bytes(depth))
