"""``bidnerf render``."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Annotated

import imageio.v3 as iio
import numpy as np
import torch
import tyro
from kornia.metrics import psnr

from bidnerf_core.cli.common import check_free, console, make_folder, parse, read_views, say
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.field import levels
from bidnerf_core.frames import Frame
from bidnerf_core.rendering import RenderedImage, render_image
from bidnerf_core.storage import load_map

DEEPEST = 65.535  # metres in a 16-bit image of millimetres


def run(arguments: list[str]) -> None:
    parse("render", render, arguments)


def render(
    map: tyro.conf.Positional[Path],
    data: tyro.conf.Positional[Path],
    out: Path,
    split: str = "test",
    frame: Annotated[tuple[str, ...], tyro.conf.arg(help="names of frames; default: all of the split")] = (),
    level: Annotated[
        int | None, tyro.conf.arg(help="level of detail, 0 the coarsest; default: the field itself")
    ] = None,
    overwrite: Annotated[bool, tyro.conf.arg(help="replace images in --out")] = False,
) -> None:
    """Render the map in folder MAP from the poses of the dataset in folder DATA.

    Writes NAME.png (8-bit RGB) and NAME.depth.png (16-bit, planar z in mm, 0 where nothing was met) per frame into --out,
    and prints PSNR and depth error against the dataset's images.
    """
    check_free(out, overwrite)
    stored = load_map(map)
    offered = levels(stored.field)
    if level is not None and not 0 <= level < len(offered):
        raise InputError(f"{map}: no level {level}, expected 0 to {len(offered) - 1}")
    field = stored.field if level is None else offered[level]
    views = read_views(open_dataset(data, stored.bounds.background), split, frame or None)
    make_folder(out)
    rows = []
    with console.status("") as status:
        for number, view in enumerate(views):
            status.update(f"rendering {number + 1}/{len(views)}: {view.frame.name}")
            image = render_image(field, view.frame.intrinsics, view.T_ref_camera, stored.bounds)
            write_images(out, view.frame.name, image)
            rows.append((view.frame.name, *_scores(image, view.frame)))
            print(
                f"{rows[-1][0]}  PSNR {rows[-1][1]:.2f} dB  depth error {_metres(rows[-1][2])} m"
            )
    errors = torch.cat([row[3] for row in rows])
    median = float(errors.median()) if len(errors) else None
    print(f"mean of {len(rows)}: PSNR {statistics.fmean(row[1] for row in rows):.2f} dB", end="")
    print(f"; median depth error over all pixels {_metres(median)} m")


def write_images(out: Path, name: str, image: RenderedImage) -> None:
    """``NAME.png`` and ``NAME.depth.png``."""
    iio.imwrite(out / f"{name}.png", (image.rgb * 255).round().to(torch.uint8).numpy())
    if float(image.depth.max()) > DEEPEST:
        say(f"{name}: depth beyond {DEEPEST} m does not fit a 16-bit image of millimetres and is cut off")
    millimetres = (image.depth.clamp(0, DEEPEST) * 1000).round().numpy().astype(np.uint16)
    iio.imwrite(out / f"{name}.depth.png", millimetres)


def _scores(image: RenderedImage, frame: Frame) -> tuple[float, float | None, torch.Tensor]:
    """PSNR, median absolute depth error where depth was measured, and those errors."""
    quality = float(psnr(image.rgb, frame.rgb, 1.0))
    if frame.depth is None or not frame.has_depth:
        return quality, None, torch.zeros(0)
    errors = (image.depth - frame.depth).abs()[frame.depth > 0]
    return quality, float(errors.median()), errors


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
