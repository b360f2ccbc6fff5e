"""A dataset of a scene that exists only as a map, such as weights trained by others.

    bidnerf render MAP DATA --split train --out RENDERS/train
    bidnerf render MAP DATA --split test --out RENDERS/test
    python benchmarks/rendered_scene.py RENDERS DATA --out FOLDER

Takes what ``bidnerf render`` wrote for the poses of ``DATA``, and writes a folder of ``transforms_SPLIT.json``, images with an
alpha channel (0 where the map has no depth) and depth, which can be used for training and localization like any other dataset.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import _lab
import imageio.v3 as iio
import torch

from bidnerf_core.datasets import open_dataset, write_transforms
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View

WHITE = (1.0, 1.0, 1.0)


def rendered(view: View, folder: Path) -> View:
    """Return a view with the colours and the depth in ``folder`` instead of its own."""
    name = view.frame.name
    try:
        rgb = torch.from_numpy(iio.imread(folder / f"{name}.png")).float() / 255
        depth = torch.from_numpy(iio.imread(folder / f"{name}.depth.png").astype("int32")).float() / 1000
    except OSError as error:
        raise InputError(f"{folder}, frame {name}: {error}; expected what 'bidnerf render' wrote") from error
    return replace(
        view, frame=replace(view.frame, rgb=rgb, depth=depth, alpha=(depth > 0).float(), hidden=None)
    )


def main() -> None:
    parser = _lab.parser(__doc__, named=False)
    parser.add_argument("renders", type=Path, help="folder with a folder of renderings for each split")
    parser.add_argument("data", type=Path, help="dataset whose poses were rendered")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    dataset = open_dataset(given.data, WHITE)
    splits = [folder.name for folder in sorted(given.renders.glob("*")) if folder.is_dir()]
    if not splits:
        parser.error(f"{given.renders}: no folders, expected one for each split")
    views = {
        split: [rendered(view, given.renders / split) for view in dataset.views(split)] for split in splits
    }
    write_transforms(given.out, views, WHITE)
    print(f"{given.out}: " + ", ".join(f"{len(part)} {split}" for split, part in views.items()))


if __name__ == "__main__":
    main()
